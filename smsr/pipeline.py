"""The reconstruction as a row of stages.

Measurements are read and factored once; cameras and shapes are found on a few virtual points at a
cost that does not depend on the number of points; the shapes of all points are written in one last
pass.
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from smsr.cameras import estimate_cameras, fix_gauge
from smsr.cautions import (
    camera_cautions,
    convergence_cautions,
    depth_cautions,
    gap_cautions,
    input_cautions,
    size_cautions,
)
from smsr.completion import completed
from smsr.errors import Cancelled, InvalidOption
from smsr.lifting import denoised_lifting, exact_lifting, smoothed_lifting
from smsr.measurements import as_source
from smsr.options import Options, parse, resolve
from smsr.progress import STAGES, Progress, part_of
from smsr.reduction import Reduction
from smsr.result import Diagnostics, Reconstruction, StageReport
from smsr.rotations import angles_between
from smsr.rowspace import factorise, map_back
from smsr.scales import divided, growth, noise_gain, varying_scales
from smsr.shapes.estimate import basis_size_of
from smsr.shapes.lengths import chosen_points
from smsr.shapes.selection import estimate_shapes
from smsr.streaming import one_blas_thread
from smsr.trajectories import smooth_trajectories

if TYPE_CHECKING:
    import os
    from collections.abc import Iterator, Mapping

    from numpy.typing import ArrayLike, NDArray

    from smsr.cameras import CameraEstimate
    from smsr.completion import Gaps
    from smsr.lifting import Lifting
    from smsr.measurements import MeasurementSource
    from smsr.progress import ProgressCallback, StageHook
    from smsr.result import Caution
    from smsr.rowspace import RowSpace
    from smsr.scales import ScaleEstimate
    from smsr.shapes.estimate import ShapeEstimate
    from smsr.trajectories import SmoothMotion

_SHARES = {
    "constant": dict(zip(STAGES, (0.02, 0.23, 0.0, 0.25, 0.05, 0.20, 0.25), strict=True)),
    "varying": dict(zip(STAGES, (0.02, 0.13, 0.45, 0.12, 0.03, 0.10, 0.15), strict=True)),
}
"""Part of the progress bar that each stage moves, by the option `camera_scale`."""

_GROWTH_FRAMES, _GROWTH_POINTS = 100, 24  # of which growth is told

_LISTED_RESIDUALS = 500
_LISTED_SINGULAR_VALUES = 100


def reconstruct(
    measurements: ArrayLike | str | os.PathLike[str] | MeasurementSource,
    *,
    out: str | os.PathLike[str] | None = None,
    visibility: ArrayLike | None = None,
    progress: ProgressCallback | None = None,
    options: Options | None = None,
    **option_values: Any,
) -> Reconstruction:
    """Reconstruct the moving 3D surface and the camera from 2D point tracks.

    Parameters
    ----------
    measurements : ndarray, memmap, path or MeasurementSource
        W: tracks of N points over T frames as (2T, N), rows u1, v1, u2, v2, ..., or any layout
        that `smsr.options.Options.layout` names; a path of a file that `smsr.files` reads; a
        source of chunks; a dask array; or, with the extra ``smsr[gpu]``, a PyTorch or CuPy array,
        whose points are worked on where they are.
    out : path, optional
        Folder, made where needed, that receives ``shapes.npy`` (T x N x 3, float32),
        ``cameras.npy`` (T x 2 x 3, float64), ``translations.npy`` (T x 2, float64) and
        ``report.json``. The shapes of the result are then a read-only memory map.
    visibility : array_like of shape (T, N), bool, optional
        True where a point is seen in a frame. Other positions, and NaN, are filled in as by
        ``missing="complete"``.
    progress : callable, optional
        Called with a `Progress` often. Returning ``False`` cancels the run.
    options : Options, optional
        All options at once.
    **option_values
        Single options by name, in place of those in `options`.

    Returns
    -------
    Reconstruction
        Shapes are float32 for float32 measurements or with `out`, float64 otherwise. The object
        frame is that of the middle frame's camera, whose axes it shares.

    Raises
    ------
    smsr.errors.InputError
        The measurements or an option cannot be used; the subclass and the message say why.
    smsr.errors.Cancelled
        The progress callback returned ``False``.

    Notes
    -----
    The method is M. D. Ansari, V. Golyanik, D. Stricker: Scalable Dense Monocular Surface
    Reconstruction, 3DV 2017; `preset="paper"` follows it to the letter.
    """
    options = _merge(options, option_values)
    clock = _Clock(progress, _SHARES[options.camera_scale])
    with clock.stage("reading"):
        as_given = visibility is None and options.missing == "refuse"
        source = as_source(measurements, options.layout, check=as_given)
        source, gaps = completed(source, options, visibility)
    with clock.stage("factorising") as hook:
        space = factorise(source, progress=hook)
    # The matrices of the solver are small: threads of BLAS cost more than they bring.
    with one_blas_thread():
        solution = solve(space, resolve(options, points=space.points), clock)
    with clock.stage("writing") as hook:
        shapes = map_back(source, space, solution.lifting, out, progress=hook)
    result = Reconstruction(
        shapes=shapes,
        cameras=solution.cameras,
        translations=space.translations.copy(),
        diagnostics=_diagnostics(
            resolve(options, points=space.points), space, solution, clock, gaps
        ),
    )
    if out is not None:
        _write_rest(result, Path(out))
    return result


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Cameras, and the linear map that takes centred measurements to shapes."""

    cameras: NDArray[np.float64]
    lifting: Lifting
    basis_size: int
    camera_model: str
    camera_reason: str
    camera_criteria: Mapping[str, float]
    noise: float
    cautions: tuple[Caution, ...]


