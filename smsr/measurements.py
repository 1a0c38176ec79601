"""Sources of the measurement matrix W: any layout, in memory, on disk or arriving in chunks.

Everything downstream reads W (2T x N, rows u1, v1, u2, v2, ...) as chunks of points, so W itself
is never copied and need not fit in memory. What can be told from shape and dtype is checked here
at once. The values of large data are checked by the one pass that `smsr.rowspace.factorise` makes
anyway; `check_values` is that check on its own, and the place where entries that were not observed
are refused.
"""

from __future__ import annotations

import mmap
import os
import sys
from dataclasses import dataclass
from typing import (
    TYPE_CHECKING,
    Any,
    Literal,
    Protocol,
    TypeAlias,
    TypeGuard,
    runtime_checkable,
)

import numpy as np

from smsr.errors import (
    AmbiguousLayout,
    ConstantMeasurements,
    InputError,
    NotFinite,
    NotNumeric,
    OddRowCount,
    TooFewFrames,
    TooFewPoints,
    WrongShape,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from numpy.typing import ArrayLike, NDArray

    from smsr.mapping import Operator
    from smsr.progress import StageHook
    from smsr.triangles import Triangle

Layout: TypeAlias = Literal["auto", "interleaved", "stacked"]
Chunk: TypeAlias = "tuple[slice, NDArray[Any]]"

MINIMUM_FRAMES = 3
MINIMUM_POINTS = 4

CHUNK_BYTES = 16 * 2**20
"""Default size of a chunk: long enough runs of each row for a disk, small beside any memory."""

_CHECKED_AT_ONCE = 8 * 2**20
_RELEASE_BYTES = 64 * 2**20


@runtime_checkable
class MeasurementSource(Protocol):
    """What the solver needs to know of a measurement matrix."""

    @property
    def frames(self) -> int:
        """T."""
        ...

    @property
    def points(self) -> int:
        """N."""
        ...

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the entries, real."""
        ...

    def chunks(self, size: int | None = None) -> Iterator[Chunk]:
        """Iterate over W by chunks of points, in order and from the start at each call.

        Parameters
        ----------
        size : int, optional
            Most points in a chunk; the source chooses when it is not given.

        Yields
        ------
        points : slice
            Which columns of W these are; together they cover 0 to N without gaps.
        block : ndarray of shape (2T, n)
            Rows u1, v1, u2, v2, ...; not to be written to.
        """
        ...


@runtime_checkable
class RemoteSource(MeasurementSource, Protocol):
    """A source whose blocks are elsewhere, so that the work is better taken to them."""

    def first_point(self) -> NDArray[Any]:
        """Return the first column (2T,) of W."""
        ...

    def triangles(
        self, shift: NDArray[np.float64], size: int, sampled: NDArray[np.intp], workers: int | None
    ) -> Iterator[tuple[int, Triangle]]:
        """Reduce blocks of about `size` points, and keep a sample of them.

        Yields the end of each block and its triangle.
        """
        ...

    def map_back(
        self,
        operator: Operator,
        means: NDArray[np.float64],
        out: NDArray[np.floating[Any]] | str | os.PathLike[str] | None,
        dtype: np.dtype[Any],
        *,
        size: int,
        workers: int | None,
        progress: StageHook,
    ) -> Any:
        """Write the shapes of all points; see `smsr.rowspace.map_back`."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class ArraySource:
    """An array, in memory or mapped from a file, as a source.

    Parameters
    ----------
    tracks : ndarray of shape (T, 2, N)
        Usually a strided view; chunks are copied only where the layout needs it.
    """

    tracks: NDArray[Any]

    @property
    def frames(self) -> int:
        """T."""
        return int(self.tracks.shape[0])

    @property
    def points(self) -> int:
        """N."""
        return int(self.tracks.shape[2])

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the entries."""
        return self.tracks.dtype

    def chunks(self, size: int | None = None) -> Iterator[Chunk]:
        """Iterate over chunks of at most `size` points; see `MeasurementSource.chunks`."""
        size = size or chunk_points(self)
        rows = 2 * self.frames
        pages = _mapped_pages(self.tracks)
        unreleased = 0
        for points in _slices(self.points, size):
            block = self.tracks[:, :, points].reshape(rows, -1)
            yield points, block
            unreleased += block.nbytes
            if pages is not None and unreleased > _RELEASE_BYTES:
                # The pages stay in the system's cache; they only stop counting as this process's.
                pages.madvise(mmap.MADV_DONTNEED)
                unreleased = 0


@dataclass(frozen=True, slots=True, eq=False)
class ChunkedSource:
    """A measurement matrix that arrives as an iterator of column blocks.

    Parameters
    ----------
    blocks : callable
        Returns a fresh iterator over consecutive (2T, n) blocks, rows u1, v1, u2, v2, ..., n free.
        It is called once for each pass over the data (two for a reconstruction).
    frames, points : int
        T and N.
    dtype : dtype-like
        Type of the entries.
    """

    blocks: Callable[[], Iterable[NDArray[Any]]]
    frames: int
    points: int
    dtype: np.dtype[Any]

    def __post_init__(self) -> None:
        object.__setattr__(self, "dtype", np.dtype(self.dtype))
        _check_dtype(self.dtype)
        _check_size(self.frames, self.points)

    def chunks(self, size: int | None = None) -> Iterator[Chunk]:
        """Iterate over chunks of at most `size` points; see `MeasurementSource.chunks`.

        Raises
        ------
        WrongShape
            A block that is no (2T, n) array, or blocks that do not add up to N points.
        """
        start = 0
        for block in self.blocks():
            array = np.asarray(block)
            if array.ndim != 2 or array.shape[0] != 2 * self.frames:
                raise WrongShape(
                    f"Block at point {start} has shape {array.shape}; {self.frames} frames need "
                    f"({2 * self.frames}, n).",
                    point=start,
                    shape=list(array.shape),
                )
            for part in _slices(array.shape[1], size or max(1, array.shape[1])):
                columns = array[:, part]
                stop = start + columns.shape[1]
                yield slice(start, stop), columns
                start = stop
        if start != self.points:
            raise WrongShape(
                f"The blocks have {start} points together; {self.points} were announced.",
                points=start,
                expected=self.points,
            )


def as_source(
    measurements: ArrayLike | str | os.PathLike[str] | MeasurementSource,
    layout: Layout = "auto",
    *,
    check: bool = True,
) -> MeasurementSource:
    """Make a source of whatever holds the measurements, checking what shape and dtype can tell.

    Parameters
    ----------
    measurements : ndarray, memmap, path or MeasurementSource
        W as (2T, N), (T, 2, N), (T, N, 2) or, stacked, (2T, N) with all u rows first or (2, T, N);
        the path of a file that `smsr.files.open_array` reads; a dask array (`smsr.cluster`); an
        array of PyTorch, CuPy or another library of the array API (`smsr.devices`); or a source,
        which passes unchanged. For data that come as an iterator of blocks see `ChunkedSource`.
    layout : {"auto", "interleaved", "stacked"}
        Row order of a 2-D array. "auto" takes it as interleaved and recognises (T, 2, N) and
        (T, N, 2).
    check : bool
        Whether to check the values of small data; `smsr.completion` accepts entries that are not
        finite here.

    Returns
    -------
    MeasurementSource
        Its values are checked already where that is quick (up to 8 MiB).

    Raises
    ------
    NotNumeric, WrongShape, OddRowCount, AmbiguousLayout, TooFewFrames, TooFewPoints
        From dtype and shape.
    NotFinite, ConstantMeasurements
        From the values of small data; large data raise them in `smsr.rowspace.factorise`.
    """
    if isinstance(measurements, str | os.PathLike):
        from smsr.files import open_array

        measurements = open_array(measurements, role="measurements")
    elif isinstance(measurements, MeasurementSource):
        _check_dtype(np.dtype(measurements.dtype))
        _check_size(measurements.frames, measurements.points)
        return measurements
    if _is_dask(measurements):
        return _dask_source(measurements, layout)
    source = _device_source(measurements, layout)
    if source is None:
        array = _as_array(measurements)
        _check_dtype(array.dtype)
        source = ArraySource(_tracks(array, layout))
    _check_size(source.frames, source.points)
    if check and _bytes(source) <= _CHECKED_AT_ONCE:
        check_values(source)
    return source


def check_shape(
    shape: tuple[int, ...], dtype: np.dtype[Any], layout: Layout = "auto"
) -> tuple[int, int]:
    """Return T and N of an array that has not been read, refusing what `as_source` would.

    Parameters
    ----------
    shape : tuple of int
    dtype : dtype
    layout : {"auto", "interleaved", "stacked"}
        As in `as_source`.

    Raises
    ------
    NotNumeric, WrongShape, OddRowCount, AmbiguousLayout, TooFewFrames, TooFewPoints
    """
    _check_dtype(dtype)
    # A broadcast zero has any shape and takes no memory.
    source = ArraySource(_tracks(np.broadcast_to(np.zeros((), dtype), shape), layout))
    _check_size(source.frames, source.points)
    return source.frames, source.points


def chunk_points(source: MeasurementSource, chunk_bytes: int = CHUNK_BYTES) -> int:
    """Return how many points make a chunk of about `chunk_bytes` (at least 1)."""
    return max(1, chunk_bytes // (2 * source.frames * np.dtype(source.dtype).itemsize))


def check_values(source: MeasurementSource) -> None:
    """Read the source once and refuse values that cannot be used.

    Raises
    ------
    NotFinite
        NaN or infinity: says the first frame, its first point and coordinate, and how many
        entries there are.
    ConstantMeasurements
        All points coincide in every frame.
    """
    count = infinite = 0
    first: tuple[int, int] | None = None
    start: NDArray[Any] | None = None
    varies = False
    for points, block in source.chunks():
        bad = ~np.isfinite(block)
        found = int(np.count_nonzero(bad))
        if found:
            count += found
            infinite += int(np.count_nonzero(np.isinf(block)))
            row, column = np.unravel_index(int(bad.argmax()), bad.shape)
            here = (int(row), points.start + int(column))
            first = here if first is None else min(first, here)
        if start is None:
            start = block[:, :1].copy()
        varies = varies or bool((block != start).any())
    if first is not None:
        raise _not_finite(first, count, infinite, source)
    if not varies:
        raise constant_measurements()


def constant_measurements() -> ConstantMeasurements:
    """Return the error for points that coincide in every frame."""
    return ConstantMeasurements(
        "All points coincide in every frame, so there is no shape to find. Check that the array "
        "holds the tracks, one column a point."
    )


def _not_finite(
    first: tuple[int, int], count: int, infinite: int, source: MeasurementSource
) -> NotFinite:
    row, point = first
    frame, coordinate = row // 2, "uv"[row % 2]
    total = 2 * source.frames * source.points
    entries = "1 entry is" if count == 1 else f"{count} entries are"
    remedy = (
        f"Infinite entries ({infinite}) are never taken; where a point is not seen in a frame, "
        "write NaN, which missing='complete' fills in."
        if infinite
        else "With missing='complete', NaN marks points that are not seen in a frame, and they are "
        "filled in."
    )
    return NotFinite(
        f"{entries} NaN or infinite, of {total}; the first is coordinate {coordinate} of point "
        f"{point} in frame {frame} (counting from 0). {remedy}",
        frame=frame,
        point=point,
        coordinate=coordinate,
        count=count,
    )


def _is_dask(measurements: object) -> TypeGuard[Any]:
    """Tell a dask array without importing dask: who has one has imported it."""
    module = sys.modules.get("dask.array")
    return module is not None and isinstance(measurements, module.Array)


def _dask_source(array: Any, layout: Layout) -> MeasurementSource:
    from smsr.cluster import DaskSource

    _check_dtype(array.dtype)
    tracks: Any = _tracks(array, layout)
    _check_size(tracks.shape[0], tracks.shape[2])
    if array.ndim == 2 and layout != "stacked":
        return DaskSource(array)  # as it is: a reshape would cut its chunks
    return DaskSource(tracks.reshape(-1, tracks.shape[2]))


def _device_source(measurements: Any, layout: Layout) -> MeasurementSource | None:
    """Take an array of another library than numpy; None where numpy has to read it."""
    if isinstance(measurements, np.ndarray) or not hasattr(measurements, "__dlpack__"):
        return None
    try:
        from smsr import devices
    except ModuleNotFoundError:  # without the extra
        return None
    if not devices.usable(measurements):
        return None
    _check_dtype(devices.dtype_of(measurements))
    array = devices.without_gradient(measurements)
    return devices.DeviceSource(_tracks(array, layout, devices.library(array)))


def _bytes(source: MeasurementSource) -> int:
    return 2 * source.frames * source.points * source.dtype.itemsize


def unmasked(array: object) -> object:
    """Return a masked array with NaN where it is masked, and anything else as it is."""
    if isinstance(array, np.ma.MaskedArray) and np.ma.is_masked(array):
        return np.where(np.ma.getmaskarray(array), np.nan, np.ma.getdata(array))
    return array


def _as_array(measurements: object) -> NDArray[Any]:
    try:
        return np.asarray(unmasked(measurements))
    except ValueError as error:
        raise WrongShape(f"The measurements are no array: {error}.") from None
    except (TypeError, RuntimeError) as error:
        if not hasattr(measurements, "__dlpack__"):
            raise
        raise InputError(
            f"numpy cannot read the measurements: {error} The extra smsr[gpu] works on them where "
            "they are, given a device with double precision."
        ) from None


def _check_dtype(dtype: np.dtype[Any]) -> None:
    if dtype.kind not in "iuf":
        raise NotNumeric(
            f"The measurements have dtype {dtype}; they must be real numbers (float or integer).",
            dtype=str(dtype),
        )


def _check_size(frames: int, points: int) -> None:
    if frames < MINIMUM_FRAMES:
        raise TooFewFrames(
            f"The measurements have {frames} frames; at least {MINIMUM_FRAMES} are needed.",
            frames=frames,
            minimum=MINIMUM_FRAMES,
        )
    if points < MINIMUM_POINTS:
        raise TooFewPoints(
            f"The measurements have {points} points; at least {MINIMUM_POINTS} are needed.",
            points=points,
            minimum=MINIMUM_POINTS,
        )


def _tracks(array: Any, layout: Layout, library: Any = np) -> Any:
    """View an array of any layout, and of any library, as (T, 2, N)."""
    shape = tuple(array.shape)
    if array.ndim == 2:
        rows, points = shape
        if rows % 2:
            turned = " Is it transposed? Columns are points." if points % 2 == 0 else ""
            raise OddRowCount(
                f"The measurement matrix has {rows} rows; it needs two (u and v) for each frame."
                + turned,
                rows=rows,
            )
        if layout == "stacked":
            return library.permute_dims(library.reshape(array, (2, rows // 2, points)), (1, 0, 2))
        return library.reshape(array, (rows // 2, 2, points))
    if array.ndim != 3:
        raise WrongShape(
            f"The measurements have shape {shape}; expected (2T, N), (T, 2, N) or (T, N, 2).",
            shape=list(shape),
        )
    if layout == "stacked":
        if shape[0] != 2:
            raise WrongShape(
                f"The measurements have shape {shape}; with layout 'stacked' expected (2T, N) or "
                "(2, T, N). For (T, 2, N) or (T, N, 2) leave layout at 'auto'.",
                shape=list(shape),
            )
        return library.permute_dims(array, (1, 0, 2))
    if shape[1] == 2 and shape[2] == 2 and layout == "auto":
        raise AmbiguousLayout(
            f"The measurements have shape {shape}, which could be (T, 2, N) or (T, N, 2). Pass "
            "layout='interleaved' for (T, 2, N), or a (2T, N) matrix.",
            shape=list(shape),
        )
    if shape[1] == 2:
        return array
    if shape[2] == 2:
        return library.permute_dims(array, (0, 2, 1))
    hint = " For (2, T, N) pass layout='stacked'." if shape[0] == 2 else ""
    raise WrongShape(
        f"The measurements have shape {shape}; of three axes the second or the last must have "
        f"size 2 (u and v), as in (T, 2, N) or (T, N, 2).{hint}",
        shape=list(shape),
    )


def _slices(points: int, size: int) -> Iterator[slice]:
    for start in range(0, points, size):
        yield slice(start, min(start + size, points))


def _mapped_pages(array: NDArray[Any]) -> mmap.mmap | None:
    """Return the file mapping under an array, if pages of it can be dropped without harm."""
    base: object = array
    while isinstance(base, np.ndarray):
        if isinstance(base, np.memmap) and base.mode == "c":
            return None  # private pages hold changes
        base = base.base
    return base if isinstance(base, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED") else None
