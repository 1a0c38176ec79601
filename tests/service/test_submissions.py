"""The settings of a job: what is taken, what is refused, and how both forms agree."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from service.problems import Problem
from service.submissions import SETTINGS, JobSettings, read_settings, settings_schema
from tests.service.conftest import problem
from worker.settings import DAY, Settings

if TYPE_CHECKING:
    import httpx

    from tests.service.conftest import Api


Parts = dict[str, tuple[str | None, bytes | str]]


def operator(**more: Any) -> Settings:
    return Settings(redis_url="redis://localhost", **more)


def test_nothing_given() -> None:
    settings = read_settings({}, operator())
    assert settings == JobSettings()
    assert (settings.batch, settings.priority, settings.ttl) == (None, "normal", None)


def test_texts_and_json_values_say_the_same() -> None:
    values = {"batch": "walk-17", "priority": "high", "ttl": 60.5, "reuse": False}
    texts = {"batch": "walk-17", "priority": "high", "ttl": "60.5", "reuse": "false"}
    assert read_settings(values, operator()) == read_settings(texts, operator(), texts=True)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("batch", ""),
        ("batch", "a" * 65),
        ("batch", "../up"),
        ("batch", ".hidden"),
        ("batch", "a/b"),
        ("batch", "a\n"),
        ("batch", "é"),
        ("batch", 7),
        ("priority", "urgent"),
        ("priority", "High"),
        ("ttl", -1),
        ("ttl", float("nan")),
        ("ttl", float("inf")),
        ("ttl", "60"),
        ("ttl", True),
        ("reuse", "false"),
        ("reuse", 0),
        ("colour", "red"),
    ],
)
def test_what_is_refused(name: str, value: object) -> None:
    with pytest.raises(Problem) as refused:
        read_settings({"reuse": True, name: value}, operator())
    assert refused.value.type.slug == "invalid-setting"
    assert refused.value.context["setting"] == name


@pytest.mark.parametrize("text", ["", "soon", "nan", "1e999", "-0.1", "0x10"])
def test_a_time_to_live_that_is_no_number(text: str) -> None:
    with pytest.raises(Problem):
        read_settings({"ttl": text}, operator(), texts=True)


@pytest.mark.parametrize(
    ("most", "usual", "ttl", "allowed"),
    [
        (10 * DAY, DAY, 10 * DAY, True),
        (10 * DAY, DAY, 10 * DAY + 1, False),
        (10 * DAY, DAY, 0, False),
        (10 * DAY, 20 * DAY, 20 * DAY, True),
        (0, DAY, 0, True),
        (0, DAY, 1e9, True),
        (10 * DAY, 0, 0, True),
    ],
)
def test_the_operator_bounds_the_time_to_live(
    most: float, usual: float, ttl: float, allowed: bool
) -> None:
    bounds = operator(max_ttl_seconds=most, result_ttl_seconds=usual)
    if allowed:
        assert read_settings({"ttl": ttl}, bounds).ttl == ttl
    else:
        with pytest.raises(Problem, match="at most"):
            read_settings({"ttl": ttl}, bounds)


def test_the_schema_names_every_setting() -> None:
    schema = settings_schema()
    assert tuple(schema) == SETTINGS
    for described in schema.values():
        assert described["description"]
        assert described["type"] in ("string", "number", "boolean")


@pytest.mark.parametrize(
    ("data", "setting"),
    [
        ({"batch": "a b"}, "batch"),
        ({"priority": "x" * 5000}, "priority"),
        ({"ttl": "1e12"}, "ttl"),
        ({"reuse": "perhaps"}, "reuse"),
    ],
)
def test_a_wrong_setting_leaves_nothing(
    api: Api, client: httpx.Client, tracks: bytes, data: dict[str, str], setting: str
) -> None:
    before = api.left_behind()
    text: Parts = {name: (None, value) for name, value in data.items()}
    file: Parts = {"measurements": ("w.npy", tracks)}
    for parts in ({**text, **file}, {**file, **text}):
        answer = client.post("/v1/jobs", files=parts)
        refusal = problem(answer, "invalid-setting", 422)
        assert refusal["setting"] == setting
    assert api.left_behind() <= before


def test_a_setting_that_is_given_twice(client: httpx.Client, tracks: bytes) -> None:
    answer = client.post(
        "/v1/jobs", files={"measurements": ("w.npy", tracks)}, data={"batch": ["a", "b"]}
    )
    problem(answer, "duplicate-part", 422)