def solve(space: RowSpace, options: Options, clock: _Clock) -> Solution:
    """Run the stages whose cost does not depend on the number of points.

    Parameters
    ----------
    space : RowSpace
        The factored measurements.
    options : Options
        Resolved.
    clock : _Clock
        Receives the reports of the stages.

    Raises
    ------
    InvalidOption
        Noise that is not below the spread of the tracks, of which it is a part.
    """
    if options.noise is not None and options.noise >= space.spread:
        raise InvalidOption(
            f"Option 'noise' must be below {space.spread:g}, the spread of the points of a frame "
            f"about their mean, of which it is a part; it was {options.noise:g}. Give the standard "
            "deviation in the units of the tracks, or null to have it estimated.",
            option="noise",
        )
    with clock.stage("scales") as hook:
        if options.camera_scale == "constant":
            scaling = None
        else:
            scaling = varying_scales(space, options, _sampled_shapes, hook)
            clock.note(scaling)
    if scaling is None:
        return _solve(space, options, clock)
    scales = scaling.scales
    solution = _solve(*divided(space, options, scales), clock)
    return dataclasses.replace(
        solution,
        cameras=scales[:, None, None] * solution.cameras,
        lifting=solution.lifting.after_division(scales),
        noise=solution.noise / noise_gain(scales),
    )


