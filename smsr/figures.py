"""Figures of a result: what a person looks at before trusting it.

Every figure reads in black and white: lines differ by dashes and markers, and the map of depths
grows lighter all the way. Equal results give equal bytes. Needs the extra ``smsr[plot]``.
"""

from __future__ import annotations

import io
import threading
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from smsr.errors import FiguresUnavailable, NothingToDraw
from smsr.files.glb import v_grows_down
from smsr.rotations import camera_scales, complete

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from smsr.files.glb import ImageV

    Array = NDArray[np.floating[Any]]

FigureName = Literal["convergence", "singular-values", "error", "shapes", "cameras"]
FigureFormat = Literal["png", "svg"]

NAMES: tuple[FigureName, ...] = get_args(FigureName)
FORMATS: tuple[FigureFormat, ...] = get_args(FigureFormat)

MOST_POINTS = 20_000
"""Points of a frame that are drawn at most."""

MOST_TRIANGLES = 30_000
"""Triangles that are drawn; of a larger mesh, the points are."""

_INK, _BLUE, _ORANGE, _PALE = "#1f2430", "#2a6099", "#c4601d", "#d9dde3"
_DOTS_PER_INCH = 150
_SIDE_TURN = 60.0
_STYLE = {
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.labelsize": 9.0,
    "axes.edgecolor": _INK,
    "axes.labelcolor": _INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": _PALE,
    "grid.linewidth": 0.6,
    "text.color": _INK,
    "xtick.color": _INK,
    "ytick.color": _INK,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.fontsize": 8.0,
    "legend.framealpha": 0.9,
    "legend.edgecolor": "none",
    "legend.facecolor": "white",
    "lines.linewidth": 1.4,
    "savefig.facecolor": "white",
    # Text stays text, and names of clip paths do not depend on chance.
    "svg.fonttype": "none",
    "svg.hashsalt": "smsr",
}

_lock = threading.Lock()
"""Matplotlib's settings belong to the process, so one figure is drawn at a time."""


