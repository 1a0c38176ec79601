"""The process in which HDF5 files are read; `smsr.files.hdf5` starts it and talks to it.

The HDF5 library follows pointers in a file and grows its buffers as the file asks, and files that
crash it keep being found. So it runs apart, with its memory and time bounded, and a bad file costs
no more than this process. It also refuses whatever would lead to other files.

On standard output comes one JSON line that lists the arrays. Each JSON line on standard input,
``{"name": ..., "start": [...], "stop": [...]}``, is answered by a line ``{"size": n}`` and n bytes,
C-ordered. A line ``{"error": ...}`` in either place ends it.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import h5py

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

if TYPE_CHECKING:
    from collections.abc import Iterator

MEMORY = 2 * 2**30
SECONDS = 30
SLOWEST = 10 * 2**20
"""Bytes a second of processor time that even slow filters deliver."""

MOST_OBJECTS = 2000
DEEPEST = 16
LONGEST_NAME = 1000

MOST_EXPANSION = 1032
"""Of deflate; no other filter in use compresses as much."""

FILTERS = {1: "deflate", 2: "shuffle", 3: "fletcher32", 4: "szip", 32000: "lzf"}


def main(path: str) -> None:
    """List the arrays of a file, then serve requests for parts of them."""
    requests, answers = sys.stdin.buffer, sys.stdout.buffer
    limit_memory()
    allow_seconds(SECONDS)
    try:
        with h5py.File(path, "r") as file:
            arrays = dict(described(file, matlab=is_matlab(path)))
            send(answers, {"arrays": list(arrays.values())})
            for line in requests:
                request = json.loads(line)
                part = tuple(map(slice, request["start"], request["stop"]))
                size = math.prod(p.stop - p.start for p in part) * 8
                allow_seconds(SECONDS + size // SLOWEST)
                data = file[request["name"]][part].tobytes()
                send(answers, {"size": len(data)})
                answers.write(data)
                answers.flush()
    except MemoryError:
        send(answers, {"error": "it needs too much memory to be read"})
    except Exception as error:  # noqa: BLE001  (h5py raises nearly anything on damaged files)
        send(answers, {"error": str(error) or type(error).__name__})


def send(answers: IO[bytes], message: dict[str, Any]) -> None:
    """Write a line of JSON."""
    answers.write(json.dumps(message).encode() + b"\n")
    answers.flush()


def limit_memory() -> None:
    """Bound what this process can allocate."""
    if resource is not None:
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))


def allow_seconds(seconds: int) -> None:
    """Bound the processor time from now on."""
    if resource is not None:
        usage = resource.getrusage(resource.RUSAGE_SELF)
        used = math.ceil(usage.ru_utime + usage.ru_stime)
        resource.setrlimit(resource.RLIMIT_CPU, (used + seconds, resource.RLIM_INFINITY))


def is_matlab(path: str) -> bool:
    """Say whether MATLAB wrote the file, from the text before the HDF5 part."""
    with Path(path).open("rb") as file:
        return file.read(10) == b"MATLAB 7.3"


def described(file: h5py.File, *, matlab: bool) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the path and the description of every dataset that can be reached in this file."""
    seen = 0
    groups = [("", file, 0)]
    while groups:
        prefix, group, depth = groups.pop(0)
        for name in group:
            seen += 1
            if seen > MOST_OBJECTS:
                raise ValueError(f"it holds more than {MOST_OBJECTS} objects")
            if name.startswith("#") or len(prefix) + len(name) > LONGEST_NAME:
                continue  # MATLAB keeps the contents of cells in #refs#
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                continue  # soft links repeat what is found anyway, external ones leave the file
            item, path = group[name], f"{prefix}{name}"
            if isinstance(item, h5py.Dataset):
                yield path, description(item, path, matlab=matlab)
            elif isinstance(item, h5py.Group) and depth < DEEPEST:
                groups.append((f"{path}/", item, depth + 1))


def description(dataset: h5py.Dataset, path: str, *, matlab: bool) -> dict[str, Any]:
    """Describe a dataset, without reading it."""
    matlab_class = bytes(dataset.attrs.get("MATLAB_class", b"")).decode("latin1")
    text_like = matlab_class in ("char", "logical", "cell", "struct")
    return {
        "name": path,
        "shape": dataset.shape or (),
        "dtype": matlab_class if text_like else dataset.dtype.str,
        "transposed": matlab or bool(matlab_class),
        "chunks": dataset.chunks,
        "offset": mappable_offset(dataset),
        "problem": problem(dataset),
    }


def problem(dataset: h5py.Dataset) -> str | None:
    """Say why a dataset is not to be read, whatever its type, or None."""
    if dataset.attrs.get("MATLAB_empty", 0) or dataset.shape is None:
        return "it is empty"
    if dataset.is_virtual or dataset.external is not None:
        return "its data lie in other files"
    plist = dataset.id.get_create_plist()
    unknown = {plist.get_filter(i)[0] for i in range(plist.get_nfilters())} - set(FILTERS)
    if unknown:
        return f"it is compressed by a filter that is not supported (number {min(unknown)})"
    if dataset.nbytes > MOST_EXPANSION * dataset.id.get_storage_size():
        return "most of its data were never written"
    return None


def mappable_offset(dataset: h5py.Dataset) -> int | None:
    """Return where the data lie in the file, if they lie there as NumPy would write them."""
    if dataset.chunks is not None or dataset.id.get_create_plist().get_nfilters():
        return None
    if dataset.dtype.kind not in "fiu" or dataset.external is not None:
        return None
    if dataset.id.get_type() != h5py.h5t.py_create(dataset.dtype):
        return None
    offset: int | None = dataset.id.get_offset()
    return offset


if __name__ == "__main__":
    main(sys.argv[1])
