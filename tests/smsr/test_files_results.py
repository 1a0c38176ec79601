from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

import smsr
from smsr.errors import ArrayNotFound, WrongShape
from smsr.files import open_result, write_npz
from smsr.synthetic import make_example

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    Arrays = dict[str, NDArray[np.float64]]


@pytest.fixture
def arrays() -> Arrays:
    example = make_example(frames=12, side=5)
    return {
        "shapes": example.ground_truth,
        "cameras": example.cameras,
        "translations": np.zeros((12, 2)),
    }


def test_a_result_opens_as_it_was_written_and_is_evaluated(tmp_path: Path, arrays: Arrays) -> None:
    write_npz(tmp_path / "result.npz", arrays)
    surface = open_result(tmp_path / "result.npz")
    for name, array in arrays.items():
        assert np.array_equal(getattr(surface, name), array)
    assert smsr.evaluate(arrays["shapes"], surface).e3d == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("name", ["shapes", "cameras", "translations"])
def test_what_is_missing_or_does_not_fit_is_refused(
    tmp_path: Path, arrays: Arrays, name: str
) -> None:
    write_npz(tmp_path / "cut.npz", arrays | {name: arrays[name][:-1]})
    with pytest.raises(WrongShape):
        open_result(tmp_path / "cut.npz")
    write_npz(tmp_path / "less.npz", {key: a for key, a in arrays.items() if key != name})
    with pytest.raises(ArrayNotFound, match=name):
        open_result(tmp_path / "less.npz")
