"""A light that changes for ever: it is taken on within the scene's patience, with masks or without."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from frame_cases import footage as frames_footage
from frame_cases.footage import SyntheticFootage

from scas4d_core.captures.frame import Frame
from scas4d_core.effect_names import Mode
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.frame_outcome import Candidate, FrameOutcome
from scas4d_core.frame_report import FrameReport
from scas4d_core.metrics import psnr
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.robust.checks import ALIKE, EXPOSURE, light_continues, record_brightness, with_light
from scas4d_core.robust.outliers import Past
from scas4d_core.settings import Settings
from scas4d_core.storage.history import History

pytestmark = pytest.mark.slow

PATIENCE = 4
FROM = 4
"""The first frame in the other light."""
LAST = FROM + PATIENCE + 1
"""The third one in which it is the usual light."""
WITHIN_DB = 0.5
GOING_DB = 1.5
"""The same of a light that still goes on: divided out of the pictures it would be 10 dB and more."""

NOISE = 1.0
"""Levels of 255: with more of it, what seems to move without masks differs from light to light."""

GIVEN: Settings = SyntheticFootage().settings
PINNED: dict[str, Mode] = {"static_colour": "on", "shadows": "off"}
"""The state was not fitted to pictures: what stands has to learn its colours, whether they change or not."""
SETTINGS = GIVEN.model_copy(
    update={"update": GIVEN.update.model_copy(update={"max_rejected_frames": PATIENCE}), "effects": PINNED}
)
FOOTAGE = SyntheticFootage(SETTINGS)


@pytest.fixture(autouse=True)
def quiet(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frames_footage, "NOISE", NOISE)


def brighten(pictures: dict[str, np.ndarray], light: float) -> dict[str, np.ndarray]:
    return {name: (light * picture).round().clip(0, 255).astype(np.uint8) for name, picture in pictures.items()}


def sent(index: int, light: float, masks: bool) -> Frame:
    frame = FOOTAGE.frame(index)
    return replace(frame, images=brighten(dict(frame.images), light), masks=frame.masks if masks else {})


def started(light: float, masks: bool) -> Reconstruction:
    state = FOOTAGE._fitted()
    state = state.replace(colours=(light * state.colours).clip(0, 1).astype(np.float32))
    if not masks:
        state = state.replace(foreground=np.zeros(len(state), np.float32))
    static = StaticResult(state, {}, [])
    return Reconstruction.start(FOOTAGE.rig, sent(0, light, masks), SETTINGS, history=History(), static=static)


def run(lights: list[float], masks: bool) -> tuple[list[float], list[FrameReport], Reconstruction]:
    """DB of the cameras held out in each frame's own light, and the reports."""
    scene, found, reports = started(lights[0], masks), [], []
    for index in range(1, len(lights)):
        reports.append(scene.step(sent(index, lights[index], masks)))
        truth = brighten(dict(FOOTAGE.truth(index)), lights[index])
        shown = {camera.name: scene.render(camera, index).colour for camera in FOOTAGE.held_out}
        found.append(float(np.mean([psnr(shown[name], truth[name]) for name in shown])))
    return found, reports, scene


@pytest.mark.parametrize("light", [0.3, 0.7, 1.4, 2.5])
@pytest.mark.parametrize("masks", [False, True])
def test_a_light_that_stays_is_taken_on(light: float, masks: bool) -> None:
    found, reports, scene = run([1.0] * FROM + [light] * (LAST - FROM + 1), masks)
    usual, _, other = run([light] * (LAST + 1), masks)
    accepted = reports[FROM - 1 + PATIENCE - 1]
    assert ", permanently" in accepted.attempts[0]
    for report in reports[FROM - 1 + PATIENCE :]:
        assert (report.exposure, report.degraded, report.dropped) == (1.0, None, {})
    assert found[-1] >= usual[-1] - WITHIN_DB
    assert scene.history.gaussians(LAST).moving.sum() >= 0.9 * other.history.gaussians(LAST).moving.sum()


