from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from smsr.errors import (
    AmbiguousLayout,
    ConstantMeasurements,
    InputError,
    NotFinite,
    NotNumeric,
    OddRowCount,
    TooFewFrames,
    TooFewPoints,
    WrongShape,
)
from smsr.measurements import (
    ChunkedSource,
    MeasurementSource,
    as_source,
    check_values,
    chunk_points,
)

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray


def tracks(frames: int, points: int, seed: int = 0) -> NDArray[np.float64]:
    """Random tracks (T, 2, N)."""
    return np.random.default_rng(seed).standard_normal((frames, 2, points))


def whole(source: MeasurementSource, size: int | None = None) -> NDArray[Any]:
    """W (2T, N) as the source tells it, checking the slices."""
    blocks, start = [], 0
    for points, block in source.chunks(size):
        assert points.start == start
        assert block.shape == (2 * source.frames, points.stop - points.start)
        assert size is None or block.shape[1] <= size
        blocks.append(block)
        start = points.stop
    assert start == source.points
    return np.concatenate(blocks, axis=1)


class TestLayouts:
    @given(frames=st.integers(3, 7), points=st.integers(4, 12), size=st.integers(1, 15))
    def test_all_layouts_tell_the_same_matrix(self, frames: int, points: int, size: int) -> None:
        X = tracks(frames, points)
        interleaved = X.reshape(2 * frames, points)
        stacked = np.concatenate([X[:, 0], X[:, 1]])
        np.testing.assert_array_equal(stacked[:frames], interleaved[::2])
        sources = [
            as_source(interleaved),
            as_source(interleaved, "interleaved"),
            as_source(np.asfortranarray(interleaved)),
            as_source(stacked, "stacked"),
            as_source(stacked.reshape(2, frames, points), "stacked"),
            as_source(X),
            as_source(X.transpose(0, 2, 1)),
            as_source(np.ascontiguousarray(X.transpose(0, 2, 1)), "interleaved"),
            ChunkedSource(
                lambda: iter([interleaved[:, :3], interleaved[:, 3:]]), frames, points, X.dtype
            ),
        ]
        for source in sources:
            assert (source.frames, source.points) == (frames, points)
            assert source.dtype == np.float64
            np.testing.assert_array_equal(whole(source, size), interleaved)
            np.testing.assert_array_equal(whole(source), interleaved)

    def test_chunks_of_an_interleaved_matrix_are_views(self) -> None:
        W = tracks(5, 40).reshape(10, 40)
        for points, block in as_source(W).chunks(7):
            assert np.shares_memory(block, W)
            np.testing.assert_array_equal(block, W[:, points])

    def test_lists_are_arrays(self) -> None:
        W = tracks(3, 4).reshape(6, 4)
        np.testing.assert_array_equal(whole(as_source(W.tolist())), W)

    @pytest.mark.parametrize("dtype", ["<f4", ">f4", ">f8", "f2", "i2", "u1", "i8", "longdouble"])
    def test_real_types_keep_their_values(self, dtype: str) -> None:
        W = (tracks(4, 6).reshape(8, 6) * 50 + 100).astype(dtype)
        source = as_source(W)
        assert source.dtype == np.dtype(dtype)
        np.testing.assert_array_equal(whole(source, 4), W)

    def test_memory_map_and_path(self, tmp_path: Path) -> None:
        W = tracks(6, 50).reshape(12, 50).astype("<f4")
        path = tmp_path / "W.npy"
        np.save(path, W)
        for source in (
            as_source(np.load(path, mmap_mode="r")),
            as_source(path),
            as_source(str(path)),
        ):
            np.testing.assert_array_equal(whole(source, 9), W)

    def test_copy_on_write_map_keeps_its_changes(self, tmp_path: Path) -> None:
        path = tmp_path / "W.npy"
        rows, points = 6, 4_000_000  # 96 MB: past the point where read pages are let go
        np.lib.format.open_memmap(path, "w+", np.dtype("<f4"), (rows, points)).flush()
        W = np.load(path, mmap_mode="c")
        W[:, :1000] = 7.0
        for _, block in as_source(W).chunks(500_000):
            block.sum()
        assert (W[:, :1000] == 7.0).all()

    def test_a_source_passes_unchanged(self) -> None:
        source = as_source(tracks(3, 4))
        assert as_source(source) is source

    def test_chunk_points(self) -> None:
        source = as_source(tracks(5, 40).astype(np.float32))
        assert chunk_points(source, 10 * 4 * 7) == 7
        assert chunk_points(source, 1) == 1


