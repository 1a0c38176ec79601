from __future__ import annotations

import base64
import hashlib
import io
import os
import shutil
import subprocess
import tempfile
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import httpx
import numpy as np
import pytest

from service.downloads import disposition, safe_media_type
from smsr_client import Client
from tests.conftest import redis_running
from tests.service.conftest import (
    Api,
    api_running,
    finished,
    npy,
    problem,
    settings_for,
    submit,
    wait_for,
)
from worker.checksums import write_checksums
from worker.records import InputFile, JobRecord, RecordStore, Verdict, new_job_id

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from smsr.synthetic import Example
    from tests.conftest import S3Process


@pytest.fixture(scope="module")
def job(api: Api, example: Example, tracks: bytes) -> dict[str, Any]:
    """A finished job with faces."""
    files = {"measurements": ("w.npy", tracks), "faces": ("f.npy", npy(example.faces))}
    with api.client() as client:
        return finished(client, submit(client, files))


VIEWS = ("shapes.npy", "cameras.npy", "translations.npy", "faces.npy", "frames/7.ply")
ARCHIVES = ("result.npz", "frames.zip")
FILES = (*VIEWS, *ARCHIVES, "report.json", "inputs/measurements", "inputs/faces")


def of(job: dict[str, Any], what: str) -> str:
    return f"/v1/jobs/{job['id']}/{what}"


def test_arrays_are_those_of_the_npz(client: httpx.Client, job: dict[str, Any]) -> None:
    with np.load(io.BytesIO(client.get(job["links"]["result"]).content)) as arrays:
        for name in ("shapes", "cameras", "translations", "faces"):
            answer = client.get(job["links"][name])
            assert answer.headers["content-type"] == "application/octet-stream"
            file = f"smsr-{job['id']}-{name}.npy"
            assert answer.headers["content-disposition"] == f'attachment; filename="{file}"'
            array = np.load(io.BytesIO(answer.content))
            np.testing.assert_array_equal(array, arrays[name], strict=True)


def test_a_result_without_faces_has_no_file_of_them(client: httpx.Client, tracks: bytes) -> None:
    bare = finished(client, submit(client, {"measurements": ("w.npy", tracks)}))
    assert bare["links"]["faces"] is None
    for file in ("faces.npy", "weights.npy"):
        document = problem(client.get(of(bare, file)), "unknown-file", 404)
        assert document["files"] == ["shapes.npy", "cameras.npy", "translations.npy"]
        assert f"no {file!r}. Such files are shapes.npy, " in document["detail"]


def test_one_frame_is_a_range_of_the_shapes(client: httpx.Client, job: dict[str, Any]) -> None:
    shapes = np.load(io.BytesIO(client.get(job["links"]["shapes"]).content))
    size = 12 * job["points"]
    first = 128 + 7 * size
    answer = client.get(
        job["links"]["shapes"], headers={"Range": f"bytes={first}-{first + size - 1}"}
    )
    assert answer.status_code == 206
    frame = np.frombuffer(answer.content, "<f4").reshape(-1, 3)
    np.testing.assert_array_equal(frame, shapes[7])


