"""The command as a person meets it: real processes, their output and their exit status."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from service.cli import main
from smsr.figures import NAMES
from smsr.files import GlbOptions, open_result, write_glb, write_xdmf
from smsr.synthetic import write_example
from tests.conftest import clean_environment, serving

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.conftest import Served

pytestmark = pytest.mark.slow


def smsr(
    *arguments: str | Path, cwd: Path | None = None, **environment: str
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "service.cli", *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=cwd,
        env=clean_environment(**environment),
        timeout=240,
        check=False,
    )


def succeeded(result: subprocess.CompletedProcess[str]) -> str:
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("example")
    succeeded(smsr("example", folder, "--frames", "24", "--side", "7"))
    return folder


@pytest.fixture(scope="module")
def result(example: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("result") / "out"
    succeeded(
        smsr(
            *("reconstruct", example / "measurements.npy", "-o", out),
            *("--ground-truth", example / "ground_truth.npy"),
            *("--faces", example / "faces.npy"),
        )
    )
    return out


def test_reconstruct_writes_arrays_frames_and_a_report(result: Path, example: Path) -> None:
    with np.load(result / "result.npz") as arrays:
        shapes, cameras, translations = (
            arrays[name] for name in ("shapes", "cameras", "translations")
        )
        assert np.array_equal(arrays["faces"], np.load(example / "faces.npy"))
    assert shapes.shape == (24, 49, 3)
    W = np.load(example / "measurements.npy").reshape(24, 2, 49)
    projected = cameras @ shapes.transpose(0, 2, 1) + translations[:, :, None]
    assert np.abs(projected - W).max() < 1e-3 * np.abs(W).max()
    assert len(list((result / "frames").glob("frame_*.ply"))) == 24
    report = json.loads((result / "report.json").read_text())
    assert report["frames"] == 24
    assert report["metrics"]["e3d"] < 1
    assert {path.name for path in result.iterdir()} == {"result.npz", "report.json", "frames"}


def test_the_frames_are_meshes_others_can_read(result: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    mesh = trimesh.load(result / "frames" / "frame_0007.ply", process=False)
    with np.load(result / "result.npz") as arrays:
        assert np.allclose(mesh.vertices, arrays["shapes"][7])
        assert np.array_equal(mesh.faces, arrays["faces"])


def test_a_result_becomes_an_animation(result: Path, example: Path, tmp_path: Path) -> None:
    found = open_result(result / "result.npz")
    faces = np.load(example / "faces.npy")
    arrays = found.shapes, found.cameras, faces
    write_glb(tmp_path / "expected.glb", *arrays, translations=found.translations)
    succeeded(smsr("convert", result, "-o", tmp_path / "a.glb"))
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "expected.glb").read_bytes()
    more = ["--quantised", "--every", "2", "--image-v", "down", "--fps", "10"]
    shown = succeeded(smsr("convert", result / "result.npz", "-o", tmp_path / "b.glb", *more))
    assert str(tmp_path / "b.glb") in shown
    options = GlbOptions(10.0, quantised=True, every=2, image_v="down")
    write_glb(tmp_path / "expected.glb", *arrays, options)
    assert (tmp_path / "b.glb").read_bytes() == (tmp_path / "expected.glb").read_bytes()


def test_a_result_becomes_a_series_for_paraview(result: Path) -> None:
    shown = succeeded(smsr("convert", result, "--format", "xdmf", "--fps", "10", "--every", "2"))
    assert str(result / "result.xdmf") in shown
    write_xdmf(result / "expected.xdmf", result / "result.npz", fps=10, every=2)
    assert (result / "result.xdmf").read_bytes() == (result / "expected.xdmf").read_bytes()
    refused = smsr("convert", result, "--format", "xdmf", "--quantised")
    assert refused.returncode == 2
    assert "--format glb" in refused.stderr


def test_reconstruct_writes_an_animation_where_asked(example: Path, tmp_path: Path) -> None:
    tracks = example / "measurements.npy"
    succeeded(smsr("reconstruct", tracks, "-o", tmp_path / "r", "--no-ply", "--glb"))
    succeeded(smsr("convert", tmp_path / "r", "-o", tmp_path / "a.glb"))
    assert (tmp_path / "r" / "result.glb").read_bytes() == (tmp_path / "a.glb").read_bytes()


def test_a_result_is_drawn(result: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    done = smsr("plot", result, "-o", tmp_path / "all")
    drawn = {Path(line).stem for line in succeeded(done).splitlines()}
    assert {path.name for path in (tmp_path / "all").iterdir()} == {f"{n}.png" for n in drawn}
    stages = json.loads((result / "report.json").read_text())["stages"]
    iterated = any(stage["residuals"] for stage in stages)
    assert drawn == set(NAMES) - (set() if iterated else {"convergence"})
    assert iterated or "convergence: " in done.stderr
    succeeded(smsr("plot", result / "result.npz", "error", "--format", "svg", "-o", tmp_path))
    e3d = json.loads((result / "report.json").read_text())["metrics"]["e3d"]
    assert f"e3D = {e3d:.4f}" in (tmp_path / "error.svg").read_text()
    (tmp_path / "result.npz").write_bytes((result / "result.npz").read_bytes())
    alone = smsr("plot", tmp_path)
    assert succeeded(alone).split() == [
        str(tmp_path / "figures" / f"{name}.png") for name in ("shapes", "cameras")
    ]
    assert "error: " in alone.stderr
    assert smsr("plot", tmp_path, "error").returncode == 1
    assert smsr("plot", tmp_path, "errors").returncode == 2


def test_evaluate_agrees_with_the_report(result: Path, example: Path) -> None:
    out = succeeded(smsr("evaluate", example / "ground_truth.npy", result / "result.npz", "--json"))
    report = json.loads((result / "report.json").read_text())
    assert json.loads(out)["e3d"] == pytest.approx(report["metrics"]["e3d"], rel=1e-5)


def test_evaluate_shows_the_error(result: Path, example: Path) -> None:
    out = succeeded(smsr("evaluate", example / "ground_truth.npy", result / "result.npz"))
    assert "e3D" in out


def test_reconstruct_prints_json_and_nothing_else(example: Path, tmp_path: Path) -> None:
    run = smsr("reconstruct", example / "measurements.npy", "--json", "--no-ply", cwd=tmp_path)
    report = json.loads(succeeded(run))
    assert report["points"] == 49
    assert report["metrics"] is None
    assert {path.name for path in (tmp_path / "measurements-3d").iterdir()} == {
        "result.npz",
        "report.json",
    }


def test_options_reach_the_solver(example: Path, tmp_path: Path) -> None:
    run = smsr(
        *("reconstruct", example / "measurements.npy", "-o", tmp_path, "--no-ply", "--json"),
        *("--preset", "paper", "-O", "layout=interleaved"),
    )
    assert (
        json.loads(succeeded(run))["options"] | {"preset": "paper"}
        == (json.loads(run.stdout)["options"])
    )
    assert json.loads(run.stdout)["options"]["layout"] == "interleaved"


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["reconstruct", "nothing.npy"], 2, "does not exist"),
        (["reconstruct", "odd.npy"], 3, "7 rows"),
        (["reconstruct", "text.npy"], 3, "text.npy"),
        (["reconstruct", "good.npy", "-O", "perset=paper"], 2, "Did you mean 'preset'"),
        (["reconstruct", "good.npy", "-O", "layout=sideways"], 2, "interleaved"),
        (["reconstruct", "good.npy", "-O", "layout"], 2, "name=value"),
        (["reconstruct", "good.npy", "--ground-truth", "other.npy"], 3, "ground truth"),
        (["evaluate", "other.npy", "good.npy"], 3, "shapes"),
        (["submit", "good.npy", "--server", "http://127.0.0.1:9", "--patience", "0"], 4, "server"),
        (["submit", "good.npy", "--server", "no address"], 2, "'no address' is no address"),
        (["submit", "good.npy", "--server", "localhost:9"], 2, "write http://localhost:9."),
        (["jobs", "list", "--server", "ftp://localhost"], 2, "https://"),
        (["jobs", "list", "--server", "http://127.0.0.1:9", "--patience", "0"], 4, "127.0.0.1:9"),
        (["worker"], 2, "REDIS_URL"),
        (["benchmark", "--data", ".", "--sets", "drunk"], 3, "drink"),
        (["reconsruct"], 2, "reconsruct"),
    ],
)
def test_mistakes_are_told_in_a_line_and_an_exit_status(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    code: int,
    says: str,
) -> None:
    generator = np.random.default_rng(0)
    np.save(tmp_path / "odd.npy", generator.standard_normal((7, 10)))
    np.save(tmp_path / "good.npy", generator.standard_normal((8, 10)))
    np.save(tmp_path / "other.npy", generator.standard_normal((15, 10)))
    (tmp_path / "text.npy").write_text("this is no array")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "environ", clean_environment())
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == code
    assert says in " ".join(capsys.readouterr().err.replace("│", " ").split())


def test_options_of_files_are_taken_as_options_too(example: Path, tmp_path: Path) -> None:
    W = np.load(example / "measurements.npy")
    np.savez(tmp_path / "two.npz", a=W, b=W[:, :40])
    two = tmp_path / "two.npz"
    assert smsr("reconstruct", two, "-o", tmp_path / "out").returncode == 3
    text = succeeded(
        smsr("reconstruct", two, "-O", "measurements_key=b", "-o", tmp_path / "out", "--json")
    )
    assert json.loads(text)["points"] == 40
    assert smsr("reconstruct", two, "-O", "ground_truth_frame=moon").returncode == 2


def test_the_process_ends_with_the_exit_status(tmp_path: Path) -> None:
    (tmp_path / "text.npy").write_text("this is no array")
    run = smsr("reconstruct", "text.npy", cwd=tmp_path)
    assert run.returncode == 3
    assert run.stdout == ""
    assert "Traceback" not in run.stderr


def test_an_interrupt_ends_a_run_without_a_trace(tmp_path: Path) -> None:
    write_example(tmp_path, frames=60, side=60)
    never = ("-O", "shape_tolerance=1e-15", "-O", "shape_iterations=100000")
    with subprocess.Popen(
        [sys.executable, "-m", "service.cli", "reconstruct", "measurements.npy", *never],
        cwd=tmp_path,
        env=clean_environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        folder = tmp_path / "measurements-3d"
        until(lambda: folder.exists() and any(folder.iterdir()))
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in errors
    assert not any(path.name.startswith(".arrays") for path in folder.iterdir())


def test_options_are_listed_in_every_form() -> None:
    listed = json.loads(succeeded(smsr("options", "--json")))
    by_name = {option["name"]: option for option in listed}
    assert by_name["preset"]["choices"] == ["default", "paper"]
    for form in ([], ["--markdown"]):
        shown = succeeded(smsr("options", *form))
        assert all(name in shown for name in by_name)


def test_version_and_help() -> None:
    assert succeeded(smsr("--version")).startswith("smsr ")
    assert "Exit status" in succeeded(smsr("--help"))


def test_submit_many_files_of_which_one_is_bad(
    served: Served, example: Path, tmp_path: Path
) -> None:
    np.save(tmp_path / "odd.npy", np.ones((7, 10)))
    good = example / "measurements.npy"
    copy = tmp_path / "second.npy"
    copy.write_bytes(good.read_bytes())
    run = smsr(
        *("submit", good, tmp_path / "odd.npy", copy, "--server", served.url),
        *("--ground-truth", example / "ground_truth.npy", "-o", tmp_path / "out"),
        *("-O", "layout=interleaved"),
    )
    assert run.returncode == 3, run.stderr
    assert "odd.npy: " in run.stderr
    assert run.stdout.count("succeeded") == 2
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["measurements", "second"]
    for name in ("measurements", "second"):
        folder = tmp_path / "out" / name
        assert len(list((folder / "frames").glob("*.ply"))) == 24
        with np.load(folder / "result.npz") as arrays:
            assert arrays["shapes"].shape == (24, 49, 3)
        assert (folder / "report.json").is_file()


def test_nothing_is_sent_where_a_name_is_no_file(
    served: Served, example: Path, tmp_path: Path
) -> None:
    of_batch = ("--batch", "misspelt", "--server", served.url)
    run = smsr("submit", example / "measurements.npy", tmp_path / "nope.npy", *of_batch)
    assert run.returncode == 2
    assert "nope.npy" in "".join(run.stderr.replace("│", "").split())
    assert json.loads(succeeded(smsr("jobs", "list", "--json", *of_batch))) == []
    told = " ".join(succeeded(smsr("submit", "--help")).replace("│", " ").split())
    assert "A name that is no file is wrong usage: nothing is sent then." in told


def test_a_job_that_fails_is_told_with_its_reason(served: Served, tmp_path: Path) -> None:
    np.save(tmp_path / "constant.npy", np.zeros((20, 30)))
    run = smsr("submit", tmp_path / "constant.npy", "--wait", "--server", served.url)
    assert run.returncode == 1
    assert "do not vary" in run.stderr


def test_jobs_are_looked_after(served: Served, example: Path, tmp_path: Path) -> None:
    url = ("--server", served.url)
    submitted = smsr("submit", example / "measurements.npy", "--json", *url)
    (job,) = json.loads(succeeded(submitted))
    out = tmp_path / "out"
    succeeded(smsr("jobs", "download", job["id"], "-o", out, "--no-ply", *url))
    assert {path.name for path in out.iterdir()} == {"result.npz", "report.json"}
    shown: dict[str, Any] = json.loads(succeeded(smsr("jobs", "show", job["id"], *url)))
    assert shown["status"] == "succeeded"
    listed = succeeded(smsr("jobs", "list", "--status", "succeeded", *url))
    (row,) = (line for line in listed.splitlines() if job["id"] in line)
    assert "succeeded" in row
    assert "measurements.npy" in row
    usual = succeeded(smsr("jobs", "keep", job["id"], *url))
    longer = succeeded(smsr("jobs", "keep", job["id"], "--ttl", "1000000", *url))
    assert "is kept until" in usual
    assert longer > usual, "dates in the order of their digits"
    refused = smsr("jobs", "cancel", job["id"], *url)
    assert refused.returncode == 1
    assert "finished" in refused.stderr
    succeeded(smsr("jobs", "delete", job["id"], *url))
    assert smsr("jobs", "show", job["id"], *url).returncode == 1


def test_serve_restarts_workers_and_leaves_nothing_behind(tmp_path: Path, example: Path) -> None:
    with serving(tmp_path, "--workers", "2", environment=clean_environment()) as server:
        first, second = two_workers(server)
        os.kill(first, signal.SIGKILL)
        until(lambda: first not in workers_of(server))
        assert second in two_workers(server), "only the killed one is started again"
        succeeded(smsr("submit", example / "measurements.npy", "--wait", "--server", server.url))
        family = descendants(server.process.pid)
        assert len(family) >= 3, "Redis and two workers"
    assert server.process.returncode == 0, server.log.read_text()
    until(lambda: not [pid for pid in family if alive(pid)])


def test_serve_goes_on_where_it_was(tmp_path: Path, example: Path) -> None:
    with serving(tmp_path, environment=clean_environment()) as server:
        run = smsr(
            "submit", example / "measurements.npy", "--wait", "--json", "--server", server.url
        )
        (job,) = json.loads(succeeded(run))
    with serving(tmp_path, environment=clean_environment()) as server:
        shown = smsr("jobs", "show", job["id"], "--server", server.url)
        assert json.loads(succeeded(shown))["status"] == "succeeded"


def test_serve_killed_outright_takes_its_processes_along(tmp_path: Path) -> None:
    with serving(tmp_path, environment=clean_environment()) as server:
        until(lambda: len(workers_of(server)) == 1)
        family = descendants(server.process.pid)
        server.process.kill()
        server.process.wait(10)
        until(lambda: not [pid for pid in family if alive(pid)])


def test_serve_says_that_a_port_is_taken(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        run = smsr("serve", "--port", str(port), "--data-dir", tmp_path / "data")
    assert run.returncode == 1
    assert f"port {port}" in run.stderr
    assert "Traceback" not in run.stderr


@pytest.mark.parametrize("command", [["serve", "--port", "0"], ["worker"], ["keys", "list"]])
def test_wrong_settings_are_told_in_a_line_each(command: list[str], tmp_path: Path) -> None:
    run = smsr(
        *command,
        cwd=tmp_path,
        SMSR_THREADS="abc",
        SMSR_STORAGE_URL="foo",
        SMSR_METRICS_TOKEN="word",
        REDIS_URL="foo://:word@host",
    )
    assert run.returncode == 2, run.stderr
    told = run.stderr.splitlines()
    variables = ["REDIS_URL", "SMSR_STORAGE_URL", "SMSR_THREADS", "SMSR_METRICS_TOKEN"]
    assert [line.split(": ")[:2] for line in told] == [["Error", name] for name in variables]
    assert "s3://bucket/prefix" in told[1]
    assert "word" not in run.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_service_that_cannot_start_has_failed(tmp_path: Path) -> None:
    """And has not refused an input, which uvicorn's own status would say."""
    (tmp_path / "file").touch()
    run = smsr(
        *("serve", "--port", "0", "--workers", "0", "--data-dir", tmp_path / "data"),
        SMSR_STORAGE_URL=(tmp_path / "file").as_uri(),
    )
    assert run.returncode == 1, run.stderr


