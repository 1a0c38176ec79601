from __future__ import annotations

import subprocess
import sys
import threading
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from threadpoolctl import threadpool_info, threadpool_limits

from smsr.errors import Cancelled, ConstantMeasurements, InputError, NotFinite, WrongShape
from smsr.lifting import Lifting
from smsr.measurements import ArraySource, ChunkedSource, as_source
from smsr.rowspace import RowSpace, factorise, map_back
from smsr.sinks import SHAPES_FILE

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

EPS = float(np.finfo(np.float64).eps)


def low_rank(
    frames: int, points: int, *, rank: int = 6, noise: float = 1e-3, seed: int = 0
) -> NDArray[np.float64]:
    """W (2T, N) of some rank with noise and translations."""
    rng = np.random.default_rng(seed)
    W = rng.standard_normal((2 * frames, rank)) @ rng.standard_normal((rank, points))
    W += noise * rng.standard_normal(W.shape)
    return W + 20 * rng.standard_normal((2 * frames, 1))


def centred(W: NDArray[Any]) -> NDArray[np.float64]:
    X = W.astype(np.float64)
    X -= X[:, :1].copy()
    X -= X.mean(axis=1, keepdims=True)
    return X


def assert_factor(rowspace: RowSpace, W: NDArray[Any], tolerance: float = 200 * EPS) -> None:
    """Check that L L^T is that of the centred W, and that L has the form that was promised."""
    X = centred(W)
    L, values = rowspace.factor, rowspace.singular_values
    scale = float(np.linalg.norm(X, 2))
    reference = np.linalg.svd(X, compute_uv=False)
    np.testing.assert_allclose(values, reference[: len(values)], rtol=0, atol=tolerance * scale)
    assert (reference[len(values) :] <= 1e-12 * scale).all()
    np.testing.assert_allclose(L @ L.T, X @ X.T, rtol=0, atol=tolerance * scale**2)
    np.testing.assert_allclose(L.T @ L, np.diag(values**2), rtol=0, atol=tolerance * scale**2)
    assert (np.diff(values) <= 0).all()
    strongest = np.take_along_axis(L, np.abs(L).argmax(axis=0)[None], axis=0)
    assert (strongest > 0).all()
    np.testing.assert_allclose(
        rowspace.means, W.mean(axis=1, dtype=np.longdouble).astype(float), rtol=1e-14, atol=1e-14
    )


