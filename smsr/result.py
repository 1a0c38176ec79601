"""What a reconstruction returns."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from smsr.rotations import camera_scales, complete

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smsr.options import Options


@dataclass(frozen=True, slots=True)
class StageReport:
    """What one stage of the pipeline did.

    Attributes
    ----------
    name : str
        One of `smsr.progress.STAGES`.
    seconds : float
        Wall time.
    iterations : int
        0 for a direct stage.
    converged : bool
        True for a direct stage that succeeded.
    reason : str
        Why it stopped, or what it decided, for a person.
    residuals : tuple of float
        The stopping residual at each iteration (thinned to at most 500 entries).
    """

    name: str
    seconds: float
    iterations: int = 0
    converged: bool = True
    reason: str = ""
    residuals: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Caution:
    """A warning a user can act on: a stable `code` and a `message`."""

    code: str
    message: str


@dataclass(frozen=True, slots=True)
class Diagnostics:
    """How a reconstruction came about and how far to trust it.

    Attributes
    ----------
    options : Options
        All options in force.
    frames, points : int
        T and N.
    basis_size : int
        K, the number of basis shapes that was found.
    camera_model : str
        Which camera candidate was taken.
    camera_reason : str
        Why.
    converged : bool
        Whether every iterative stage met its tolerance.
    stages : tuple of StageReport
        In order of execution.
    singular_values : tuple of float
        Of the centred measurement matrix, largest first (at most 100).
    cautions : tuple of Caution
        Weaknesses of this input: too little rotation, near-planar shape, and so on.
    camera_criteria : dict
        The numbers the choice of cameras was based on: see `smsr.cameras.free` and
        `smsr.cameras.selection`.
    noise : float
        Standard deviation of the noise that was taken off the measurements, in their units; 0 for
        none.
    missing, rejected : float
        Parts of the positions that were not seen, and that were taken as gross errors; both were
        filled in.
    """

    options: Options
    frames: int
    points: int
    basis_size: int
    camera_model: str
    camera_reason: str
    converged: bool
    stages: tuple[StageReport, ...]
    singular_values: tuple[float, ...]
    cautions: tuple[Caution, ...] = ()
    camera_criteria: dict[str, float] = field(default_factory=dict)
    noise: float = 0.0
    missing: float = 0.0
    rejected: float = 0.0

    @property
    def seconds(self) -> dict[str, float]:
        """Wall time of each stage by name."""
        return {stage.name: stage.seconds for stage in self.stages}

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists, dicts and numbers, ready for JSON."""
        return dataclasses.asdict(self)


@dataclass(frozen=True, slots=True, eq=False)
class MovingSurface:
    """A moving 3D surface and the camera that saw it: ``W_t = R_t S_t + t_t``.

    Attributes
    ----------
    shapes : ndarray of shape (T, N, 3), float32 or float64, read-only
        S: points of each frame in the object frame, in the units of the measurements, each frame
        centred on the origin. Memory-mapped where the run wrote to a folder; a lazy dask array on
        a zarr store where the measurements were a dask array too.
    cameras : ndarray of shape (T, 2, 3), float64, read-only
        R: orthonormal rows of the orthographic camera of each frame; with
        ``camera_scale="varying"`` times its scale, of geometric mean 1.
    translations : ndarray of shape (T, 2), float64, read-only
        t: image position of the shape's centroid.
    """

    shapes: NDArray[np.floating[Any]]
    cameras: NDArray[np.float64]
    translations: NDArray[np.float64]

    def __post_init__(self) -> None:
        for name in ("shapes", "cameras", "translations"):
            array = getattr(self, name)
            if isinstance(array, np.ndarray):  # a dask array is read-only by itself
                array.flags.writeable = False
                # A view of a read-only array cannot be made writeable again.
                object.__setattr__(self, name, array.view())

    @property
    def scales(self) -> NDArray[np.float64]:
        """Scales (T,) of the cameras: exactly 1 where they keep it."""
        return camera_scales(self.cameras)

    @property
    def rotations(self) -> NDArray[np.float64]:
        """Cameras (T, 3, 3) without scale, completed by the viewing direction.

        That is the cross product of the rows.
        """
        return complete(self.cameras / self.scales[:, None, None])

    def in_camera_frame(self) -> NDArray[np.floating[Any]]:
        """Return the shapes (T, N, 3) turned into the camera frame of each frame, R3_t S_t."""
        rotations = self.rotations.astype(self.shapes.dtype)
        turned: NDArray[np.floating[Any]] = self.shapes @ rotations.transpose(0, 2, 1)
        return turned


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction(MovingSurface):
    """The surface that a run found, and how.

    Attributes
    ----------
    diagnostics : Diagnostics
        How it came about.
    """

    diagnostics: Diagnostics
