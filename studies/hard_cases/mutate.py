"""Mutation test of guards: disables each guard in a copy of the sources and records which cases fail.

The value in the copy's ``guards.py`` is replaced with the guard's ``without`` value. If the guard is a comparison
without a value, the edits in ``PATCHES`` are made instead. Compiled kernels of the copies are discarded. Results are
stored under a digest of the sources, so an interrupted study can be resumed.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import scas4d_core
from scas4d_core.guards import CONVENTIONS, GUARDS, Guard

CORE = Path(scas4d_core.__file__).parent
SECONDS = 900
"""Time limit of a run in seconds. A run that takes longer counts as failing."""
CONTROL = "nothing"
"""Name of the unchanged copy, on which all cases must pass."""

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
            "find_finite(np.ascontiguousarray(previous.means), np.ascontiguousarray(previous.factors), moving, sound)",
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
from importlib import import_module
from studies.hard_cases.run import backends, run_case
found = []
for section in sys.argv[1].split(","):
    for case in import_module("studies.hard_cases." + section).CASES:
        if not case.slow:
            lines = [run_case(case, size, backends()) for size in case.sizes]
            if any(line.violations for line in lines):
                found.append(case.name)
print("\\n" + json.dumps(found))
"""


class MutationError(RuntimeError):
    """Raised if a mutation cannot be made or measured. The message contains the mutation and the reason."""


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


def failing_without(guard: Guard | None, sections: list[str]) -> list[str]:
    """Returns the cases that fail without a guard, including those whose process crashes or hangs."""
    with tempfile.TemporaryDirectory(prefix="scas4d-mutation-") as folder:
        copy = Path(folder) / "scas4d_core"
        shutil.copytree(CORE, copy, ignore=shutil.ignore_patterns("__pycache__"))
        if guard is not None:
            take_away(guard, copy)
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join((folder, str(CORE.parent))),
            "NUMBA_CACHE_DIR": str(Path(folder) / "cache"),
        }
        command = [sys.executable, "-W", "ignore", "-c", PROGRAM, ",".join(sections)]
        try:
            done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=SECONDS)
        except subprocess.TimeoutExpired:
            return ["(the run hangs)"]
        if done.returncode != 0:
            if done.returncode < 0 and guard is not None:
                return ["(the run crashes)"]
            raise MutationError(f"the run without {guard.name if guard else CONTROL} failed: {done.stderr[-2000:]}")
        failing: list[str] = json.loads(done.stdout.strip().splitlines()[-1])
        return failing


LOOKED_AT = (
    "scas4d_core/guards.py", "scas4d_core/kernels/*.py", "scas4d_core/engines/limits.py",
    "scas4d_core/engines/cpu/[!ce]*.py", "scas4d_core/structure/*h*.py",
    "scas4d_core/engines/torch/deformation.py", "scas4d_core/engines/torch/losses.py",
    "scas4d_core/engines/torch/rasterizer.py", "scas4d_core/query/ply.py",
    "studies/hard_cases/ca*.py", "studies/hard_cases/*ing.py", "studies/hard_cases/geometry.py",
    "studies/hard_cases/cluster_map.py", "studies/hard_cases/steps.py",
)  # fmt: skip
"""Patterns of the files that determine the results of the mutations."""


def sources() -> str:
    """Returns a digest of the files that determine the results of the mutations."""
    hasher = hashlib.sha256()
    for path in sorted({path for pattern in LOOKED_AT for path in CORE.parent.glob(pattern)}):
        hasher.update(str(path.relative_to(CORE.parent)).encode() + path.read_bytes())
    return hasher.hexdigest()[:16]


def known(store: Path) -> dict[str, list[str]] | None:
    """Returns the results of ``study`` for the current sources, or None if they are incomplete."""
    file = store / f"mutations-{sources()}.json"
    results: dict[str, list[str]] = json.loads(file.read_text()) if file.exists() else {}
    stored = {guard.name: results[guard.name] for guard in mutants() if guard.name in results}
    return stored if len(stored) == len(list(mutants())) else None


def study(store: Path, echo: Callable[[str], None] = print) -> dict[str, list[str]]:
    """Disables each guard in turn and returns the cases that fail without it, keyed by guard.

    Args:
        store: results folder; results for the same sources are reused.
        echo: callback that prints progress messages.

    Raises:
        MutationError: a case fails on the unchanged copy, or a mutation cannot be made.
    """
    store.mkdir(parents=True, exist_ok=True)
    digest = sources()
    file = store / f"mutations-{digest}.json"
    results: dict[str, list[str]] = json.loads(file.read_text()) if file.exists() else {}
    if CONTROL not in results:
        results[CONTROL] = failing_without(None, [section for _, section in SECTIONS])
        file.write_text(json.dumps(results, indent=1))
    if results[CONTROL]:
        raise MutationError(f"cases fail with all guards in place: {', '.join(results[CONTROL])}; fix them first")
    for guard in mutants():
        if guard.name not in results:
            results[guard.name] = failing_without(guard, sections_of(guard))
            file.write_text(json.dumps(results, indent=1))
        cases = results[guard.name]
        echo(f"without {guard.name}: {', '.join(cases) if cases else 'NOTHING fails'}")
    return {name: cases for name, cases in results.items() if name != CONTROL}
