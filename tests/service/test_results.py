from __future__ import annotations

import io
import json
import zipfile
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np
import plyfile
import pytest
import trimesh

import smsr
from smsr.files import GlbOptions, write_glb
from smsr.synthetic import make_low_rank
from tests.service.conftest import Api, finished, npy, problem, submit

if TYPE_CHECKING:
    from pathlib import Path

    import httpx

    from smsr import Reconstruction
    from smsr.synthetic import Example


DOWNLOADS = (
    *("result.npz", "frames.zip", "frames/0.ply", "report.json"),
    *("result.glb", "figures/shapes.svg"),
)


@pytest.fixture(scope="module")
def expected(example: Example, tmp_path_factory: pytest.TempPathFactory) -> Reconstruction:
    """What the solver gives for the same measurements in this process."""
    out: Path = tmp_path_factory.mktemp("expected")
    return smsr.reconstruct(example.measurements.astype(np.float32), out=out)


@pytest.fixture(scope="module")
def job(api: Api, example: Example, tracks: bytes) -> dict[str, Any]:
    """A finished job with faces."""
    files = {"measurements": ("w.npy", tracks), "faces": ("f.npy", npy(example.faces))}
    with api.client() as client:
        return finished(client, submit(client, files))


@pytest.fixture(scope="module")
def bare_job(api: Api, tracks: bytes) -> dict[str, Any]:
    """A finished job without faces."""
    with api.client() as client:
        return finished(client, submit(client, {"measurements": ("w.npy", tracks)}))


def test_the_npz_is_what_the_solver_returns(
    client: httpx.Client, job: dict[str, Any], example: Example, expected: Reconstruction
) -> None:
    answer = client.get(job["links"]["result"])
    assert answer.headers["content-type"] == "application/zip"
    assert int(answer.headers["content-length"]) == len(answer.content)
    name = f"smsr-{job['id']}.npz"
    assert answer.headers["content-disposition"] == f'attachment; filename="{name}"'
    with np.load(io.BytesIO(answer.content)) as arrays:
        assert set(arrays) == {"shapes", "cameras", "translations", "faces"}
        assert arrays["shapes"].dtype == np.float32
        np.testing.assert_array_equal(arrays["shapes"], expected.shapes)
        np.testing.assert_array_equal(arrays["cameras"], expected.cameras)
        np.testing.assert_array_equal(arrays["translations"], expected.translations)
        np.testing.assert_array_equal(arrays["faces"], example.faces)
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        assert {info.compress_type for info in archive.infolist()} == {zipfile.ZIP_STORED}


def test_a_result_without_faces_has_none(
    client: httpx.Client, bare_job: dict[str, Any], expected: Reconstruction
) -> None:
    with np.load(io.BytesIO(client.get(bare_job["links"]["result"]).content)) as arrays:
        assert set(arrays) == {"shapes", "cameras", "translations"}
    ply = client.get(bare_job["links"]["frame"].replace("{t}", "3"))
    data = plyfile.PlyData.read(io.BytesIO(ply.content))
    assert [element.name for element in data.elements] == ["vertex"]
    cloud: Any = trimesh.load(io.BytesIO(ply.content), file_type="ply")
    np.testing.assert_array_equal(np.asarray(cloud.vertices, np.float32), expected.shapes[3])


@pytest.mark.parametrize("frame", [0, 7, 19])
def test_a_frame_is_a_mesh_for_every_reader(
    client: httpx.Client,
    job: dict[str, Any],
    example: Example,
    expected: Reconstruction,
    frame: int,
) -> None:
    answer = client.get(job["links"]["frame"].replace("{t}", str(frame)))
    assert int(answer.headers["content-length"]) == len(answer.content)
    assert f"frame-{frame:04d}.ply" in answer.headers["content-disposition"]
    data = plyfile.PlyData.read(io.BytesIO(answer.content))
    vertices = np.stack([data["vertex"][axis] for axis in "xyz"], axis=1)
    np.testing.assert_array_equal(vertices, expected.shapes[frame])
    np.testing.assert_array_equal(np.stack(data["face"]["vertex_indices"]), example.faces)
    mesh: Any = trimesh.load(io.BytesIO(answer.content), file_type="ply", process=False)
    np.testing.assert_array_equal(np.asarray(mesh.vertices, np.float32), vertices)
    np.testing.assert_array_equal(mesh.faces, example.faces)


