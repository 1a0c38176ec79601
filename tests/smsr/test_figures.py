from __future__ import annotations

import dataclasses
import io
import sys
import xml.etree.ElementTree as ET
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import smsr
from smsr.errors import FiguresUnavailable, NothingToDraw
from smsr.figures import MOST_POINTS, NAMES, FigureName, FigureSource, draw, view_angles
from smsr.synthetic import make_example

if TYPE_CHECKING:
    from numpy.typing import NDArray

matplotlib = pytest.importorskip("matplotlib")
Image = pytest.importorskip("PIL.Image")

EXAMPLE = make_example(frames=20, side=8)

LABELS = {
    "convergence": {"iteration", "relative residual", "residual", "tolerance"},
    "singular-values": {"index", "singular value (unit of the measurements)", "the rest"},
    "error": {"frame", "error (standard deviations of the truth)", "each frame"},
    "shapes": {"frame 0", "frame 6", "frame 13", "frame 19", "camera's view", "turned by 60°"},
    "cameras": {"frame", "angle to the first view (degrees)", "azimuth", "elevation", "roll"},
}


@pytest.fixture(scope="module")
def source() -> FigureSource:
    result = smsr.reconstruct(EXAMPLE.measurements)
    rows = np.asarray(result.shapes).reshape(-1, 3)
    report = result.diagnostics.to_dict()
    report["metrics"] = smsr.evaluate(EXAMPLE.ground_truth, result).to_dict()
    return FigureSource(
        report,
        result.cameras,
        result.translations,
        EXAMPLE.ground_truth.shape[1],
        lambda start, stop: rows[start:stop],
        EXAMPLE.faces,
    )


def texts(picture: bytes) -> set[str]:
    """Return what is written in an SVG."""
    tree = ET.fromstring(picture)
    return {"".join(e.itertext()).strip() for e in tree.iter("{http://www.w3.org/2000/svg}text")}


def pixels(picture: bytes) -> NDArray[Any]:
    return np.asarray(Image.open(io.BytesIO(picture)).convert("L"), float)


@pytest.mark.parametrize("name", NAMES)
def test_figures_say_what_they_show_and_are_the_same_each_time(
    source: FigureSource, name: FigureName
) -> None:
    before = dict(matplotlib.rcParams)
    vector = draw(name, source, "svg")
    assert LABELS[name] <= texts(vector)
    with ThreadPoolExecutor(2) as threads:
        again = list(threads.map(lambda _: draw(name, source, "svg"), range(2)))
    assert set(again) == {vector}
    raster = draw(name, source)
    assert draw(name, source) == raster
    assert dict(matplotlib.rcParams) == before
    shown = pixels(raster)
    assert 250 < shown.shape[0] < 1500
    assert 700 < shown.shape[1] < 1500
    assert shown.min() < 60 < 250 < shown.max()


def test_other_results_give_other_figures(source: FigureSource) -> None:
    report = dict(source.report)
    report["stages"] = [
        {**stage, "residuals": [2 * r for r in stage["residuals"]]} for stage in report["stages"]
    ]
    report["singular_values"] = [v**1.1 for v in report["singular_values"]]
    errors = report["metrics"]["per_frame"]
    report["metrics"] = {**report["metrics"], "per_frame": errors[::-1]}
    other = dataclasses.replace(
        source,
        report=report,
        cameras=source.cameras[::-1],
        read=lambda start, stop: source.read(start, stop) * [1.0, 1.5, 1.0],
    )
    for name in NAMES:
        assert draw(name, source) != draw(name, other), name


def test_what_was_not_measured_is_not_drawn(source: FigureSource) -> None:
    bare = dataclasses.replace(source, report={"metrics": None}, faces=None)
    names: tuple[FigureName, ...] = ("convergence", "singular-values", "error")
    for name in names:
        with pytest.raises(NothingToDraw):
            draw(name, bare)
    assert "depth towards the camera" in " ".join(texts(draw("shapes", bare, "svg")))
    assert LABELS["cameras"] <= texts(draw("cameras", bare, "svg"))


def test_lines_differ_without_colour(source: FigureSource) -> None:
    """Every line of a figure has dashes or markers of its own."""
    names: tuple[FigureName, ...] = ("error", "cameras")
    for name in names:
        tree = ET.fromstring(draw(name, source, "svg"))
        styles: dict[str, set[str]] = {}
        for path in tree.iter("{http://www.w3.org/2000/svg}path"):
            style = dict(
                part.strip().split(": ", 1)
                for part in (path.get("style") or "").split(";")
                if ": " in part
            )
            if float(style.get("stroke-width", 0)) > 1.2 and "stroke" in style:
                styles.setdefault(style["stroke"], set()).add(style.get("stroke-dasharray", ""))
        assert len(styles) == 3, name
        assert len({frozenset(dashes) for dashes in styles.values()}) == 3, styles


def test_large_results_are_thinned(source: FigureSource) -> None:
    points, asked = 3 * MOST_POINTS + 5, []

    def read(start: int, stop: int) -> NDArray[Any]:
        asked.append((start, stop))
        return np.random.default_rng(start).standard_normal((stop - start, 3))

    large = dataclasses.replace(source, points=points, read=read, faces=None)
    assert draw("shapes", large, "svg").count(b"<image") >= 8  # rasterised points
    assert len(large.frame(3, 4)) <= MOST_POINTS
    frames = {start // points for start, _ in asked}
    assert frames == {0, 6, 13, 19, 3}


def test_v_may_grow_both_ways(source: FigureSource) -> None:
    """The example has pixels, which count from the top; its mirror image stands the same."""
    assert source.down
    flipped = source.cameras * np.array([[1.0], [-1.0]])
    up = dataclasses.replace(source, cameras=flipped, image_v="up")
    np.testing.assert_allclose(up.rotations, source.rotations)
    assert draw("shapes", up) == draw("shapes", source)
    centred = dataclasses.replace(source, translations=np.zeros_like(source.translations))
    assert not centred.down


def test_the_scale_of_the_camera_does_not_turn_it(source: FigureSource) -> None:
    scales = np.linspace(0.5, 2.0, len(source.cameras))[:, None, None]
    scaled = dataclasses.replace(source, cameras=scales * source.cameras)
    np.testing.assert_allclose(scaled.rotations, source.rotations, atol=1e-12)


def test_view_angles_are_those_that_the_camera_turned_by() -> None:
    first = Rotation.random(rng=np.random.default_rng(0)).as_matrix()
    angles = np.radians([[0, 0, 0], [70, 0, 0], [-30, 40, 0], [20, -10, 25], [150, 60, -80]])
    placed = []
    for azimuth, elevation, roll in angles:
        # The camera stands upright in front, goes up, then around, and turns about its own axis.
        axes = Rotation.from_euler("YXZ", [azimuth, -elevation, roll]).as_matrix().T
        placed.append(axes @ first)
    np.testing.assert_allclose(view_angles(np.array(placed)), angles, atol=1e-12)


def test_without_matplotlib_it_says_so(
    source: FigureSource, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(FiguresUnavailable, match="plot"):
        draw("cameras", source)
