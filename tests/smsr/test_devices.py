"""Measurements as arrays of other libraries, on the host and on a GPU."""

from __future__ import annotations

import sys
import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import array_api_strict
import numpy as np
import pytest

import smsr
from smsr.devices import DeviceSource
from smsr.errors import (
    AmbiguousLayout,
    Cancelled,
    ConstantMeasurements,
    InputError,
    NotFinite,
    NotNumeric,
    OddRowCount,
    SmsrError,
    TooFewFrames,
    TooFewPoints,
    WrongShape,
)
from smsr.lifting import Lifting
from smsr.measurements import ArraySource, as_source
from smsr.rowspace import factorise, map_back
from smsr.synthetic import make_example

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import DTypeLike, NDArray

    from smsr.measurements import Layout

FRAMES, POINTS = 15, 2000
SIZE = 8 * 2 * FRAMES * 300  # bytes of a chunk of 300 points
TOLERANCE = {"float32": 1e-6, "float64": 1e-9}


@dataclass(frozen=True)
class Place:
    """Where arrays are put."""

    library: Any
    device: Any

    def put(self, array: NDArray[Any]) -> Any:
        return self.library.asarray(np.ascontiguousarray(array), device=self.device)


@pytest.fixture(params=["strict", "torch-cpu", "torch-cuda", "cupy"], scope="module")
def place(request: pytest.FixtureRequest) -> Place:
    if request.param == "strict":
        # Refuses whatever the standard does not promise, and to mix its devices.
        return Place(array_api_strict, array_api_strict.Device("device1"))
    if request.param == "cupy":
        cupy = pytest.importorskip("cupy", reason="CuPy is not installed")
        if not cupy.cuda.is_available():
            pytest.skip("CuPy finds no CUDA device")
        return Place(pytest.importorskip("array_api_compat.cupy"), None)
    torch = pytest.importorskip("torch", reason="PyTorch is not installed")
    if request.param == "torch-cuda" and not torch.cuda.is_available():
        pytest.skip("PyTorch finds no CUDA device")
    return Place(torch, request.param.removeprefix("torch-"))


def matrix(dtype: DTypeLike = np.float64) -> NDArray[Any]:
    rng = np.random.default_rng(0)
    W = rng.standard_normal((2 * FRAMES, 6)) @ rng.standard_normal((6, POINTS))
    W += 1e-2 * rng.standard_normal(W.shape) + 30 * rng.standard_normal((2 * FRAMES, 1))
    return W.astype(dtype)


def some_map() -> NDArray[np.float64]:
    return np.random.default_rng(1).standard_normal((3 * FRAMES, 2 * FRAMES))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_the_passes_agree_with_those_of_numpy(place: Place, dtype: str, tmp_path: Path) -> None:
    W, A = matrix(dtype), some_map()
    source = as_source(place.put(W))
    assert isinstance(source, DeviceSource)
    expected = factorise(as_source(W))
    space = factorise(source, chunk_bytes=SIZE)
    np.testing.assert_allclose(space.means, expected.means, rtol=1e-13)
    scale = expected.singular_values[0]
    np.testing.assert_allclose(space.factor, expected.factor, atol=1e-10 * scale)
    np.testing.assert_allclose(space.sample, expected.sample, atol=1e-12 * scale)
    S = map_back(as_source(W), expected, A)
    shapes = map_back(source, space, A, chunk_bytes=SIZE)
    assert type(shapes) is np.ndarray
    assert shapes.dtype == S.dtype == np.dtype(dtype)
    np.testing.assert_allclose(shapes, S, atol=TOLERANCE[dtype] * np.abs(S).max())
    given = np.empty((FRAMES, POINTS, 3))
    assert map_back(source, space, A, given, chunk_bytes=SIZE) is given
    stored = map_back(source, space, A, tmp_path, chunk_bytes=SIZE)
    for other in (given, stored):
        np.testing.assert_allclose(other, S, atol=1e-6 * np.abs(S).max())


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_weak_direction_keeps_its_digits(place: Place, dtype: str) -> None:
    rng = np.random.default_rng(2)
    values = np.logspace(0, -11, 12)
    W = np.linalg.qr(rng.standard_normal((2 * FRAMES, 12)))[0] * values
    W = (W @ np.linalg.qr(rng.standard_normal((POINTS, 12)))[0].T).astype(dtype)
    expected = factorise(as_source(W)).singular_values
    found = factorise(as_source(place.put(W)), chunk_bytes=SIZE).singular_values
    np.testing.assert_allclose(found, expected, atol=1e-14)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_reconstruction_is_that_of_numpy(place: Place, dtype: str) -> None:
    # Noise fixes the weak directions; without it rounding alone moves the numpy run by 1e-9.
    W = make_example(frames=40, side=20).measurements
    W = (W + 0.05 * np.random.default_rng(5).standard_normal(W.shape)).astype(dtype)
    here = smsr.reconstruct(W)
    seen: list[float] = []
    there = smsr.reconstruct(place.put(W), progress=lambda progress: seen.append(progress.fraction))
    tolerance = TOLERANCE[dtype]
    assert there.shapes.dtype == np.dtype(dtype)
    scale = float(np.abs(here.shapes).max())
    np.testing.assert_allclose(there.shapes, here.shapes, atol=tolerance * scale)
    np.testing.assert_allclose(there.cameras, here.cameras, atol=tolerance)
    np.testing.assert_allclose(there.translations, here.translations, rtol=1e-12)
    assert seen == sorted(seen)