def test_a_light_that_flickers_is_not_taken_on() -> None:
    """Nor is darkness; saturated pictures make a light seem less at first, it may change a while."""
    past = Past()
    for light in (1.3, 0.8, 1.3, 1.3, 1.31, 1.0):
        past = with_light(past, light)
    assert past.light_frames == 0
    counts = []
    for light in (1.3, 0.8, 1.3, 1.3, 1.33, 2.4, 2.5, 0.02, 0.0):
        past = with_light(past, light)
        counts.append(past.light_frames)
    assert counts == [1, 1, 1, 2, 3, 4, 5, 0, 0]


def test_the_light_is_part_of_what_is_carried_on() -> None:
    past = with_light(with_light(Past(), 1.4), 1.41)
    again = Past.of_arrays(past.arrays())
    assert (again.light, again.light_frames) == (1.41, 2)


def test_frames_that_were_held_or_stood_are_told_as_they_are() -> None:
    scene = started(1.0, True)
    moved = scene.step(sent(1, 1.0, True))
    again = scene.step(replace(sent(1, 1.0, True), index=2, time=2 / 30))
    dark = scene.step(sent(3, 0.02, True))
    outcomes = [report.outcome for report in (moved, again, dark)]
    assert outcomes == [FrameOutcome.UPDATED, FrameOutcome.UNCHANGED, FrameOutcome.REJECTED_UNUSABLE]
    assert (moved.used, moved.candidate) == (list(FOOTAGE.rig.names), "end")
    assert (again.used, again.iterations, again.candidate, again.exposure) == ([], 0, "previous", 1.0)
    assert (dark.used, dark.iterations, dark.candidate, dark.errors) == ([], 0, "previous", {})
    assert dark.exposure == pytest.approx(0.02, abs=0.01)
    upside_down = {name: image[::-1].copy() for name, image in sent(4, 1.2, True).images.items()}
    held = scene.step(replace(sent(4, 1.0, True), images=upside_down))
    assert (held.used, held.candidate, held.outcome) == ([], "previous", FrameOutcome.REJECTED_MISFIT)
    assert str(held.degraded).startswith("previous state kept: ")
    assert held.exposure > 1.0
    assert held.errors[Candidate.END] < held.errors[Candidate.PREVIOUS]


DIMS = [1.0, 0.99, 0.97, 0.94, 0.90, 0.85, 0.79, 0.73, 0.68]
"""A lamp that dims slowly at first; its steps are as fast as those of one that crosses a room, and a little faster."""


@pytest.mark.parametrize(
    "light", [DIMS, [1.0, 1.0, 1.0, *(0.9**k for k in range(1, 5))], [1.1**-k for k in range(4, 0, -1)]]
)
def test_a_light_that_goes_on_is_followed_at_once(light: list[float]) -> None:
    """Slow or fast, darker or brighter: of a step that is like the one before nothing is taken out of the pictures."""
    found, reports, _ = run(light, masks=True)
    usual, _, _ = run([light[-1]] * len(light), masks=True)
    steps = [now / before for before, now in pairwise(light)]
    alike = [1 / EXPOSURE < steps[0] < EXPOSURE] + [1 / ALIKE < now / before < ALIKE for before, now in pairwise(steps)]
    assert any("permanently" in report.attempts[0] for report in reports)
    assert all(report.exposure == 1.0 for report, like in zip(reports, alike, strict=True) if like)
    assert found[-1] >= usual[-1] - GOING_DB


def test_lights_that_flicker_or_jump_do_not_go_on() -> None:
    bright = dict.fromkeys("abcdefgh", 0.4)
    for lights, goes in (
        ([1, 1.3, 1, 1.3, 1], [False, False, False, False]),
        ([1, 1.1, 1 / 1.1, 1.1, 1 / 1.1], [False, False, False, False]),
        ([1, 1.4, 1.4, 1.4, 1.41], [False, False, False, False]),
        ([1, 0.96, 0.93, 0.9], [False, False, False]),  # each step is too small to be told from noise
        ([1, 0.9, 0.81, 0.73, 0.73], [False, True, True, False]),
    ):
        past, found = record_brightness(Past(), bright), []
        for light in lights[1:]:
            pictures = {name: light * value for name, value in bright.items()}
            found.append(light_continues(past, pictures))
            past = Past.of_arrays(record_brightness(past, pictures).arrays())
        assert found == goes
