"""Digests of request bodies: Content-Digest and Repr-Digest (RFC 9530), and tus checksums."""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from service.problems import Problem

if TYPE_CHECKING:
    from collections.abc import Sequence

    from starlette.datastructures import Headers

FIELDS = ("content-digest", "repr-digest")
ALGORITHMS = {"sha-256": "sha256", "sha-512": "sha512"}
"""Of RFC 9530, those that are not deprecated."""
CHECKSUMS = ("sha1", "sha256", "sha512")
"""Of tus, which requires sha1; md5 and crc32 are not taken."""

_WANTED = "sha-256=10, sha-512=5"
_MEMBER = re.compile(r"\s*([a-z*][a-z0-9_.*-]*)=:([A-Za-z0-9+/=]*):\s*(?:;[^,]*)?")


@dataclass(frozen=True, slots=True)
class _Expected:
    """One digest that a body must have."""

    field: str
    algorithm: str
    digest: bytes
    hash: hashlib._Hash


class BodyDigests:
    """The digests that a client declared for a body.

    A request has no Range and no Content-Encoding here, so that its representation is its content:
    both fields of RFC 9530 are about the same bytes (its appendix A says so for PATCH as well).

    Parameters
    ----------
    expected : sequence of _Expected
    """

    def __init__(self, expected: Sequence[_Expected]) -> None:
        self._expected = expected

    def __bool__(self) -> bool:
        return bool(self._expected)

    @classmethod
    def of(cls, headers: Headers, *, tus: bool = False) -> BodyDigests:
        """Read the fields of a request.

        Parameters
        ----------
        headers : Headers
        tus : bool
            Whether ``Upload-Checksum`` counts too.

        Raises
        ------
        Problem
            A field cannot be read, or has no algorithm that is supported.
        """
        expected = [e for name in FIELDS if name in headers for e in _read(name, headers)]
        if tus and "upload-checksum" in headers:
            expected.append(_checksum(headers["upload-checksum"]))
        return cls(expected)

    def update(self, data: bytes) -> None:
        """Take the next bytes of the body."""
        for expected in self._expected:
            expected.hash.update(data)

    def verify(self) -> None:
        """Refuse a body, now whole, that is not what the client declared.

        Raises
        ------
        Problem
        """
        for expected in self._expected:
            found = expected.hash.digest()
            if not hmac.compare_digest(found, expected.digest):
                tus = expected.field == "Upload-Checksum"
                raise Problem(
                    "checksum-mismatch" if tus else "digest-mismatch",
                    f"The {expected.algorithm} of the body is not that of {expected.field}. "
                    "Nothing of it was kept.",
                    algorithm=expected.algorithm,
                    received=base64.b64encode(found).decode(),
                )


def _read(name: str, headers: Headers) -> list[_Expected]:
    """Parse a dictionary of byte sequences (RFC 9651), and keep what is supported."""
    title = name.title()
    members: dict[str, str] = {}
    for member in ",".join(headers.getlist(name)).split(","):
        found = _MEMBER.fullmatch(member)
        if found is None:
            raise Problem(
                "malformed-digest",
                f"{title} is read as sha-256=:BASE64:, not as {member.strip()[:80]!r}.",
                headers={f"Want-{title}": _WANTED},
            )
        members[found[1]] = found[2]
    supported = [
        _Expected(title, algorithm, _decoded(title, text, known), hashlib.new(known))
        for algorithm, text in members.items()
        if (known := ALGORITHMS.get(algorithm)) is not None
    ]
    if not supported:
        raise Problem(
            "malformed-digest",
            f"{title} has no digest that is verified here; there are {', '.join(ALGORITHMS)}.",
            headers={f"Want-{title}": _WANTED},
        )
    return supported


def _checksum(text: str) -> _Expected:
    algorithm, _, value = text.strip().partition(" ")
    if algorithm not in CHECKSUMS:
        raise Problem(
            "malformed-digest",
            f"Upload-Checksum takes {', '.join(CHECKSUMS)}, not {algorithm[:40]!r}.",
        )
    digest = _decoded("Upload-Checksum", value.strip(), algorithm)
    return _Expected("Upload-Checksum", algorithm, digest, hashlib.new(algorithm))


def _decoded(field: str, text: str, algorithm: str) -> bytes:
    try:
        digest = base64.b64decode(text, validate=True)
    except binascii.Error:
        digest = b""
    if len(digest) != hashlib.new(algorithm).digest_size:
        raise Problem("malformed-digest", f"{field}: {text[:120]!r} is no base64 of {algorithm}.")
    return digest
