"""``-O name=value``: text from the command line as values of typed options."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smsr.errors import InvalidOption
from smsr.options import OptionDescription, describe

if TYPE_CHECKING:
    from collections.abc import Sequence

_BOOLEANS = {"true": True, "yes": True, "on": True, "1": True}
_BOOLEANS |= {"false": False, "no": False, "off": False, "0": False}


def read(cls: type, assignments: Sequence[str]) -> dict[str, object]:
    """Convert ``name=value`` texts by the types of an options dataclass.

    Names that do not exist and values out of range are left for `smsr.options.parse` to refuse.

    Raises
    ------
    InvalidOption
        No ``=``, or text that is no value of the option's type.
    """
    known = {what.name: what for what in describe(cls)}
    values: dict[str, object] = {}
    for assignment in assignments:
        name, equals, text = (part.strip() for part in assignment.partition("="))
        if not equals:
            raise InvalidOption(f"Write -O name=value; it was {assignment!r}.", option=name)
        name = name.replace("-", "_")
        values[name] = _convert(known[name], text) if name in known else text
    return values


def _convert(what: OptionDescription, text: str) -> object:
    if what.nullable and text.lower() in ("none", "null", ""):
        return None
    try:
        match what.type:
            case "integer":
                return int(text)
            case "number":
                return float(text)
            case "boolean":
                return _BOOLEANS[text.lower()]
            case "string":
                return text
    except (ValueError, KeyError):
        expected = "true or false" if what.type == "boolean" else f"of type {what.type}"
        raise InvalidOption(
            f"Option {what.name!r} must be {expected}; it was {text!r}.", option=what.name
        ) from None