class TestFactorise:
    @settings(max_examples=60, deadline=None)
    @given(
        frames=st.integers(3, 12),
        points=st.integers(4, 200),
        chunk_bytes=st.integers(1, 20_000),
        seed=st.integers(0, 100),
    )
    def test_it_factors_the_centred_matrix(
        self, frames: int, points: int, chunk_bytes: int, seed: int
    ) -> None:
        W = low_rank(frames, points, seed=seed)
        assert_factor(factorise(as_source(W), chunk_bytes=chunk_bytes), W)

    @pytest.mark.parametrize(
        ("frames", "points"), [(3, 4), (400, 12), (30, 60), (30, 61), (20, 30_000), (130, 700)]
    )
    @pytest.mark.parametrize("dtype", ["f4", "f8", ">f4", "i2"])
    def test_shapes_and_types(self, frames: int, points: int, dtype: str) -> None:
        W = (low_rank(frames, points) * 20).astype(dtype)
        rowspace = factorise(as_source(W), chunk_bytes=2**20)
        assert_factor(rowspace, W)
        assert (rowspace.frames, rowspace.points) == (frames, points)
        assert rowspace.factor.dtype == np.float64

    @pytest.mark.parametrize("points", [300, 20_000])
    def test_weak_directions_keep_their_digits(self, points: int) -> None:
        # From 1 to 1e-13: a Gram matrix would lose everything below 1e-8.
        frames = 10
        rng = np.random.default_rng(1)
        U = np.linalg.qr(rng.standard_normal((2 * frames, 2 * frames)))[0]
        V = rng.standard_normal((points, 2 * frames))
        V = np.linalg.qr(V - V.mean(axis=0))[0]
        expected = np.logspace(0, -13, 2 * frames)
        W = (U * expected) @ V.T
        values = factorise(as_source(W)).singular_values
        assert len(values) == 2 * frames
        np.testing.assert_allclose(values, expected, rtol=0, atol=10 * EPS)

    @pytest.mark.parametrize("points", [256, 16_384])
    @pytest.mark.parametrize("chunk_bytes", [2_000, 2**24])
    def test_far_translations_cost_no_digits(self, points: int, chunk_bytes: int) -> None:
        # Whole numbers, so that adding the translation rounds nothing: what comes out must be as
        # exact as without it, down to singular values of 1e-13 of the translation.
        frames = 6
        rng = np.random.default_rng(2)
        W = rng.integers(-1000, 1000, (2 * frames, points)).astype(np.float64)
        W[-1] = W[0] + rng.integers(-1, 2, points)
        far = 2.0 ** rng.integers(38, 43, (2 * frames, 1))
        near = factorise(as_source(W), chunk_bytes=chunk_bytes)
        moved = factorise(as_source(W + far), chunk_bytes=chunk_bytes)
        np.testing.assert_allclose(moved.singular_values, near.singular_values, rtol=1e-12)
        np.testing.assert_allclose(
            moved.factor, near.factor, rtol=0, atol=1e-11 * near.singular_values[0]
        )
        np.testing.assert_allclose(moved.means, near.means + far[:, 0], rtol=2 * EPS)
        assert_factor(moved, W + far)

    def test_points_that_drift_along_the_columns(self) -> None:
        # The first chunk stands for none of the others, and chunk means differ wildly.
        W = low_rank(8, 30_000)
        W[:, 10_000:] *= 1e3
        W[:, 20_000:] += 1e5 * np.random.default_rng(3).standard_normal((16, 1))
        assert_factor(factorise(as_source(W), chunk_bytes=2**18), W)
        assert_factor(factorise(as_source(W)), W)

    def test_few_outliers_among_many_points(self) -> None:
        W = low_rank(8, 30_000, noise=1e-2)
        W[:, 12_345] += 1e9 * np.arange(16)
        W[:, 23_456] -= 1e7 * np.arange(16) ** 2
        assert_factor(factorise(as_source(W)), W)

    def test_exact_low_rank_is_found(self) -> None:
        for points in (80, 20_000):
            W = low_rank(12, points, rank=5, noise=0.0)
            rowspace = factorise(as_source(W))
            assert rowspace.factor.shape == (24, 5)
            assert_factor(rowspace, W)

    def test_repeated_frames(self) -> None:
        W = low_rank(9, 20_000)
        W[4:8] = W[0:4]
        rowspace = factorise(as_source(W))
        assert rowspace.factor.shape == (18, 14)
        assert_factor(rowspace, W)

    def test_chunks_do_not_change_the_result(self) -> None:
        W = low_rank(20, 9_000)
        source = as_source(W)
        reference = factorise(source)
        for chunk_bytes in (1, 50_000, 700_000):
            other = factorise(source, chunk_bytes=chunk_bytes)
            assert_factor(other, W)
            scale = reference.singular_values[0]
            np.testing.assert_allclose(
                other.singular_values, reference.singular_values, rtol=0, atol=100 * EPS * scale
            )
            np.testing.assert_allclose(
                other.factor[:, :6], reference.factor[:, :6], atol=1e-11 * scale
            )

    def test_threads_do_not_change_the_result_at_all(self) -> None:
        source = as_source(low_rank(20, 20_000))
        one, two, five = (factorise(source, chunk_bytes=2**18, workers=n) for n in (1, 2, 5))
        np.testing.assert_array_equal(one.factor, two.factor)
        np.testing.assert_array_equal(one.factor, five.factor)
        np.testing.assert_array_equal(one.means, five.means)

    def test_left_and_translations(self) -> None:
        W = low_rank(7, 50)
        rowspace = factorise(as_source(W))
        np.testing.assert_allclose(rowspace.left.T @ rowspace.left, np.eye(14), atol=1e-12)
        np.testing.assert_allclose(rowspace.translations, W.mean(axis=1).reshape(7, 2))

    @pytest.mark.parametrize("points", [30, 30_000])
    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
    def test_not_finite_is_found_in_the_pass(self, points: int, bad: float) -> None:
        W = low_rank(6, points)
        W[7, points // 2] = W[8, 1] = bad
        source = ArraySource(W.reshape(6, 2, points))
        with pytest.raises(NotFinite) as caught:
            factorise(source, chunk_bytes=2**18)
        assert caught.value.context == {
            "frame": 3,
            "point": points // 2,
            "coordinate": "v",
            "count": 2,
        }

    def test_constant_is_found_in_the_pass(self) -> None:
        rows = np.random.default_rng(0).standard_normal((12, 1)) * 1e3
        for W in (rows + np.zeros(40), np.zeros((12, 40))):
            with pytest.raises(ConstantMeasurements):
                factorise(ArraySource(W.reshape(6, 2, 40)))

    @pytest.mark.parametrize("points", [40, 20_000])
    def test_too_large_entries(self, points: int) -> None:
        W = low_rank(5, points)
        for largest in (1e155, 1e308):
            with pytest.raises(InputError, match="too large"):
                factorise(as_source(W * (largest / np.abs(W).max())))

    @pytest.mark.parametrize("points", [40, 20_000])
    @pytest.mark.parametrize(
        ("scale", "dtype"), [(1e-160, np.float64), (1e-300, np.float64), (1e-42, np.float32)]
    )
    def test_too_small_differences(self, scale: float, dtype: type, points: int) -> None:
        W: NDArray[Any] = (low_rank(5, points) * scale).astype(dtype)
        with pytest.raises(InputError, match="too little"):
            factorise(as_source(W))

    @pytest.mark.parametrize("scale", [1e-145, 1e145])
    @pytest.mark.parametrize("points", [40, 20_000])
    def test_any_unit_will_do(self, scale: float, points: int) -> None:
        W = low_rank(5, points)
        reference = factorise(as_source(W)).singular_values
        values = factorise(as_source(W * scale)).singular_values / scale
        np.testing.assert_allclose(values, reference, rtol=1e-9)

    def test_progress_grows_to_one_and_may_stop_the_pass(self) -> None:
        source = as_source(low_rank(5, 4_000))
        seen: list[float] = []
        factorise(source, chunk_bytes=40_000, progress=lambda done, *_: seen.append(done))
        assert len(seen) > 3
        assert seen == sorted(seen)
        assert seen[-1] == 1.0

        def stop(done: float, *_: object) -> None:
            if done > 0.4:
                raise Cancelled("enough")

        threads = threading.active_count()
        with pytest.raises(Cancelled):
            factorise(source, chunk_bytes=40_000, workers=3, progress=stop)
        assert threading.active_count() == threads

    def test_blas_threads_are_given_back(self) -> None:
        def threads() -> dict[str, int]:
            pools = (pool for pool in threadpool_info() if pool["user_api"] == "blas")
            return {pool["filepath"]: pool["num_threads"] for pool in pools}

        source = as_source(low_rank(5, 4_000))
        factorise(source)  # whatever is loaded late is loaded now
        with threadpool_limits(2, user_api="blas"):
            before = threads()
            assert 2 in before.values()
            factorise(source)
            assert threads() == before
            with pytest.raises(NotFinite):
                factorise(ArraySource(np.full((3, 2, 5), np.nan)))
            assert threads() == before

    def test_a_source_that_breaks_its_word(self) -> None:
        class Liar:
            frames, points, dtype = 3, 10, np.dtype(float)

            def __init__(self, *cuts: slice) -> None:
                self.cuts = cuts

            def chunks(self, size: int | None = None) -> Any:
                W = low_rank(3, 10)
                return ((cut, W[:, cut]) for cut in self.cuts)

        factorise(Liar(slice(0, 4), slice(4, 10)))
        for cuts in ([slice(0, 4)], [slice(0, 4), slice(5, 10)], [slice(0, 9), slice(9, 11)]):
            with pytest.raises(WrongShape):
                factorise(Liar(*cuts))
        with pytest.raises(WrongShape):
            factorise(Liar())


def some_map(frames: int, seed: int = 0) -> NDArray[np.float64]:
    return np.random.default_rng(seed).standard_normal((3 * frames, 2 * frames))


def some_lifting(frames: int, inside: int, *, cameras: bool, seed: int = 0) -> Lifting:
    rng = np.random.default_rng(seed)
    return Lifting(
        outer=rng.standard_normal((frames, 3, inside)),
        inner=rng.standard_normal((inside, 2 * frames)),
        cameras=rng.standard_normal((frames, 2, 3)) if cameras else None,
    )


def shapes_of(A: NDArray[np.float64], W: NDArray[Any]) -> NDArray[np.float64]:
    """S (T, N, 3) by the definition."""
    frames = len(A) // 3
    return (A @ centred(W)).reshape(frames, 3, -1).transpose(0, 2, 1)


def relative(S: NDArray[Any], reference: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(S - reference) / np.linalg.norm(reference))


class TestDivided:
    @pytest.mark.parametrize(("frames", "points"), [(5, 40), (30, 8)])
    def test_is_the_space_of_divided_measurements(self, frames: int, points: int) -> None:
        W = low_rank(frames, points)
        scales = np.random.default_rng(0).uniform(0.3, 3.0, frames)
        W[4:6] = W[4:5]  # a rank that division keeps
        divided = factorise(as_source(W)).divided(scales)
        other = W / np.repeat(scales, 2)[:, None]
        assert_factor(divided, other)
        assert len(divided.singular_values) == np.linalg.matrix_rank(centred(other))
        np.testing.assert_allclose(divided.sample, centred(other), atol=1e-12)

    @pytest.mark.parametrize("cameras", [True, False])
    def test_its_map_serves_the_measurements(self, cameras: bool) -> None:
        scales = np.random.default_rng(0).uniform(0.3, 3.0, 6)
        W = centred(low_rank(6, 30))
        lifting = some_lifting(6, 3, cameras=cameras)
        after = lifting.after_division(scales)
        shapes = lifting.apply(W / np.repeat(scales, 2)[:, None])
        np.testing.assert_allclose(after.apply(W), shapes, atol=1e-12)


class TestMapBack:
    @settings(max_examples=40, deadline=None)
    @given(
        frames=st.integers(3, 9),
        points=st.integers(4, 100),
        chunk_bytes=st.integers(1, 10_000),
        workers=st.integers(1, 3),
    )
    def test_it_is_the_product(
        self, frames: int, points: int, chunk_bytes: int, workers: int
    ) -> None:
        W, A = low_rank(frames, points), some_map(frames)
        source = as_source(W)
        S = map_back(source, factorise(source), A, chunk_bytes=chunk_bytes, workers=workers)
        assert S.shape == (frames, points, 3)
        assert S.dtype == np.float64
        assert relative(S, shapes_of(A, W)) < 1e-13

    @pytest.mark.parametrize("dtype", ["f4", "f8", ">f4", "i2", "f2"])
    @pytest.mark.parametrize("frames", [5, 101])
    def test_single_precision_to_a_millionth(self, tmp_path: Path, frames: int, dtype: str) -> None:
        W, A = (low_rank(frames, 3000) * 10).astype(dtype), some_map(frames)
        source = as_source(W)
        rowspace = factorise(source)
        reference = shapes_of(A, W)
        new = map_back(source, rowspace, A)
        assert new.dtype == (np.float32 if dtype in ("f4", ">f4", "f2") else np.float64)
        given = np.empty((frames, 3000, 3), np.float32)
        assert map_back(source, rowspace, A, given, chunk_bytes=100_000) is given
        mapped = map_back(source, rowspace, A, tmp_path, chunk_bytes=100_000)
        for S in (new, given, mapped):
            assert relative(S, reference) < 1e-6

    def test_far_translations_of_single_precision_tracks(self) -> None:
        rng = np.random.default_rng(0)
        W = (rng.integers(-64, 64, (20, 500)) / 64 + 2.0**16).astype(np.float32)
        A = some_map(10)
        source = as_source(W)
        assert relative(map_back(source, factorise(source), A), shapes_of(A, W)) < 1e-6

    def test_terms_that_cancel_are_not_summed_in_single_precision(self, tmp_path: Path) -> None:
        # A amplifies by 1e5 the directions in which W is weakest.
        W = low_rank(10, 2000, noise=1e-5)
        source = as_source(W)
        rowspace = factorise(source)
        gains = 1 / rowspace.singular_values
        A = np.random.default_rng(0).standard_normal((30, 20)) * gains @ rowspace.left.T
        reference = shapes_of(A, W)
        assert (
            relative(
                (A.astype(np.float32) @ centred(W).astype(np.float32))
                .reshape(10, 3, -1)
                .transpose(0, 2, 1),
                reference,
            )
            > 1e-4
        )
        assert relative(map_back(source, rowspace, A, tmp_path), reference) < 1e-6

    @pytest.mark.parametrize("cameras", [True, False])
    @pytest.mark.parametrize(("frames", "inside"), [(6, 9), (60, 5), (100, 12)])
    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    def test_a_lifting_is_its_matrix(
        self, frames: int, inside: int, cameras: bool, dtype: type[np.floating[Any]]
    ) -> None:
        W = low_rank(frames, 700).astype(dtype)
        lifting = some_lifting(frames, inside, cameras=cameras)
        source = as_source(W)
        rowspace = factorise(source)
        reference = shapes_of(lifting.matrix(), W)
        S = map_back(source, rowspace, lifting, chunk_bytes=50_000)
        assert relative(S, reference) < (1e-6 if dtype == np.float32 else 1e-13)

    def test_file_is_plain_npy(self, tmp_path: Path) -> None:
        W, A = low_rank(6, 90), some_map(6)
        source = as_source(W)
        folder = tmp_path / "new" / "folder"
        S = map_back(source, factorise(source), A, folder)
        assert isinstance(S, np.memmap)
        assert not S.flags.writeable
        loaded = np.load(folder / SHAPES_FILE)
        assert (loaded.dtype.str, loaded.shape, loaded.flags.c_contiguous) == (
            "<f4",
            (6, 90, 3),
            True,
        )
        np.testing.assert_array_equal(loaded, S)
        assert relative(loaded, shapes_of(A, W)) < 1e-6

    def test_strided_output(self) -> None:
        W, A = low_rank(6, 90), some_map(6)
        source = as_source(W)
        out = np.zeros((6, 3, 90)).transpose(0, 2, 1)
        map_back(source, factorise(source), A, out, chunk_bytes=2_000)
        assert relative(out, shapes_of(A, W)) < 1e-13

    def test_iterator_of_chunks(self) -> None:
        W, A = low_rank(6, 90), some_map(6)
        source = ChunkedSource(lambda: np.array_split(W, 7, axis=1), 6, 90, W.dtype)
        assert relative(map_back(source, factorise(source), A), shapes_of(A, W)) < 1e-13

    @pytest.mark.parametrize("out", [np.empty((6, 90, 2)), np.empty((6, 90, 3), np.int32)])
    def test_wrong_output_array(self, out: NDArray[Any]) -> None:
        source = as_source(low_rank(6, 90))
        with pytest.raises(WrongShape):
            map_back(source, factorise(source), some_map(6), out)

    def test_too_large_for_single_precision(self, tmp_path: Path) -> None:
        source = as_source(low_rank(6, 90) * 1e40)
        rowspace = factorise(source)
        assert np.isfinite(map_back(source, rowspace, some_map(6))).all()
        with pytest.raises(InputError, match="too large"):
            map_back(source, rowspace, some_map(6), tmp_path)
        assert not list(tmp_path.iterdir())

    @pytest.mark.parametrize("workers", [1, 3])
    def test_a_stopped_pass_leaves_no_file(self, tmp_path: Path, workers: int) -> None:
        source = as_source(low_rank(6, 9000))
        rowspace = factorise(source)
        seen: list[float] = []

        def stop(done: float, *_: object) -> None:
            seen.append(done)
            if done > 0.3:
                raise Cancelled("enough")

        threads = threading.active_count()
        with pytest.raises(Cancelled) as caught:
            map_back(
                source,
                rowspace,
                some_map(6),
                tmp_path,
                chunk_bytes=10_000,
                workers=workers,
                progress=stop,
            )
        assert 0.3 < seen[-1] < 0.5
        assert not list(tmp_path.iterdir())
        # Nothing that could write on is left even while the error and its frames are.
        assert threading.active_count() == threads, caught

    def test_an_error_in_the_source_passes_through(self, tmp_path: Path) -> None:
        W = low_rank(6, 900)

        def blocks() -> Any:
            yield W[:, :500]
            raise OSError("the disk is gone")

        source = ChunkedSource(blocks, 6, 900, W.dtype)
        with pytest.raises(OSError, match="gone"):
            map_back(source, factorise(as_source(W)), some_map(6), tmp_path, chunk_bytes=5_000)
        assert not list(tmp_path.iterdir())


_BOUNDED = """
import resource, sys
import numpy as np
from smsr.measurements import as_source
from smsr.rowspace import factorise, map_back

def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

source = as_source(np.load(sys.argv[1], mmap_mode="r"))
before = peak()
rowspace = factorise(source, workers=2)
first = peak()
A = np.ones((3 * source.frames, 2 * source.frames))
S = map_back(source, rowspace, A, sys.argv[2], workers=2)
print(before, first, peak(), S.nbytes / 2**20)
"""


def test_memory_does_not_grow_with_the_points(tmp_path: Path) -> None:
    frames, points = 50, 500_000
    path = tmp_path / "W.npy"
    W = np.lib.format.open_memmap(path, "w+", np.dtype("<f4"), (2 * frames, points))
    block = low_rank(frames, 50_000).astype(np.float32)
    for start in range(0, points, 50_000):
        W[:, start : start + 50_000] = block
    W.flush()
    assert W.nbytes > 190_000_000
    command = [sys.executable, "-c", _BOUNDED, str(path), str(tmp_path)]
    answer = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    before, first, peak, written = map(float, answer.split())
    assert written > 280
    assert first - before < 150  # mapped pages of W among it, which the system may take back
    assert peak - before < 220
