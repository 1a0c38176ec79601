"""Which array of a file is meant: by key, by a customary name, or by shape."""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from smsr.errors import AmbiguousArray, ArrayNotFound, InputError, TooLarge, WrongShape

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    import numpy as np
    from numpy.typing import NDArray

Role: TypeAlias = Literal["measurements", "ground_truth", "faces"]

CUSTOMARY_NAMES: dict[Role, tuple[str, ...]] = {
    "measurements": (
        "W",
        "measurements",
        "measurement_matrix",
        "tracks",
        "tracks2d",
        "points2d",
        "W2D",
        "xy",
    ),
    "ground_truth": (
        "ground_truth",
        "groundtruth",
        "GT",
        "GT.shape3D",
        "S_gt",
        "Sgt",
        "S",
        "S_world",
        "shape3D",
        "shapes",
        "S3D",
        "points3d",
        "X3D",
    ),
    "faces": ("faces", "F", "triangles", "tri", "tris", "Tri", "face", "f"),
}
"""Names that mean a role, best first."""

_SHOWN = 20


@dataclass(frozen=True, slots=True)
class StoredArray:
    """An array in a file that has been found but not read.

    Attributes
    ----------
    name : str
        Its name, with fields of structs after a dot; empty where the format has no names.
    shape : tuple of int
        As a reader of the file's own tool would see it.
    dtype : dtype or None
        None where the entries are no real numbers.
    read : callable
        Returns the array; to be called while the file is open.
    problem : InputError or None
        Why it cannot be used, raised if it is chosen.
    damaged : bool
        Whether its shape is lost, so that nothing tells whether it was meant.
    """

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any] | None
    read: Callable[[], NDArray[Any]]
    problem: InputError | None = None
    damaged: bool = False

    @property
    def usable(self) -> bool:
        """Whether it holds real numbers, more than one."""
        return self.problem is None and math.prod(self.shape) > 1

    def __str__(self) -> str:
        return f"{self.name} {self.shape}"


def select(stored: Iterable[StoredArray], key: str | None, role: Role) -> StoredArray:
    """Return the array that is meant.

    Parameters
    ----------
    stored : iterable of StoredArray
        All arrays in the file.
    key : str or None
        Its name, if the caller knows it.
    role : {"measurements", "ground_truth", "faces"}
        What it is for. Without a key, an array with a customary name of the role is taken, else
        the only one with a shape that fits the role, else the only one there is.

    Raises
    ------
    ArrayNotFound, AmbiguousArray
        None or several could be meant; the message lists what there is.
    InputError
        A damaged array could be meant: another must not be taken in its place.
    """
    stored = list(stored)
    if key is not None:
        return _by_key(stored, key)
    usable = [array for array in stored if array.usable and len(array.shape) > 1]
    damaged = [array for array in stored if array.damaged]
    by_name = {array.name: array for array in (*usable, *damaged)}
    for name in CUSTOMARY_NAMES[role]:
        if name in by_name:
            return by_name[name]
    others = {name for other in CUSTOMARY_NAMES if other != role for name in CUSTOMARY_NAMES[other]}
    for array in damaged:
        if array.name not in others:
            return array
    free = [array for array in usable if array.name not in others]
    for choice in ([array for array in free if _fits(array.shape, role)], free, usable, stored):
        if len(choice) == 1:
            return choice[0]
        if choice:
            raise AmbiguousArray(
                f"The file holds {len(choice)} arrays that could be the {_words(role)}: "
                f"{_listed(choice)}. Name the one that is meant by its key.",
                role=role,
                arrays=_facts(choice),
            )
    raise ArrayNotFound("The file holds no array.", role=role, arrays=[])


def check_chosen(array: StoredArray, limit: int) -> None:
    """Refuse an array that cannot be used or would be larger than `limit` bytes."""
    if array.problem is not None:
        raise array.problem
    if not array.shape:
        raise WrongShape(f"The array{_quoted(array.name)} is a single number.", shape=[])
    if 0 in array.shape:
        raise WrongShape(
            f"The array{_quoted(array.name)} is empty: its shape is {array.shape}.",
            shape=list(array.shape),
        )
    assert array.dtype is not None  # noqa: S101  (what has no dtype has a problem)
    check_size(math.prod(array.shape) * array.dtype.itemsize, limit, array.name)


def check_size(size: int, limit: int, name: str = "") -> None:
    """Refuse more than `limit` bytes of decompressed data."""
    if size > limit:
        raise TooLarge(
            f"The array{_quoted(name)} takes {size} bytes; the limit is {limit}.",
            size=size,
            limit=limit,
        )


def _by_key(stored: list[StoredArray], key: str) -> StoredArray:
    for array in stored:
        if array.name == key:
            return array
    named = [array for array in stored if array.name]
    if not named and stored:
        raise ArrayNotFound(
            f"The file holds one array without a name, so there is no key {key!r}; leave the key "
            f"out.",
            key=key,
            arrays=[],
        )
    names = {array.name.lower(): array.name for array in named}
    near = difflib.get_close_matches(key.lower(), names, n=1)
    hint = f" Did you mean {names[near[0]]!r}?" if near else ""
    raise ArrayNotFound(
        f"The file holds no array {key!r}.{hint} It holds {_listed(named) or 'none'}.",
        key=key,
        arrays=_facts(named),
    )


def _fits(shape: tuple[int, ...], role: Role) -> bool:
    match role, shape:
        case "measurements", (rows, points):
            return rows % 2 == 0 and rows >= 6 and points >= 4
        case "measurements", (frames, a, b):
            return frames >= 3 and ((a == 2) != (b == 2))
        case "ground_truth", (rows, points):
            return rows % 3 == 0 and rows >= 9 and points >= 4
        case "ground_truth", (frames, a, b):
            return frames >= 3 and ((a == 3) != (b == 3))
        case "faces", (_, corners):
            return corners == 3
        case _:
            return False


def _words(role: Role) -> str:
    return role.replace("_", " ")


def _quoted(name: str) -> str:
    return f" {name!r}" if name else ""


def _listed(arrays: list[StoredArray]) -> str:
    shown = ", ".join(str(array) for array in arrays[:_SHOWN])
    return shown + (f" and {len(arrays) - _SHOWN} more" if len(arrays) > _SHOWN else "")


def _facts(arrays: list[StoredArray]) -> list[dict[str, object]]:
    return [{"name": array.name, "shape": list(array.shape)} for array in arrays[:_SHOWN]]