@pytest.mark.parametrize("kind", ["job", "bare_job"])
def test_the_archive_of_frames_holds_each_frame_as_it_is_alone(
    client: httpx.Client, kind: str, request: pytest.FixtureRequest
) -> None:
    job: dict[str, Any] = request.getfixturevalue(kind)
    answer = client.get(job["links"]["frames"])
    assert int(answer.headers["content-length"]) == len(answer.content)
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        assert archive.testzip() is None
        assert archive.namelist() == [f"frame_{t:04d}.ply" for t in range(20)]
        for t in (0, 11, 19):
            alone = client.get(job["links"]["frame"].replace("{t}", str(t))).content
            assert archive.read(f"frame_{t:04d}.ply") == alone


def test_a_result_is_sent_again_only_when_it_is_another(
    client: httpx.Client, bare_job: dict[str, Any]
) -> None:
    for url in (
        bare_job["links"]["result"],
        bare_job["links"]["frames"],
        bare_job["links"]["frame"].replace("{t}", "0"),
    ):
        tag = client.get(url).headers["etag"]
        for known in (tag, f'"x", W/{tag}', "*"):
            answer = client.get(url, headers={"If-None-Match": known})
            assert (answer.status_code, answer.content) == (304, b"")
            assert answer.headers["etag"] == tag
        assert client.get(url, headers={"If-None-Match": '"x"'}).status_code == 200
    client.post(f"/v1/jobs/{bare_job['id']}/retry")
    client.get(f"/v1/jobs/{bare_job['id']}", headers={"Prefer": "wait=30"})
    answer = client.get(bare_job["links"]["result"], headers={"If-None-Match": tag})
    assert answer.status_code == 200


def test_head_tells_what_get_would(client: httpx.Client, job: dict[str, Any]) -> None:
    frame = job["links"]["frame"].replace("{t}", "0")
    links = [job["links"][name] for name in ("self", "result", "frames", "report", "glb")]
    for url in (*links, frame, "/v1/jobs", "/v1/info", "/healthz", "/problems"):
        got, asked = client.get(url), client.head(url)
        assert (asked.status_code, asked.content) == (200, b"")
        for name in ("content-type", "content-length", "content-disposition", "etag"):
            assert asked.headers.get(name) == got.headers.get(name), (url, name)


def test_the_animation_is_that_of_the_result(
    client: httpx.Client,
    job: dict[str, Any],
    bare_job: dict[str, Any],
    example: Example,
    expected: Reconstruction,
    tmp_path: Path,
) -> None:
    for document, faces in ((job, example.faces), (bare_job, None)):
        for query, options in (
            ({}, GlbOptions()),
            (
                {"quantised": "true", "fps": "12.5", "every": "3", "image_v": "down"},
                GlbOptions(12.5, quantised=True, every=3, image_v="down"),
            ),
        ):
            answer = client.get(document["links"]["glb"], params=query)
            assert answer.headers["content-type"] == "model/gltf-binary"
            assert int(answer.headers["content-length"]) == len(answer.content)
            write_glb(
                tmp_path / "a.glb",
                expected.shapes,
                expected.cameras,
                faces,
                options,
                expected.translations,
            )
            assert answer.content == (tmp_path / "a.glb").read_bytes()
            part = client.get(
                document["links"]["glb"],
                params=query,
                headers={"Range": "bytes=1000-4999", "If-Range": answer.headers["etag"]},
            )
            assert (part.status_code, part.content) == (206, answer.content[1000:5000])
    url = bare_job["links"]["glb"]
    plain = client.get(url).headers["etag"]
    assert client.get(url, headers={"If-None-Match": plain}).status_code == 304
    assert client.get(url, params={"fps": 5}, headers={"If-None-Match": plain}).status_code == 200


@pytest.mark.parametrize("query", ["fps=0", "fps=nan", "every=0", "image_v=left", "quantised=x"])
def test_animations_that_make_no_sense_are_refused(
    client: httpx.Client, bare_job: dict[str, Any], query: str
) -> None:
    problem(client.get(f"{bare_job['links']['glb']}?{query}"), "invalid-request", 422)


def test_figures_are_those_of_the_result(
    client: httpx.Client, job: dict[str, Any], bare_job: dict[str, Any]
) -> None:
    pytest.importorskip("matplotlib")
    for name in ("convergence", "singular-values", "shapes", "cameras"):
        url = bare_job["links"]["figure"].replace("{name}", name)
        vector = client.get(url.replace("{form}", "svg"))
        assert vector.headers["content-type"].startswith("image/svg+xml")
        assert ElementTree.fromstring(vector.content).tag == "{http://www.w3.org/2000/svg}svg"
        again = client.get(
            url.replace("{form}", "svg"), headers={"If-None-Match": vector.headers["etag"]}
        )
        assert (again.status_code, again.content) == (304, b"")
        raster = client.get(url.replace("{form}", "png"))
        assert raster.headers["content-type"] == "image/png"
        assert raster.headers["etag"] != vector.headers["etag"]
        assert raster.content.startswith(b"\x89PNG\r\n")
        assert raster.headers["content-disposition"].startswith("inline")
    clouds, meshes = (
        client.get(f"/v1/jobs/{document['id']}/figures/shapes.png").content
        for document in (bare_job, job)
    )
    assert clouds != meshes
    problem(client.get(f"/v1/jobs/{job['id']}/figures/error.png"), "nothing-to-draw", 404)
    for path in ("figures/none.png", "figures/error.gif", "figures/error.svg.png"):
        document = problem(client.get(f"/v1/jobs/{job['id']}/{path}"), "unknown-file", 404)
        assert f"no '{path}'" in document["detail"]
        assert {"figures/shapes.png", "figures/shapes.svg"} < set(document["files"])