def _solve(space: RowSpace, options: Options, clock: _Clock) -> Solution:
    """Find cameras of one scale, and shapes."""
    reduction = Reduction.of(space, options)
    measurements = reduction.measurements
    with clock.stage("cameras") as hook:
        estimate = _cameras(reduction, options, hook)
        rotations = estimate.rotations
        clock.note(estimate)
    with clock.stage("smoothing") as hook:
        motion = _smooth(measurements, rotations, estimate.basis_size, options, hook)
        if motion is not None:
            measurements = motion.apply(measurements)
            clock.note(motion)
    with clock.stage("shapes") as hook:
        found = _shapes(measurements, estimate, reduction, options, hook)
        clock.note(found)
        reason = estimate.reason
        if found.rotations is not None:
            degrees = math.degrees(angles_between(found.rotations, rotations).max())
            reason += f"; adjusted with the depths, by up to {degrees:.1f} degrees"
            rotations = found.rotations
    cameras = np.ascontiguousarray(rotations[:, :2])
    points, left, values = reduction.points, reduction.left, reduction.values
    if points.noise > 0.0:
        lifting = denoised_lifting(found.shapes * reduction.unit, points.coordinates)
    elif motion is None:
        lifting = exact_lifting(found.shapes, cameras, left, values)
    else:
        lifting = smoothed_lifting(found.shapes, cameras, left, values, motion.basis)
    published = estimate.model == "paper"
    return Solution(
        cameras=cameras,
        lifting=lifting,
        basis_size=estimate.basis_size if published else basis_size_of(found.shapes),
        camera_model=estimate.model,
        camera_reason=reason,
        camera_criteria=estimate.criteria,
        noise=points.noise,
        cautions=(
            *input_cautions(
                space.singular_values,
                points,
                space.points,
                flat=estimate.flat,
                rigid=estimate.model == "rigid"
                or not (estimate.flat or options.camera_model == "auto"),
            ),
            *camera_cautions(rotations, estimate),
            *depth_cautions(found.complexity, found.steadiness),
            *size_cautions(_growth(found.shapes, reduction, space, options), found.complexity),
            *convergence_cautions(clock.reports),
        ),
    )


def _cameras(reduction: Reduction, options: Options, hook: StageHook) -> CameraEstimate:
    """Find the cameras, in the frame of the middle one."""
    return fix_gauge(
        estimate_cameras(
            reduction.left,
            reduction.values,
            options,
            hook,
            points=reduction.sample,
            tracks=reduction.tracks,
            noise=reduction.noise,
            neglected=reduction.neglected,
        )
    )


def _shapes(
    measurements: NDArray[np.float64],
    estimate: CameraEstimate,
    reduction: Reduction,
    options: Options,
    hook: StageHook,
) -> ShapeEstimate:
    """Find the shapes of the virtual points, which may have been smoothed."""
    return estimate_shapes(
        measurements,
        estimate.rotations,
        options,
        camera_model=estimate.model,
        coherent=estimate.coherent,
        simpler=estimate.simpler,
        simpler_share=estimate.simpler_share,
        adjustable=estimate.adjustable,
        noise=reduction.noise,
        points=reduction.sample,
        hook=hook,
    )


def _growth(
    shapes: NDArray[np.float64], reduction: Reduction, space: RowSpace, options: Options
) -> float:
    """Return by what factor some points grow in some frames, 1 where the camera did it."""
    if options.camera_scale == "varying":
        return 1.0
    step = math.ceil(space.frames / _GROWTH_FRAMES)
    chosen = chosen_points(space.sample, _GROWTH_POINTS)
    return growth(shapes[::step] @ reduction.sample[:, chosen])


def _sampled_shapes(space: RowSpace, options: Options, hook: StageHook) -> NDArray[np.float64]:
    """Return shapes (T, 3, s) of the sample of points."""
    reduction = Reduction.of(space, options)
    estimate = _cameras(reduction, options, part_of(hook, 0.0, 0.5))
    found = _shapes(reduction.measurements, estimate, reduction, options, part_of(hook, 0.5, 1.0))
    sampled: NDArray[np.float64] = found.shapes @ reduction.sample
    return sampled


