"""Imports point one way, in no circle, and what should be light is."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("scas4d_core", "server", "client")
HEAVY = ("torch", "numba", "scipy", "sklearn", "pycolmap", "fastapi", "uvicorn")

LIGHT_ROOMS = (
    "scas4d_core.errors",
    "scas4d_core.cameras",
    "scas4d_core.captures",
    "scas4d_core.settings",
    "scas4d_core.presets",
)
"""What the client may import when it is imported; its heavy commands import the rest when they run."""

NUMPY_ONLY = ("scas4d_core.cameras", "scas4d_core.gaussians", "scas4d_core.captures", "scas4d_core.settings")


def module_name(path: Path) -> str:
    parts = list(path.relative_to(ROOT).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))}


def statements(tree: ast.AST, lazy: bool) -> Iterator[ast.Import | ast.ImportFrom]:
    """Import statements of a module; without ``lazy`` only those that run when it is imported."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node
        elif isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING"):
            continue
        elif lazy or not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            yield from statements(node, lazy)


def imports(name: str, lazy: bool) -> set[str]:
    """Dotted names that a module imports; ``from package import module`` names the module."""
    found: set[str] = set()
    for node in statements(ast.parse(MODULES[name].read_text()), lazy):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        else:
            assert node.level == 0, f"{name}: relative import"
            module = node.module or ""
            for alias in node.names:
                inner = f"{module}.{alias.name}"
                found.add(inner if inner in MODULES else module)
    return found


def within(name: str, packages: tuple[str, ...]) -> bool:
    return any(name == package or name.startswith(package + ".") for package in packages)


def test_the_tree_was_read() -> None:
    assert {"scas4d_core.update.frame_update", "server.app", "client.wire", "scas4d_core.captures"} <= set(MODULES)
    assert "scas4d_core.kernels.image_loss" in imports("scas4d_core.update.picture_loss", lazy=False)
    assert "numpy" in imports("scas4d_core.cameras", lazy=False)


@pytest.mark.parametrize("name", [name for name in MODULES if within(name, ("scas4d_core",))])
def test_the_core_imports_neither_server_nor_client(name: str) -> None:
    assert not [found for found in imports(name, lazy=True) if within(found, ("server", "client", "tests"))]


@pytest.mark.parametrize("name", [name for name in MODULES if within(name, ("server",))])
def test_the_server_imports_of_the_client_only_the_wire(name: str) -> None:
    found = {other for other in imports(name, lazy=True) if within(other, ("client",))}
    assert all(other == "client" or within(other, ("client.wire",)) for other in found)  # `client` holds the version


@pytest.mark.parametrize("name", [name for name in MODULES if within(name, ("client",))])
def test_the_client_imports_only_light_rooms(name: str) -> None:
    found = imports(name, lazy=False)
    assert not [other for other in found if within(other, (*HEAVY, "server"))]
    core = [other for other in found if within(other, ("scas4d_core",))]
    assert not [other for other in core if not within(other, LIGHT_ROOMS)]


def test_no_circles() -> None:
    graph = {}
    for name in MODULES:
        graph[name] = {found for found in imports(name, lazy=False) if found in MODULES and found != name}
    list(TopologicalSorter(graph).static_order())  # raises CycleError, which names the circle


def loaded_by(*names: str) -> set[str]:
    """Top-level packages in ``sys.modules`` of a fresh interpreter after importing."""
    program = f"import {', '.join(names)}, sys; print(*{{name.split('.')[0] for name in sys.modules}})"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_importing_the_client_loads_nothing_heavy() -> None:
    names = ("cli", "commands", "sdk", "wire", "calls", "rig", "local", "ingest", "importers.door", "importers.write")
    loaded = loaded_by(*(f"client.{name}" for name in names))
    assert not loaded & {*HEAVY, "server", "cv2", "av"}
    assert "scas4d_core" in loaded


def test_numpy_only_rooms_load_nothing_heavy() -> None:
    assert not loaded_by(*NUMPY_ONLY) & {*HEAVY, "server", "client"}


def test_reconstructing_on_the_cpu_needs_no_torch() -> None:
    loaded = loaded_by("scas4d_core.reconstruction", "scas4d_core.first_frame.initial_points")
    assert "numba" in loaded
    assert "torch" not in loaded


def test_the_doors_of_the_server_are_light() -> None:
    """The process that answers requests holds no kernels: the workers do."""
    assert not loaded_by("server.app") & {"torch", "numba", "pycolmap", "sklearn"}
