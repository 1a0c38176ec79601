from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import pytest

from smsr.errors import InvalidOption, UnknownOption
from smsr.options import Options, describe, option, parse


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    count: int = option(3, "How many.", minimum=1, maximum=9)
    ratio: float = option(0.5, "How much.", minimum=0)
    name: str | None = option(None, "Which.")
    mode: Literal["fast", "exact"] = option("fast", "How.")
    flag: bool = option(False, "Whether.")


def test_describe_tells_type_default_range_and_choices() -> None:
    by_name = {d.name: d for d in describe(Sample)}
    assert list(by_name) == ["count", "ratio", "name", "mode", "flag"]
    assert (by_name["count"].type, by_name["count"].minimum, by_name["count"].maximum) == (
        "integer",
        1,
        9,
    )
    assert by_name["name"].nullable
    assert not by_name["count"].nullable
    assert by_name["mode"].choices == ("fast", "exact")
    assert by_name["flag"].type == "boolean"


def test_every_solver_option_explains_itself() -> None:
    for what in describe(Options):
        assert what.help.endswith("."), what.name
        if what.choices is not None:
            assert what.default in what.choices


def test_parse_accepts_good_values_and_integers_for_numbers() -> None:
    sample = parse(Sample, {"count": 9, "ratio": 2, "name": None, "mode": "exact", "flag": True})
    assert sample == Sample(count=9, ratio=2.0, name=None, mode="exact", flag=True)
    assert isinstance(sample.ratio, float)


def test_parse_takes_numbers_of_numpy() -> None:
    values = {"count": np.int64(9), "ratio": np.float32(2.0), "flag": np.True_}
    assert parse(Sample, values) == Sample(count=9, ratio=2.0, flag=True)


@pytest.mark.parametrize(
    ("name", "value", "rule"),
    [
        ("count", 0, "between 1 and 9"),
        ("count", 10, "between 1 and 9"),
        ("count", 2.0, "type integer"),
        ("count", True, "type integer"),
        ("count", None, "type integer"),
        ("ratio", "0.5", "type number"),
        ("ratio", float("nan"), "type number"),
        ("ratio", -0.1, "at least 0;"),
        ("count", np.float64(3.0), "type integer"),
        ("count", np.timedelta64(3), "type integer"),
        ("name", 5, "type string or null"),
        ("mode", "slow", "one of fast, exact"),
        ("flag", 1, "type boolean"),
    ],
)
def test_parse_refuses_wrong_values_and_says_what_would_be_right(
    name: str, value: object, rule: str
) -> None:
    with pytest.raises(InvalidOption, match=rule) as caught:
        parse(Sample, {name: value})
    assert caught.value.context["option"] == name


def test_parse_suggests_a_near_name() -> None:
    with pytest.raises(UnknownOption, match="Did you mean 'count'"):
        parse(Sample, {"cuont": 3})
