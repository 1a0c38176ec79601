"""A moving surface as one binary glTF file, for viewers and for Blender.

The first frame is the geometry, every later one a morph target that holds its displacement from the
first, and an animation blends from each to the next. The file is made piece by piece from any byte
on, so its size does not matter to memory; one pass over the shapes comes before, since glTF states
the bounds of all data at its beginning.

Formats: glTF 2.0 (ISO/IEC 12113:2022), extensions KHR_mesh_quantization and KHR_materials_unlit.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from smsr.errors import AnimationTooLarge
from smsr.rotations import camera_scales

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    Array = NDArray[Any]
    ReadRows = Callable[[int, int], Array]

ImageV = Literal["auto", "up", "down"]
"""Where the second image coordinate of the measurements grows to; "auto" is as `v_grows_down`."""

MOST_FRAMES = 2048
"""Layers that graphics processors commonly give an array texture; viewers keep a frame in each."""

MOST_BYTES = 2**32 - 1
"""A GLB counts its bytes by 32 bits."""

MOST_SHADED_CORNERS = 3_000_000
"""Corners of triangles up to which normals are made; viewers shade larger meshes facet by facet."""

_WINDOW = 1 << 16
"""Points that are worked on at once."""

_FLOAT, _UINT, _SHORT, _BYTE, _UBYTE = 5126, 5125, 5122, 5120, 5121
_VERTICES, _INDICES = 34962, 34963
_POINTS, _TRIANGLES = 0, 4

_GREY = (0.55, 0.53, 0.5, 1.0)
_CIVIDIS = np.array(
    [
        (0, 34, 78),
        (26, 56, 111),
        (67, 78, 108),
        (97, 101, 111),
        (125, 124, 120),
        (155, 148, 118),
        (188, 174, 108),
        (222, 201, 88),
        (254, 232, 56),
    ]
)
"""Far to near; a map that colour-blind people and black-and-white prints tell apart, as sRGB."""


@dataclass(frozen=True, slots=True)
class GlbOptions:
    """How an animation is written.

    Attributes
    ----------
    fps : float
        Frames of the sequence per second.
    quantised : bool
        Positions as 16-bit and normals as 8-bit integers (KHR_mesh_quantization), which not every
        viewer reads. Positions are then exact to 1/32767 of the extent.
    every : int
        Takes only every n-th frame, from the first on.
    image_v : "auto", "up" or "down"
        Where the second image coordinate grows to: "down" for pixels counted from the top; "auto"
        is "down" where the first frame has no negative coordinates.
    """

    fps: float = 25.0
    quantised: bool = False
    every: int = 1
    image_v: ImageV = "auto"


@dataclass(frozen=True, slots=True, eq=False)
class Bounds:
    """Ranges of the numbers in a file.

    Attributes
    ----------
    first : ndarray of shape (2, 3), float32
        Least and greatest coordinates of the first frame.
    moves : ndarray of shape (T - 1, 2, 3), float32
        Least and greatest displacements of each later frame.
    extent : float
        Greatest magnitude of a coordinate in any frame.
    depths : tuple of float
        Least and greatest depth of the first frame, towards its camera.
    """

    first: NDArray[np.float32]
    moves: NDArray[np.float32]
    extent: float
    depths: tuple[float, float]

    @property
    def span(self) -> float:
        """Greatest magnitude of all that the file holds as positions."""
        moves = float(np.abs(self.moves).max()) if len(self.moves) else 0.0
        return max(float(np.abs(self.first).max()), moves) or 1.0


def v_grows_down(image_v: ImageV, shape: Array, camera: Array, translation: Array) -> bool:
    """Tell whether the second image coordinate grows downwards.

    Parameters
    ----------
    image_v : "auto", "up" or "down"
        "auto": it does where no coordinate is negative, as pixels are not.
    shape : ndarray of shape (N, 3)
        Of one frame.
    camera, translation : ndarrays of shapes (2, 3) and (2,)
        Of the same frame.
    """
    if image_v != "auto":
        return image_v == "down"
    lowest = (np.asarray(shape, np.float64) @ np.asarray(camera).T + translation).min()
    return bool(lowest >= 0.0)


class Glb:
    """A GLB file that can be read from any position.

    Parameters
    ----------
    read : callable
        Gives rows ``start`` to ``stop`` of the shapes as a (T N, 3) matrix, in any float type.
    frames, points : int
        T and N.
    camera : ndarray of shape (2, 3)
        R of the first frame: the object stands as this camera saw it.
    translation : ndarray of shape (2,), optional
        t of the first frame, by which ``image_v="auto"`` is decided; otherwise it is "up".
    faces : ndarray of shape (F, 3), optional
        Triangles, indices of points from 0; without them, the file holds a cloud of points that
        are coloured by depth.
    options : GlbOptions, optional
    bounds : Bounds, optional
        Those of another `Glb` of the same shapes and the same `every`; otherwise, all shapes are
        read at once.

    Attributes
    ----------
    size : int
        Length of the file in bytes.
    bounds : Bounds

    Raises
    ------
    AnimationTooLarge
        More than `MOST_FRAMES` frames, or a file of more than `MOST_BYTES`.
    """

    def __init__(
        self,
        read: ReadRows,
        *,
        frames: int,
        points: int,
        camera: Array,
        translation: Array | None = None,
        faces: Array | None = None,
        options: GlbOptions | None = None,
        bounds: Bounds | None = None,
    ) -> None:
        self._read = read
        self._options = options = options or GlbOptions()
        self._points = points
        self._frames = range(0, frames, options.every)
        self._faces = None if faces is None or not len(faces) else np.asarray(faces)
        shaded = self._faces is not None and 3 * len(self._faces) <= MOST_SHADED_CORNERS
        self._normals = (
            _Normals(self._faces, points) if self._faces is not None and shaded else None
        )
        self._record = _record(options.quantised, shaded)
        self._check(frames)
        if translation is None:
            down = options.image_v == "down"
        else:
            down = v_grows_down(options.image_v, read(0, points), camera, translation)
        self._turn = _upright(camera, down=down)
        self.bounds = bounds or self._measure()
        self._parts = list(self._small_parts())
        head = self._json()
        head += b" " * (-len(head) % 4)
        small = sum(len(part) for part in self._parts)
        binary = small + len(self._frames) * self._block
        self.size = 12 + 8 + len(head) + 8 + binary
        self._parts.insert(
            0,
            struct.pack("<4sII", b"glTF", 2, self.size)
            + struct.pack("<I4s", len(head), b"JSON")
            + head
            + struct.pack("<I4s", binary, b"BIN\0"),
        )

    def pieces(self, start: int = 0, stop: int | None = None) -> Iterator[bytes]:
        """Yield the bytes of the file from one position up to another."""
        stop = self.size if stop is None else min(stop, self.size)
        position = 0
        for size, make in self._segments():
            if position >= stop:
                return
            if position + size > start:
                yield make()[max(start - position, 0) : stop - position]
            position += size

    @property
    def _block(self) -> int:
        """Bytes of a frame."""
        return self._points * self._record.itemsize

    def _check(self, frames: int) -> None:
        count = len(self._frames)
        size = count * self._block + (0 if self._faces is None else self._faces.size * 4)
        size += 1024 * (count + 2)  # more than what describes them
        if count > MOST_FRAMES or size > MOST_BYTES:
            least = max(-(-frames // MOST_FRAMES), -(-size * self._options.every // MOST_BYTES))
            raise AnimationTooLarge(
                f"{count} frames of {self._points} points are {size >> 20} MiB; a GLB holds at "
                f"most {MOST_FRAMES} frames and {MOST_BYTES >> 20} MiB. Take every {least}th frame "
                "or fewer (every).",
                frames=count,
                points=self._points,
                every=least,
            )

    # What is read

    def _window(self) -> int:
        """How many points are read of a frame at once: all of them where normals are made."""
        return self._points if self._normals is not None else min(self._points, _WINDOW)

    def _tiles(self) -> Iterator[tuple[range, int, int]]:
        """Yield frames and points that are worked on together, in the order of the file."""
        window = self._window()
        together = max(1, _WINDOW // self._points) if self._options.every == 1 else 1
        for k in range(1, len(self._frames), together):
            group = self._frames[k : k + together]
            for start in range(0, self._points, window):
                yield group, start, min(start + window, self._points)

    def _rows(self, frames: range, start: int, stop: int) -> NDArray[np.float32]:
        """Read points of frames that follow each other, (len(frames), stop - start, 3)."""
        first = frames[0] * self._points + start
        last = frames[-1] * self._points + stop
        rows = self._read(first, last).reshape(len(frames), stop - start, 3)
        found: NDArray[np.float32] = rows.astype(np.float32, copy=False)
        return found

    def _first(self, start: int, stop: int) -> NDArray[np.float32]:
        if self._points > _WINDOW and self._normals is None:
            first: NDArray[np.float32] = self._rows(range(1), start, stop)[0]
            return first
        if self._kept is None:
            self._kept = self._rows(range(1), 0, self._points)[0]
        return self._kept[start:stop]

    _kept: NDArray[np.float32] | None = None

    def _measure(self) -> Bounds:
        """Read all shapes and find their ranges."""
        window = min(self._points, _WINDOW)
        extremes, depths, extent = _Extremes(1), _Extremes(1), 0.0
        for start in range(0, self._points, window):
            first = self._first(start, min(start + window, self._points))
            extremes.take(0, first[None])
            depths.take(0, (first @ self._turn[2])[None, :, None])
            extent = max(extent, float(np.abs(first).max()))
        moves = _Extremes(len(self._frames) - 1)
        for group, start, stop in self._tiles():
            shapes = self._rows(group, start, stop)
            k = group[0] // self._options.every - 1
            moves.take(k, shapes - self._first(start, stop))
            extent = max(extent, float(np.abs(shapes).max()))
        low, high = depths.found[0, :, 0].tolist()
        return Bounds(extremes.found[0], moves.found, extent or 1.0, (low, high))

    # What is written

    def _segments(self) -> Iterator[tuple[int, Callable[[], bytes]]]:
        """Yield sizes of what follows each other in the file, and what makes it."""
        for part in self._parts:
            yield len(part), lambda part=part: part  # type: ignore[misc]
        stride, window = self._record.itemsize, self._window()
        for start in range(0, self._points, window):
            stop = min(start + window, self._points)
            yield (stop - start) * stride, lambda a=start, b=stop: self._geometry(a, b)  # type: ignore[misc]
        for tile in self._tiles():
            group, start, stop = tile
            yield (
                len(group) * (stop - start) * stride,
                lambda tile=tile: self._targets(*tile),  # type: ignore[misc]
            )

    def _geometry(self, start: int, stop: int) -> bytes:
        first = self._first(start, stop)
        normals = None if self._normals is None else self._normals(first)
        return self._records(first, normals)

    def _targets(self, frames: range, start: int, stop: int) -> bytes:
        first = self._first(start, stop)
        shapes = self._rows(frames, start, stop)
        if self._normals is None:
            return self._records((shapes - first).reshape(-1, 3), None)
        rest = self._normals(first)
        return b"".join(
            self._records(shape - first, self._normals(shape) - rest) for shape in shapes
        )

    def _records(self, positions: Array, normals: Array | None) -> bytes:
        records = np.zeros(len(positions), self._record)
        if self._options.quantised:
            records["position"] = _quantise(positions, self.bounds.span)
            if normals is not None:
                # Differences beyond 1, of normals that turn far, end at the range of the format.
                records["normal"] = np.rint(127.0 * np.clip(normals, -1.0, 1.0))
        else:
            records["position"] = positions
            if normals is not None:
                records["normal"] = normals
        return records.tobytes()

    def _small_parts(self) -> Iterator[bytes]:
        """Yield what lies before the frames: keyframes, then triangles or colours."""
        count = len(self._frames)
        if count > 1:
            yield (
                (np.arange(count) / self._options.fps * self._options.every).astype("<f4").tobytes()
            )
            # Frame k has all the weight on target k - 1: a sparse T x (T - 1) matrix.
            k = np.arange(1, count)
            yield (k * (count - 1) + k - 1).astype("<u4").tobytes()
            yield np.ones(count - 1, "<f4").tobytes()
        if self._faces is not None:
            yield np.ascontiguousarray(self._faces, "<u4").tobytes()
            return
        colours = np.empty((self._points, 4), "u1")
        for start in range(0, self._points, _WINDOW):
            stop = min(start + _WINDOW, self._points)
            colours[start:stop] = self._colours(self._first(start, stop) @ self._turn[2])
        yield colours.tobytes()

    def _colours(self, depths: Array) -> Array:
        """Return linear RGBA of depths, as glTF wants vertex colours (section 3.7.2.1)."""
        low, high = self.bounds.depths
        at = (depths - low) / ((high - low) or 1.0) * (len(_CIVIDIS) - 1)
        scale = _CIVIDIS / 255.0
        linear = np.where(scale <= 0.04045, scale / 12.92, ((scale + 0.055) / 1.055) ** 2.4)
        steps = np.arange(len(_CIVIDIS))
        colours = np.stack([np.interp(at, steps, linear[:, c]) for c in range(3)], axis=1)
        return np.rint(255.0 * np.column_stack([colours, np.ones(len(at))]))

    def _json(self) -> bytes:
        """Return the description of all data."""
        buffers = _Views([len(part) for part in self._parts])
        accessors: list[dict[str, Any]] = []
        count = len(self._frames)
        primitive: dict[str, Any] = {
            "attributes": {},
            "mode": _POINTS if self._faces is None else _TRIANGLES,
            "material": 0,
        }
        mesh: dict[str, Any] = {"primitives": [primitive], "name": "surface"}
        document: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "smsr"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0, "name": "surface", **self._placement()}],
            "meshes": [mesh],
            "materials": [_material(shaded=self._faces is not None)],
        }
        if count > 1:
            document["animations"] = [_animation(self._options, count, buffers, accessors)]
        view = buffers.next(_VERTICES if self._faces is None else _INDICES)
        if self._faces is None:
            primitive["attributes"]["COLOR_0"] = len(accessors)
            colours = _accessor(view, _UBYTE, self._points, "VEC4", normalized=True)
            accessors.append(colours)
        else:
            primitive["indices"] = len(accessors)
            accessors.append(_accessor(view, _UINT, self._faces.size, "SCALAR"))
        view = buffers.add(count * self._block, _VERTICES, byteStride=self._record.itemsize)
        primitive["attributes"] |= self._attributes(view, 0, self.bounds.first, accessors)
        if count > 1:
            primitive["targets"] = [
                self._attributes(view, k, moves, accessors)
                for k, moves in enumerate(self.bounds.moves, 1)
            ]
            mesh["extras"] = {"targetNames": [f"frame {t}" for t in self._frames[1:]]}
        used = [] if self._faces is not None else ["KHR_materials_unlit"]
        if self._options.quantised:
            used.append("KHR_mesh_quantization")
            document["extensionsRequired"] = ["KHR_mesh_quantization"]
        if used:
            document["extensionsUsed"] = used
        document |= {
            "accessors": accessors,
            "bufferViews": buffers.views,
            "buffers": [{"byteLength": buffers.length}],
        }
        return json.dumps(document, separators=(",", ":"), allow_nan=False).encode("ascii")

    def _placement(self) -> dict[str, Any]:
        """Return rotation and scale of the node: upright and of about the size 2."""
        fit = 1.0 / self.bounds.extent
        scale = fit * self.bounds.span if self._options.quantised else fit
        turn = Rotation.from_matrix(self._turn).as_quat()
        return {
            "rotation": turn.tolist(),
            "scale": [scale] * 3,
            "extras": {"unitsOfMeasurements": self.bounds.extent, "fps": self._options.fps},
        }

    def _attributes(
        self, view: int, k: int, bounds: Array, accessors: list[dict[str, Any]]
    ) -> dict[str, int]:
        """Describe block k of the frames."""
        quantised = self._options.quantised
        limits = _quantise(bounds, self.bounds.span) if quantised else bounds
        named = {"POSITION": len(accessors)}
        accessors.append(
            _accessor(
                view,
                _SHORT if quantised else _FLOAT,
                self._points,
                "VEC3",
                byteOffset=k * self._block,
                min=limits[0].tolist(),
                max=limits[1].tolist(),
                normalized=quantised,
            )
        )
        if self._normals is not None:
            named["NORMAL"] = len(accessors)
            fields = self._record.fields
            assert fields is not None  # noqa: S101  (it is a record)
            accessors.append(
                _accessor(
                    view,
                    _BYTE if quantised else _FLOAT,
                    self._points,
                    "VEC3",
                    byteOffset=k * self._block + fields["normal"][1],
                    normalized=quantised,
                )
            )
        return named


def write_glb(
    path: str | os.PathLike[str],
    shapes: Array,
    cameras: Array,
    faces: Array | None = None,
    options: GlbOptions | None = None,
    translations: Array | None = None,
) -> None:
    """Write a moving surface as an animated GLB.

    Parameters
    ----------
    path : path
    shapes : ndarray of shape (T, N, 3)
        Written as float32 where not quantised.
    cameras : ndarray of shape (T, 2, 3)
        The surface stands as the first of them saw it, y up.
    faces : ndarray of shape (F, 3), optional
        Triangles, point indices from 0; without them, the file holds points.
    options : GlbOptions, optional
    translations : ndarray of shape (T, 2), optional
        By which ``image_v="auto"`` is decided; otherwise it is "up".

    Raises
    ------
    AnimationTooLarge
        A GLB cannot hold so much.
    """
    frames, points = shapes.shape[:2]
    rows = shapes.reshape(-1, 3)
    glb = Glb(
        lambda start, stop: rows[start:stop],
        frames=frames,
        points=points,
        camera=cameras[0],
        translation=None if translations is None else translations[0],
        faces=faces,
        options=options,
    )
    with Path(path).open("wb") as file:
        file.writelines(glb.pieces())


class _Extremes:
    """Least and greatest of arrays that come in parts; of no array yet, infinite."""

    def __init__(self, count: int) -> None:
        self.found = np.empty((count, 2, 3), np.float32)
        self.found[:, 0], self.found[:, 1] = np.inf, -np.inf

    def take(self, k: int, values: Array) -> None:
        """Regard values (n, points, 3) of the k-th and following."""
        found = self.found[k : k + len(values)]
        np.minimum(found[:, 0], values.min(axis=1), out=found[:, 0])
        np.maximum(found[:, 1], values.max(axis=1), out=found[:, 1])


class _Normals:
    """Normals at the vertices of a triangle mesh, the mean of their faces' by area."""

    def __init__(self, faces: Array, points: int) -> None:
        self._faces = faces
        corners = faces.ravel()
        owners = np.repeat(np.arange(len(faces)), 3)
        ones = np.ones(len(corners), np.float32)
        self._sum = csr_array((ones, (corners, owners)), (points, len(faces)))

    def __call__(self, shape: Array) -> Array:
        """Return unit normals (N, 3) of points (N, 3); those of no face point along z."""
        a, b, c = (shape[self._faces[:, k]] for k in range(3))
        normals = self._sum @ np.cross(b - a, c - a)
        lengths = np.linalg.norm(normals, axis=1)
        flat = lengths <= 1e-30
        normals[flat] = (0.0, 0.0, 1.0)
        lengths[flat] = 1.0
        found: Array = normals / lengths[:, None]
        return found


