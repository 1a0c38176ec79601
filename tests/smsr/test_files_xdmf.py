from __future__ import annotations

import os
import shutil
import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from smsr.errors import ArrayNotFound, UnsupportedFormat
from smsr.files import write_npz, write_xdmf
from smsr.synthetic import make_example

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

EXAMPLE = make_example(frames=11, side=6)
SHAPES = EXAMPLE.ground_truth.astype(np.float32)


def result(folder: Path, faces: NDArray[Any] | None) -> Path:
    arrays: dict[str, NDArray[Any]] = {
        "shapes": SHAPES,
        "cameras": EXAMPLE.cameras,
        "translations": np.zeros((len(SHAPES), 2)),
    }
    if faces is not None:
        arrays["faces"] = faces
    folder.mkdir(parents=True, exist_ok=True)
    write_npz(folder / "result.npz", arrays)
    return folder / "result.npz"


def numbers(item: ET.Element, folder: Path) -> NDArray[Any]:
    """Read what an item stands for, as the format says."""
    assert (item.attrib["Format"], item.attrib["Endian"]) == ("Binary", "Little")
    kind = {"Float": "f", "Int": "i"}[item.attrib["NumberType"]]
    shape = tuple(map(int, item.attrib["Dimensions"].split()))
    file = folder / str(item.text).strip()
    dtype, seek = f"<{kind}{item.attrib['Precision']}", int(item.attrib["Seek"])
    return np.fromfile(file, dtype, int(np.prod(shape)), offset=seek).reshape(shape)


@pytest.mark.parametrize("faces", [None, EXAMPLE.faces], ids=["points", "mesh"])
def test_positions_in_the_file_hold_the_frames(
    tmp_path: Path, faces: NDArray[np.int32] | None
) -> None:
    source = result(tmp_path / "a & b", faces)
    write_xdmf(tmp_path / "out.xdmf", source, fps=10, every=3)
    grids = ET.parse(tmp_path / "out.xdmf").getroot().findall("Domain/Grid/Grid")
    assert len(grids) == 4
    for t, grid in zip(range(0, 11, 3), grids, strict=True):
        time, topology = grid.find("Time"), grid.find("Topology")
        item = grid.find("Geometry/DataItem")
        assert time is not None
        assert topology is not None
        assert item is not None
        assert float(time.attrib["Value"]) == pytest.approx(t / 10)
        np.testing.assert_array_equal(numbers(item, tmp_path), SHAPES[t])
        now, before = grid.findall("Attribute/DataItem/DataItem")
        np.testing.assert_array_equal(numbers(now, tmp_path), SHAPES[t])
        np.testing.assert_array_equal(numbers(before, tmp_path), SHAPES[max(t - 1, 0)])
        if faces is None:
            assert topology.attrib["TopologyType"] == "Polyvertex"
        else:
            np.testing.assert_array_equal(numbers(topology[0], tmp_path), faces)


def test_a_compressed_result_is_refused(tmp_path: Path) -> None:
    source = result(tmp_path, None)
    with np.load(source) as stored:
        arrays = dict(stored)
    np.savez_compressed(source, **arrays)
    with pytest.raises(UnsupportedFormat, match="compressed"):
        write_xdmf(tmp_path / "result.xdmf", source)
    np.savez(source, shapes=SHAPES)
    with pytest.raises(ArrayNotFound):
        write_xdmf(tmp_path / "result.xdmf", source)
    assert not (tmp_path / "result.xdmf").exists()


@pytest.mark.parametrize("faces", [None, EXAMPLE.faces], ids=["points", "mesh"])
def test_vtk_reads_every_frame(tmp_path: Path, faces: NDArray[np.int32] | None) -> None:
    """VTK's reader is ParaView's."""
    xdmf = pytest.importorskip("vtkmodules.vtkIOXdmf2", reason="needs VTK (pip install vtk)")
    numpy_of = pytest.importorskip("vtkmodules.util.numpy_support").vtk_to_numpy
    pipeline = pytest.importorskip("vtkmodules.vtkCommonExecutionModel")

    write_xdmf(tmp_path / "result.xdmf", result(tmp_path, faces))
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    for name in ("result.xdmf", "result.npz"):
        shutil.move(tmp_path / name, moved)
    reader = xdmf.vtkXdmfReader()
    reader.SetFileName(os.fspath(moved / "result.xdmf"))
    reader.UpdateInformation()
    times = reader.GetOutputInformation(0).Get(
        pipeline.vtkStreamingDemandDrivenPipeline.TIME_STEPS()
    )
    np.testing.assert_allclose(times, np.arange(11) / 25, atol=1e-9)
    for t, time in enumerate(times):
        reader.UpdateTimeStep(time)
        grid = reader.GetOutputDataObject(0)
        np.testing.assert_array_equal(numpy_of(grid.GetPoints().GetData()), SHAPES[t])
        motion = numpy_of(grid.GetPointData().GetArray("motion"))
        np.testing.assert_allclose(motion, SHAPES[t] - SHAPES[max(t - 1, 0)], atol=1e-4)
        cells = range(grid.GetNumberOfCells())
        found = [
            [grid.GetCell(c).GetPointId(k) for k in range(3)] for c in cells if faces is not None
        ]
        np.testing.assert_array_equal(found, [] if faces is None else faces)