@dataclass(frozen=True)
class FigureSource:
    """What figures are drawn from.

    Attributes
    ----------
    report : mapping
        report.json; may be empty where only `shapes` and `cameras` are drawn.
    cameras : ndarray of shape (T, 2, 3)
    translations : ndarray of shape (T, 2)
    points : int
        N.
    read : callable
        Gives rows ``start`` to ``stop`` of the shapes as a (T N, 3) matrix.
    faces : ndarray of shape (F, 3), optional
        Triangles; drawn where there are at most `MOST_TRIANGLES`.
    image_v : "auto", "up" or "down"
        Where the second image coordinate grows to; "auto" is "down" where the first frame has no
        negative coordinates.
    """

    report: Mapping[str, Any]
    cameras: Array
    translations: Array
    points: int
    read: Callable[[int, int], Array]
    faces: NDArray[np.integer[Any]] | None = None
    image_v: ImageV = "auto"

    @cached_property
    def down(self) -> bool:
        """Whether the second image coordinate grows downwards."""
        first = self.frame(0, -(-self.points // MOST_POINTS))
        return v_grows_down(self.image_v, first, self.cameras[0], self.translations[0])

    @cached_property
    def rotations(self) -> NDArray[np.float64]:
        """Rotations (T, 3, 3) to x right, y up, z towards the viewer."""
        cameras = np.asarray(self.cameras, np.float64)
        cameras = cameras / camera_scales(cameras)[:, None, None]
        if self.down:
            cameras[:, 1] *= -1.0
        return complete(cameras)

    def frame(self, t: int, step: int) -> NDArray[np.float64]:
        """Read every `step`-th point of frame t, a window at a time."""
        window = step * max(1, (1 << 18) // step)
        first, parts = t * self.points, []
        for start in range(0, self.points, window):
            stop = min(start + window, self.points)
            parts.append(np.array(self.read(first + start, first + stop)[::step], np.float64))
        return np.concatenate(parts)


def draw(name: FigureName, source: FigureSource, form: FigureFormat = "png") -> bytes:
    """Draw a figure.

    Parameters
    ----------
    name : {"convergence", "singular-values", "error", "shapes", "cameras"}
    source : FigureSource
    form : {"png", "svg"}

    Returns
    -------
    bytes
        The file.

    Raises
    ------
    FiguresUnavailable
        Matplotlib is missing.
    NothingToDraw
        The report has no such numbers, for instance no error without ground truth.
    """
    try:
        from matplotlib import style
        from matplotlib.figure import Figure
    except ImportError:
        raise FiguresUnavailable("Figures need Matplotlib: pip install 'smsr[plot]'.") from None
    buffer = io.BytesIO()
    with _lock, style.context(["default", _STYLE]):
        figure = Figure(dpi=_DOTS_PER_INCH, layout="constrained")
        _FIGURES[name](figure, source)
        undated: dict[str, Any] = {"Date": None} if form == "svg" else {"Software": None}
        figure.savefig(buffer, format=form, dpi=_DOTS_PER_INCH, metadata=undated)
    return buffer.getvalue()


def view_angles(rotations: Array) -> NDArray[np.float64]:
    """Return how the camera stood relative to its first view.

    Parameters
    ----------
    rotations : ndarray of shape (T, 3, 3)
        Rows are the camera's axes: right, up, and towards it from the object.

    Returns
    -------
    ndarray of shape (T, 3)
        Radians: azimuth, positive to the right; elevation, positive upwards; and roll, positive
        where the camera turns counter-clockwise.
    """
    axes = np.asarray(rotations, np.float64)
    axes = axes @ axes[0].T
    up, toward = axes[:, 1], axes[:, 2]
    azimuth = np.arctan2(toward[:, 0], toward[:, 2])
    elevation = np.arcsin(np.clip(toward[:, 1], -1.0, 1.0))
    right = np.stack([np.cos(azimuth), np.zeros(len(azimuth)), -np.sin(azimuth)], axis=1)
    level = np.cross(toward, right)
    roll = np.arctan2(-np.einsum("ti,ti->t", up, right), np.einsum("ti,ti->t", up, level))
    return np.stack([azimuth, elevation, roll], axis=1)


def _convergence(figure: Figure, source: FigureSource) -> None:
    """Draw the stopping residual of each iterative stage over its iterations."""
    stages = [stage for stage in source.report.get("stages", ()) if stage["residuals"]]
    if not stages:
        raise NothingToDraw("No stage of this run iterated: there is no convergence to show.")
    figure.set_size_inches(3.2 * len(stages) + 0.4, 2.9)
    options = source.report.get("options", {})
    tolerances = {"cameras": "camera_tolerance", "shapes": "shape_tolerance"}
    for column, stage in enumerate(stages):
        axes = figure.add_subplot(1, len(stages), column + 1)
        residuals = np.asarray(stage["residuals"], float)
        # Long runs are listed thinned, the last iteration among them.
        total = max(stage["iterations"], len(residuals))
        every = -(-total // 500) if total > len(residuals) else 1
        iterations = total - every * np.arange(len(residuals))[::-1]
        axes.plot(iterations, residuals, color=_BLUE, label="residual")
        axes.plot(*(x[-1:] for x in (iterations, residuals)), "o", color=_INK, markersize=4.0)
        tolerance = options.get(tolerances.get(stage["name"], ""))
        if tolerance and residuals.min() < 1e3 * tolerance:
            axes.axhline(tolerance, color=_ORANGE, linestyle=(0, (5, 3)), label="tolerance")
            axes.legend(loc="upper right")
        axes.set_yscale("log")
        axes.set_xlim(0, total * 1.03)
        ended = "converged" if stage["converged"] else "not converged"
        axes.set_title(f"{stage['name']}: {ended} after {total} iterations", loc="left")
        axes.set_xlabel("iteration")
        if column == 0:
            axes.set_ylabel("relative residual")


def _singular_values(figure: Figure, source: FigureSource) -> None:
    """Draw the singular values of the centred measurements, those that the basis spans filled."""
    from matplotlib.ticker import MaxNLocator

    values = np.asarray(source.report.get("singular_values", ()), float)
    values = values[values > 0.0]
    if not len(values):
        raise NothingToDraw("The report lists no singular values.")
    basis_size = source.report["basis_size"]
    rank = 3 * basis_size
    figure.set_size_inches(5.2, 3.1)
    axes = figure.add_subplot()
    index = np.arange(1, len(values) + 1)
    inside = index <= rank
    bottom = 10.0 ** np.floor(np.log10(values.min()) - 0.3)
    axes.vlines(index, bottom, values, color=np.where(inside, _BLUE, "#9aa3af"), linewidth=0.8)
    axes.plot(
        index[inside],
        values[inside],
        "o",
        color=_BLUE,
        markersize=4.5,
        label=f"first 3K = {rank}, what K = {basis_size} basis shapes can span",
    )
    if not inside.all():
        axes.plot(
            index[~inside],
            values[~inside],
            "s",
            color=_INK,
            markersize=3.5,
            markerfacecolor="white",
            markeredgewidth=0.8,
            label="the rest",
        )
    if 0 < rank < len(values):
        axes.axvline(rank + 0.5, color=_ORANGE, linestyle=(0, (5, 3)), linewidth=1.2)
    axes.set_yscale("log")
    axes.set_ylim(bottom, values.max() * 3.0)
    axes.set_xlim(0.0, len(values) + 1.0)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("index")
    axes.set_ylabel("singular value (unit of the measurements)")
    axes.legend(loc="upper right")


def _error(figure: Figure, source: FigureSource) -> None:
    """Draw each frame's part of e3D."""
    metrics = source.report.get("metrics") or {}
    if not metrics.get("per_frame"):
        raise NothingToDraw("The job had no ground truth: there is no error to show.")
    errors = np.asarray(metrics["per_frame"], float)
    figure.set_size_inches(5.2, 2.9)
    axes = figure.add_subplot()
    frames = np.arange(len(errors))
    axes.fill_between(frames, errors, color=_PALE, linewidth=0.0)
    axes.plot(frames, errors, color=_BLUE, label="each frame")
    mean = metrics["e3d"]
    axes.axhline(mean, color=_ORANGE, linestyle=(0, (5, 3)), label=f"mean, e3D = {mean:.4f}")
    aligned = metrics["e3d_per_frame"]
    axes.axhline(
        aligned,
        color=_INK,
        linestyle=(0, (1, 2)),
        label=f"mean with each frame aligned on its own, {aligned:.4f}",
    )
    axes.set_xlim(0, max(len(errors) - 1, 1))
    axes.set_ylim(0.0, 1.45 * float(errors.max()) or 1.0)
    axes.legend(loc="upper left")
    axes.set_xlabel("frame")
    axes.set_ylabel("error (standard deviations of the truth)")


def _shapes(figure: Figure, source: FigureSource) -> None:
    """Draw four frames as their cameras saw them, and from the side."""
    count = len(source.cameras)
    frames = np.unique(np.linspace(0, count - 1, 4).round().astype(int))
    faces = source.faces
    meshed = faces is not None and 0 < len(faces) <= MOST_TRIANGLES
    step = 1 if meshed else -(-source.points // MOST_POINTS)
    rotations = source.rotations
    angle = np.radians(_SIDE_TURN)
    c, s = np.cos(angle), np.sin(angle)
    aside = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    seen = [source.frame(int(t), step) @ rotations[t].T for t in frames]
    views = np.array([seen, [shape @ aside.T for shape in seen]])
    low, high = views.min(axis=(1, 2)), views.max(axis=(1, 2))
    sizes = np.maximum(high - low, 1e-12 * (1.0 + np.abs(high)))[:, :2]
    width = sizes[:, 0].max()
    heights = np.maximum(sizes[:, 1], 0.55 * width)
    inches = 7.0 * heights.sum() / (len(frames) * width)
    figure.set_size_inches(7.4, min(float(inches), 9.0) + 0.5)
    grid = figure.subplots(2, len(frames), squeeze=False, height_ratios=heights)
    depths = (float(views[0, :, :, 2].min()), float(views[0, :, :, 2].max()))
    drawn = None
    for row in range(2):
        for column, t in enumerate(frames):
            axes, shape = grid[row, column], views[row, column]
            if meshed:
                assert faces is not None  # noqa: S101
                _mesh(axes, shape, faces)
            else:
                drawn = _cloud(axes, shape, views[0, column, :, 2], depths)
            middle = (low[row] + high[row]) / 2.0
            axes.set_xlim(middle[0] - 0.54 * width, middle[0] + 0.54 * width)
            axes.set_ylim(middle[1] - 0.54 * heights[row], middle[1] + 0.54 * heights[row])
            axes.set_aspect("equal")
            axes.grid(visible=False)
            axes.set(xticks=[], yticks=[])
            for spine in axes.spines.values():
                spine.set_visible(False)
            if row == 0:
                axes.set_title(f"frame {t}")
    grid[0, 0].set_ylabel("camera's view")
    grid[1, 0].set_ylabel(f"turned by {_SIDE_TURN:g}°")
    if drawn is not None:
        bar = figure.colorbar(drawn, ax=grid, shrink=0.7, pad=0.02, aspect=30)
        bar.set_label("depth towards the camera\n(unit of the measurements)")
        bar.outline.set_linewidth(0.5)


def _mesh(axes: Axes, shape: Array, faces: NDArray[np.integer[Any]]) -> None:
    """Draw a mesh along z, flat-shaded and lit from both sides, far triangles first."""
    from matplotlib.collections import PolyCollection

    corners = shape[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    normals *= np.where(normals[:, 2:] < 0.0, -1.0, 1.0)
    light = np.array([-0.4, 0.45, 0.8]) / np.linalg.norm([-0.4, 0.45, 0.8])
    lit = 0.16 + 0.8 * np.clip(normals @ light, 0.0, 1.0)
    order = np.argsort(corners[:, :, 2].mean(axis=1), kind="stable")
    colours = np.repeat(lit[order, None], 3, axis=1) * (0.96, 0.98, 1.0)
    axes.add_collection(
        PolyCollection(
            corners[order, :, :2],
            facecolors=colours,
            edgecolors=colours,
            linewidths=0.25,
            rasterized=True,
        )
    )


def _cloud(axes: Axes, shape: Array, depth: Array, limits: tuple[float, float]) -> Any:
    """Draw points along z, near ones last, coloured by their depth before the camera."""
    order = np.argsort(shape[:, 2], kind="stable")
    size = float(np.clip(3000.0 / len(shape), 0.6, 16.0))
    return axes.scatter(
        shape[order, 0], shape[order, 1], s=size, c=depth[order], cmap="cividis",
        vmin=limits[0], vmax=limits[1], linewidths=0.3 if size > 6.0 else 0.0, edgecolors=_INK,
        rasterized=len(shape) > 2000,
    )  # fmt: skip


def _cameras(figure: Figure, source: FigureSource) -> None:
    """Draw where the camera was relative to its first view, and where the image had the object."""
    azimuth, elevation, roll = view_angles(source.rotations).T
    figure.set_size_inches(9.2, 3.0)
    grid = figure.add_gridspec(1, 3, width_ratios=(1.0, 1.2, 0.95))
    angles, image = figure.add_subplot(grid[0]), figure.add_subplot(grid[2])
    globe = figure.add_subplot(grid[1], projection="mollweide")
    frames = np.arange(len(azimuth))
    some = max(1, len(frames) // 8)
    for name, values, colour, dashes, marker in (
        ("azimuth", azimuth, _BLUE, "-", "o"),
        ("elevation", elevation, _ORANGE, (0, (5, 2)), "s"),
        ("roll", roll, _INK, (0, (1, 1.5)), "^"),
    ):
        angles.plot(
            frames, np.degrees(np.unwrap(values)), color=colour, linestyle=dashes, marker=marker,
            markersize=3.5, markevery=some, label=name,
        )  # fmt: skip
    angles.set_xlabel("frame")
    angles.set_ylabel("angle to the first view (degrees)")
    angles.set_xlim(0, max(len(frames) - 1, 1))
    angles.legend(
        loc="lower center", bbox_to_anchor=(0.45, 1.0), ncols=3, handlelength=2.4, columnspacing=0.9
    )

    jumps = np.flatnonzero(np.abs(np.diff(azimuth)) > np.pi) + 1
    globe.plot(np.insert(azimuth, jumps, np.nan), np.insert(elevation, jumps, np.nan), color=_BLUE)
    _ends(globe, azimuth, elevation)
    globe.set_title("direction of the camera\n(azimuth, elevation)")
    globe.set_xticks(np.radians([-120, -60, 0, 60, 120]), ["", "−60°", "0°", "60°", ""])
    globe.set_yticks(np.radians([-60, -30, 0, 30, 60]))
    globe.tick_params(labelsize=7.0)

    u, v = np.asarray(source.translations, float).T
    image.plot(u, v, color=_BLUE)
    _ends(image, u, v)
    # Not less than a twentieth of the object, so that rounding does not look like motion.
    least = 0.025 * float(np.ptp(source.frame(0, -(-source.points // MOST_POINTS)), axis=0).max())
    half = max(0.6 * float(np.ptp(u)), 0.6 * float(np.ptp(v)), least, 1e-9)
    for values, limit in ((u, image.set_xlim), (v, image.set_ylim)):
        middle = (float(values.min()) + float(values.max())) / 2.0
        limit(middle - half, middle + half)
    image.set_aspect("equal")
    image.locator_params(nbins=5)
    if source.down:
        image.invert_yaxis()
    image.set_title("centre of the object in the image")
    image.set_xlabel("u (unit of the measurements)")
    image.set_ylabel("v")
    image.ticklabel_format(useOffset=False)
    image.legend(loc="best", handletextpad=0.2)


def _ends(axes: Axes, x: Array, y: Array) -> None:
    axes.plot(x[:1], y[:1], "o", color=_INK, markersize=5.5, linestyle="", label="first frame")
    axes.plot(
        x[-1:], y[-1:], "s", color=_INK, markerfacecolor="white", markersize=5.5, linestyle="",
        label="last frame",
    )  # fmt: skip


_FIGURES: dict[FigureName, Callable[[Figure, FigureSource], None]] = {
    "convergence": _convergence,
    "singular-values": _singular_values,
    "error": _error,
    "shapes": _shapes,
    "cameras": _cameras,
}
