"""Measurements as dask arrays, on this machine and on a cluster of processes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import smsr
from smsr.errors import Cancelled, NotFinite, NotNumeric, OddRowCount, TooFewPoints
from smsr.measurements import as_source
from smsr.rowspace import factorise, map_back

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from smsr.measurements import Layout

da = pytest.importorskip("dask.array", reason="needs the extra smsr[dask]")
zarr = pytest.importorskip("zarr", reason="needs the extra smsr[dask]")
distributed = pytest.importorskip("distributed", reason="needs the extra smsr[dask]")

FRAMES, POINTS = 15, 4000
SIZE = 8 * 2 * FRAMES * 1000  # bytes of a chunk of 1000 points


def cluster(memory: str) -> Any:
    return distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, memory_limit=memory, dashboard_address=":0"
    )


@pytest.fixture(params=["threads", pytest.param("cluster", marks=pytest.mark.slow)], scope="module")
def scheduler(request: pytest.FixtureRequest) -> Iterator[None]:
    if request.param == "threads":
        yield
    else:
        with cluster("1GB") as running, distributed.Client(running):
            yield


def matrix() -> NDArray[np.float64]:
    rng = np.random.default_rng(0)
    W = rng.standard_normal((2 * FRAMES, 6)) @ rng.standard_normal((6, POINTS))
    return W + 1e-2 * rng.standard_normal(W.shape) + 30 * rng.standard_normal((2 * FRAMES, 1))


def some_map() -> NDArray[np.float64]:
    return np.random.default_rng(1).standard_normal((3 * FRAMES, 2 * FRAMES))


@pytest.mark.usefixtures("scheduler")
class TestDaskSource:
    @pytest.mark.parametrize(
        "chunks", [(30, 1000), (10, 700), (30, (500, 3500)), (30, 4000), (7, 250)]
    )
    def test_as_the_array_itself(self, tmp_path: Path, chunks: Any) -> None:
        W, A = matrix(), some_map()
        source = as_source(da.from_array(W, chunks=chunks))
        here = as_source(W)
        expected = factorise(here)
        space = factorise(source, chunk_bytes=SIZE)
        np.testing.assert_allclose(space.means, expected.means, rtol=1e-13)
        scale = expected.singular_values[0]
        np.testing.assert_allclose(space.factor, expected.factor, atol=1e-10 * scale)
        np.testing.assert_allclose(space.sample, expected.sample, atol=1e-12 * scale)
        S = map_back(here, expected, A)
        np.testing.assert_allclose(
            map_back(source, space, A, chunk_bytes=SIZE), S, atol=1e-12 * np.abs(S).max()
        )
        given = np.empty((FRAMES, POINTS, 3), np.float32)
        assert map_back(source, space, A, given, chunk_bytes=SIZE) is given
        lazy = map_back(source, space, A, tmp_path, chunk_bytes=SIZE)
        stored = zarr.open_array(str(tmp_path / "shapes.zarr"), mode="r")[...]
        assert stored.dtype == np.float32
        np.testing.assert_array_equal(np.asarray(lazy), stored)
        for shapes in (given, stored):
            np.testing.assert_allclose(shapes, S, atol=1e-6 * np.abs(S).max())

    def test_layouts(self) -> None:
        W = matrix()
        X = W.reshape(FRAMES, 2, POINTS)
        stacked = np.concatenate([W[::2], W[1::2]])
        layouts: list[tuple[Any, Layout]] = [
            (X, "auto"),
            (X.transpose(0, 2, 1), "auto"),
            (stacked, "stacked"),
        ]
        for array, layout in layouts:
            source = as_source(da.from_array(array, chunks=700), layout)
            assert (source.frames, source.points) == (FRAMES, POINTS)
            blocks = [block for _, block in source.chunks(1000)]
            np.testing.assert_array_equal(np.concatenate(blocks, axis=1), W)

    def test_reconstruction(self, tmp_path: Path) -> None:
        W = matrix()
        here = smsr.reconstruct(W)
        seen: list[float] = []
        result = smsr.reconstruct(
            da.from_array(W, chunks=(30, 1000)),
            out=tmp_path,
            progress=lambda progress: seen.append(progress.fraction),
        )
        np.testing.assert_allclose(result.cameras, here.cameras, atol=1e-6)
        scale = float(np.abs(here.shapes).max())
        np.testing.assert_allclose(np.asarray(result.shapes), here.shapes, atol=1e-5 * scale)
        assert seen == sorted(seen)
        assert {path.name for path in tmp_path.iterdir()} >= {"shapes.zarr", "cameras.npy"}

    def test_refusals(self) -> None:
        for array, error in (
            (da.zeros((7, 9)), OddRowCount),
            (da.zeros((8, 3)), TooFewPoints),
            (da.zeros((8, 9), dtype=complex), NotNumeric),
        ):
            with pytest.raises(error):
                as_source(array)

    def test_not_finite_is_found_where_the_block_is(self) -> None:
        W = matrix()
        W[5, 3777] = np.nan
        with pytest.raises(NotFinite) as caught:
            factorise(as_source(da.from_array(W, chunks=(30, 1000))))
        assert caught.value.context == {"frame": 2, "point": 3777, "coordinate": "v", "count": 1}

    def test_a_stopped_pass_leaves_no_store(self, tmp_path: Path) -> None:
        source = as_source(da.from_array(matrix(), chunks=(30, 1000)))
        space = factorise(source, chunk_bytes=SIZE)

        def stop(done: float, *_: object) -> None:
            if done > 0.3:
                raise Cancelled("enough")

        with pytest.raises(Cancelled):
            map_back(source, space, some_map(), tmp_path, chunk_bytes=SIZE, progress=stop)
        assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_matrix_larger_than_the_memory_of_the_cluster(tmp_path: Path) -> None:
    frames, points, rank = 50, 2_050_000, 12
    columns = da.random.default_rng(0).standard_normal(
        (rank, points), dtype=np.float32, chunks=(rank, 25_000)
    )
    rng = np.random.default_rng(1)
    mixing = rng.standard_normal((2 * frames, rank)).astype(np.float32)
    translations = 100 * rng.standard_normal((2 * frames, 1)).astype(np.float32)
    W = da.from_array(mixing, chunks=-1) @ columns + translations
    assert W.nbytes > 2 * 400e6
    A = rng.standard_normal((3 * frames, 2 * frames))
    with cluster("400MB") as running, distributed.Client(running) as client:
        workers = set(client.scheduler_info()["workers"])
        source = as_source(W)
        space = factorise(source)
        shapes: Any = map_back(source, space, A, tmp_path)
        # A worker that outgrows its memory is killed and started again under another address.
        assert set(client.scheduler_info()["workers"]) == workers
        part = slice(1_700_000, 1_700_100)
        block = W[:, part].compute(scheduler="synchronous").astype(np.float64)
    assert shapes.nbytes > 3 * 400e6
    np.testing.assert_allclose(space.means, translations[:, 0], atol=0.02)
    # N V^T V is near N I for random columns: the singular values are those of the mixing matrix.
    expected = np.linalg.svd(mixing, compute_uv=False) * np.sqrt(points)
    np.testing.assert_allclose(space.singular_values[:rank], expected, rtol=0.01)
    assert space.singular_values[rank] < 1e-5 * space.singular_values[0]
    S = (A @ (block - space.means[:, None])).reshape(frames, 3, -1).transpose(0, 2, 1)
    np.testing.assert_allclose(shapes[:, part].compute(), S, atol=1e-5 * np.abs(S).max())
