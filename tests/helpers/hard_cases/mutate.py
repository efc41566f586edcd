"""Mutation test of guards: disables each guard in a copy of the sources and records which cases fail.

The value in the copy's ``guards.py`` is replaced with the guard's ``without`` value. If the guard is a comparison
without a value, the edits in ``PATCHES`` are made instead. Compiled kernels of the copies are discarded.
"""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import scas4d_core
from scas4d_core.guards import CONVENTIONS, GUARDS, Guard

CORE = Path(scas4d_core.__file__).parent
HELPERS = Path(__file__).parents[1]
SECONDS = 900
"""Time limit of a run in seconds. A run that takes longer counts as failing."""

PATCHES: dict[str, tuple[tuple[str, str, str], ...]] = {
    "not_finite": (
        (
            "kernels/projection.py",
            "sound = lanes.choose(size <= FARTHEST, sound_features(features, first), zero)",
            "sound = lanes.fill(ONE)",
        ),
    ),
    "gradient_not_finite": (
        (
            "kernels/projection.py",
            "steep = not lanes.sum_of(worst) <= STEEPEST",
            "steep = lanes.sum_of(worst) < ZERO",
        ),
        ("kernels/projection.py", "if not steep <= STEEPEST:", "if False:"),
    ),
    "held_back": (
        (
            "engines/cpu/deformation.py",
            "sound &= np.isfinite(previous.factors[moving]).all(axis=(1, 2))",
            "sound[:] = True",
        ),
    ),
    "left_out_of_hierarchy": (
        ("structure/hierarchy.py", "finite = np.isfinite(means).all(axis=1)", "finite = np.ones(len(means), bool)"),
    ),
}
"""Edits that disable each guard: a file, a text that occurs in it exactly once, and its replacement."""

SECTIONS = (
    (("projection", "tiles", "limits", "twin"), "geometry"),
    (("cascade", "deformation", "neighbour_terms", "lanes"), "cluster_map"),
    (("adam", "activation", "image_loss", "hierarchy", "losses", "jit"), "steps"),
)
"""Each entry pairs the names of files that contain guards with the module whose cases exercise these guards."""

PROGRAM = """
import json, sys
from hard_cases.run import SECTIONS, backends, violations
cases = [case for name in sys.argv[1].split(",") for case in SECTIONS[name] if not case.slow]
found = [case.name for case in cases if any(violations(case, size, backends()) for size in case.sizes)]
print("\\n" + json.dumps(found))
"""


class MutationError(RuntimeError):
    """Raised if a mutation cannot be made or measured."""


def mutants() -> Iterator[Guard]:
    """Yields every guard and convention that the study disables."""
    yield from GUARDS.values()
    yield from CONVENTIONS.values()


def take_away(guard: Guard, core: Path) -> None:
    """Edits a copy of ``scas4d_core`` to disable a guard.

    Raises:
        MutationError: the text to replace does not occur exactly once.
    """
    if math.isnan(guard.without):
        edits = PATCHES[guard.name]
    else:
        text = (core / "guards.py").read_text()
        values = re.findall(rf'^    "{guard.name}", [^,]+, ([^,]+),$', text, re.MULTILINE)
        old = re.findall(rf'^    "{guard.name}", [^,]+, [^,]+,$', text, re.MULTILINE)
        if len(old) != 1:
            raise MutationError(f"expected one row for guard {guard.name!r} in guards.py, got {len(old)}")
        edits = (("guards.py", old[0], f'    "{guard.name}", {values[0]}, {values[0]},'),)
    for name, old_text, new_text in edits:
        path = core / name
        text = path.read_text()
        if text.count(old_text) != 1:
            raise MutationError(
                f"expected {old_text!r} once in {name}, found it {text.count(old_text)} times; fix the patch of "
                f"{guard.name}"
            )
        path.write_text(text.replace(old_text, new_text))


def sections_of(guard: Guard) -> list[str]:
    """Returns the modules whose cases exercise a guard."""
    return [section for names, section in SECTIONS if any(name in guard.where for name in names)]


def failing_without(guard: Guard) -> list[str]:
    """Returns the cases that fail without a guard, including those whose process crashes or hangs."""
    with tempfile.TemporaryDirectory(prefix="scas4d-mutation-") as folder:
        copy = Path(folder) / "scas4d_core"
        shutil.copytree(CORE, copy, ignore=shutil.ignore_patterns("__pycache__"))
        take_away(guard, copy)
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join((folder, str(HELPERS), str(CORE.parent))),
            "NUMBA_CACHE_DIR": str(Path(folder) / "cache"),
        }
        command = [sys.executable, "-W", "ignore", "-c", PROGRAM, ",".join(sections_of(guard))]
        try:
            done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=SECONDS)
        except subprocess.TimeoutExpired:
            return ["(the run hangs)"]
        if done.returncode != 0:
            if done.returncode < 0:
                return ["(the run crashes)"]
            raise MutationError(f"the run without {guard.name} failed: {done.stderr[-2000:]}")
        failing: list[str] = json.loads(done.stdout.strip().splitlines()[-1])
        return failing
