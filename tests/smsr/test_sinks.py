from __future__ import annotations

import os
import subprocess
import sys
from typing import TYPE_CHECKING

import numpy as np
import pytest

from smsr.sinks import SHAPES_FILE, FileSink, sink_for

if TYPE_CHECKING:
    from pathlib import Path

FLOAT64 = np.dtype(np.float64)


@pytest.mark.parametrize("positioned", [True, False])
def test_ranges_of_points_in_any_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, positioned: bool
) -> None:
    if not positioned:
        monkeypatch.delattr(os, "pwrite")
    expected = np.random.default_rng(0).standard_normal((4, 30, 3)).astype(np.float32)
    sink = FileSink(tmp_path, 4, 30)
    for points in (slice(20, 30), slice(0, 7), slice(7, 20)):
        sink.write(points, np.ascontiguousarray(expected[:, points]))
    shapes = sink.finish()
    np.testing.assert_array_equal(shapes, expected)
    np.testing.assert_array_equal(np.load(tmp_path / SHAPES_FILE), expected)


def test_a_file_that_was_there_is_replaced(tmp_path: Path) -> None:
    (tmp_path / SHAPES_FILE).write_bytes(b"x" * 10_000)
    sink = FileSink(tmp_path, 3, 4)
    sink.write(slice(0, 4), np.ones((3, 4, 3), np.float32))
    np.testing.assert_array_equal(sink.finish(), np.ones((3, 4, 3)))
    assert (tmp_path / SHAPES_FILE).stat().st_size < 1_000


def test_discarded(tmp_path: Path) -> None:
    sink = FileSink(tmp_path, 3, 4)
    sink.discard()
    assert not list(tmp_path.iterdir())


def test_new_array() -> None:
    sink = sink_for(None, 3, 4, FLOAT64)
    target = sink.target(slice(1, 3))
    assert target is not None
    target[...] = 5
    shapes = sink.finish()
    assert (shapes.shape, shapes.dtype) == ((3, 4, 3), FLOAT64)
    np.testing.assert_array_equal(shapes[:, 1:3], 5)


_FULL = """
import resource, signal, sys
from smsr.sinks import FileSink
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
try:
    FileSink(sys.argv[1], 100, 100)
except OSError as error:
    print(type(error).__name__)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="there are no file size limits")
def test_no_room_is_an_error_at_once_and_leaves_nothing(tmp_path: Path) -> None:
    command = [sys.executable, "-c", _FULL, str(tmp_path)]
    answer = subprocess.run(command, capture_output=True, text=True, check=True)
    assert answer.stdout == "OSError\n"
    assert not list(tmp_path.iterdir())
