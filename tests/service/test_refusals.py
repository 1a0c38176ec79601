"""Every input that cannot be used gets a problem document of its own and leaves nothing behind."""

from __future__ import annotations

import gzip
import io
import zipfile
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import scipy.io

from tests.service.conftest import (
    ARRAY_LIMIT,
    UPLOAD_LIMIT,
    Api,
    Files,
    finished,
    npy,
    problem,
    submit,
    wait_for,
)
from worker.records import new_job_id

if TYPE_CHECKING:
    from collections.abc import Mapping

    import httpx
    from numpy.typing import NDArray

    from smsr.synthetic import Example

RNG = np.random.default_rng(0)
T, N = 6, 9
GOOD: NDArray[np.float32] = RNG.standard_normal((2 * T, N)).astype(np.float32)
MULTIPART = {"Content-Type": "multipart/form-data; boundary=x"}


def changed(row: int, point: int, value: float) -> NDArray[np.float32]:
    matrix = GOOD.copy()
    matrix[row, point] = value
    return matrix


def mat(**arrays: object) -> bytes:
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, arrays)  # type: ignore[arg-type]  # takes files too
    return buffer.getvalue()


def npz(**arrays: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=True, **arrays)
    return buffer.getvalue()


def corrupt_zip() -> bytes:
    archive = bytearray(npz(W=GOOD))
    archive[200:260] = bytes(60)  # within the data: the checksum is wrong
    return bytes(archive)


