"""The same client twice: what holds for one is asked of both."""

from __future__ import annotations

import inspect
import io
from typing import TYPE_CHECKING, Any, cast

import anyio
import httpx
import numpy as np
import pytest

from smsr import reconstruct
from smsr.synthetic import make_example
from smsr_client import AsyncClient, Client, JobFailed, ServiceError
from smsr_client.flows import RESUMABLE_BYTES
from smsr_client.transfer import Counter, Source

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from numpy.typing import NDArray

    from smsr.synthetic import Example
    from smsr_client import Job
    from tests.conftest import Served

pytestmark = pytest.mark.anyio


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def example() -> Example:
    return make_example(frames=20, side=6)


def _methods(client: type) -> dict[str, inspect.Signature]:
    return {
        name: inspect.signature(method)
        for name, method in inspect.getmembers(client, inspect.isfunction)
        if not name.startswith("_")
    }


def test_both_clients_have_the_same_methods() -> None:
    one, other = _methods(Client), _methods(AsyncClient)
    assert one.keys() == other.keys()
    assert len(one) > 15
    for name in one:
        assert one[name].parameters == other[name].parameters, name


def test_arrays_go_in_and_arrays_come_out(served: Served, example: Example) -> None:
    seen: list[Job] = []
    with Client(served.url) as client:
        result = client.reconstruct(
            example.measurements,
            ground_truth=example.ground_truth,
            faces=example.faces,
            progress=seen.append,
        )
    assert result.shapes.shape == (20, 36, 3)
    assert result.shapes.dtype == np.float32
    assert result.faces is not None
    assert np.array_equal(result.faces, example.faces)
    assert result.metrics is not None
    assert 0 <= result.metrics["e3d"] < 1
    assert seen[-1].status == "succeeded"
    assert seen[-1].inputs["measurements"].name == "measurements.npy"
    tracks = np.einsum("tij,tnj->tin", result.cameras, result.shapes)
    tracks += result.translations[:, :, None]
    given = example.measurements.reshape(tracks.shape)
    assert np.abs(tracks - given).max() < 0.05 * np.ptp(given)


def _sent(array: NDArray[Any], role: str = "measurements") -> NDArray[Any]:
    source = Source(array, role)
    with source.open(Counter(source.bytes, None)) as file:
        return cast("NDArray[Any]", np.load(io.BytesIO(file.read())))


@pytest.mark.parametrize(
    ("given", "sent"),
    [("float32", "float32"), ("float64", "float64"), ("int16", "float64"), ("int64", "float64")],
)
def test_masked_entries_are_sent_as_nan(given: str, sent: str) -> None:
    values = np.arange(12).reshape(3, 4).astype(given)
    array = np.ma.masked_array(values, mask=values == 5)
    found = _sent(array)
    assert found.dtype == sent
    assert np.array_equal(found, np.where(values == 5, np.nan, values), equal_nan=True)
    assert array.mask.sum() == 1, "what was given stays as it is"
    # Without a masked entry there is nothing that integers could not say.
    assert _sent(np.ma.masked_array(values, mask=False)).dtype == given


def test_masked_tracks_are_refused_or_completed_as_by_the_library(
    served: Served, example: Example
) -> None:
    tracks = np.ma.masked_array(example.measurements, mask=False)
    tracks[3, 5] = np.ma.masked
    tracks.data[3, 5] = 1e6  # what lies under the mask
    with Client(served.url) as client:
        with pytest.raises(JobFailed, match="missing='complete'"):
            client.reconstruct(tracks)
        sent = client.reconstruct(tracks, options={"missing": "complete"})
    here = reconstruct(tracks, missing="complete")
    # The service keeps shapes in single precision.
    assert np.allclose(sent.shapes, here.shapes, atol=1e-3 * np.ptp(here.shapes))


def test_no_error_is_measured_against_what_is_masked(served: Served, example: Example) -> None:
    truth = np.ma.masked_array(example.ground_truth, mask=False)
    truth[3, 5] = np.ma.masked
    with Client(served.url) as client, pytest.raises(JobFailed, match="ground truth"):
        client.reconstruct(example.measurements, ground_truth=truth)


@pytest.mark.parametrize("resumable", [1, RESUMABLE_BYTES], ids=["tus", "form"])
def test_numbers_of_numpy_are_options_and_settings(
    served: Served, example: Example, resumable: int
) -> None:
    with Client(served.url) as client:
        job = client.submit(
            example.measurements,
            options={
                "basis_size": np.int64(3),
                "smoothing": np.bool_(True),
                "penalty": np.float32(0.5),
            },
            settings={"ttl": np.int64(1000), "reuse": np.bool_(False)},
            resumable=resumable,
        )
        assert job.options["basis_size"] == 3
        assert job.options["smoothing"] is True
        assert job.options["penalty"] == 0.5
        assert job.ttl == 1000
        assert client.keep(job.id, np.int64(2000)).ttl == 2000  # type: ignore[arg-type]
        client.delete(job.id)