def test_the_error_is_drawn_where_there_is_truth(
    client: httpx.Client, example: Example, tracks: bytes
) -> None:
    pytest.importorskip("matplotlib")
    files = {
        "measurements": ("w.npy", tracks),
        "ground_truth": ("s.npy", npy(example.ground_truth)),
    }
    job = finished(client, submit(client, files))
    answer = client.get(f"/v1/jobs/{job['id']}/figures/error.svg")
    assert f"e3D = {job['metrics']['e3d']:.4f}" in answer.text


def test_more_frames_than_a_file_can_animate(client: httpx.Client) -> None:
    tracks = make_low_rank(2060, 6).measurements.astype(np.float32)
    job = finished(client, submit(client, {"measurements": ("w.npy", npy(tracks))}))
    assert job["status"] == "succeeded", job
    answer = client.get(job["links"]["glb"])
    assert problem(answer, "animation-too-large", 422)["every"] == 2
    assert client.get(job["links"]["glb"], params={"every": 2}).status_code == 200


def test_frames_out_of_range(client: httpx.Client, job: dict[str, Any]) -> None:
    for frame in ("20", "-1", "99999999999999999999999"):
        answer = client.get(job["links"]["frame"].replace("{t}", frame))
        assert problem(answer, "unknown-frame", 404)["frames"] == 20
    answer = client.get(job["links"]["frame"].replace("{t}", "first"))
    assert problem(answer, "invalid-request", 422)["errors"][0]["in"] == "path"


def test_an_unfinished_job_has_no_result_yet(idle_api: Api, tracks: bytes) -> None:
    with idle_api.client() as client:
        url = submit(client, {"measurements": ("w.npy", tracks)}).headers["Location"]
        for path in (
            "result.npz",
            "frames.zip",
            "frames/0.ply",
            "report.json",
            "result.glb",
            "figures/shapes.svg",
        ):
            answer = client.get(f"{url}/{path}")
            assert problem(answer, "job-unfinished", 409)["job_status"] == "queued"
            assert int(answer.headers["Retry-After"]) > 0


def test_a_failed_job_says_why_wherever_its_result_is_asked_for(client: httpx.Client) -> None:
    constant = npy(np.ones((12, 6), np.float32))
    job = finished(client, submit(client, {"measurements": ("w.npy", constant)}))
    assert job["status"] == "failed"
    assert job["problem"]["type"] == "/problems/constant-measurements"
    assert job["problem"]["instance"] == f"/v1/jobs/{job['id']}"
    for path in (
        "result.npz",
        "frames.zip",
        "frames/0.ply",
        "report.json",
        "result.glb",
        "figures/shapes.svg",
    ):
        document = problem(client.get(f"/v1/jobs/{job['id']}/{path}"), "job-failed", 409)
        assert document["cause"]["type"] == "/problems/constant-measurements"


def test_results_that_vanish_while_they_are_asked_for(api: Api, tracks: bytes) -> None:
    """As when a job expires between the look at its record and the look at its files."""
    with api.client() as client:
        job = finished(client, submit(client, {"measurements": ("w.npy", tracks)}))
        for path in (api.objects / "results" / job["id"]).rglob("*.*"):
            path.unlink()
        for path in (
            "result.npz",
            "frames.zip",
            "frames/0.ply",
            "report.json",
            "result.glb",
            "figures/shapes.svg",
        ):
            problem(client.get(f"/v1/jobs/{job['id']}/{path}"), "result-gone", 410)
        assert client.get(f"/v1/jobs/{job['id']}").json()["diagnostics"] is None
        client.delete(f"/v1/jobs/{job['id']}")


def test_reports_are_strict_json(client: httpx.Client, bare_job: dict[str, Any]) -> None:
    def refuse(name: str) -> float:
        raise AssertionError(f"{name} is no JSON")

    text = client.get(bare_job["links"]["report"]).text
    assert json.loads(text, parse_constant=refuse)["frames"] == 20
