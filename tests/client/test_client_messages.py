"""What the `scas4d` command says where a user can mend something: one line with the remedy, never a traceback."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from waiting import HANG_S

from client.cli.extras import EXPORTS, SERVER, install_hint

pytestmark = pytest.mark.slow

FAKES = str(Path(__file__).parents[1] / "helpers")
ALONE = f"""
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {SERVER!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Missing())
"""


def scas4d(*arguments, before=(), **environment):
    path = os.pathsep.join([*map(str, before), FAKES, os.getcwd()])
    return subprocess.run(
        [sys.executable, "-m", "client.cli.main", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=HANG_S,
        env={**os.environ, "PYTHONPATH": path, "COLUMNS": "200", "NO_COLOR": "1", "TERM": "dumb", **environment},
    )


def refused(*arguments, **more):
    """The one line."""
    done = scas4d(*arguments, **more)
    assert done.returncode == 1, done.stdout + done.stderr
    assert done.stderr.startswith("scas4d: "), done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
    return done.stderr


@pytest.mark.parametrize(
    ("command", "extra"),
    [
        ("serve", "server"),
        ("demo --capture TINY --out OUT", "server"),
        ("reconstruct TINY --out OUT", "server"),
        ("evaluate TINY --out OUT", "server"),
    ],
)
def test_the_client_alone_names_what_to_install(capture_folder, tmp_path, command, extra):
    (tmp_path / "sitecustomize.py").write_text(ALONE)
    words = command.replace("TINY", str(capture_folder)).replace("OUT", str(tmp_path / "out")).split()
    said = refused(*words, before=[tmp_path])
    assert f"pip install -e '.[{extra}]'" in said


@pytest.mark.parametrize("package", EXPORTS)
def test_a_missing_package_of_an_extra_names_the_extra(package):
    said = install_hint(ModuleNotFoundError(f"No module named {package!r}", name=f"{package}.module"))
    assert said is not None
    assert package in said
    assert "pip install -e '.[exports]'" in said
    assert install_hint(ModuleNotFoundError("No module named 'other'", name="other")) is None


def test_the_client_alone_still_helps(tmp_path):
    (tmp_path / "sitecustomize.py").write_text(ALONE)
    for command in (["--help"], ["serve", "--help"], ["evaluate", "--help"]):
        assert scas4d(*command, before=[tmp_path]).returncode == 0


@pytest.mark.parametrize("command", ["reconstruct", "evaluate", "demo --capture"])
def test_a_folder_of_another_kind_is_told_the_layouts(tmp_path, command):
    said = refused(*command.split(), tmp_path, "--out", tmp_path / "out")
    for word in (str(tmp_path), "train_meta.json", "transforms.json", "COLMAP", "--calibration"):
        assert word in said


def test_evaluate_says_that_it_measures_on_the_training_cameras(capture_folder, tmp_path):
    for file in capture_folder.iterdir():
        if file.name != "test_meta.json":
            (tmp_path / file.name).symlink_to(file)
    done = scas4d("evaluate", tmp_path, "--out", tmp_path / "out", "--set", "update.iterations=2")
    assert done.returncode == 0
    assert "no test cameras: scoring the training cameras instead" in done.stdout


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("update.iterations=x", "setting update.iterations='x': "),
        (
            "update.iteration=4",
            "no such setting; did you mean update.iterations?",
        ),
    ],
)
def test_a_setting_that_cannot_be_is_named_with_its_value(capture_folder, tmp_path, change, said):
    for command in ("reconstruct", "evaluate"):
        line = refused(command, capture_folder, "--out", tmp_path, "--set", change)
        assert said in line
        assert "docs/settings.md" in line


def test_an_address_without_its_scheme(capture_folder):
    for command in (["push", capture_folder], ["scenes"], ["watch", "some"]):
        assert "use http://localhost:8000\n" in refused(*command, "--url", "localhost:8000")


def test_a_setting_of_the_service_is_named_with_its_value():
    assert "setting port has the invalid value 'abc'" in refused("serve", SCAS4D_PORT="abc")


def test_a_folder_that_cannot_be_written_is_one_line(capture_folder, tmp_path):
    (tmp_path / "file").touch()
    said = refused("demo", "--capture", capture_folder, "--out", tmp_path / "file" / "out")
    assert str(tmp_path / "file" / "out") in said


def test_the_help_names_every_preset():
    from client.cli.changes import PRESETS as named
    from scas4d_core.presets import PRESETS

    assert set(re.split(r", | or ", named.rstrip("."))) == set(PRESETS)
