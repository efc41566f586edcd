"""Imports point one way, between packages, folders and files; the client and the service's doors load nothing heavy."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from source_tree import MODULES, PACKAGES, ROOT, circles, folders, imports, level, modules_below, product, within

HEAVY = ("torch", "numba", "scipy", "sklearn", "pycolmap", "fastapi", "uvicorn")

LIGHT_ROOMS = (
    "scas4d_core.errors",
    "scas4d_core.frame_outcome",
    "scas4d_core.frame_times",
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
    assert "scas4d_core.kernels.image_loss" in imports("scas4d_core.engines.cpu.renderer", lazy=False)
    assert "numpy" in imports("scas4d_core.cameras", lazy=False)


@pytest.mark.parametrize("folder", folders(MODULES))
def test_no_circles_between_the_files_and_folders_of_a_folder(folder: str) -> None:
    """Imports in functions and under TYPE_CHECKING count, and a folder stands for all below it."""
    there = level(folder)
    assert there.circles() == [], there.explained()


def test_no_circles_between_files() -> None:
    graph = {name: imports(name, lazy=True) & (MODULES.keys() - {name}) for name in MODULES}
    assert circles(graph) == []


def test_a_circle_is_seen() -> None:
    graph = {"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": set(), "e": {"f"}, "f": {"e"}}
    assert circles(graph) == [["a", "b", "c"], ["e", "f"]]
    assert circles({"a": {"b"}, "b": {"c"}, "c": set()}) == []


PLANTED = {
    "at the top": "from pack.far.away import y",
    "the package itself": "import pack.far",
    "in a function": "def f():\n    from pack.far import away",
    "for types": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from pack.far.away import y",
}


@pytest.mark.parametrize("imported", PLANTED.values(), ids=list(PLANTED))
@pytest.mark.parametrize("file", ["near/one.py", "near/deep/one.py", "near/__init__.py", "near.py"])
def test_a_circle_between_folders_is_seen_and_explained(tmp_path: Path, file: str, imported: str) -> None:
    lines = {
        "__init__.py": "",
        "far/__init__.py": "from pack import alone",
        "far/away.py": "y = 1",
        "far/other.py": "import pack.near.two" if file != "near.py" else "from pack import near",
        "alone.py": "import numpy",
        "near/two.py": "x = 1",
        file: imported,
    }
    if file == "near.py":
        del lines["near/two.py"]
    for name, text in lines.items():
        (tmp_path / "pack" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "pack" / name).write_text(text)
    modules = modules_below(tmp_path, ["pack"])
    assert circles({name: imports(name, lazy=True, modules=modules) & modules.keys() for name in modules}) == []
    there = level("pack", modules)
    assert there.circles() == [["pack.far", "pack.near"]]
    importing = f"pack.{file[:-3].replace('/', '.').removesuffix('.__init__')}"
    assert f"{importing} imports pack.far" in there.explained()
    assert "pack.far.other imports pack.near" in there.explained()
    assert "pack.far -> pack.near" in there.explained()
    assert "alone" not in there.explained()
    assert level("pack.far", modules).circles() == []


def test_a_circle_within_a_folder_is_seen_at_its_level(tmp_path: Path) -> None:
    for name, text in {
        "a/one.py": "import pack.room.b.two",
        "b/two.py": "",
        "b/three.py": "import pack.room.a.one",
    }.items():
        (tmp_path / "pack" / "room" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "pack" / "room" / name).write_text(text)
    modules = modules_below(tmp_path, ["pack"])
    assert folders(modules) == ["pack", "pack.room", "pack.room.a", "pack.room.b"]
    assert [level(folder, modules).circles() for folder in folders(modules)] == [
        [],
        [["pack.room.a", "pack.room.b"]],
        [],
        [],
    ]


def test_imports_in_functions_and_for_types_are_seen() -> None:
    assert "client.cli.evaluate" in imports("client.cli.main", lazy=True)
    assert "client.cli.evaluate" not in imports("client.cli.main", lazy=False)
    assert "scas4d_core.reconstruction" in imports("scas4d_core.metrics.evaluation", lazy=True)
    assert "scas4d_core.reconstruction" not in imports("scas4d_core.metrics.evaluation", lazy=False)


@pytest.mark.parametrize("package", PACKAGES)
def test_the_product_imports_neither_studies_nor_tests(package: str) -> None:
    outside = ("studies", "tests", *(path.stem for path in (ROOT / "tests" / "helpers").glob("*.py")))
    for name in product():
        if within(name, (package,)):
            assert not [other for other in imports(name, lazy=True) if within(other, outside)], name


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


def test_workers_and_readers_start_without_heavy_packages() -> None:
    loaded = loaded_by("server.processes.worker", "server.processes.reader_process")
    assert not loaded & {"torch", "numba", "pycolmap", "sklearn", "scipy", "fastapi"}
