"""The same input, seed and settings give the same bits, whatever the number of threads: frame 0 and updates."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

PROGRAM = Path(__file__).parent / "committed_bits.py"
LIBRARIES = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def committed(threads: int) -> dict[str, object]:
    """What a process with so many threads commits."""
    environment = {**os.environ, **dict.fromkeys(LIBRARIES, str(threads)), "PYTHONPATH": str(PROGRAM.parents[2])}
    done = subprocess.run(
        [sys.executable, str(PROGRAM), "0.5"], env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]
    found: dict[str, object] = json.loads(done.stdout)
    assert found.pop("threads") == threads
    return found


def test_frame_0_updates_and_parts_are_the_same_for_one_thread_and_two() -> None:
    one, two = committed(1), committed(2)
    assert one == two
    assert len(one) == 14
    assert len(set(one.values())) == len(one)  # every state, report and set of parts is another