@pytest.mark.parametrize("what", FILES)
def test_any_part_of_any_file(client: httpx.Client, job: dict[str, Any], what: str) -> None:
    url = of(job, what)
    whole = client.get(url)
    size = len(whole.content)
    assert (whole.status_code, whole.headers["accept-ranges"]) == (200, "bytes")
    cuts = {0, 1, size // 3, size // 2, size - 1} | {
        int.from_bytes(os.urandom(4)) % size for _ in range(6)
    }
    for start in cuts:
        for stop in {start + 1, size, (start + size + 1) // 2}:
            if not start < stop <= size:
                continue
            wanted = {"Range": f"bytes={start}-{stop - 1}", "If-Range": whole.headers["etag"]}
            answer = client.get(url, headers=wanted)
            assert answer.status_code == 206, (what, start, stop)
            assert answer.content == whole.content[start:stop]
            assert answer.headers["content-range"] == f"bytes {start}-{stop - 1}/{size}"
            for name in ("etag", "last-modified", "content-type", "cache-control"):
                assert answer.headers[name] == whole.headers[name]
    assert client.get(url, headers={"Range": "bytes=-5"}).content == whole.content[-5:]


@pytest.mark.parametrize("what", FILES)
def test_conditions(client: httpx.Client, job: dict[str, Any], what: str) -> None:
    url = of(job, what)
    whole = client.get(url)
    tag, date = whole.headers["etag"], whole.headers["last-modified"]
    size = len(whole.content)

    def ask(**fields: str) -> httpx.Response:
        return client.get(url, headers={k.replace("_", "-"): v for k, v in fields.items()})

    for fields in ({"If_None_Match": tag}, {"If_Modified_Since": date}):
        answer = ask(**fields, Range="bytes=0-4")
        assert (answer.status_code, answer.content) == (304, b"")
        assert answer.headers["etag"] == tag
    assert ask(If_Match=tag).status_code == 200
    problem(ask(If_Match='"other"'), "precondition-failed", 412)
    problem(ask(If_Unmodified_Since="Thu, 01 Jan 2026 00:00:00 GMT"), "precondition-failed", 412)
    outside = ask(Range=f"bytes={size}-")
    assert problem(outside, "range-not-satisfiable", 416)["size"] == size
    assert outside.headers["content-range"] == f"bytes */{size}"
    for ignored in ("bytes=0-1,3-4", "bytes=4-1", "lines=0-4"):
        answer = ask(Range=ignored)
        assert (answer.status_code, answer.content) == (200, whole.content)
    other = ask(Range="bytes=0-4", If_Range='"other"')
    assert (other.status_code, other.content) == (200, whole.content)
    assert ask(Range="bytes=0-4", If_Range=date).status_code == 206
    asked = client.head(url, headers={"Range": "bytes=0-4"})
    assert (asked.status_code, asked.headers["content-length"]) == (200, str(size))


def test_inputs_come_back_as_they_were_sent(client: httpx.Client, tracks: bytes) -> None:
    name = "spür \u2603 a;b.npy"
    files: Any = {"measurements": (name, tracks, "application/x-npy")}
    sent = finished(client, client.post("/v1/jobs", files=files))
    answer = client.get(sent["inputs"]["measurements"]["link"])
    assert answer.content == tracks
    assert answer.headers["content-type"] == "application/x-npy"
    assert answer.headers["content-disposition"] == (
        'attachment; filename="sp_r _ a;b.npy"; '
        "filename*=utf-8''sp%C3%BCr%20%E2%98%83%20a%3Bb.npy"
    )
    digest = base64.b64encode(hashlib.sha256(tracks).digest()).decode()
    assert answer.headers["repr-digest"] == f"sha-256=:{digest}:"
    for role in ("faces", "nope"):
        document = problem(client.get(of(sent, f"inputs/{role}")), "unknown-file", 404)
        assert document["files"] == ["inputs/measurements"]
    problem(client.get(of(sent, "inputs/..%2F..")), "not-found", 404)


def test_a_job_that_failed_for_its_input_has_none_to_give(client: httpx.Client) -> None:
    constant = npy(np.ones((12, 6), np.float32))
    failed = finished(client, submit(client, {"measurements": ("w.npy", constant)}))
    assert failed["status"] == "failed"
    link = failed["inputs"]["measurements"]["link"]
    # The worker removes them after it has said that the job failed.
    wait_for(lambda: client.head(link).status_code == 404)
    problem(client.get(link), "unknown-file", 404)


def test_names_cannot_break_out_of_their_header() -> None:
    assert disposition("a.npy") == 'attachment; filename="a.npy"'
    broken = disposition('a"\r\nSet-Cookie: x=1\\%22.npy')
    assert "\r" not in broken
    assert broken.count('"') == 2


@pytest.mark.parametrize("sent", [None, "", "text", "a/b; c=d", "a/b\r\nx: y", "text /html"])
def test_types_that_are_none(sent: str | None) -> None:
    assert safe_media_type(sent) == "application/octet-stream"


@pytest.mark.parametrize("what", [name for name in VIEWS if name.endswith(".npy")])
def test_an_array_comes_with_its_digest(
    client: httpx.Client, job: dict[str, Any], what: str
) -> None:
    whole = client.get(of(job, what))
    digest = base64.b64encode(hashlib.sha256(whole.content).digest()).decode()
    assert whole.headers["repr-digest"] == f"sha-256=:{digest}:"
    part = client.get(of(job, what), headers={"Range": "bytes=0-9"})
    assert part.headers["repr-digest"] == whole.headers["repr-digest"]


@pytest.mark.parametrize("what", ARCHIVES)
def test_results_without_checksums_are_sent_whole(api: Api, tracks: bytes, what: str) -> None:
    """As earlier versions published them."""
    with api.client() as client:
        job = finished(client, submit(client, {"measurements": ("w.npy", tracks)}))
        stored = api.storage()
        prefix = f"results/{job['id']}/{job['attempt']}/"
        kept = {item.key: stored.get(item.key) for item in stored.list_prefix(prefix)}
        stored.delete_prefix(prefix)
        for key, data in kept.items():
            if "checksums" not in key:
                stored.put_bytes(key, data)
        answer = client.get(of(job, what), headers={"Range": "bytes=0-9"})
        assert (answer.status_code, answer.headers["accept-ranges"]) == (200, "none")
        assert len(answer.content) == int(answer.headers["content-length"])
        with zipfile.ZipFile(io.BytesIO(answer.content)) as opened:
            assert opened.testzip() is None
        client.delete(job["links"]["self"])


@pytest.fixture(scope="module")
def long_job(api: Api) -> str:
    """A finished job of 20,000 frames with many faces: as records and files, without a solver."""
    generator = np.random.default_rng(0)
    frames, points = 20_000, 60
    shapes = generator.normal(size=(frames, points, 3)).astype("<f4")
    return publish_result(
        api,
        {
            "shapes.npy": shapes,
            "cameras.npy": np.zeros((frames, 2, 3)),
            "translations.npy": np.zeros((frames, 2)),
            "faces.npy": generator.integers(0, points, (80, 3)),
        },
    )


def publish_result(api: Api, arrays: Mapping[str, NDArray[Any]]) -> str:
    """Publish arrays as the result of a new job, as a worker does."""
    records = RecordStore(api.redis.client())
    storage = api.storage()
    job_id = new_job_id()
    inputs = {
        role: InputFile(f"uploads/{job_id}/{role}", "w.npy", 1, "0" * 64)
        for role in ("measurements", "faces")
    }
    records.create(JobRecord.new(job_id, options={}, inputs=inputs, name="w.npy"))
    ticket = records.assign_ticket(job_id, "ticket")
    assert ticket is not None
    attempt = records.begin_attempt(job_id, worker="test", ticket="ticket", lease=60)
    assert attempt is not None
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        for name, array in arrays.items():
            np.save(folder / name, array)
        (folder / "report.json").write_text("{}")
        write_checksums(folder, tuple(arrays))
        for path in folder.iterdir():
            storage.put_file(f"results/{job_id}/{attempt}/{path.name}", path)
    frames, points, _ = arrays["shapes.npy"].shape
    verdict = records.publish(job_id, attempt, frames=frames, points=points, timings={})
    assert verdict is Verdict.OK
    return job_id


def test_an_archive_of_many_frames_takes_no_more_memory(api: Api, long_job: str) -> None:
    """34 MB in 20,000 members: whole, and any part without what stands before it."""
    url = f"/v1/jobs/{long_job}/frames.zip"
    with api.client() as client:
        client.get(f"/v1/jobs/{long_job}/frames/0.ply")
        before = api.resident()
        answer = client.get(url)
        assert len(answer.content) == int(answer.headers["content-length"]) > 30_000_000
        assert api.resident("VmHWM") - before < 48 << 20
        with zipfile.ZipFile(io.BytesIO(answer.content)) as opened:
            assert len(opened.namelist()) == 20_000
            assert opened.testzip() is None
            assert (
                opened.read("frame_19999.ply")
                == client.get(f"/v1/jobs/{long_job}/frames/19999.ply").content
            )
        size = len(answer.content)
        for start in (size - 20, size - 1_000_000, size // 2, 12_345_678):
            part = client.get(url, headers={"Range": f"bytes={start}-{start + 99_999}"})
            assert part.status_code == 206
            assert part.content == answer.content[start : start + 100_000]


def test_curl_goes_on_where_it_was_killed_though_the_service_was_restarted(
    tmp_path: Path,
) -> None:
    curl = shutil.which("curl")
    if curl is None:
        pytest.skip("curl is not here")
    wholes: dict[str, httpx.Response] = {}
    with redis_running(tmp_path) as redis:
        settings = settings_for(tmp_path, redis)
        with api_running(settings, redis, tmp_path / "api.log") as api:
            shapes = np.random.default_rng(0).normal(size=(2000, 400, 3)).astype("<f4")
            arrays = {
                "shapes.npy": shapes,
                "cameras.npy": np.zeros((2000, 2, 3)),
                "translations.npy": np.zeros((2000, 2)),
                "faces.npy": np.zeros((5, 3), np.int64),
            }
            job = f"/v1/jobs/{publish_result(api, arrays)}"
            for what in ARCHIVES:
                target = tmp_path / what
                wholes[what] = httpx.get(f"{api.url}{job}/{what}")
                # A limit of the size of files ends it in the middle, however fast it is.
                limited = ["sh", "-c", 'ulimit -f 2000; exec "$@"', "sh", curl, "-sS", "-o"]
                ended = subprocess.run(
                    [*limited, str(target), f"{api.url}{job}/{what}"],
                    capture_output=True,
                    check=False,
                )
                assert ended.returncode != 0
                held = target.read_bytes()
                assert 0 < len(held) < len(wholes[what].content)
                assert wholes[what].content.startswith(held)
        with api_running(settings, redis, tmp_path / "api.log") as api:
            for what, whole in wholes.items():
                target = tmp_path / what
                held_size = target.stat().st_size
                url = f"{api.url}{job}/{what}"
                resume = [curl, "-sS", "-f", "-C", "-", "-D", "-", "-o", str(target), url]
                done = subprocess.run(resume, capture_output=True, text=True, check=True)
                assert "206 Partial Content" in done.stdout
                assert f"content-range: bytes {held_size}-" in done.stdout.lower()
                assert httpx.head(url).headers["etag"] == whole.headers["etag"]
                assert target.read_bytes() == whole.content
                unzip = shutil.which("unzip")
                if unzip is not None:
                    subprocess.run([unzip, "-tqq", target], check=True)


def test_arrays_come_from_the_store_itself_where_that_is_wanted(
    tmp_path: Path, s3_process: S3Process, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in s3_process.environment.items():
        monkeypatch.setenv(name, value)
    bucket = s3_process.new_bucket()
    with redis_running(tmp_path) as redis:
        settings = settings_for(tmp_path, redis, storage_url=bucket, presigned_links_seconds=60)
        with api_running(settings, redis, tmp_path / "api.log") as api:
            shapes = np.random.default_rng(0).normal(size=(5, 7, 3)).astype("<f4")
            job_id = publish_result(
                api,
                {
                    "shapes.npy": shapes,
                    "cameras.npy": np.zeros((5, 2, 3)),
                    "translations.npy": np.zeros((5, 2)),
                    "faces.npy": np.zeros((2, 3), np.int64),
                },
            )
            path = f"/v1/jobs/{job_id}/shapes.npy"
            sent = httpx.get(api.url + path, headers={"Range": "bytes=0-9"})
            assert (sent.status_code, sent.headers["cache-control"]) == (307, "no-store")
            assert sent.headers["location"].startswith(s3_process.url)
            stored = httpx.get(sent.headers["location"], headers={"Range": "bytes=128-139"})
            assert (stored.status_code, stored.content) == (206, shapes.tobytes()[:12])
            assert httpx.head(api.url + path).status_code == 200
            with Client(api.url) as client:
                found = client.download(job_id, "shapes.npy", tmp_path / "shapes.npy")
                np.testing.assert_array_equal(np.load(found), shapes)
                archive = client.download(job_id, "result.npz", tmp_path / "result.npz")
                np.testing.assert_array_equal(np.load(archive)["shapes"], shapes)