class _Views:
    """The buffer views: parts of the binary chunk, one behind the other."""

    def __init__(self, sizes: list[int]) -> None:
        self.views: list[dict[str, int]] = []
        self.length = 0
        self._sizes = iter(sizes)

    def next(self, target: int | None = None) -> int:
        """Add a view of the next of the small parts."""
        return self.add(next(self._sizes), target)

    def add(self, size: int, target: int | None = None, **more: int) -> int:
        """Add a view and return its index."""
        view = {"buffer": 0, "byteOffset": self.length, "byteLength": size, **more}
        if target is not None:
            view["target"] = target
        self.views.append(view)
        self.length += size
        return len(self.views) - 1


def _record(quantised: bool, shaded: bool) -> np.dtype[Any]:
    """Return what is stored of a point; each member begins at a multiple of four bytes."""
    if not quantised:
        normal = [("normal", "<f4", (3,))] if shaded else []
        return np.dtype([("position", "<f4", (3,)), *normal])
    names, formats, offsets = ["position"], [("<i2", (3,))], [0]
    if shaded:
        names, formats, offsets = [*names, "normal"], [*formats, ("i1", (3,))], [0, 8]
    return np.dtype(
        {
            "names": names,
            "formats": formats,
            "offsets": offsets,
            "itemsize": 12 if shaded else 8,
        }
    )


