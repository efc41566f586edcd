"""`scripts/bench`: it runs from any folder, lists every study, and says what is not installed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from waiting import HANG_S

ROOT = Path(__file__).parents[2]
WITHOUT = """
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "MISSING":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Missing())
"""


def bench(*arguments: object, folder: Path, before: Path | None = None) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "COLUMNS": "200", "NO_COLOR": "1", "TERM": "dumb"}
    environment.pop("PYTHONPATH", None)
    if before is not None:
        environment["PYTHONPATH"] = str(before)
    command = [str(ROOT / "scripts" / "bench"), *map(str, arguments)]
    if not (ROOT / ".venv" / "bin" / "python").exists():  # installed elsewhere: the same without the shell
        environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), environment.get("PYTHONPATH", "")])
        command = [sys.executable, "-m", "studies", *map(str, arguments)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=HANG_S, env=environment)


def test_it_lists_every_study_from_any_folder(tmp_path: Path) -> None:
    done = bench("--help", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Usage: scripts/bench" in done.stdout
    for room in sorted(path.parent.name for path in (ROOT / "studies").glob("*/commands.py")):
        text = (ROOT / "studies" / room / "commands.py").read_text()
        functions = [line.split("(")[0].split()[-1] for line in text.splitlines() if line.startswith("def ")]
        for command in (name.replace("_", "-") for name in functions if not name.startswith("_")):
            assert f" {command} " in done.stdout, f"{room}: {command} is not listed"


@pytest.mark.parametrize("missing", ["matplotlib", "typer", "scipy"])
def test_it_says_what_to_do_where_a_package_is_missing(tmp_path: Path, missing: str) -> None:
    (tmp_path / "sitecustomize.py").write_text(WITHOUT.replace("MISSING", missing))
    done = bench("frontier", tmp_path, "--out", tmp_path / "out", "--only", "page", folder=tmp_path, before=tmp_path)
    assert done.returncode == 1, done.stdout + done.stderr
    assert done.stderr == (
        f"scripts/bench: this command requires {missing}, which is not installed; run in the checkout: scripts/setup "
        "dev\n"
    )


def test_without_a_set_up_it_says_so(tmp_path: Path) -> None:
    (tmp_path / "scripts").mkdir()
    (tmp_path / "scripts" / "bench").write_text((ROOT / "scripts" / "bench").read_text())
    command = ["sh", tmp_path / "scripts" / "bench", "targets"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=HANG_S)
    assert done.returncode == 1
    assert "scripts/setup dev" in done.stderr