def _smooth(
    virtual: NDArray[np.float64],
    rotations: NDArray[np.float64],
    basis_size: int,
    options: Options,
    hook: StageHook,
) -> SmoothMotion | None:
    """Fit a smooth motion where that is asked for and can leave anything out."""
    frames = len(rotations)
    basis_size = min(basis_size, (2 * frames - 1) // 3)
    if not options.smoothing or basis_size < 1:
        return None
    return smooth_trajectories(
        virtual,
        rotations,
        basis_size=basis_size,
        cosines=min(frames, max(basis_size, math.ceil(options.smoothing_ratio * frames))),
        max_iterations=options.smoothing_iterations,
        hook=hook,
    )


class _Clock:
    """Times the stages and turns their reports into those of the run."""

    def __init__(self, callback: ProgressCallback | None, shares: Mapping[str, float]) -> None:
        self._callback = callback
        self._shares = shares
        self._done = 0.0
        self.reports: list[StageReport] = []

    @contextmanager
    def stage(self, name: str) -> Iterator[StageHook]:
        """Time a stage; the hook it gets reports and cancels."""
        first = sum(self._shares[before] for before in STAGES[: STAGES.index(name)])

        def hook(fraction: float, iteration: int, residual: float | None) -> None:
            self._report(name, first + min(fraction, 1.0) * self._shares[name], iteration, residual)

        hook(0.0, 0, None)
        self.reports.append(StageReport(name, 0.0))
        started = time.perf_counter()
        yield hook
        seconds = time.perf_counter() - started
        self.reports[-1] = dataclasses.replace(self.reports[-1], seconds=seconds)
        last = self.reports[-1]
        hook(1.0, last.iterations, last.residuals[-1] if last.residuals else None)

    def note(self, outcome: ScaleEstimate | CameraEstimate | SmoothMotion | ShapeEstimate) -> None:
        """Add what the present stage did."""
        step = -(-len(outcome.residuals) // _LISTED_RESIDUALS) or 1
        self.reports[-1] = dataclasses.replace(
            self.reports[-1],
            iterations=outcome.iterations,
            converged=outcome.converged,
            reason=outcome.reason,
            residuals=outcome.residuals[::-1][::step][::-1],
        )

    def _report(self, stage: str, fraction: float, iteration: int, residual: float | None) -> None:
        self._done = max(self._done, min(fraction, 1.0))
        if self._callback is None:
            return
        if self._callback(Progress(stage, self._done, iteration, residual)) is False:
            raise Cancelled(f"The run was cancelled in stage {stage!r}.", stage=stage)


def _merge(options: Options | None, values: dict[str, Any]) -> Options:
    """Return the options given as one object and by name, checked."""
    if options is None:
        return parse(Options, values)
    if not isinstance(options, Options):
        raise InvalidOption(
            "`options` must be an smsr.Options; single options are given by name, as in "
            "reconstruct(W, preset='paper').",
            option="options",
        )
    given = {field.name: getattr(options, field.name) for field in dataclasses.fields(Options)}
    return parse(Options, given | values)


def _diagnostics(
    options: Options, space: RowSpace, solution: Solution, clock: _Clock, gaps: Gaps
) -> Diagnostics:
    positions = space.frames * space.points
    missing, rejected = gaps.missing / positions, gaps.rejected / positions
    return Diagnostics(
        options=options,
        frames=space.frames,
        points=space.points,
        basis_size=solution.basis_size,
        camera_model=solution.camera_model,
        camera_reason=solution.camera_reason,
        camera_criteria=dict(solution.camera_criteria),
        noise=solution.noise,
        converged=all(report.converged for report in clock.reports),
        stages=tuple(clock.reports),
        singular_values=tuple(space.singular_values[:_LISTED_SINGULAR_VALUES].tolist()),
        cautions=(*gap_cautions(missing, rejected), *solution.cautions),
        missing=missing,
        rejected=rejected,
    )


def _write_rest(result: Reconstruction, folder: Path) -> None:
    """Write everything but the shapes, the report last."""
    np.save(folder / "cameras.npy", result.cameras)
    np.save(folder / "translations.npy", result.translations)
    text = json.dumps(result.diagnostics.to_dict(), indent=1)
    (folder / "report.json").write_text(text + "\n", encoding="utf-8")