@pytest.mark.data
def test_benchmark_measures_a_set_in_its_own_process(evaluation_data: Path) -> None:
    run = smsr("benchmark", "--data", evaluation_data, "--sets", "yoga,dinosaur", "--json")
    report = json.loads(succeeded(run))
    yoga, dinosaur = report["sets"]
    assert (yoga["frames"], yoga["points"]) == (307, 41)
    assert list(yoga["e3d"]) == ["object"]
    assert list(dinosaur["e3d"]) == ["object", "camera"]
    assert yoga["start_bytes"] < yoga["peak_bytes"] < 2 << 30
    assert report["environment"]["blas_threads"] == 1


@pytest.mark.data
def test_benchmark_measures_camera_paths(evaluation_data: Path) -> None:
    family = ("--camera-paths", "fast,tripod", "--noises", "0.05")
    run = smsr("benchmark", "--data", evaluation_data, "--sets", "yoga", *family, "--json")
    fast, tripod = json.loads(succeeded(run))["camera_paths"]
    assert [(one["shape"], one["path"], one["noise"]) for one in (fast, tripod)] == [
        ("yoga", "fast", 0.05),
        ("yoga", "tripod", 0.05),
    ]
    assert fast["default"]["object"] < 0.5 * fast["baseline"]["object"]
    table = smsr("benchmark", "--data", evaluation_data, "--sets", "yoga", *family, "--markdown")
    assert "| 5% | fast |" in succeeded(table)


