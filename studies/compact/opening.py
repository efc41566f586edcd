"""``scripts/bench opening``: time to open and read a history of many frames in compact files."""

from __future__ import annotations

import time
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import numpy as np

from scas4d_core.cameras import WorldFrame
from scas4d_core.compact import CompactWriter, FileHeader
from scas4d_core.gaussians import Gaussians
from scas4d_core.storage.chunks import chunk_file, make_note
from scas4d_core.storage.compaction import CHUNK_FRAMES
from scas4d_core.storage.history import History

GAUSSIANS = 200
"""Number of Gaussians per state. Opening a history only locates its states, so their size does not matter."""
EXACT, TURNS, READS = 48, 5, 200


def opening(frames: int) -> str:
    """Creates a history of ``frames`` frames, times opening and reading it, and returns the result as a sentence."""
    with TemporaryDirectory() as temporary:
        folder = Path(temporary) / "states"
        _fill(folder, frames)
        seconds = []
        for _ in range(TURNS):
            began = time.process_time()
            history = History.load(folder)
            seconds.append(time.process_time() - began)
        draw = np.random.default_rng(0)
        reads = []
        for index in draw.integers(1, frames - EXACT, READS).tolist():
            began = time.process_time()
            history.gaussians(index)
            reads.append(time.process_time() - began)
        files = len(list(folder.glob("states_*.s4d")))
    return (
        f"{frames:,} frames, {frames - EXACT - 1:,} of them in {files} compact files: opened in "
        f"{median(seconds):.2f} s of CPU time (median of {TURNS}); a random state of {GAUSSIANS} Gaussians read in "
        f"{1e3 * median(reads):.1f} ms"
    )


def _fill(folder: Path, frames: int) -> None:
    """Writes a history as the service does: the first and newest frames exact, the others in compact files."""
    state = Gaussians.of_points(np.random.default_rng(0).uniform(-1, 1, (GAUSSIANS, 3)), 0.02)
    history = History(folder)
    history.append(0, 0.0, state, report={})
    exact = frames - EXACT
    for first in range(1, exact, CHUNK_FRAMES):
        with CompactWriter(folder / chunk_file(first), FileHeader(WorldFrame(np.zeros(3)))) as writer:
            for index in range(first, min(exact, first + CHUNK_FRAMES)):
                writer.add(index, index / 30, state, note=make_note({}, history.log_at(0), writer.last_frame))
    for index in range(exact, frames):
        history.append(index, index / 30, state, report={})
