from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from starlette.datastructures import Headers

from service.conditional import (
    NotModified,
    PreconditionFailed,
    Unsatisfiable,
    Validators,
    wanted_range,
)

NOON = 1_772_366_400.75
DATE = "Sun, 01 Mar 2026 12:00:00 GMT"
EARLIER, LATER = "Sun, 01 Mar 2026 11:59:59 GMT", "Sun, 01 Mar 2026 12:00:01 GMT"
FILE = Validators("abc", NOON)


def headers(*lines: tuple[str, str]) -> Headers:
    return Headers(raw=[(name.lower().encode(), value.encode("latin-1")) for name, value in lines])


def test_a_file_says_its_tag_and_its_date() -> None:
    assert FILE.headers == {"ETag": '"abc"', "Last-Modified": DATE}


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("bytes=0-0", range(1)),
        ("bytes=0-", range(100)),
        ("Bytes = 5-9", range(5, 10)),
        ("bytes=90-500", range(90, 100)),
        ("bytes=-10", range(90, 100)),
        ("bytes=-500", range(100)),
        ("bytes=99-", range(99, 100)),
        ("bytes=0-99999999999999999999999", range(100)),
        ("bytes=9-5", None),
        ("bytes=0-1,5-6", None),
        ("bytes=", None),
        ("bytes=-", None),
        ("bytes=a-b", None),
        ("bytes=1-2-3", None),
        ("bytes=+1-2", None),
        ("bytes=\xb2-5", None),
        ("items=0-5", None),
        ("0-5", None),
        ("bytes=" + "9" * 5000 + "-", None),
    ],
)
def test_ranges(value: str, expected: range | None) -> None:
    assert wanted_range(headers(("Range", value)), 100) == expected


@pytest.mark.parametrize("value", ["bytes=100-", "bytes=100-200", "bytes=-0"])
def test_ranges_with_nothing_in_them(value: str) -> None:
    with pytest.raises(Unsatisfiable):
        wanted_range(headers(("Range", value)), 100)


@given(st.text(st.characters(max_codepoint=255)), st.integers(1, 1000))
def test_whatever_is_asked_for_lies_within_the_file(value: str, size: int) -> None:
    try:
        found = wanted_range(headers(("Range", f"bytes={value}")), size)
    except Unsatisfiable:
        return
    assert found is None or 0 <= found.start < found.stop <= size


@pytest.mark.parametrize(
    "line",
    [
        ("If-Match", '"abc"'),
        ("If-Match", '"x", "abc"'),
        ("If-Match", "*"),
        ("If-None-Match", '"x"'),
        ("If-None-Match", "abc"),
        ("If-Unmodified-Since", DATE),
        ("If-Unmodified-Since", "yesterday"),
        ("If-Modified-Since", EARLIER),
        ("If-Modified-Since", "Sun, 99 Mar 2026 12:00:00 GMT"),
    ],
)
def test_conditions_that_hold(line: tuple[str, str]) -> None:
    FILE.check(headers(line))


@pytest.mark.parametrize(
    "line",
    [("If-Match", '"x"'), ("If-Match", 'W/"abc"'), ("If-Unmodified-Since", EARLIER)],
)
def test_conditions_for_another_version(line: tuple[str, str]) -> None:
    with pytest.raises(PreconditionFailed):
        FILE.check(headers(line))


@pytest.mark.parametrize(
    "line",
    [
        ("If-None-Match", '"abc"'),
        ("If-None-Match", 'W/"abc"'),
        ("If-None-Match", '"x,y" , "abc"'),
        ("If-None-Match", "*"),
        ("If-Modified-Since", DATE),
        ("If-Modified-Since", LATER),
    ],
)
def test_versions_that_the_client_has(line: tuple[str, str]) -> None:
    with pytest.raises(NotModified):
        FILE.check(headers(line))


def test_tags_are_stronger_than_dates() -> None:
    FILE.check(headers(("If-None-Match", '"x"'), ("If-Modified-Since", LATER)))
    FILE.check(headers(("If-Match", '"abc"'), ("If-Unmodified-Since", EARLIER)))
    with pytest.raises(NotModified):
        FILE.check(headers(("If-None-Match", '"x"'), ("If-None-Match", '"abc"')))


@pytest.mark.parametrize(
    ("condition", "dated", "allowed"),
    [
        ('"abc"', False, True),
        ('W/"abc"', True, False),
        ('"x"', True, False),
        (DATE, True, True),
        (DATE, False, False),
        (EARLIER, True, False),
        (LATER, True, False),
        ("soon", True, False),
    ],
)
def test_a_range_of_one_version_only(condition: str, dated: bool, allowed: bool) -> None:
    file = Validators("abc", NOON, dated=dated)
    assert file.allow_range(headers(("If-Range", condition))) is allowed
    assert file.allow_range(headers())
