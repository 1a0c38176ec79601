from __future__ import annotations

import json
import os
import shutil
import struct
import subprocess
import tracemalloc
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from smsr.errors import AnimationTooLarge
from smsr.files import GlbOptions, write_glb
from smsr.files.glb import MOST_FRAMES, Glb, v_grows_down
from smsr.synthetic import make_example

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

TOOLS = Path(__file__).resolve().parent.parent / "gltf"

EXAMPLE = make_example(frames=12, side=7)
SHAPES = EXAMPLE.ground_truth.astype(np.float32)

with_node = pytest.mark.skipif(
    shutil.which("node") is None or not (TOOLS / "node_modules" / "gltf-validator").is_dir(),
    reason="needs node and `npm ci` in tests/gltf",
)


@pytest.fixture(scope="module")
def blender() -> str:
    """Blender, with the numpy that its importer needs and Debian's package leaves out."""
    found = shutil.which("blender")
    if found is None:
        pytest.skip("needs Blender")
    imports = ["--python-exit-code", "1", "--python-expr", "import numpy"]
    command = [found, "--background", "--factory-startup", *imports]
    if subprocess.run(command, capture_output=True, timeout=300).returncode:
        pytest.skip("Blender's Python has no numpy; on Debian, python3-numpy brings it")
    return found


def document(content: bytes) -> tuple[dict[str, Any], bytes]:
    """Split a GLB into its JSON and its binary chunk, as section 4.4 of glTF 2.0 says."""
    magic, version, size, length, kind = struct.unpack_from("<4sIII4s", content)
    assert (magic, version, size, kind) == (b"glTF", 2, len(content), b"JSON")
    rest, binary = struct.unpack_from("<I4s", content, 20 + length)
    assert (rest, binary) == (len(content) - 28 - length, b"BIN\0")
    return json.loads(content[20 : 20 + length]), content[28 + length :]


def reader(shapes: NDArray[Any]) -> Callable[[int, int], NDArray[Any]]:
    rows = shapes.reshape(-1, 3)
    return lambda start, stop: rows[start:stop]


def glb(
    shapes: NDArray[Any],
    faces: NDArray[Any] | None = None,
    camera: NDArray[Any] = EXAMPLE.cameras[0],
    **options: Any,
) -> Glb:
    frames, points = shapes.shape[:2]
    return Glb(
        reader(shapes),
        frames=frames,
        points=points,
        camera=camera,
        faces=faces,
        options=GlbOptions(**options),
    )