def bomb() -> bytes:
    """Four times the limit in an archive of some hundred kilobytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        rows = ARRAY_LIMIT // 1_000_000 * 1000
        with archive.open("W.npy", "w", force_zip64=True) as member:
            np.lib.format.write_array_header_1_0(
                member, {"descr": "<f4", "fortran_order": False, "shape": (rows, 1000)}
            )
            for _ in range(0, rows, 1000):
                member.write(bytes(4 * 1000 * 1000))
    return buffer.getvalue()


@dataclass(frozen=True)
class Bad:
    """An input, the problem it is, and when it shows: 'upload' or 'run'."""

    slug: str
    when: str
    measurements: bytes = field(repr=False, default=npy(GOOD))
    name: str = "w.npy"
    more: Mapping[str, bytes] = field(repr=False, default_factory=dict)
    options: Mapping[str, object] | None = None
    status: int = 422
    says: str = ""
    facts: Mapping[str, object] = field(default_factory=dict)


BAD = {
    "odd rows": Bad("odd-row-count", "upload", npy(GOOD[:-1]), says="11"),
    "three points": Bad("too-few-points", "upload", npy(GOOD[:, :3]), says="3"),
    "two frames": Bad("too-few-frames", "upload", npy(GOOD[:4]), says="2"),
    "a vector": Bad("wrong-shape", "upload", npy(GOOD.ravel())),
    "nan": Bad("not-finite", "run", npy(changed(7, 4, np.nan)), facts={"frame": 3, "point": 4}),
    "inf": Bad("not-finite", "run", npy(changed(2, 8, -np.inf)), facts={"frame": 1, "point": 8}),
    "constant": Bad("constant-measurements", "run", npy(np.full_like(GOOD, 3.0))),
    "zeros": Bad("constant-measurements", "run", npy(np.zeros_like(GOOD))),
    "complex": Bad("not-numeric", "upload", npy(GOOD.astype(np.complex64))),
    "text entries": Bad("not-numeric", "upload", npy(GOOD.astype("<U8"))),
    "structs": Bad("not-numeric", "upload", npy(np.zeros(12, [("u", "f4"), ("v", "f4")]))),
    "objects": Bad("unreadable-file", "upload", npy(GOOD.astype(object)), says="pickle"),
    "truncated npy": Bad("unreadable-file", "upload", npy(GOOD)[:-40], says="truncated"),
    "longer than its header": Bad("unreadable-file", "upload", npy(GOOD) + b"more"),
    "npy without header": Bad("unreadable-file", "upload", npy(GOOD)[:20]),
    "corrupt zip": Bad("unreadable-file", "run", corrupt_zip(), "w.npz"),
    "cut zip": Bad("unreadable-file", "run", npz(W=GOOD)[:-30], "w.npz"),
    "zip bomb": Bad("too-large", "run", bomb(), "w.npz"),
    "npy beyond the limit": Bad(
        "too-large",
        "upload",
        npy(GOOD)[:128].replace(b"(12, 9)", b"(999999, 9999)").replace(b" " * 8 + b"\n", b" \n"),
        status=413,
    ),
    "mat without numbers": Bad("not-numeric", "run", mat(note="hello"), "w.mat", says="'note'"),
    "empty zip": Bad("unreadable-file", "upload", npz(), "w.npz"),
    "two candidates": Bad(
        "ambiguous-array",
        "run",
        npz(one=GOOD, two=GOOD),
        "w.npz",
        says="'measurements_key'",
        facts={"option": "measurements_key", "role": "measurements"},
    ),
    "two candidates for the faces": Bad(
        "ambiguous-array",
        "run",
        more={"faces": npz(one=np.zeros((5, 3), np.int32), two=np.zeros((6, 3), np.int32))},
        says="'faces_key'",
    ),
    "no such key": Bad(
        "array-not-found", "run", npz(W=GOOD), "w.npz", options={"measurements_key": "X"}
    ),
    "an image": Bad(
        "unsupported-format", "upload", b"\x89PNG\r\n\x1a\n" + bytes(99), "w.png", status=415
    ),
    "noise": Bad("unsupported-format", "upload", RNG.bytes(5000), "w.npy", status=415),
    "empty file": Bad("empty-file", "upload", b""),
    "truth of other frames": Bad(
        "ground-truth-mismatch", "upload", more={"ground_truth": npy(np.ones((T + 1, N, 3)))}
    ),
    "truth of other points": Bad(
        "ground-truth-mismatch", "upload", more={"ground_truth": npy(np.ones((T, N + 1, 3)))}
    ),
    "truth that is no file": Bad("empty-file", "upload", more={"ground_truth": b""}),
    "faces out of range": Bad(
        "invalid-faces", "run", more={"faces": npy(np.array([[0, 1, N]], np.int32))}
    ),
    "faces of four corners": Bad(
        "invalid-faces", "upload", more={"faces": npy(np.zeros((5, 4), np.int32))}
    ),
    "unknown option": Bad("unknown-option", "upload", options={"layuot": "auto"}, says="'layout'?"),
    "option of a wrong type": Bad("invalid-option", "upload", options={"layout": 3}),
    "option out of range": Bad("invalid-option", "upload", options={"time_limit": 0}),
    "over the limit": Bad(
        "upload-too-large",
        "upload",
        npy(np.zeros((8, UPLOAD_LIMIT // 32), np.float32)),
        status=413,
        facts={"limit": UPLOAD_LIMIT},
    ),
    "over the limit together": Bad(
        "upload-too-large",
        "upload",
        npy(RNG.standard_normal((256, UPLOAD_LIMIT // 2048)).astype(np.float32)),
        more={"ground_truth": npy(np.zeros((128, UPLOAD_LIMIT // 2048, 3)))},
        status=413,
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_inputs_are_explained_and_leave_nothing(
    api: Api, client: httpx.Client, case: str
) -> None:
    bad = BAD[case]
    before = api.left_behind()
    files: Files = {"measurements": (bad.name, bad.measurements)}
    files |= {role: (f"{role}.npy", content) for role, content in bad.more.items()}
    answer = submit(client, files, bad.options)
    if bad.when == "upload":
        document = problem(answer, bad.slug, bad.status)
    else:
        job = finished(client, answer)
        assert job["status"] == "failed", job
        document = job["problem"]
        assert document["type"] == f"/problems/{bad.slug}", document
        # Only the record stays, to say what was wrong, until it is deleted.
        wait_for(lambda: api.stored() <= before)
        problem(client.post(job["links"]["retry"]), "inputs-gone", 409)
        assert client.delete(f"/v1/jobs/{job['id']}").status_code == 204
    assert bad.says in document["detail"]
    assert {name: document.get(name) for name in bad.facts} == bad.facts
    assert client.get(document["type"]).status_code == 200
    wait_for(lambda: api.left_behind() <= before)  # the worker may be about to drop its ticket


def part(name: str, content: bytes, *, filename: str | None = None) -> bytes:
    file = f'; filename="{filename}"' if filename else ""
    head = f'--x\r\nContent-Disposition: form-data; name="{name}"{file}\r\n\r\n'
    return head.encode() + content + b"\r\n"


W = part("measurements", npy(GOOD), filename="w.npy")
END = b"--x--\r\n"

BODIES = {
    "no parts": (END, "missing-measurements", 422),
    "options only": (part("options", b"{}") + END, "missing-measurements", 422),
    "a misspelt part": (part("measurement", npy(GOOD)) + END, "unknown-part", 422),
    "a part without a name": (part("", b"") + END, "unknown-part", 422),
    "measurements twice": (W + W + END, "duplicate-part", 422),
    "options twice": (part("options", b"{}") * 2 + W + END, "duplicate-part", 422),
    "no end": (W, "malformed-multipart", 400),
    "another boundary": (W.replace(b"--x", b"--y"), "malformed-multipart", 400),
    "measurements ahead of the first boundary": (W[1:] + END, "missing-measurements", 422),
    "nothing": (b"", "malformed-multipart", 400),
    "no header": (b"--x\r\n\r\nabc\r\n" + END, "malformed-multipart", 400),
    "endless header": (b"--x\r\nA: " + b"a" * 9000 + END, "malformed-multipart", 400),
    "options that are no JSON": (part("options", b"{") + W + END, "malformed-options", 422),
    "options in a list": (part("options", b"[]") + W + END, "malformed-options", 422),
    "options that are not UTF-8": (part("options", b"\xff") + END, "malformed-options", 422),
    "options of NaN": (
        part("options", b'{"time_limit": NaN}') + END,
        "malformed-options",
        422,
    ),
    "deep options": (part("options", b"[" * 60_000) + END, "malformed-options", 422),
    "long options": (
        part("options", b'{"layout": "' + b"a" * 70_000 + b'"}') + END,
        "malformed-options",
        422,
    ),
    "huge numbers": (part("options", b'{"time_limit": 1e999}') + END, "invalid-option", 422),
}


@pytest.mark.parametrize("case", BODIES)
def test_bodies_that_make_no_job(api: Api, client: httpx.Client, case: str) -> None:
    body, slug, status = BODIES[case]
    before = api.left_behind()
    problem(client.post("/v1/jobs", content=body, headers=MULTIPART), slug, status)
    assert api.left_behind() <= before


@pytest.mark.parametrize(
    "kind", ["application/x-www-form-urlencoded", "", "multipart/mixed", "text/json"]
)
def test_bodies_of_another_type(client: httpx.Client, kind: str) -> None:
    answer = client.post("/v1/jobs", content=b"{}", headers={"Content-Type": kind})
    problem(answer, "unsupported-media-type", 415)


TUS = {"Tus-Resumable": "1.0.0", "Content-Type": "application/offset+octet-stream"}
JSON = {"Content-Type": "application/json"}


@pytest.mark.parametrize(
    ("method", "path", "headers"),
    [
        ("POST", "/v1/jobs", MULTIPART),
        ("POST", "/v1/jobs", JSON),
        ("PATCH", "/v1/jobs/{job}", JSON),
        ("POST", "/v1/uploads", {**TUS, "Upload-Length": "1000"}),
        ("PATCH", "/v1/uploads/{upload}", {**TUS, "Upload-Offset": "0"}),
        ("PUT", "/v1/uploads/{new}", {}),
    ],
)
def test_a_compressed_body(
    idle_api: Api, method: str, path: str, headers: Mapping[str, str]
) -> None:
    with idle_api.client() as client:
        job = submit(client, {"measurements": ("w.npy", npy(GOOD))}).json()["id"]
        begun = client.post("/v1/uploads", headers={**TUS, "Upload-Length": "1000"})
        upload = begun.headers["Location"].rpartition("/")[2]
        before = idle_api.left_behind()
        url = path.format(job=job, upload=upload, new=new_job_id())
        for coding in ("gzip", "identity, gzip"):
            sent = {**headers, "Content-Encoding": coding}
            answer = client.request(method, url, content=gzip.compress(W + END), headers=sent)
            document = problem(answer, "unsupported-media-type", 415)
            assert f"without Content-Encoding {coding}." in document["detail"]
            assert answer.headers["Accept-Encoding"] == "identity"
        assert idle_api.left_behind() == before
        (kept,) = client.get("/v1/uploads").json()["uploads"]
        assert (kept["id"], kept["offset"]) == (upload, 0)


def test_a_body_that_says_it_is_sent_as_it_is(client: httpx.Client) -> None:
    put = f"/v1/uploads/{new_job_id()}"
    answer = client.put(put, content=npy(GOOD), headers={"Content-Encoding": "identity"})
    assert answer.status_code == 201
    client.delete(put)


def test_a_body_without_boundary(client: httpx.Client) -> None:
    kind = {"Content-Type": "multipart/form-data"}
    problem(client.post("/v1/jobs", content=W, headers=kind), "malformed-multipart", 400)


def test_the_last_point_is_a_valid_corner(
    client: httpx.Client, example: Example, tracks: bytes
) -> None:
    last = example.measurements.shape[1] - 1
    faces = npy(np.array([[0, 1, last]], np.int64))
    files: Files = {"measurements": ("w.npy", tracks), "faces": ("f.npy", faces)}
    job = finished(client, submit(client, files))
    assert job["status"] == "succeeded", job
    client.delete(f"/v1/jobs/{job['id']}")
