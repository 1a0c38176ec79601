"""Results as files: what `write_npz` wrote of a reconstruction, opened again."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smsr.errors import WrongShape
from smsr.files.opening import open_array
from smsr.result import MovingSurface

if TYPE_CHECKING:
    import os


def open_result(path: str | os.PathLike[str]) -> MovingSurface:
    """Open a result.npz, of the command line or of the service.

    Parameters
    ----------
    path : path
        With the arrays ``shapes`` (T, N, 3), ``cameras`` (T, 2, 3) and ``translations`` (T, 2).

    Returns
    -------
    MovingSurface
        The shapes are a memory map.

    Raises
    ------
    ArrayNotFound
        One of the arrays is missing.
    WrongShape
        Their shapes do not agree.
    UnreadableFile, UnsupportedFormat
        As `smsr.files.open_array`.
    """
    shapes, cameras, translations = (
        open_array(path, key=name, role="ground_truth")
        for name in ("shapes", "cameras", "translations")
    )
    frames = len(shapes)
    if (
        shapes.ndim != 3
        or shapes.shape[2] != 3
        or cameras.shape != (frames, 2, 3)
        or translations.shape != (frames, 2)
    ):
        raise WrongShape(
            f"shapes {shapes.shape}, cameras {cameras.shape} and translations "
            f"{translations.shape} are not those of one result; they must be (T, N, 3), (T, 2, 3) "
            "and (T, 2)."
        )
    return MovingSurface(shapes, cameras, translations)
