"""``scripts/bench processors``: variation of a capture's results between processors and seeds.

A capture's first frames are reconstructed three times: without restrictions, with only AVX2, and as on a processor from
2008. Environment variables restrict the kernels (``NUMBA_CPU_NAME``), NumPy (``NPY_DISABLE_CPU_FEATURES``) and BLAS
(``OPENBLAS_CORETYPE``). For comparison, the updates are also run with other seeds. Each row, including its frame 0, is
computed in a separate process. Rows already on disk are recomputed only if ``scas4d_core`` has changed.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import statistics
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from client.cli.evaluate import Report
from client.cli.scores import Row, Store, digest
from scas4d_core.metrics import psnr
from studies.captures import open_measured
from studies.machine import core_version, machine
from studies.quality.settings import settings_of

PROCESSORS: Mapping[str, Mapping[str, str]] = {
    "this processor": {},
    "AVX2 and FMA": {
        "NUMBA_CPU_NAME": "x86-64-v3",
        "NUMBA_CPU_FEATURES": "",
        "OPENBLAS_CORETYPE": "Haswell",
        "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
    },
    "as of 2008": {
        "NUMBA_CPU_NAME": "generic",
        "NUMBA_CPU_FEATURES": "",
        "OPENBLAS_CORETYPE": "Nehalem",
        "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR",
    },
}
"""Environment variables that make an x86-64 processor compute like a less capable one."""


def run(
    captures: Sequence[Path], out: Path, *, frames: int, seeds: int, changes: Sequence[str] = (), report: Report = print
) -> bool:
    """Measures each capture on all ``PROCESSORS`` with seed 0, and on this processor with the other seeds.

    Args:
        captures: folders of captures with test cameras.
        out: study folder; a second call with the same folder resumes the study.
        frames: updates per run.
        seeds: number of seeds for the updates, starting at 0.
        changes: changes to the settings, such as ``update.iterations=20``.
        report: callback that prints progress messages.

    Returns:
        Whether the states of every capture are bit-identical on all processors.

    Raises:
        RuntimeError: a run failed; the message contains its last line of output.
    """
    store, rows = Store(out), []
    for capture in captures:
        for target, seed in [*((name, 0) for name in PROCESSORS), *(("this processor", k) for k in range(1, seeds))]:
            key = f"{capture.resolve().name}-{target.replace(' ', '-')}-s{seed}-{digest(frames, list(changes))}"
            row = store.row(key)
            if row is None or row["core"] != core_version():
                report(key)
                row = {"key": key, "capture": capture.resolve().name, "target": target, "seed": seed}
                row |= _apart(capture, PROCESSORS[target], frames, seed, changes)
                store.put(row)
            rows.append(row)
    text = table(rows)
    (out / "table.md").write_text(text + "\n")
    report(text)
    return all(same_bits(rows, name) for name in {row["capture"] for row in rows})


def same_bits(rows: Sequence[Row], capture: str) -> bool:
    """Returns whether the states of a capture are bit-identical on all measured processors."""
    own = [row for row in rows if row["capture"] == capture and row["seed"] == 0]
    return len({json.dumps(row["states"]) for row in own}) == 1


def table(rows: Sequence[Row]) -> str:
    """Returns a Markdown table with one row per capture.

    The columns are the PSNR in dB on each processor, whether the states are bit-identical, and the spread over seeds.
    """
    lines = [
        f"| capture | {' | '.join(PROCESSORS)} | states | seeds: spread (standard deviation) |",
        "|---" * (len(PROCESSORS) + 3) + "|",
    ]
    for name in dict.fromkeys(row["capture"] for row in rows):
        own = [row for row in rows if row["capture"] == name]
        by_target = {row["target"]: row for row in own if row["seed"] == 0}
        means = [f"{statistics.fmean(by_target[target]['psnr']):.2f} dB" for target in PROCESSORS]
        by_seed = [statistics.fmean(row["psnr"]) for row in own if row["target"] == "this processor"]
        spread = f"{max(by_seed) - min(by_seed):.2f} dB"
        if len(by_seed) > 1:
            spread += f" ({statistics.stdev(by_seed):.2f} dB, {len(by_seed)} seeds)"
        lines.append(
            f"| {name} | {' | '.join(means)} | {'the same bits' if same_bits(rows, name) else 'differ'} | {spread} |"
        )
    return "\n".join(lines)


def measure(capture: Path, frames: int, seed: int, changes: Sequence[str]) -> Row:
    """Runs frame 0 and ``frames`` updates in this process and returns the row.

    The row contains the mean test PSNR of each update in dB, and a digest of the state of each frame.
    """
    from scas4d_core.reconstruction import Reconstruction
    from scas4d_core.warm_up import compile_in_processes

    compile_in_processes()
    opened = open_measured(capture)
    assert opened.test_rig is not None
    settings = settings_of("scas4d", changes=changes)
    settings = settings.model_copy(update={"update": settings.update.model_copy(update={"seed": seed})})
    scene = Reconstruction.start(opened.rig, opened.frame(0), settings, points=opened.points)
    row: Row = {"psnr": [], "states": [], "core": core_version(), "machine": machine()}
    for index in range(min(frames + 1, opened.frame_count)):
        if index:
            scene.step(opened.frame(index))
            truth = opened.test_frame(index)
            views = [scene.render(camera, index).colour for camera in opened.test_rig.cameras]
            truths = [truth.images[camera.name] / np.float32(255) for camera in opened.test_rig.cameras]
            row["psnr"].append(float(np.mean([psnr(a, b) for a, b in zip(views, truths, strict=True)])))
        hasher = hashlib.sha256()
        for array in scene.history.gaussians(index).arrays().values():
            hasher.update(np.ascontiguousarray(array).tobytes())
        row["states"].append(hasher.hexdigest()[:16])
    return row


def _apart(capture: Path, target: Mapping[str, str], frames: int, seed: int, changes: Sequence[str]) -> dict[str, Any]:
    present = os.environ | dict(target)
    if "NPY_DISABLE_CPU_FEATURES" in target:  # numpy warns about missing features
        numpy_core: Any = importlib.import_module("numpy._core._multiarray_umath")
        features: Mapping[str, bool] = numpy_core.__cpu_features__
        wanted = target["NPY_DISABLE_CPU_FEATURES"].split()
        present["NPY_DISABLE_CPU_FEATURES"] = " ".join(name for name in wanted if features.get(name))
    program = "import json, sys; from studies.quality import processors as p; from pathlib import Path; "
    program += "a = json.loads(sys.argv[1]); print(json.dumps(p.measure(Path(a[0]), *a[1:])))"
    given = json.dumps([str(capture), frames, seed, list(changes)])
    done = subprocess.run([sys.executable, "-c", program, given], env=present, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{capture} failed: {done.stderr.strip().splitlines()[-1:]}")
    row: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return row
