"""Each evaluation set goes in over HTTP and comes out as the library returns it."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np
import plyfile
import pytest
import trimesh

import smsr
from smsr.files import open_array
from tests.service.conftest import Api, finished, npy, submit

if TYPE_CHECKING:
    from pathlib import Path

    import httpx

pytestmark = pytest.mark.data

SPARSE = ("drink", "pickup", "stretch", "yoga", "dance", "dinosaur")


@pytest.mark.parametrize(
    "name", [f"sparse/{name}.mat" for name in SPARSE] + ["dense/facecap.npz", "dense/samba.npz"]
)
def test_the_service_returns_what_the_library_returns(
    api: Api, client: httpx.Client, evaluation_data: Path, tmp_path: Path, name: str
) -> None:
    path = evaluation_data / name
    content = path.read_bytes()
    files = {"measurements": (path.name, content), "ground_truth": (path.name, content)}
    if path.suffix == ".npz":
        files["faces"] = ("faces.npy", npy(open_array(path, role="faces")))
    job = finished(client, submit(client, files))
    assert job["status"] == "succeeded", job

    expected = smsr.reconstruct(path, out=tmp_path / "expected")
    truth = open_array(path, role="ground_truth")
    evaluation = smsr.evaluate(truth, expected)
    assert job["metrics"]["e3d"] == pytest.approx(evaluation.e3d, rel=1e-6)
    assert job["metrics"]["frame"] == evaluation.frame

    with np.load(io.BytesIO(client.get(job["links"]["result"]).content)) as arrays:
        np.testing.assert_allclose(
            arrays["shapes"], expected.shapes, atol=1e-6 * np.abs(expected.shapes).max()
        )
        np.testing.assert_allclose(arrays["cameras"], expected.cameras, atol=1e-9)
        shapes = arrays["shapes"]

    last = len(shapes) - 1
    ply = client.get(job["links"]["frame"].replace("{t}", str(last))).content
    vertices = plyfile.PlyData.read(io.BytesIO(ply))["vertex"]
    read = np.stack([vertices[axis] for axis in "xyz"], axis=1)
    np.testing.assert_array_equal(read, shapes[last])
    surface: Any = trimesh.load(io.BytesIO(ply), file_type="ply", process=False)
    np.testing.assert_array_equal(np.asarray(surface.vertices, np.float32), shapes[last])
    assert client.delete(job["links"]["self"]).status_code == 204
    assert not any(job["id"] in stored for stored in api.stored())
