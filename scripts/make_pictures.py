"""Draw docs/images/reconstruction.png: input tracks, then the reconstructed mesh in four frames.

Everything drawn comes from a real run on the generated example: the tracks go through
`smsr.reconstruct`, and the meshes are its shapes.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from PIL import Image

import smsr
from smsr.synthetic import make_example

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

FRAMES = (16, 24, 40, 50)
INK, TRACK, SKIN = "#20252b", "#3b6ea8", np.array([0.93, 0.72, 0.56])
LIGHT = np.array([-0.35, 0.5, 0.8]) / np.linalg.norm([-0.35, 0.5, 0.8])
TARGET = Path(__file__).resolve().parent.parent / "docs" / "images" / "reconstruction.png"


def draw_tracks(axes: Axes, measurements: NDArray[np.float64], frame: int) -> None:
    """Draw a frame's points and where each came from in the frames before."""
    tracks = measurements.reshape(-1, 2, measurements.shape[1])
    chosen = np.random.default_rng(0).choice(tracks.shape[2], 700, replace=False)
    tail = tracks[max(frame - 7, 0) : frame + 1, :, chosen].transpose(2, 0, 1)
    axes.add_collection(LineCollection(list(tail), colors=TRACK, linewidths=0.6, alpha=0.45))
    axes.scatter(*tracks[frame][:, chosen], s=3.0, color=INK, linewidths=0, zorder=2)
    axes.invert_yaxis()  # pixels count from the top


def draw_mesh(axes: Axes, vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> None:
    """Draw an orthographic view along z, flat-shaded, far triangles first."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    facing = normals[:, 2] > 0
    lit = np.clip(normals @ LIGHT, 0.0, None)
    half = LIGHT + np.array([0.0, 0.0, 1.0])  # between the light and the viewer
    gloss = np.clip(normals @ (half / np.linalg.norm(half)), 0.0, None) ** 30
    colours = np.clip(SKIN * (0.22 + 0.78 * lit)[:, None] + 0.16 * gloss[:, None], 0.0, 1.0)
    order = np.argsort(corners[:, :, 2].mean(axis=1))
    order = order[facing[order]]
    axes.add_collection(
        PolyCollection(
            list(corners[order, :, :2]),
            facecolors=colours[order],
            edgecolors=colours[order],
            linewidths=0.35,
        )
    )


def turned(vertices: NDArray[np.float64], degrees: float) -> NDArray[np.float64]:
    """Turn points about the vertical axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return vertices @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]).T


def main() -> None:
    """Reconstruct the example and draw it."""
    example = make_example(frames=60, side=70)
    result = smsr.reconstruct(example.measurements)
    error = smsr.evaluate(example.ground_truth, result)
    # The depth sign of an orthographic camera is free: show the side that the truth shows.
    Q = error.alignment
    shapes = np.asarray(result.shapes, np.float64) @ Q.T

    figure, grid = plt.subplots(3, len(FRAMES), figsize=(11, 9.6), facecolor="white")
    for column, frame in enumerate(FRAMES):
        draw_tracks(grid[0, column], example.measurements, frame)
        draw_mesh(grid[1, column], turned(shapes[frame], 0.0), example.faces)
        draw_mesh(grid[2, column], turned(shapes[frame], -50.0), example.faces)
        grid[0, column].set_title(f"frame {frame}", fontsize=11, color=INK)
    for row, label in enumerate(("2D tracks in", "3D surface out", "the same, turned by 50°")):
        middle = 0.96 - (row + 0.5) * 0.96 / 3
        figure.text(0.02, middle, label, rotation=90, ha="center", va="center", color=INK)
        for axes in grid[row]:
            axes.set_aspect("equal")
            axes.autoscale_view()
            axes.axis("off")
    figure.subplots_adjust(left=0.04, right=1, top=0.96, bottom=0, wspace=0.02, hspace=0.02)
    TARGET.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(TARGET, dpi=100)
    with Image.open(TARGET) as picture:  # 256 colours are enough and a third of the size
        picture.convert("RGB").quantize(256).save(TARGET, optimize=True)
    print(f"{TARGET}: e3D {error.e3d:.4f}, {example.measurements.shape[1]} points")


if __name__ == "__main__":
    main()
