"""A compact file of the moving blob (`tests/helpers/export_cases/blob.py`), and a capture of its rig."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from export_cases.blob import BACKGROUND, BLOB, FRAMES, RATE, WORLD, make_rig, state, true_colour

from scas4d_core.cameras import Rig
from scas4d_core.captures import Capture
from scas4d_core.compact import CompactWriter, FileHeader


@pytest.fixture(scope="session")
def source(tmp_path_factory):
    """A folder like that of `scas4d reconstruct`."""
    folder = tmp_path_factory.mktemp("reconstructed")
    head = FileHeader(WORLD, background=BACKGROUND, rig=make_rig(), frames_per_second=RATE)
    with CompactWriter(folder / "states.s4d", head) as writer:
        for frame in range(FRAMES):
            writer.add(frame, frame / RATE, state(frame))
        writer.add_parts(FRAMES - 1, np.where(np.arange(len(state(0))) < BLOB, 1, -1))
    return folder


@pytest.fixture
def true_capture():
    """Pictures of one colour a frame, of the rig's cameras; `side` is held out."""
    front, side = make_rig().cameras
    reader = SimpleNamespace(
        frame_count=FRAMES,
        time=lambda index: None,
        image=lambda index, name: np.full((60, 80, 3), true_colour(index), np.uint8),
        has_mask=lambda index, name: False,
    )
    return Capture("made", Rig((front,)), Rig((side,)), reader, fps=RATE)
