from __future__ import annotations

import base64
import hashlib
import io
import os
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from service.downloads import disposition, safe_media_type
from tests.service.conftest import Api, finished, npy, problem, submit

if TYPE_CHECKING:
    import httpx

    from smsr.synthetic import Example


@pytest.fixture(scope="module")
def job(api: Api, example: Example, tracks: bytes) -> dict[str, Any]:
    """A finished job with faces."""
    files = {"measurements": ("w.npy", tracks), "faces": ("f.npy", npy(example.faces))}
    with api.client() as client:
        return finished(client, submit(client, files))


RESUMABLE = ("shapes.npy", "cameras.npy", "translations.npy", "faces.npy", "frames/7.ply")
FILES = (*RESUMABLE, "report.json", "inputs/measurements", "inputs/faces")


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
    problem(client.get(of(bare, "faces.npy")), "unknown-file", 404)
    problem(client.get(of(bare, "weights.npy")), "invalid-request", 422)


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
    problem(client.get(of(sent, "inputs/faces")), "unknown-file", 404)
    problem(client.get(of(sent, "inputs/..%2F..")), "not-found", 404)


def test_a_job_that_failed_for_its_input_has_none_to_give(client: httpx.Client) -> None:
    constant = npy(np.ones((12, 6), np.float32))
    failed = finished(client, submit(client, {"measurements": ("w.npy", constant)}))
    assert failed["status"] == "failed"
    answer = client.get(failed["inputs"]["measurements"]["link"])
    problem(answer, "unknown-file", 404)


def test_names_cannot_break_out_of_their_header() -> None:
    assert disposition("a.npy") == 'attachment; filename="a.npy"'
    broken = disposition('a"\r\nSet-Cookie: x=1\\%22.npy')
    assert "\r" not in broken
    assert broken.count('"') == 2


@pytest.mark.parametrize("sent", [None, "", "text", "a/b; c=d", "a/b\r\nx: y", "text /html"])
def test_types_that_are_none(sent: str | None) -> None:
    assert safe_media_type(sent) == "application/octet-stream"
