from __future__ import annotations

import dataclasses

import pytest

from smsr.errors import InvalidOption, UnknownOption
from smsr.options import Options, describe, parse
from worker.options import JobOptions


def test_job_options_are_solver_options_and_more() -> None:
    names = {option.name for option in describe(JobOptions)}
    assert {option.name for option in describe(Options)} < names
    assert {"measurements_key", "ground_truth_frame", "time_limit"} <= names


def test_the_solver_gets_its_own() -> None:
    options = parse(JobOptions, {"preset": "paper", "time_limit": 5})
    assert options.solver_options() == parse(Options, {"preset": "paper"})


def test_options_come_back_from_a_record() -> None:
    options = parse(JobOptions, {"faces_key": "tri", "time_limit": 2.5})
    assert parse(JobOptions, dataclasses.asdict(options)) == options


def test_wrong_options_are_refused() -> None:
    with pytest.raises(InvalidOption):
        parse(JobOptions, {"time_limit": 0.5})
    with pytest.raises(UnknownOption):
        parse(JobOptions, {"timelimit": 5})