def _quantise(values: Array, span: float) -> NDArray[np.int16]:
    # In float64, so that it is monotonous: bounds become the bounds of what is written.
    found: NDArray[np.int16] = np.rint(values.astype(np.float64) * (32767.0 / span)).astype("<i2")
    return found


def _upright(camera: Array, *, down: bool) -> NDArray[np.float64]:
    """Return the rotation (3, 3) from the object frame to x right, y up, z towards the viewer."""
    rows = np.asarray(camera, np.float64)
    right, v = rows / camera_scales(rows[None])[0]
    up = -v if down else v
    return np.stack([right, up, np.cross(right, up)])


def _accessor(view: int, component: int, count: int, kind: str, **more: Any) -> dict[str, Any]:
    given = {name: value for name, value in more.items() if value}
    return {
        "bufferView": view,
        "componentType": component,
        "count": count,
        "type": kind,
        **given,
    }


def _animation(
    options: GlbOptions, count: int, buffers: _Views, accessors: list[dict[str, Any]]
) -> dict[str, Any]:
    """Describe the blending from frame to frame, and its data."""
    last = float(np.float32((count - 1) / options.fps * options.every))
    keys = {"min": [0.0], "max": [last]}
    times = len(accessors)
    accessors.append(_accessor(buffers.next(), _FLOAT, count, "SCALAR", **keys))
    where, values = buffers.next(), buffers.next()
    sparse = {
        "count": count - 1,
        "indices": {"bufferView": where, "componentType": _UINT},
        "values": {"bufferView": values},
    }
    accessors.append(
        {
            "componentType": _FLOAT,
            "count": count * (count - 1),
            "type": "SCALAR",
            "sparse": sparse,
        }
    )
    sampler = {"input": times, "output": times + 1, "interpolation": "LINEAR"}
    channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
    return {"name": "sequence", "channels": [channel], "samplers": [sampler]}


def _material(*, shaded: bool) -> dict[str, Any]:
    if not shaded:  # the colours are those of the points
        return {
            "name": "points",
            "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
            "extensions": {"KHR_materials_unlit": {}},
        }
    return {
        "name": "surface",
        "doubleSided": True,
        "pbrMetallicRoughness": {
            "baseColorFactor": list(_GREY),
            "metallicFactor": 0.0,
            "roughnessFactor": 0.7,
        },
    }