@pytest.mark.data
def test_benchmark_refuses_an_unknown_camera_path(evaluation_data: Path) -> None:
    run = smsr("benchmark", "--data", evaluation_data, "--camera-paths", "zigzag")
    assert run.returncode == 2
    assert "lissajous" in run.stderr


def until(condition: Any, seconds: float = 30.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.05)


def processes() -> Iterator[tuple[int, int, str, list[str]]]:
    """Process id, parent, state and command of every process, from /proc."""
    for folder in Path("/proc").iterdir():
        if not folder.name.isdigit():
            continue
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
            command = (folder / "cmdline").read_text().split("\0")
        except OSError:
            continue
        yield int(folder.name), int(fields[1]), fields[0], command


def descendants(root: int) -> set[int]:
    parents = {pid: parent for pid, parent, _, _ in processes()}
    found: set[int] = set()
    new = {root}
    while new:
        new = {pid for pid, parent in parents.items() if parent in new}
        found |= new
    return found


def workers_of(server: Served) -> list[int]:
    """Return the worker processes that the server itself started."""
    return [
        pid
        for pid, parent, _, command in processes()
        if parent == server.process.pid and "worker.main" in command
    ]


def two_workers(server: Served) -> list[int]:
    """Wait until there are two worker processes and return them."""
    found: list[int] = []

    def both() -> bool:
        found[:] = workers_of(server)
        return len(found) == 2

    until(both)
    return found


