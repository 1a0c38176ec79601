"""HDF5 files, among them MATLAB files of version 7.3: read in a process apart.

MATLAB stores its column-major arrays as HDF5 arrays with the axes in reverse order; here they come
back as MATLAB shows them.
"""

from __future__ import annotations

import io
import itertools
import json
import math
import os
import re
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, cast

import numpy as np

from smsr.errors import InputError, NotNumeric, UnreadableFile
from smsr.files.selection import StoredArray

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

_PROCESS = Path(__file__).with_name("hdf5_process.py")
_BLOCK = 16 * 2**20
_LONGEST_LINE = 16 * 2**20
_REAL = re.compile(r"[<>|](f[248]|[iu][1248])")
_INHERITED = ("PATH", "PYTHONPATH", "PYTHONHOME", "LD_LIBRARY_PATH", "SYSTEMROOT")
"""What Python needs to start; secrets of the service are no business of a file's reader."""

_ENVIRONMENT = {
    "HDF5_PLUGIN_PRELOAD": "::",  # no filters from shared libraries
    "HDF5_USE_FILE_LOCKING": "FALSE",  # files on read-only and network storage
    "OPENBLAS_NUM_THREADS": "1",  # its threads' stacks would count as memory
}


@contextmanager
def open_hdf5(path: Path, limit: int) -> Iterator[list[StoredArray]]:  # noqa: ARG001
    """Find the arrays of an HDF5 file; names of those in groups have dots (``"GT.shape3D"``)."""
    command = [sys.executable, "-P", str(_PROCESS), str(path.resolve())]
    with subprocess.Popen(
        command,
        bufsize=0,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env={name: os.environ[name] for name in _INHERITED if name in os.environ} | _ENVIRONMENT,
    ) as process:
        assert process.stdin is not None  # noqa: S101
        assert process.stdout is not None  # noqa: S101
        try:
            reader = _Reader(path, process.stdin, process.stdout)
            yield [reader.stored(described) for described in reader.answer()["arrays"]]
        finally:
            process.kill()


class _Reader:
    """Talks to the process that reads the file."""

    def __init__(self, path: Path, requests: IO[bytes], answers: IO[bytes]) -> None:
        self._path = path
        self._requests = requests
        self._answers = io.BufferedReader(cast("io.RawIOBase", answers))

    def answer(self) -> dict[str, Any]:
        """Return the next message."""
        line = self._answers.readline(_LONGEST_LINE)
        try:
            message: dict[str, Any] = json.loads(line)
        except ValueError:  # the process died
            raise _failed() from None
        if "error" in message:
            raise UnreadableFile(f"The HDF5 file cannot be read: {message['error'][:300]}.")
        return message

    def stored(self, described: dict[str, Any]) -> StoredArray:
        """Make an entry for `select`."""
        name = described["name"].replace("/", ".")
        shape = tuple(described["shape"])
        dtype = np.dtype(described["dtype"]) if _REAL.fullmatch(described["dtype"]) else None
        problem: InputError | None = None
        if dtype is None:
            problem = NotNumeric(
                f"The array {name!r} has entries of type {described['dtype'][:60]}; real numbers "
                f"are needed."
            )
        elif described["problem"] is not None:
            problem = UnreadableFile(f"The array {name!r} cannot be read: {described['problem']}.")

        def read() -> NDArray[Any]:
            stored = self._read(described, shape, cast("np.dtype[Any]", dtype))
            return stored.T if described["transposed"] else stored

        seen = shape[::-1] if described["transposed"] else shape
        return StoredArray(name, seen, dtype, read, problem)

    def _read(
        self, described: dict[str, Any], shape: tuple[int, ...], dtype: np.dtype[Any]
    ) -> NDArray[Any]:
        if described["offset"] is not None:
            end = described["offset"] + math.prod(shape) * dtype.itemsize
            if end > self._path.stat().st_size:
                raise UnreadableFile("The HDF5 file is truncated.")
            return np.memmap(self._path, dtype, "r", described["offset"], shape)
        array = np.empty(shape, dtype)
        for start, stop in _blocks(shape, described["chunks"] or (1,) * len(shape), dtype.itemsize):
            request = {"name": described["name"], "start": start, "stop": stop}
            self._send(request)
            size = math.prod(b - a for a, b in zip(start, stop, strict=True)) * dtype.itemsize
            if self.answer()["size"] != size:
                raise UnreadableFile("The HDF5 file is damaged: an array changes its size.")
            block = np.empty([b - a for a, b in zip(start, stop, strict=True)], dtype)
            self._fill(block.reshape(-1).view(np.uint8))
            array[tuple(map(slice, start, stop))] = block
        return array

    def _send(self, request: dict[str, Any]) -> None:
        try:
            self._requests.write(json.dumps(request).encode() + b"\n")
            self._requests.flush()
        except BrokenPipeError:
            raise _failed() from None

    def _fill(self, target: NDArray[np.uint8]) -> None:
        filled = 0
        while filled < len(target):
            data = self._answers.read(min(2**20, len(target) - filled))
            if not data:
                raise _failed()
            target[filled : filled + len(data)] = np.frombuffer(data, np.uint8)
            filled += len(data)


def _failed() -> UnreadableFile:
    return UnreadableFile("The HDF5 file is damaged: reading it fails.")


def _blocks(
    shape: tuple[int, ...], chunks: tuple[int, ...] | list[int], itemsize: int
) -> Iterator[tuple[list[int], list[int]]]:
    """Cut an array into blocks of whole chunks, each of about `_BLOCK` bytes or one chunk."""
    steps = [max(1, min(chunk, size)) for chunk, size in zip(chunks, shape, strict=True)]
    for axis in reversed(range(len(shape))):
        room = _BLOCK // (math.prod(steps) * itemsize)
        steps[axis] = min(shape[axis], steps[axis] * max(1, room))
    ranges = [range(0, size, step) for size, step in zip(shape, steps, strict=True)]
    for start in itertools.product(*ranges):
        stop = [min(a + step, size) for a, step, size in zip(start, steps, shape, strict=True)]
        yield list(start), stop
