"""Measurements on a GPU: the two passes run with the array's own library, on its device.

Needs the extra ``smsr[gpu]`` and the library of the array (PyTorch, CuPy or any other of the Python
array API standard). Blocks of points are reduced, and their shapes made, on the device; only
triangles (2T x 2T) and finished shapes come to the host, where the small solver runs.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import array_api_compat as compat
import numpy as np

from smsr.errors import NotNumeric
from smsr.progress import ignore
from smsr.sinks import sink_for
from smsr.streaming import blas_threads, map_chunks
from smsr.triangles import NotUsableError, Triangle, within

if TYPE_CHECKING:
    import os
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from smsr.mapping import Operator
    from smsr.measurements import Chunk
    from smsr.progress import StageHook


@dataclass(frozen=True, slots=True, eq=False)
class DeviceSource:
    """An array of the array API as a source that works on the array's device.

    Parameters
    ----------
    tracks : array of shape (T, 2, N)
        A view where the library has views; never copied as a whole here.
    """

    tracks: Any

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
        return dtype_of(self.tracks)

    def first_point(self) -> NDArray[Any]:
        """Return the first column (2T,) of W."""
        return _to_host(self._block(slice(0, 1)))[:, 0]

    def chunks(self, size: int | None = None) -> Iterator[Chunk]:
        """Bring one block after another to the host; see `MeasurementSource.chunks`."""
        for points in self._slices(size or self.points):
            yield points, _to_host(self._block(points))

    def triangles(
        self,
        shift: NDArray[np.float64],
        size: int,
        sampled: NDArray[np.intp],
        workers: int | None,  # noqa: ARG002
    ) -> Iterator[tuple[int, Triangle]]:
        """Reduce blocks of `size` points and keep a sample; see `smsr.streaming.map_chunks`.

        Raises
        ------
        NotUsableError
            NaN or infinity in a block, or overflow.
        """
        origin = self._put(shift[:, None])
        for points in self._slices(size):
            yield points.stop, self._triangle(points, origin, within(points, sampled))

    def map_back(
        self,
        operator: Operator,
        means: NDArray[np.float64],
        out: NDArray[np.floating[Any]] | str | os.PathLike[str] | None,
        dtype: np.dtype[Any],
        *,
        size: int,
        workers: int | None,
        progress: StageHook = ignore,
    ) -> NDArray[np.floating[Any]]:
        """Make the shapes of all points, in host memory; see `smsr.rowspace.map_back`."""
        sink = sink_for(out, self.frames, self.points, dtype)
        try:
            # In double precision always: "single" may be a GPU's ten-bit TF32 products.
            factors = [self._put(factor) for factor in reversed(operator.factors)]
            cameras = operator.cameras
            lift = None if cameras is None else self._put(cameras.transpose(0, 2, 1))
            origin = self._put(means[:, None])

            def finished() -> Iterator[Chunk]:
                for points in self._slices(size):
                    yield points, self._shapes(points, origin, factors, lift, sink.dtype)

            def store(points: slice, shapes: NDArray[Any]) -> None:
                target = sink.target(points)
                if target is not None:
                    target[...] = shapes
                sink.write(points, shapes)

            # The device is used from this thread alone, as some libraries keep its state by thread.
            with closing(map_chunks(store, finished(), workers or blas_threads())) as done:
                for index, (stop, _) in enumerate(done, 1):
                    progress(stop / self.points, index, None)
        except BaseException:
            sink.discard()
            raise
        return sink.finish()

    @property
    def _library(self) -> Any:
        return library(self.tracks)

    def _put(self, array: NDArray[np.floating[Any]]) -> Any:
        """Copy an array to the device, in double precision."""
        return self._library.asarray(
            np.array(array, np.float64, order="C"), device=compat.device(self.tracks)
        )

    def _slices(self, size: int) -> Iterator[slice]:
        for start in range(0, self.points, size):
            yield slice(start, min(start + size, self.points))

    def _block(self, points: slice) -> Any:
        """Return the block (2T, n) on the device."""
        return self._library.reshape(self.tracks[:, :, points], (2 * self.frames, -1))

    def _centred(self, points: slice, origin: Any) -> Any:
        return self._library.astype(self._block(points), self._library.float64) - origin

    def _triangle(self, points: slice, origin: Any, sampled: NDArray[np.intp]) -> Triangle:
        """Reduce a block by a Householder QR."""
        xp = self._library
        centred = self._centred(points, origin)
        means = xp.mean(centred, axis=1, keepdims=True)
        mean = _to_host(means)[:, 0]
        if not np.isfinite(mean).all():
            raise NotUsableError
        rows = xp.permute_dims(centred - means, (1, 0))
        if rows.shape[0] > rows.shape[1]:
            rows = xp.linalg.qr(rows, mode="reduced")[1]
        where = xp.asarray(sampled, device=compat.device(self.tracks))
        sample = _to_host(xp.take(centred, where, axis=1))
        return Triangle(points.stop - points.start, mean, _to_host(rows), sample)

    def _shapes(
        self, points: slice, origin: Any, factors: list[Any], lift: Any, dtype: np.dtype[Any]
    ) -> NDArray[np.floating[Any]]:
        """Make the shapes (T, n, 3) of a block, and bring them to the host."""
        xp = self._library
        centred = self._centred(points, origin)
        result = centred
        for factor in factors:
            result = factor @ result
        result = xp.reshape(result, (self.frames, 3, -1))
        if lift is not None:
            result = result + lift @ xp.reshape(centred, (self.frames, 2, -1))
        # In the order and precision of the host already: memory is slower there.
        result = xp.reshape(xp.permute_dims(result, (0, 2, 1)), (-1,))
        return _to_host(xp.astype(result, getattr(xp, dtype.name))).reshape(self.frames, -1, 3)


def library(array: Any) -> Any:
    """Return the array's library under the names of the array API."""
    return compat.array_namespace(array)


def usable(array: Any) -> bool:
    """Tell whether the array's library and device can do the work, in double precision."""
    if not compat.is_array_api_obj(array):
        return False
    xp = library(array)
    if not hasattr(xp, "linalg") or not hasattr(xp, "__array_namespace_info__"):
        return False
    device = compat.device(array)
    types = xp.__array_namespace_info__().dtypes(device=device, kind="real floating")
    return "float64" in types


def without_gradient(array: Any) -> Any:
    """Return the array without a record of its operations, where PyTorch keeps one."""
    return array.detach() if compat.is_torch_array(array) else array


def dtype_of(array: Any) -> np.dtype[Any]:
    """Return numpy's name of the type of the entries.

    Raises
    ------
    NotNumeric
        A type that numpy does not have.
    """
    name = str(array.dtype).rpartition(".")[2]
    try:
        return np.dtype(name)
    except TypeError:
        raise NotNumeric(
            f"The measurements have dtype {name}, which numpy does not have; convert them to "
            "float32, for one.",
            dtype=name,
        ) from None


def _to_host(array: Any) -> NDArray[Any]:
    """Return an array of numpy's."""
    if compat.is_torch_array(array) or compat.is_cupy_array(array):
        return np.asarray(compat.to_device(array, "cpu"))
    if compat.is_jax_array(array):
        return np.asarray(array)
    return np.from_dlpack(array)