async def test_an_event_loop_does_the_same(served: Served, example: Example) -> None:
    async with AsyncClient(served.url) as client:
        result = await client.reconstruct(example.measurements)
        again = await client.result(result.job_id)
        assert np.array_equal(result.shapes, again.shapes)
        assert result.metrics is None
        listed = [job.id async for job in client.list(status="succeeded")]
        assert result.job_id in listed
        kept = await client.keep(result.job_id, 1000)
        assert kept.ttl == 1000
        assert kept.expires_at is not None
        await client.delete(result.job_id)
        with pytest.raises(ServiceError) as caught:
            await client.get(result.job_id)
        assert caught.value.slug == "unknown-job"


async def test_several_jobs_side_by_side(served: Served, example: Example) -> None:
    results = []
    async with AsyncClient(served.url) as client, anyio.create_task_group() as group:

        async def one(scale: float) -> None:
            results.append(await client.reconstruct(scale * example.measurements))

        for scale in (1.0, 2.0, 3.0):
            group.start_soon(one, scale)
    assert len({result.job_id for result in results}) == 3


async def test_large_files_go_over_by_tus(served: Served, tmp_path: Path) -> None:
    tracks = np.random.default_rng(0).standard_normal((60, 10_000))
    np.save(tmp_path / "w.npy", tracks)
    size = (tmp_path / "w.npy").stat().st_size
    seen: list[tuple[int, int]] = []
    async with AsyncClient(served.url) as client:
        job = await client.submit(
            tmp_path / "w.npy",
            options={"layout": "interleaved"},
            settings={"batch": "asynchronous", "priority": "low"},
            progress=lambda done, total: seen.append((done, total)),
            resumable=1,
        )
        assert (job.points, job.batch, job.priority) == (10_000, "asynchronous", "low")
        assert (seen[0], seen[-1]) == ((0, size), (size, size))
        assert (await client.batch("asynchronous")).total == 1
        await client.delete_batch("asynchronous")


def test_events_lead_from_the_queue_to_the_end(served: Served, example: Example) -> None:
    with Client(served.url) as client:
        job = client.submit(example.measurements)
        statuses = [now.status for now in client.events(job.id)]
        assert statuses[-1] == "succeeded"
        assert [now.status for now in client.events(job.id)] == ["succeeded"]
        with pytest.raises(ServiceError) as caught:
            list(client.events("0" * 32))
        assert caught.value.slug == "unknown-job"


class Breaking(httpx.AsyncBaseTransport):
    """A network that breaks every answer off after some bytes, and notes the headers asked with."""

    def __init__(self, after: int) -> None:
        self.after = after
        self.asked: list[httpx.Headers] = []
        self._network = httpx.AsyncHTTPTransport()

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        self.asked.append(request.headers)
        answer = await self._network.handle_async_request(request)
        stream = Broken(answer, self.after)
        return httpx.Response(answer.status_code, headers=answer.headers, stream=stream)

    async def aclose(self) -> None:
        await self._network.aclose()


class Broken(httpx.AsyncByteStream):
    def __init__(self, answer: httpx.Response, after: int) -> None:
        self.answer, self.left = answer, after

    async def __aiter__(self) -> AsyncIterator[bytes]:
        async for chunk in self.answer.aiter_raw():
            yield chunk[: self.left]
            self.left -= len(chunk)
            if self.left < 0:
                raise httpx.ReadError("the connection broke")

    async def aclose(self) -> None:
        await self.answer.aclose()


async def test_events_and_downloads_go_on_where_they_broke(
    served: Served, example: Example, tmp_path: Path
) -> None:
    async with AsyncClient(served.url) as client:
        job = await client.submit(example.measurements)
        length = len(job.model_dump_json())
        network = Breaking(2 * length + 500)
        async with AsyncClient(served.url, transport=network) as broken:
            statuses = [now.status async for now in broken.events(job.id)]
            assert statuses[-1] == "succeeded"
            assert all("last-event-id" in headers for headers in network.asked[1:])
            whole = await client.download(job.id, "result.npz", tmp_path / "whole.npz")
            network.asked.clear()
            network.after = whole.stat().st_size // 3
            target = await broken.download(job.id, "result.npz", tmp_path / "result.npz")
    assert target.read_bytes() == whole.read_bytes()
    assert len(network.asked) > 2
    assert all("range" in headers for headers in network.asked[1:])


async def test_a_failed_job_and_a_time_that_is_over(served: Served, example: Example) -> None:
    async with AsyncClient(served.url) as client:
        with pytest.raises(JobFailed, match="do not vary"):
            await client.reconstruct(np.zeros((20, 30)))
        many = np.random.default_rng(0).standard_normal((400, 3000))
        with pytest.raises(TimeoutError):
            await client.reconstruct(many, timeout=0, settings={"reuse": False})


async def test_waiting_can_be_given_up(served: Served, example: Example) -> None:
    """A cancelled operation leaves nothing open."""
    many = np.random.default_rng(1).standard_normal((1000, 1000))
    async with AsyncClient(served.url) as client:
        # The result of an equal job would be there at once.
        job = await client.submit(many, settings={"reuse": False})
        with anyio.move_on_after(0.2) as scope:
            await client.wait(job.id)
        assert scope.cancelled_caught
        await client.delete(job.id)
