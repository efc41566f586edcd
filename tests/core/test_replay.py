"""Frames updated again in memory: the same as the scene itself would have done, and nothing on disk is touched."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from box_scene import SHIFT, make_box, make_rig, moved, take_frame
from scipy.spatial.transform import Rotation

from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.frame_report import FrameReport
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.replay import replay, summary
from scas4d_core.settings import Settings, UpdateSettings
from scas4d_core.storage.history import History, UnreadableFrameError

BOX, RIG = make_box(), make_rig()
TURN = Rotation.from_rotvec([0, 0.06, 0])
FRAMES = [take_frame(k, 0.1 * k, moved(BOX, TURN**k, k * SHIFT), RIG) for k in range(5)]
SETTINGS = Settings(
    update=UpdateSettings(iterations=6, clusters=(2, 12), skip_tolerance=0.5, stop_gain=0.5, budget_ms=5)
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("states")
    scene = Reconstruction.start(RIG, FRAMES[0], SETTINGS, history=History(folder), static=StaticResult(BOX, {}, [0.5]))
    for frame in FRAMES[1:]:
        scene.step(frame)
    return folder


def digests(folder):
    return {path.name: hashlib.sha256(path.read_bytes()).digest() for path in folder.iterdir()}


def given(*indices):
    return [lambda index=index: (FRAMES[index], {}) for index in indices]


def test_it_is_the_update_with_so_many_iterations_and_neither_clock_nor_stop_rule(folder):
    before = digests(folder)
    told = []
    found = replay(RIG, SETTINGS, History.load(folder), 0, given(1, 2, 3, 4), 12, lambda: told.append(1))
    assert (found.iterations, found.frames, len(told)) == (12, 3, 4)
    assert digests(folder) == before
    plain = Settings(update=SETTINGS.update.model_copy(update={"iterations": 12, "budget_ms": None, "stop_gain": 0.0}))
    plain = plain.model_copy(update={"update": plain.update.model_copy(update={"skip_tolerance": -1.0})})
    scene = Reconstruction.start(RIG, FRAMES[0], plain, static=StaticResult(BOX, {}, [0.5]))
    reports = [scene.step(frame) for frame in FRAMES[1:]]
    assert [len(report.loss) for report in reports] == [36, 12, 12, 12]  # the first finds the motion
    assert found.psnr == pytest.approx(np.mean([report.psnr for report in reports[1:]]), abs=0.5)


def test_more_iterations_show_the_frames_better(folder):
    history = History.load(folder)
    few, many = (replay(RIG, SETTINGS, history, 0, given(1, 2, 3), count) for count in (2, 400))
    assert many.error < few.error
    assert many.psnr > few.psnr
    assert many.milliseconds > few.milliseconds > 0


def test_it_starts_from_any_committed_frame_and_refuses_others(folder):
    assert replay(RIG, SETTINGS, History.load(folder), 2, given(3, 4), 3).frames == 1
    with pytest.raises(UnreadableFrameError):
        replay(RIG, SETTINGS, History.load(folder), 9, given(3, 4), 3)


def test_frames_that_were_not_met_do_not_count_unless_all_are():
    def report(milliseconds, error, **more):
        seconds = {"decode": milliseconds / 1000}
        return FrameReport(0, 0.0, 5, seconds, [0.1], 30.0, 1, 1, errors={"end": error, "previous": 9.0}, **more)

    clean, held = report(10, 0.1), report(99, 0.9, degraded="previous state kept: dark", candidate="previous")
    tried = report(50, 0.5, attempts=["as set: 9 are not finite", "smaller steps"])
    found = summary(5, [clean, held, tried])
    assert (found.milliseconds, found.error, found.frames) == (pytest.approx(10), 0.1, 1)
    assert summary(5, [held]).error == 9.0
