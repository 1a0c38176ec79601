"""The three floors import only down; the solver and the client stand on their own."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FLOORS = ("smsr", "worker", "service")

SOLVER_LIBRARIES = {"numpy", "scipy", "threadpoolctl", "h5py"}
OF_AN_EXTRA = {
    "smsr/cluster.py": {"dask", "zarr"},
    "smsr/devices.py": {"array_api_compat"},
    "smsr/figures.py": {"matplotlib"},
}
CLIENT_LIBRARIES = {"anyio", "httpx", "numpy", "pydantic"}
WEB_LIBRARIES = {"fastapi", "starlette", "uvicorn", "httpx", "typer", "rich", "multipart"}


def modules(floor: str) -> list[Path]:
    return sorted((ROOT / floor).rglob("*.py"))


def imported(path: Path) -> set[str]:
    """Top-level names of everything that a module imports, wherever in the module it does so."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: imports are absolute here"
            names.add((node.module or "").split(".")[0])
    return names


def everything(floor: str) -> dict[str, set[str]]:
    return {str(path.relative_to(ROOT)): imported(path) for path in modules(floor)}


@pytest.mark.parametrize("floor", FLOORS)
def test_a_floor_imports_only_itself_and_what_lies_below(floor: str) -> None:
    above = set(FLOORS[FLOORS.index(floor) + 1 :])
    upward = {path: names & above for path, names in everything(floor).items() if names & above}
    assert upward == {}
    assert modules(floor), f"no modules found in {floor}"


def test_the_solver_needs_arrays_and_file_formats_only() -> None:
    allowed = SOLVER_LIBRARIES | set(sys.stdlib_module_names) | {"smsr"}
    foreign = {
        path: names - allowed - OF_AN_EXTRA.get(path, set())
        for path, names in everything("smsr").items()
    }
    assert {path: names for path, names in foreign.items() if names} == {}


def test_the_client_stands_beside_the_floors() -> None:
    """It could be installed alone; the service shares its documents, the worker nothing."""
    allowed = CLIENT_LIBRARIES | set(sys.stdlib_module_names) | {"smsr_client"}
    found = everything("smsr_client")
    assert found
    assert {path: names - allowed for path, names in found.items() if names - allowed} == {}
    for floor in ("smsr", "worker"):
        assert [path for path, names in everything(floor).items() if "smsr_client" in names] == []


def test_the_web_side_takes_the_documents_of_the_client_only() -> None:
    """Only the command line talks to a server."""
    for path in modules("service"):
        if path.is_relative_to(ROOT / "service" / "cli"):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("smsr_client"):
                assert node.module == "smsr_client.documents", f"{path}:{node.lineno}"


def test_the_worker_knows_nothing_of_the_web() -> None:
    web = {path: names & WEB_LIBRARIES for path, names in everything("worker").items()}
    assert {path: names for path, names in web.items() if names} == {}


def test_the_web_side_never_calls_the_solver() -> None:
    """Only the command line, which works without a server too, reconstructs on its own."""
    for path in modules("service"):
        if path.is_relative_to(ROOT / "service" / "cli"):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module in ("smsr", "smsr.pipeline"):
                names = {alias.name for alias in node.names}
                assert not names & {"reconstruct", "pipeline"}, f"{path}:{node.lineno}"
            if isinstance(node, ast.Attribute):
                assert node.attr != "reconstruct", f"{path}:{node.lineno}"
