"""Imports between the packages point one way, and importing the client or the service's doors loads nothing heavy."""

from __future__ import annotations

import subprocess
import sys

import pytest
from source_tree import MODULES, ROOT, imports, within

HEAVY = ("torch", "numba", "scipy", "sklearn", "pycolmap", "fastapi", "uvicorn")

LIGHT_ROOMS = (
    "scas4d_core.errors",
    "scas4d_core.frame_outcome",
    "scas4d_core.cameras",
    "scas4d_core.captures",
    "scas4d_core.settings",
    "scas4d_core.presets",
    "scas4d_core.rig_checks",
    "scas4d_core.compact",
    "scas4d_core.gaussians",
)
"""What the client may import when it is imported; its heavy commands import the rest when they run."""

NUMPY_ONLY = (
    "scas4d_core.cameras",
    "scas4d_core.gaussians",
    "scas4d_core.captures",
    "scas4d_core.settings",
    "scas4d_core.rig_checks",
    "scas4d_core.compact",
)


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


def loaded_by(*names: str) -> set[str]:
    """Top-level packages in ``sys.modules`` of a fresh interpreter after importing."""
    program = f"import {', '.join(names)}, sys; print(*{{name.split('.')[0] for name in sys.modules}})"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_importing_the_client_loads_nothing_heavy() -> None:
    loaded = loaded_by(*(name for name in MODULES if within(name, ("client",))))
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
