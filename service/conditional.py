"""Conditional requests and ranges (RFC 9110, sections 13 and 14), apart from what is served."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass
from email.utils import formatdate, parsedate_to_datetime
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from starlette.datastructures import Headers

_TAG = re.compile(r'(?:W/)?"[\x21\x23-\x7e\x80-\xff]*"')
_INT_RANGE = re.compile(r"([0-9]{1,30})-([0-9]{0,30})")
_SUFFIX_RANGE = re.compile(r"-([0-9]{1,30})")


class PreconditionFailed(Exception):
    """The client wants an answer only for a version that this is not; 412."""


class NotModified(Exception):
    """The client has this version already; 304."""


class Unsatisfiable(Exception):
    """Nothing of the wanted range exists; 416."""


@dataclass(frozen=True, slots=True)
class Validators:
    """What tells versions of a file apart.

    Attributes
    ----------
    tag : str
        Strong entity tag, without its quotes: equal tags mean equal bytes.
    modified : float
        Unix seconds; clients see whole seconds.
    dated : bool
        Whether only one version of the file bears the second of `modified`, so that the date is a
        strong validator too (section 8.8.2.2).
    """

    tag: str
    modified: float
    dated: bool = False

    @property
    def headers(self) -> dict[str, str]:
        """The header fields that carry them."""
        # Section 8.8.2.1: never in the future, whatever another machine's clock says.
        modified = formatdate(min(self.modified, time.time()), usegmt=True)
        return {"ETag": f'"{self.tag}"', "Last-Modified": modified}

    def check(self, headers: Headers) -> None:
        """Evaluate the preconditions of a GET or HEAD in the order of section 13.2.2.

        Raises
        ------
        PreconditionFailed, NotModified
        """
        if (wanted := _field(headers, "if-match")) is not None:
            # Strong comparison: a weak tag never matches.
            if wanted != "*" and f'"{self.tag}"' not in _TAG.findall(wanted):
                raise PreconditionFailed
        elif (date := _date(_field(headers, "if-unmodified-since"))) is not None and (
            int(self.modified) > date
        ):
            raise PreconditionFailed
        if (known := _field(headers, "if-none-match")) is not None:
            tags = {tag.removeprefix("W/") for tag in _TAG.findall(known)}
            if known == "*" or f'"{self.tag}"' in tags:
                raise NotModified
        elif (date := _date(_field(headers, "if-modified-since"))) is not None and (
            int(self.modified) <= date
        ):
            raise NotModified

    def allow_range(self, headers: Headers) -> bool:
        """Whether If-Range, where there is one, lets the range stand (section 13.1.5)."""
        condition = _field(headers, "if-range")
        if condition is None or condition == f'"{self.tag}"':
            return True
        return self.dated and _date(condition) == int(self.modified)


def wanted_range(headers: Headers, size: int) -> range | None:
    """Return the positions of the bytes that a request wants, None for the whole file.

    What is malformed, in another unit or of several ranges is ignored, as section 14.2 allows: a
    client that wants many parts asks for them one by one.

    Raises
    ------
    Unsatisfiable
    """
    unit, _, ranges = (_field(headers, "range") or "").partition("=")
    if unit.strip().lower() != "bytes":
        return None
    ranges = ranges.strip()
    if found := _INT_RANGE.fullmatch(ranges):
        start = int(found[1])
        stop = min(int(found[2]) + 1, size) if found[2] else size
        if found[2] and int(found[2]) < start:
            return None
        if start >= size:
            raise Unsatisfiable
        return range(start, stop)
    if found := _SUFFIX_RANGE.fullmatch(ranges):
        if int(found[1]) == 0:
            raise Unsatisfiable
        return range(max(size - int(found[1]), 0), size) if size else None
    return None


def _field(headers: Headers, name: str) -> str | None:
    """Return a field, its lines joined (section 5.3)."""
    lines = headers.getlist(name)
    return ", ".join(lines).strip() if lines else None


def _date(value: str | None) -> int | None:
    """Return an HTTP date in Unix seconds; what is no date counts as not sent."""
    if value is None:
        return None
    try:
        return int(parsedate_to_datetime(value).timestamp())
    except (ValueError, OverflowError, TypeError):
        return None
