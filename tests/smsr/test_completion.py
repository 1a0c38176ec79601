"""Gaps in tracks and gross errors: what is filled, what is left alone, what is refused."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import smsr
from smsr.completion import completed
from smsr.errors import NotFinite, NotNumeric, TooFewObservations, WrongShape
from smsr.measurements import ArraySource, ChunkedSource, MeasurementSource, as_source
from smsr.options import Options
from smsr.synthetic import make_example, make_low_rank

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]
    Mask = NDArray[np.bool_]

COMPLETE = Options(missing="complete")
REJECT = Options(outliers="reject")
FRAMES, POINTS = 50, 70


def smooth_tracks(noise: float = 0.0) -> Array:
    return make_low_rank(FRAMES, POINTS, 2, noise=noise, seed=3).measurements


def jerky_tracks() -> Array:
    """Of rank 7 and a translation, with nothing alike from frame to frame."""
    rng = np.random.default_rng(5)
    matrix = rng.standard_normal((2 * FRAMES, 7)) @ rng.standard_normal((7, POINTS))
    return np.asarray(matrix + 10.0 * rng.standard_normal((2 * FRAMES, 1)))


def at_random(part: float, seed: int = 0) -> Mask:
    return np.random.default_rng(seed).random((FRAMES, POINTS)) >= part


def in_blocks(seed: int = 0) -> Mask:
    """Tracks that start late, end early and drop out."""
    rng = np.random.default_rng(seed)
    seen = np.ones((FRAMES, POINTS), dtype=bool)
    for point in range(0, POINTS, 2):
        start = rng.integers(-8, FRAMES - 4)
        seen[max(0, start) : start + 14, point] = False
    return seen


def with_gaps(measurements: Array, seen: Mask) -> Array:
    tracks = measurements.reshape(FRAMES, 2, POINTS).copy()
    tracks[:, 0][~seen] = np.nan  # one coordinate is enough
    return tracks.reshape(2 * FRAMES, POINTS)


def whole(source: MeasurementSource, size: int | None = None) -> Array:
    return np.concatenate([block for _, block in source.chunks(size)], axis=1)


def fill(measurements: Any, options: Options = COMPLETE, visibility: Any = None) -> Array:
    return whole(completed(as_source(measurements, check=False), options, visibility)[0])


def disturbed(measurements: Array, part: float) -> tuple[Array, Mask]:
    rng = np.random.default_rng(8)
    bad = rng.random((FRAMES, POINTS)) < part
    spread = (measurements - measurements.mean(axis=1, keepdims=True)).std()
    angle = rng.uniform(0, 2 * np.pi, bad.shape)
    error = rng.uniform(0.5, 3.0, bad.shape) * spread * bad
    tracks = measurements.reshape(FRAMES, 2, POINTS)
    moved = tracks + error[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return moved.reshape(measurements.shape), bad


class TestFilling:
    @pytest.mark.parametrize("tracks", [smooth_tracks(), jerky_tracks()], ids=["smooth", "jerky"])
    @pytest.mark.parametrize("part", [0.1, 0.3])
    def test_low_rank_tracks_are_recovered(self, tracks: Array, part: float) -> None:
        filled = fill(with_gaps(tracks, at_random(part)))
        np.testing.assert_allclose(filled, tracks, atol=1e-6 * tracks.std())

    def test_half_of_smooth_tracks_is_enough(self) -> None:
        tracks = smooth_tracks()
        np.testing.assert_allclose(fill(with_gaps(tracks, at_random(0.5))), tracks, atol=1e-3)

    def test_late_starts_early_ends_and_dropouts(self) -> None:
        tracks = smooth_tracks()
        np.testing.assert_allclose(fill(with_gaps(tracks, in_blocks())), tracks, atol=1e-6)

    @pytest.mark.parametrize("seen", [at_random(0.3), in_blocks()], ids=["random", "blocks"])
    def test_noise_is_not_blown_up(self, seen: Mask) -> None:
        filled = fill(with_gaps(smooth_tracks(0.01), seen))
        error = (filled - smooth_tracks()).reshape(FRAMES, 2, POINTS).transpose(0, 2, 1)[~seen]
        assert np.sqrt(np.mean(error**2)) < 0.02

    def test_what_is_seen_is_left_as_it_is(self) -> None:
        tracks, seen = smooth_tracks(0.01), at_random(0.3)
        filled = fill(with_gaps(tracks, seen)).reshape(FRAMES, 2, POINTS)
        kept = np.broadcast_to(seen[:, None], filled.shape)
        np.testing.assert_array_equal(filled[kept], tracks.reshape(filled.shape)[kept])

    def test_a_mask_is_as_good_as_nan(self) -> None:
        tracks, seen = smooth_tracks(0.01), at_random(0.3)
        hidden = np.where(np.repeat(seen, 2, axis=0), tracks, np.inf)
        by_mask = fill(hidden, Options(), seen)
        np.testing.assert_array_equal(by_mask, fill(with_gaps(tracks, seen)))

    def test_order_scale_and_position_of_the_points_do_not_matter(self) -> None:
        tracks = with_gaps(smooth_tracks(), at_random(0.3))
        order = np.random.default_rng(1).permutation(POINTS)
        shift = np.random.default_rng(2).standard_normal((2 * FRAMES, 1)) * 500.0
        there = fill(300.0 * tracks[:, order] + shift)
        back = np.empty_like(there)
        back[:, order] = (there - shift) / 300.0
        np.testing.assert_allclose(back, fill(tracks), atol=1e-6)

    def test_blocks_do_not_matter(self) -> None:
        tracks = with_gaps(smooth_tracks(0.01), at_random(0.3))
        blocks = np.array_split(tracks, [7, 8, 40], axis=1)
        source = ChunkedSource(lambda: iter(blocks), FRAMES, POINTS, tracks.dtype)
        filled, _ = completed(source, COMPLETE)
        np.testing.assert_allclose(whole(filled, 9), fill(tracks), atol=1e-9)

    def test_points_beyond_the_sample(self) -> None:
        tracks = make_example(30, 45).measurements.astype(np.float32)
        seen = np.random.default_rng(0).random((30, tracks.shape[1])) >= 0.3
        source, gaps = completed(as_source(tracks), Options(), seen)
        filled = whole(source, 256)
        assert filled.dtype == np.float32
        assert gaps.missing == np.count_nonzero(~seen)
        error = np.linalg.norm(filled - tracks) / np.linalg.norm(
            tracks - tracks.mean(axis=1, keepdims=True)
        )
        assert error < 5e-3

    def test_integers_become_floats(self) -> None:
        tracks = np.rint(100.0 * smooth_tracks()).astype(np.int64)
        source, _ = completed(as_source(tracks), Options(), at_random(0.1))
        assert source.dtype == np.float64
        np.testing.assert_allclose(whole(source), tracks, atol=5.0)

    def test_nothing_to_fill_leaves_the_source(self) -> None:
        source = as_source(smooth_tracks())
        assert completed(source, COMPLETE)[0] is source
        assert completed(source, Options(), np.ones((FRAMES, POINTS), bool))[0] is source


class TestErrors:
    def test_nan_is_refused_by_default(self) -> None:
        with pytest.raises(NotFinite, match="missing='complete'"):
            smsr.reconstruct(with_gaps(smooth_tracks(), at_random(0.1)))

    def test_rejecting_errors_does_not_take_nan(self) -> None:
        source = ArraySource(with_gaps(smooth_tracks(), at_random(0.1)).reshape(FRAMES, 2, POINTS))
        with pytest.raises(NotFinite):
            completed(source, REJECT)

    def test_infinity_is_always_refused(self) -> None:
        tracks = smooth_tracks()
        tracks[11, 4] = -np.inf
        with pytest.raises(NotFinite, match="v of point 4 in frame 5") as caught:
            smsr.reconstruct(tracks, missing="complete")
        assert caught.value.context == {"frame": 5, "point": 4, "coordinate": "v"}

    def test_a_frame_with_three_points(self) -> None:
        seen = np.ones((FRAMES, POINTS), bool)
        seen[6, 3:] = False
        with pytest.raises(TooFewObservations, match=r"Frame 6 .* 3 points"):
            completed(as_source(smooth_tracks()), Options(), seen)

    def test_a_point_in_two_frames(self) -> None:
        seen = np.ones((FRAMES, POINTS), bool)
        seen[2:, 9] = False
        with pytest.raises(TooFewObservations, match=r"Point 9 .* 2 frames"):
            completed(as_source(smooth_tracks()), Options(), seen)

    def test_a_mask_of_another_size(self) -> None:
        with pytest.raises(WrongShape, match="visibility"):
            smsr.reconstruct(smooth_tracks(), visibility=np.ones((POINTS, FRAMES), bool))

    def test_a_mask_of_numbers(self) -> None:
        with pytest.raises(NotNumeric, match="bool"):
            smsr.reconstruct(smooth_tracks(), visibility=np.ones((FRAMES, POINTS)))


class TestGrossErrors:
    @pytest.mark.parametrize("part", [0.01, 0.05])
    @pytest.mark.parametrize("noise", [0.0, 0.01])
    def test_they_are_found_and_undone(self, part: float, noise: float) -> None:
        tracks, bad = disturbed(smooth_tracks(noise), part)
        source, gaps = completed(as_source(tracks), REJECT)
        error = np.linalg.norm((whole(source) - smooth_tracks()).reshape(FRAMES, 2, POINTS), axis=1)
        assert error.max() < max(1e-5, 8 * noise)
        assert gaps.rejected == np.count_nonzero(bad)

    def test_they_are_found_beside_gaps(self) -> None:
        tracks, bad = disturbed(smooth_tracks(0.01), 0.02)
        seen = at_random(0.3)
        source, gaps = completed(as_source(tracks), REJECT, seen)
        assert np.abs(whole(source) - smooth_tracks()).max() < 0.2
        assert gaps.rejected == np.count_nonzero(bad & seen)

    @pytest.mark.parametrize("noise", [0.0, 0.01, 0.1])
    def test_clean_tracks_are_left_alone(self, noise: float) -> None:
        source = as_source(smooth_tracks(noise))
        found, gaps = completed(source, REJECT)
        assert found is source
        assert gaps.rejected == 0


class TestSmall:
    """Of few positions none can be spared to choose the rank by."""

    @pytest.mark.parametrize("points", [4, 5, 10, 12, 15])
    @pytest.mark.parametrize("frames", [3, 4, 6])
    def test_matrices_are_looked_through(self, frames: int, points: int) -> None:
        example = make_low_rank(frames, points, 1, seed=points)
        result = smsr.reconstruct(example.measurements, outliers="reject")
        seen = result.cameras @ result.shapes.transpose(0, 2, 1) + result.translations[:, :, None]
        rejected = result.diagnostics.rejected * frames * points
        error = np.linalg.norm(seen - example.measurements.reshape(frames, 2, points), axis=1)
        assert np.count_nonzero(error > 1e-6) <= rejected + 0.5

    @pytest.mark.parametrize(("frames", "points"), [(4, 10), (5, 11), (6, 10), (36, 5)])
    def test_a_gap_is_filled(self, frames: int, points: int) -> None:
        measurements = make_low_rank(frames, points, 1, seed=0).measurements
        seen = np.ones((frames, points), dtype=bool)
        if points == 5:  # the fewest that a frame needs are left
            seen[np.arange(frames), np.arange(frames) % points] = False
        else:
            seen[0, 1] = False
        filled = fill(measurements, visibility=seen).reshape(frames, 2, points)
        true = measurements.reshape(frames, 2, points)
        np.testing.assert_array_equal(
            filled.transpose(0, 2, 1)[seen], true.transpose(0, 2, 1)[seen]
        )
        assert np.abs(filled - true).max() < np.ptp(true)


class TestReconstruction:
    def test_gaps_and_errors_hardly_change_the_shapes(self) -> None:
        example = make_low_rank(FRAMES, POINTS, 1, seed=3)
        clean = smsr.reconstruct(example.measurements)
        tracks, bad = disturbed(example.measurements, 0.02)
        result = smsr.reconstruct(tracks, visibility=at_random(0.2), outliers="reject")
        whole_error = smsr.evaluate(example.ground_truth, clean).e3d
        assert smsr.evaluate(example.ground_truth, result).e3d < whole_error + 1e-3
        assert result.diagnostics.missing == np.mean(~at_random(0.2))
        assert result.diagnostics.rejected == np.mean(bad & at_random(0.2))
        codes = {caution.code for caution in result.diagnostics.cautions}
        assert {"missing", "outliers"} <= codes
