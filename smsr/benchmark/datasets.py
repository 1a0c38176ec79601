"""The evaluation sets: which file, which arrays, and the frame of their ground truth.

The sets are their authors' and are not shipped; `load` reads them from a folder that holds
``sparse/*.mat`` (the six sets of the paper's Table 1) and ``dense/*.npz``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias

from smsr.errors import ArrayNotFound
from smsr.files import open_array

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

Frame: TypeAlias = Literal["object", "camera"]


@dataclass(frozen=True, slots=True)
class Dataset:
    """One evaluation set.

    Attributes
    ----------
    name : str
        As in the table.
    file : str
        Path within the data folder, or of any file.
    ground_truths : mapping of str to str
        Frame of comparison to the key of the ground truth in it; the first is the one that counts.
    """

    name: str
    file: str
    ground_truths: Mapping[Frame, str] = field(default_factory=dict)

    @property
    def frame(self) -> Frame:
        """The frame that the ground truth sits in."""
        return next(iter(self.ground_truths))


def _mocap(name: str) -> Dataset:
    return Dataset(name, f"sparse/{name}.mat", {"object": "S"})


def _mesh(name: str, file: str) -> Dataset:
    return Dataset(name, file, {"camera": "S", "object": "S_world"})


DATASETS: Final[tuple[Dataset, ...]] = (
    _mocap("drink"),
    _mocap("pickup"),
    _mocap("stretch"),
    _mocap("yoga"),
    # The published figures of dinosaur compare in the camera frame; its ground truth is not there.
    Dataset("dinosaur", "sparse/dinosaur.mat", {"object": "GT.shape3D", "camera": "GT.shape3D"}),
    Dataset("dance", "sparse/dance.mat", {"camera": "S"}),
    _mesh("facecap", "dense/facecap.npz"),
    _mesh("samba", "dense/samba.npz"),
)


def select(names: Iterable[str]) -> tuple[Dataset, ...]:
    """Return the sets of these names; a path stands for a dense set in a file of one's own.

    Raises
    ------
    ArrayNotFound
        No such set and no such file.
    """
    known = {dataset.name: dataset for dataset in DATASETS}
    chosen = []
    for name in names:
        if name in known:
            chosen.append(known[name])
        elif Path(name).is_file():
            chosen.append(_mesh(Path(name).stem, str(Path(name).resolve())))
        else:
            raise ArrayNotFound(
                f"There is no set {name!r} and no file of that name. Sets are {', '.join(known)}.",
                sets=list(known),
            )
    return tuple(chosen)


def load(dataset: Dataset, folder: Path) -> tuple[NDArray[Any], dict[Frame, NDArray[Any]]]:
    """Open a set's measurements (2T, N) and its ground truth in each frame of comparison.

    Raises
    ------
    UnreadableFile
        The file is not there or is broken.
    """
    path = folder / dataset.file
    measurements = open_array(path, key="W", role="measurements")
    truths = {
        frame: open_array(path, key=key, role="ground_truth")
        for frame, key in dataset.ground_truths.items()
    }
    return measurements, truths