class TestRefusals:
    @pytest.mark.parametrize("rows", [5, 7, 101])
    def test_odd_rows(self, rows: int) -> None:
        with pytest.raises(OddRowCount, match=f"{rows} rows") as caught:
            as_source(np.zeros((rows, 9)))
        assert caught.value.context["rows"] == rows

    @pytest.mark.parametrize("shape", [(4, 9), (2, 2, 9), (1, 9, 2), (0, 9)])
    def test_few_frames(self, shape: tuple[int, ...]) -> None:
        with pytest.raises(TooFewFrames) as caught:
            as_source(np.ones(shape))
        assert caught.value.context["minimum"] == 3

    @pytest.mark.parametrize("shape", [(6, 3), (5, 2, 3), (5, 1, 2), (6, 0)])
    def test_few_points(self, shape: tuple[int, ...]) -> None:
        with pytest.raises(TooFewPoints) as caught:
            as_source(np.ones(shape))
        assert caught.value.context["minimum"] == 4

    def test_the_least_size_passes(self) -> None:
        source = as_source(tracks(3, 4))
        assert (source.frames, source.points) == (3, 4)

    def test_ambiguous_layout_says_what_settles_it(self) -> None:
        with pytest.raises(AmbiguousLayout, match="layout='interleaved'"):
            as_source(np.ones((5, 2, 2)))
        with pytest.raises(TooFewPoints):
            as_source(np.ones((5, 2, 2)), "interleaved")

    @pytest.mark.parametrize("shape", [(8,), (3, 4, 5), (2, 3, 4, 5), ()])
    def test_shapes_of_no_layout(self, shape: tuple[int, ...]) -> None:
        with pytest.raises(WrongShape):
            as_source(np.ones(shape))

    def test_two_by_frames_names_its_layout(self) -> None:
        with pytest.raises(WrongShape, match="layout='stacked'"):
            as_source(np.ones((2, 7, 9)))

    def test_stacked_needs_two_blocks(self) -> None:
        with pytest.raises(WrongShape, match="'stacked'"):
            as_source(np.ones((7, 2, 9)), "stacked")

    @pytest.mark.parametrize("dtype", [complex, object, bool, "U4", "S4", "M8[s]", "m8[s]"])
    def test_types_that_are_no_real_numbers(self, dtype: Any) -> None:
        with pytest.raises(NotNumeric):
            as_source(np.zeros((6, 8), dtype))

    def test_structured_type(self) -> None:
        with pytest.raises(NotNumeric):
            as_source(np.zeros((6, 8), [("u", float), ("v", float)]))

    @pytest.mark.parametrize("value", [[[1, 2], [3]], {"W": 1}, iter([1]), None])
    def test_things_that_are_no_array(self, value: Any) -> None:
        with pytest.raises(InputError):
            as_source(value)

    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
    def test_not_finite_says_where_and_how_many(self, bad: float) -> None:
        X = tracks(5, 30)
        X[3, 0, 2] = X[2, 1, 17] = X[2, 1, 20] = bad
        with pytest.raises(
            NotFinite, match=r"3 entries .* coordinate v of point 17 in frame 2"
        ) as caught:
            as_source(X)
        assert caught.value.context == {"frame": 2, "point": 17, "coordinate": "v", "count": 3}
        assert ("never taken" in str(caught.value)) == np.isinf(bad)

    def test_not_finite_in_a_later_chunk(self) -> None:
        X = tracks(5, 30)
        X[4, 0, 1] = X[1, 1, 29] = np.nan
        W = X.reshape(10, 30)
        source = ChunkedSource(lambda: np.split(W, 6, axis=1), 5, 30, W.dtype)
        with pytest.raises(NotFinite) as caught:
            check_values(source)
        assert caught.value.context == {"frame": 1, "point": 29, "coordinate": "v", "count": 2}

    def test_masked_entries_are_not_taken_for_values(self) -> None:
        W = np.ma.array(tracks(5, 30), mask=False)
        as_source(W)
        W[2, 0, 5] = np.ma.masked
        with pytest.raises(NotFinite):
            as_source(W)

    def test_constant(self) -> None:
        for W in (np.zeros((6, 9)), np.full((6, 9), 3), np.arange(6.0)[:, None] + np.zeros((6, 9))):
            with pytest.raises(ConstantMeasurements):
                as_source(W)

    def test_one_moving_point_is_enough(self) -> None:
        W = np.zeros((6, 9))
        W[4, 8] = 1e-30
        as_source(W)


class TestChunkedSource:
    def blocks(self) -> Iterator[NDArray[np.float64]]:
        for start in range(0, 30, 10):
            yield tracks(4, 30).reshape(8, 30)[:, start : start + 10]

    def test_it_can_be_read_again(self) -> None:
        source = ChunkedSource(self.blocks, 4, 30, np.dtype(np.float64))
        assert isinstance(source, MeasurementSource)
        np.testing.assert_array_equal(whole(source, 4), whole(source))

    def test_a_missing_block(self) -> None:
        source = ChunkedSource(self.blocks, 4, 31, np.dtype(np.float64))
        with pytest.raises(WrongShape, match="30 points together; 31"):
            whole(source)

    def test_a_block_of_other_frames(self) -> None:
        source = ChunkedSource(self.blocks, 5, 30, np.dtype(np.float64))
        with pytest.raises(WrongShape, match="need \\(10, n\\)"):
            whole(source)

    def test_sizes_and_type_are_checked(self) -> None:
        with pytest.raises(TooFewFrames):
            ChunkedSource(self.blocks, 2, 30, np.dtype(np.float64))
        with pytest.raises(TooFewPoints):
            ChunkedSource(self.blocks, 4, 3, np.dtype(np.float64))
        with pytest.raises(NotNumeric):
            ChunkedSource(self.blocks, 4, 30, np.dtype(np.complex128))