def checked(*paths: Path) -> list[dict[str, Any]]:
    """Return what Khronos' validator and three.js say of files."""
    command = ["node", str(TOOLS / "check.mjs"), *map(str, paths)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    found: list[dict[str, Any]] = json.loads(done.stdout)
    return found


def upright(shapes: NDArray[Any], camera: NDArray[Any], extent: float) -> NDArray[np.float64]:
    """Return shapes as the first camera sees them, right, up and towards it."""
    turn = np.stack([*camera, np.cross(*camera)])
    turned: NDArray[np.float64] = shapes @ turn.T / extent
    return turned


@with_node
@pytest.mark.parametrize("meshed", [False, True], ids=["points", "mesh"])
@pytest.mark.parametrize("quantised", [False, True], ids=["float", "quantised"])
def test_other_implementations_find_no_fault_and_see_the_shapes(
    tmp_path: Path, meshed: bool, quantised: bool
) -> None:
    path = tmp_path / "a.glb"
    faces = EXAMPLE.faces if meshed else None
    write_glb(path, SHAPES, EXAMPLE.cameras, faces, GlbOptions(fps=10, quantised=quantised))
    (report,) = checked(path)
    assert report["issues"]["messages"] == []
    assert report["info"]["animationCount"] == 1
    played = report["played"]
    assert played["type"] == ("Mesh" if meshed else "Points")
    assert played["colours"] is not meshed
    assert played["names"] == [f"frame {t}" for t in range(1, 12)]
    if meshed:
        np.testing.assert_array_equal(played["index"], EXAMPLE.faces.ravel())
    expected = upright(SHAPES, EXAMPLE.cameras[0], np.abs(SHAPES).max())
    tolerance = 4e-5 if quantised else 2e-6
    for t, frame in enumerate(played["frames"]):
        assert frame["time"] == pytest.approx(t / 10)
        # The last one is taken a microsecond early.
        np.testing.assert_allclose(frame["shown"], expected[t], atol=tolerance + 1e-5 * (t == 11))
        if t < 11:
            between = (expected[t] + expected[t + 1]) / 2
            np.testing.assert_allclose(frame["halfway"], between, atol=tolerance)


@with_node
def test_normals_are_those_of_the_mesh_in_every_frame(tmp_path: Path) -> None:
    paths = [tmp_path / "float.glb", tmp_path / "quantised.glb"]
    for path in paths:
        options = GlbOptions(quantised=path.stem == "quantised")
        write_glb(path, SHAPES, EXAMPLE.cameras, EXAMPLE.faces, options)
    for report, tolerance in zip(checked(*paths), (1e-4, 0.03), strict=True):
        for t, frame in enumerate(report["played"]["frames"]):
            a, b, c = (SHAPES[t][EXAMPLE.faces[:, k]].astype(float) for k in range(3))
            expected = np.zeros(SHAPES[t].shape)
            for corner in range(3):
                np.add.at(expected, EXAMPLE.faces[:, corner], np.cross(b - a, c - a))
            expected /= np.linalg.norm(expected, axis=1, keepdims=True)
            np.testing.assert_allclose(frame["normals"], expected, atol=tolerance)


@with_node
def test_odd_inputs_are_valid_too(tmp_path: Path) -> None:
    """One frame, no motion, points of no face, faces of no area, other types and orders."""
    thin = np.array([[0, 1, 2], [0, 0, 1]])
    cases: dict[str, tuple[NDArray[Any], NDArray[Any] | None, GlbOptions]] = {
        "one": (SHAPES, None, GlbOptions(every=100)),
        "still": (np.repeat(SHAPES[:1], 3, axis=0), EXAMPLE.faces, GlbOptions(quantised=True)),
        "nothing": (np.zeros((3, 5, 3), np.float32), None, GlbOptions()),
        "loose": (SHAPES.astype(np.float64), EXAMPLE.faces[:4], GlbOptions(fps=29.97)),
        "thin": (SHAPES, thin, GlbOptions(every=3)),
        "fortran": (np.asfortranarray(SHAPES), EXAMPLE.faces[:0], GlbOptions(every=5)),
    }
    for name, (shapes, faces, options) in cases.items():
        write_glb(tmp_path / f"{name}.glb", shapes, EXAMPLE.cameras, faces, options)
    reports = checked(*(tmp_path / f"{name}.glb" for name in cases))
    for name, report in zip(cases, reports, strict=True):
        counts = {kind: report["issues"][kind] for kind in ("numErrors", "numWarnings")}
        assert counts == {"numErrors": 0, "numWarnings": 0}, name
    assert [len(report["played"]["frames"]) for report in reports] == [1, 3, 3, 12, 4, 3]


@pytest.mark.slow
@pytest.mark.parametrize("meshed", [False, True], ids=["points", "mesh"])
def test_blender_plays_it(tmp_path: Path, blender: str, meshed: bool) -> None:
    faces = EXAMPLE.faces if meshed else None
    options = GlbOptions(fps=12, quantised=meshed)
    write_glb(tmp_path / "a.glb", SHAPES, EXAMPLE.cameras, faces, options)
    times = (0, 3, 7, 11)
    command = [blender, "--background", "--factory-startup", "--python-exit-code", "1"]
    script = ["--python", str(TOOLS / "import_into_blender.py"), "--"]
    files = [str(tmp_path / "a.glb"), str(tmp_path / "out.json")]
    done = subprocess.run(
        [*command, *script, *files, *(str(t / 12) for t in times)],
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "HOME": str(tmp_path)},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads((tmp_path / "out.json").read_text())
    assert report["faces"] == (len(EXAMPLE.faces) if meshed else 0)
    assert report["keys"] == ["Basis", *(f"frame {t}" for t in range(1, 12))]
    assert len(report["actions"]) == 1
    x, y, z = upright(SHAPES, EXAMPLE.cameras[0], np.abs(SHAPES).max())[list(times)].T
    expected = np.stack([x, -z, y]).T  # z is up there
    np.testing.assert_allclose(report["positions"], expected, atol=1e-4)


@pytest.mark.parametrize("faces", [None, EXAMPLE.faces], ids=["points", "mesh"])
@pytest.mark.parametrize("quantised", [False, True])
def test_any_part_of_the_file_is_the_same_alone(
    faces: NDArray[Any] | None, quantised: bool
) -> None:
    made = glb(SHAPES, faces, quantised=quantised)
    whole = b"".join(made.pieces())
    assert len(whole) == made.size
    rng = np.random.default_rng(0)
    for start, stop in np.sort(rng.integers(0, made.size + 1, (40, 2)), axis=1).tolist():
        assert b"".join(made.pieces(start, stop)) == whole[start:stop]
    again = Glb(
        reader(SHAPES),
        frames=12,
        points=49,
        camera=EXAMPLE.cameras[0],
        faces=faces,
        options=GlbOptions(quantised=quantised),
        bounds=made.bounds,
    )
    assert b"".join(again.pieces()) == whole


def test_frames_of_many_points_are_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    """As many points at once as there are, or fewer: the bytes are the same."""
    for options in ({}, {"quantised": True}, {"every": 4}, {"faces": EXAMPLE.faces}):
        files = []
        for window in (7, 49, 120, 1 << 16):
            monkeypatch.setattr("smsr.files.glb._WINDOW", window)
            files.append(b"".join(glb(SHAPES, **options).pieces()))
        assert len(set(files)) == 1


def test_the_first_camera_looks_at_it_from_the_front() -> None:
    described, _ = document(b"".join(glb(SHAPES, EXAMPLE.faces).pieces()))
    (node,) = described["nodes"]
    x, y, z, w = node["rotation"]
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    np.testing.assert_allclose(turn[:2], EXAMPLE.cameras[0], atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    down, _ = document(b"".join(glb(SHAPES, EXAMPLE.faces, image_v="down").pieces()))
    flipped = down["nodes"][0]["rotation"]
    # The same view, turned by 180 degrees about the axis that points right.
    np.testing.assert_allclose(np.abs(flipped), np.abs([w, z, y, x]), atol=1e-12)


def test_the_scale_of_the_camera_does_not_matter() -> None:
    near, nearer = (
        glb(SHAPES, EXAMPLE.faces, camera=scale * EXAMPLE.cameras[0]) for scale in (2.0, 4.0)
    )
    assert b"".join(nearer.pieces()) == b"".join(near.pieces())
    nodes = [document(b"".join(one.pieces()))[0]["nodes"] for one in (near, glb(SHAPES))]
    scaled, plain = (node["rotation"] for (node,) in nodes)
    np.testing.assert_allclose(scaled, plain, atol=1e-12)


def test_pixels_are_told_by_their_signs(tmp_path: Path) -> None:
    shape, camera = SHAPES[0], EXAMPLE.cameras[0]
    centre = np.ptp(shape @ camera.T, axis=0)
    for translation, down in ((centre, True), (0.1 * centre, False), (-centre, False)):
        assert v_grows_down("auto", shape, camera, translation) is down
        assert v_grows_down("up", shape, camera, translation) is False
        assert v_grows_down("down", shape, camera, translation) is True
    written = {}
    for image_v, translations in (("auto", True), ("down", True), ("up", True), ("auto", False)):
        path = tmp_path / "a.glb"
        write_glb(
            path,
            SHAPES,
            EXAMPLE.cameras,
            options=GlbOptions(image_v=image_v),  # type: ignore[arg-type]
            translations=np.tile(centre, (len(SHAPES), 1)) if translations else None,
        )
        written[image_v, translations] = path.read_bytes()
    assert written["auto", True] == written["down", True] != written["up", True]
    assert written["auto", False] == written["up", True]


def test_integers_take_less_room() -> None:
    shapes = np.random.default_rng(0).standard_normal((20, 3000, 3)).astype(np.float32)
    faces = np.random.default_rng(1).integers(0, 3000, (500, 3))
    assert glb(shapes, quantised=True).size < 0.7 * glb(shapes).size
    assert glb(shapes, faces, quantised=True).size < 0.55 * glb(shapes, faces).size


def test_memory_does_not_grow_with_the_sequence() -> None:
    points = 20_000

    def read(start: int, stop: int) -> NDArray[np.float32]:
        rows = np.arange(start, stop, dtype=np.float32)
        return np.stack([np.sin(rows), np.cos(rows), rows % 7], axis=1)

    peaks = []
    for frames in (20, 200):
        tracemalloc.start()
        made = Glb(read, frames=frames, points=points, camera=EXAMPLE.cameras[0])
        assert sum(map(len, made.pieces())) == made.size > frames * points * 12
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0] + 1e6


def test_what_no_file_can_hold_is_refused_with_what_would_fit() -> None:
    def never(start: int, stop: int) -> NDArray[Any]:
        raise AssertionError("nothing must be read")

    for frames, points in ((MOST_FRAMES + 1, 10), (500, 1_000_000), (60, 20_000_000)):
        with pytest.raises(AnimationTooLarge, match="every") as caught:
            Glb(never, frames=frames, points=points, camera=EXAMPLE.cameras[0])
        least = caught.value.context["every"]
        assert isinstance(least, int)
        with pytest.raises(AssertionError, match="nothing must be read"):
            Glb(
                never,
                frames=frames,
                points=points,
                camera=EXAMPLE.cameras[0],
                options=GlbOptions(every=least),
            )
