"""The benchmarks run, and what they compare agrees."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def run(name: str, *arguments: str) -> list[list[str]]:
    """Return the words of each line that a benchmark prints."""
    answer = subprocess.run(
        [sys.executable, str(ROOT / "benchmarks" / name), *arguments],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    return [line.split() for line in answer.stdout.splitlines()]


def test_floor(tmp_path: Path) -> None:
    options = ("--frames", "10", "--repeats", "2", "--folder", str(tmp_path))
    rows = run("floor.py", *options, "--points", "100", "5000")
    first, second = rows[2:4]
    assert (first[0], second[0]) == ("100", "5000")
    assert all(float(word) > 0 for word in first[5:])
    assert not list(tmp_path.iterdir())


def test_device() -> None:
    options = ("--frames", "10", "--points", "3000", "--repeats", "1")
    rows = run("device.py", "array_api_strict", *options)
    assert [row[1] for row in rows[2:]] == ["numpy", "array_api_strict"]
    assert all(float(row[-1]) < 1e-6 for row in rows[2:])


def test_the_reduction_computes_the_same_as_the_whole() -> None:
    rows = run("unreduced.py", "--frames", "12", "--points", "300", "3000", "--iterations", "20")
    for row in rows[2:]:
        assert float(row[-1]) < 1e-12


@pytest.mark.data
def test_camera_paths(tmp_path: Path, evaluation_data: Path) -> None:
    few = ("--shapes", "yoga", "--paths", "fast", "--noises", "0.01", "--processes", "1")
    run("camera_paths.py", "--data", str(evaluation_data), "--out", str(tmp_path / "paths"), *few)
    (member,) = json.loads((tmp_path / "paths.json").read_text())
    assert member["model"] == "uniform"
    assert member["default"]["object"] < member["baseline"]["object"]
    assert "| 1% | fast |" in (tmp_path / "paths.md").read_text()


@pytest.mark.data
def test_held_out(tmp_path: Path, evaluation_data: Path) -> None:
    report = tmp_path / "members.json"
    few = ("--first", "3", "--count", "2", "--processes", "1", "--json", str(report))
    rows = run("held_out.py", "--data", str(evaluation_data), *few)
    members = json.loads(report.read_text())
    total = next(row for row in rows if row[:3] == ["|", "all", "|"])
    assert total[3] == "2"
    ratios = [one["default"]["object"] / one["baseline"]["object"] for one in members]
    assert float(total[5]) == pytest.approx((ratios[0] * ratios[1]) ** 0.5, abs=0.006)
    assert members[0]["shape"] != members[1]["shape"]


@pytest.mark.data
def test_missing_data(tmp_path: Path, evaluation_data: Path) -> None:
    out = tmp_path / "missing.json"
    cases = ("all seen", "30% at random", "5% errors, reject")
    few = ("--sets", "yoga", "--draws", "1", "--json", str(out), "--cases", *cases)
    rows = run("missing_data.py", "--data", str(evaluation_data), *few)
    assert len(rows) == 2 + len(cases)
    clean, gaps, errors = json.loads(out.read_text())
    assert 0.25 < gaps["missing"] < 0.35
    assert 0.04 < errors["rejected"] < 0.06
    assert errors["wrong"] == 0.0
    for spoilt in (gaps, errors):
        assert spoilt["e3d"] < clean["e3d"] + 1e-3


def test_a_batch_is_looked_at_and_dealt_with() -> None:
    rows = run("batches.py", "--jobs", "30")
    assert rows[0][:2] == ["30", "jobs"]
    measured = [" ".join(row).split("|")[2] for row in rows[3:]]
    assert len(measured) == 9
    assert all(int(milliseconds) >= 0 for milliseconds in measured)


@pytest.mark.data
def test_camera_scale(tmp_path: Path, evaluation_data: Path) -> None:
    few = ("--shapes", "yoga", "--paths", "fast", "--noises", "0.01", "--processes", "1")
    report = tmp_path / "scale.json"
    rows = run("camera_scale.py", "--data", str(evaluation_data), "--json", str(report), *few)
    assert rows[0][1:4] == ["noise", "|", "path"]
    (member,) = json.loads(report.read_text())
    for frame in ("object", "camera"):
        errors = member[frame]
        assert errors["scaled, varying"] < 0.5 * errors["scaled, constant"]
        assert errors["pinhole, varying"] < 0.8 * errors["pinhole, constant"]


def test_sheets(tmp_path: Path) -> None:
    few = ("--sheets", "flag", "--paths", "fast", "--seeds", "1", "--noises", "0.01")
    report = tmp_path / "sheets.json"
    rows = run("sheets.py", "--json", str(report), "--processes", "1", *few)
    assert rows[2][:4] == ["|", "1%", "|", "flag"]
    (member,) = json.loads(report.read_text())
    assert member["default"]["camera"] < 0.5 * member["baseline"]["camera"]