def alive(pid: int) -> bool:
    return any(pid == other and state != "Z" for other, _, state, _ in processes())


def test_a_batch_from_the_command_line(served: Served, example: Path, tmp_path: Path) -> None:
    label, server = f"cli-{tmp_path.name}", ("--server", served.url)
    files = [shutil.copy(example / "measurements.npy", tmp_path / f"{n}.npy") for n in "ab"]
    more = ("--batch", label, "--priority", "high", "--ttl", "600", "--wait", "--json")
    jobs = json.loads(succeeded(smsr("submit", *files, *more, *server)))
    assert [(job["batch"], job["priority"], job["ttl"]) for job in jobs] == [
        (label, "high", 600.0)
    ] * 2
    shown = json.loads(succeeded(smsr("batch", label, "--json", *server)))
    assert (shown["jobs"]["succeeded"], shown["progress"]) == (2, 1.0)
    assert "100% of 2 jobs" in succeeded(smsr("batch", label, *server))
    again = smsr("submit", files[0], "--reuse", "--batch", label, "--json", *server)
    (reused,) = json.loads(succeeded(again))
    assert reused["reused_from"] in {job["id"] for job in jobs}
    succeeded(smsr("batch", label, "--download", tmp_path / "b.zip", *server))
    with zipfile.ZipFile(tmp_path / "b.zip") as packed:
        assert sum(name.endswith("/result.npz") for name in packed.namelist()) == 3
    assert "deleted" in succeeded(smsr("batch", label, "--delete", *server))
    assert smsr("batch", label, *server).returncode != 0
    assert smsr("batch", label, "--delete", "--cancel", *server).returncode != 0