def test_lifting_in_factors(place: Place) -> None:
    rng = np.random.default_rng(3)
    frames = 120  # so many that A stays in factors, with the cameras apart
    W = rng.standard_normal((2 * frames, 4)) @ rng.standard_normal((4, 300))
    lifting = Lifting(
        outer=rng.standard_normal((frames, 3, 2)),
        inner=rng.standard_normal((2, 2 * frames)),
        cameras=rng.standard_normal((frames, 2, 3)),
    )
    space = factorise(as_source(W))
    expected = map_back(as_source(W), space, lifting)
    shapes = map_back(as_source(place.put(W)), space, lifting, chunk_bytes=SIZE)
    np.testing.assert_allclose(shapes, expected, atol=1e-12 * np.abs(expected).max())


def test_layouts(place: Place) -> None:
    W = matrix()
    X = W.reshape(FRAMES, 2, POINTS)
    layouts: list[tuple[Any, Layout]] = [
        (W, "interleaved"),
        (X, "auto"),
        (X.transpose(0, 2, 1), "auto"),
        (np.concatenate([W[::2], W[1::2]]), "stacked"),
        (X.transpose(1, 0, 2), "stacked"),
    ]
    for array, layout in layouts:
        source = as_source(place.put(array), layout)
        assert isinstance(source, DeviceSource)
        assert (source.frames, source.points) == (FRAMES, POINTS)
        blocks = [block for _, block in source.chunks(700)]
        np.testing.assert_array_equal(np.concatenate(blocks, axis=1), W)


def test_integers(place: Place) -> None:
    W = np.rint(100 * matrix()).astype(np.int32)
    expected = factorise(as_source(W)).factor
    found = factorise(as_source(place.put(W))).factor
    np.testing.assert_allclose(found, expected, atol=1e-10 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("array", "error"),
    [
        (np.zeros((7, 9)), OddRowCount),
        (np.zeros((4, 9)), TooFewFrames),
        (np.zeros((8, 3)), TooFewPoints),
        (np.zeros(8), WrongShape),
        (np.zeros((2, 8, 9)), WrongShape),
        (np.zeros((8, 2, 2)), AmbiguousLayout),
        (np.zeros((8, 9), complex), NotNumeric),
        (np.zeros((8, 9), bool), NotNumeric),
        (np.ones((8, 9)), ConstantMeasurements),
        (np.where(np.arange(72).reshape(8, 9) == 31, np.nan, 1.0), NotFinite),
    ],
)
def test_refusals_are_those_of_numpy(
    place: Place, array: NDArray[Any], error: type[SmsrError]
) -> None:
    with pytest.raises(error) as here:
        as_source(array)
    with pytest.raises(error) as there:
        as_source(place.put(array))
    assert (there.value.detail, there.value.context) == (here.value.detail, here.value.context)


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")  # of array_api_strict
@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("point", [0, 1777])
def test_the_pass_finds_what_is_not_finite(place: Place, value: float, point: int) -> None:
    W = matrix()
    W[5, point] = value
    with pytest.raises(NotFinite) as caught:
        factorise(as_source(place.put(W), check=False), chunk_bytes=SIZE)
    assert caught.value.context == {"frame": 2, "point": point, "coordinate": "v", "count": 1}


def test_the_pass_refuses_overflow(place: Place) -> None:
    with pytest.raises(InputError, match="too large"):
        factorise(as_source(place.put(1e200 * matrix())))


def test_gaps_are_filled(place: Place) -> None:
    W = make_example(frames=20, side=12).measurements.copy()
    W.reshape(20, 2, -1)[3:6, :, 17] = np.nan
    here = smsr.reconstruct(W, missing="complete")
    there = smsr.reconstruct(place.put(W), missing="complete")
    np.testing.assert_array_equal(there.shapes, here.shapes)


def test_a_stopped_pass_leaves_no_file(place: Place, tmp_path: Path) -> None:
    source = as_source(place.put(matrix()))
    space = factorise(source)

    def stop(done: float, *_: object) -> None:
        if done > 0.3:
            raise Cancelled("enough")

    threads = threading.active_count()
    with pytest.raises(Cancelled) as caught:
        map_back(source, space, some_map(), tmp_path, chunk_bytes=SIZE, progress=stop)
    assert not list(tmp_path.iterdir())
    # Nothing that could write on is left even while the error and its frames are.
    assert threading.active_count() == threads, caught


class TestWithoutTheExtra:
    @pytest.fixture(autouse=True)
    def missing(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.delattr(smsr, "devices")
        monkeypatch.setitem(sys.modules, "smsr.devices", None)

    def test_numpy_reads_what_is_on_the_host(self) -> None:
        source = as_source(array_api_strict.asarray(matrix()))
        assert isinstance(source, ArraySource)
        np.testing.assert_array_equal(source.tracks.reshape(-1, POINTS), matrix())

    def test_other_arrays_are_told_of_it(self) -> None:
        device = array_api_strict.Device("device1")
        with pytest.raises(InputError, match=r"smsr\[gpu\]"):
            as_source(array_api_strict.asarray(matrix(), device=device))


class TestTorch:
    def test_tensors_that_record_gradients(self) -> None:
        torch = pytest.importorskip("torch", reason="PyTorch is not installed")
        W = torch.asarray(matrix()).requires_grad_()
        expected = factorise(as_source(matrix()))
        np.testing.assert_allclose(factorise(as_source(W)).means, expected.means, rtol=1e-13)

    def test_types_that_numpy_lacks(self) -> None:
        torch = pytest.importorskip("torch", reason="PyTorch is not installed")
        with pytest.raises(NotNumeric, match="bfloat16"):
            as_source(torch.asarray(matrix()).bfloat16())
