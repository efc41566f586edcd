"""The past goes through a checkpoint: after a held frame, and with a camera left out, a scene taken up again goes
on with the same bits."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from frame_cases import cases as frames
from frame_cases.cases import Sent, each
from frame_cases.footage import SyntheticFootage

from scas4d_core.captures.frame import Frame
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.storage.history import History
from studies.constants import all_varied

FOOTAGE = SyntheticFootage()
AT = 2


@pytest.fixture(scope="module", autouse=True)
def constants() -> Iterator[None]:
    """Those of the footage hold when a scene is resumed, too."""
    with all_varied(SyntheticFootage.constants):
        yield


def shown(sent: Sequence[Sent]) -> list[Frame]:
    """Two good frames, what is sent, numbered on."""
    given = [FOOTAGE.frame(1), *(one.frame for one in sent)]
    return [replace(frame, index=k + 1, time=(k + 1) / 30) for k, frame in enumerate(given)]


SEQUENCES = {
    "held": shown(frames.filled(0)(FOOTAGE, AT, 2) or []),
    "left out": shown(frames.swapped(FOOTAGE, AT, 2)),
    "bumped": shown(frames.bumped(FOOTAGE, AT, 4)),
    "flickers": shown(
        frames.replaced(
            FOOTAGE, AT, 2,
            lambda number, frame: each(frame, lambda name, picture: (0.7 * picture).astype(np.uint8)),
        )
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", SEQUENCES)
def test_a_scene_taken_up_again_goes_on_with_the_same_bits(kind: str, tmp_path: Path) -> None:
    sent = SEQUENCES[kind]
    whole = FOOTAGE.start(tmp_path / "whole")
    reports = []
    for frame in sent:
        reports.append(whole.step(frame))
        shutil.copytree(tmp_path / "whole", tmp_path / f"after{frame.index}")
    assert any(report.degraded or report.dropped or report.exposure != 1 for report in reports)
    for index in range(1, len(sent)):
        scene = Reconstruction.resume(FOOTAGE.rig, FOOTAGE.settings, History.open(tmp_path / f"after{index}"))
        assert scene.resumed is not None
        assert (scene.resumed.index, scene.resumed.cold) == (index, False)
        report = scene.step(sent[index])
        assert (report.degraded, report.dropped, report.exposure, report.loss) == (
            reports[index].degraded,
            reports[index].dropped,
            reports[index].exposure,
            reports[index].loss,
        )
        expected, found = whole.history.gaussians(index + 1).arrays(), scene.history.gaussians(index + 1).arrays()
        for name, array in expected.items():
            np.testing.assert_array_equal(found[name], array, err_msg=f"{kind}, after frame {index}: {name}")
