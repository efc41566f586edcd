"""The first update of a scene goes on once more from where it ended: there is far to go."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from box_scene import MOVING, make_box, make_rig, moved, take_frame
from scipy.spatial.transform import Rotation

from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.frame_outcome import FrameOutcome
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings, UpdateSettings

RIG = make_rig()
BOX = make_box()
FAR = moved(BOX, Rotation.from_rotvec([0.05, 0.25, 0.0]), np.array([0.08, 0.0, -0.05]))
FURTHER = moved(BOX, Rotation.from_rotvec([0.1, 0.5, 0.0]), np.array([0.16, 0.0, -0.1]))
TWICE = ["as set", "on from where the update ended"]


def scene(effects: dict[str, Any] | None = None, **update: float) -> Reconstruction:
    made = UpdateSettings(iterations=15, clusters=(2, 12), **update)  # type: ignore[arg-type]
    settings = Settings(update=made, effects=effects or {})
    return Reconstruction.start(RIG, take_frame(0, 0.0, BOX, RIG), settings, static=StaticResult(BOX, {}, []))


def missed(one: Reconstruction, truth: np.ndarray) -> float:
    return float(np.linalg.norm(one.history.newest.means - truth, axis=1)[:MOVING].mean())


def test_the_first_update_goes_on_from_where_it_ended_and_the_next_does_not() -> None:
    once, twice = scene(cold_longer=1.01), scene()  # 15 iterations both
    reports = [one.step(take_frame(1, 0.1, FAR, RIG)) for one in (once, twice)]
    assert [report.attempts for report in reports] == [["as set"], TWICE]
    assert [(report.iterations, report.outcome) for report in reports] == 2 * [(15, FrameOutcome.UPDATED)]
    assert missed(twice, FAR.means) < 0.8 * missed(once, FAR.means)
    assert twice.step(take_frame(2, 0.2, FURTHER, RIG)).attempts == ["as set"]


def test_the_motion_of_both_is_gone_on_with() -> None:
    one = scene()
    one.step(take_frame(1, 0.1, FAR, RIG))
    motion = one._carried.motion
    assert motion is not None
    gone = np.linalg.norm(motion.shifts[0], axis=1).mean()
    way = np.linalg.norm(FAR.means - BOX.means, axis=1)[:MOVING].mean()
    assert 0.5 * way < gone < 2 * way


def test_an_update_that_was_longer_for_it_does_not_go_on() -> None:
    report = scene(cold_longer=2.0).step(take_frame(1, 0.1, FAR, RIG))
    assert (report.iterations, report.attempts) == (30, ["as set"])


def test_a_budget_is_kept_and_without_the_judge_nothing_is_compared() -> None:
    for one in (scene(budget_ms=2000.0), scene(judge=False)):
        assert one.step(take_frame(1, 0.1, FAR, RIG)).attempts == ["as set"]


def test_where_nothing_moves_there_is_nothing_to_go_on_with() -> None:
    one = scene()
    report = one.step(take_frame(1, 0.1, BOX, RIG))
    assert (report.outcome, report.iterations) == (FrameOutcome.STOOD, 0)
    np.testing.assert_array_equal(one.history.newest.means, BOX.means)


def test_a_later_update_without_a_motion_does_not_go_on() -> None:
    one = scene()
    one.step(take_frame(1, 0.1, FAR, RIG))
    one._carried = replace(one._carried, motion=None)  # as where labels, clusters or neighbours are made anew
    assert one.step(take_frame(2, 0.2, FURTHER, RIG)).attempts == ["as set"]


def test_while_the_light_changes_no_frame_stands() -> None:
    rng = np.random.default_rng(0)
    for mode, iterations in (("off", 0), ("on", 15)):
        one = scene(effects={"light": mode}, still=1.0)
        for index in (1, 2, 3):
            still = take_frame(index, 0.1 * index, FAR, RIG)
            noisy = {name: image ^ rng.integers(0, 2, image.shape, np.uint8) for name, image in still.images.items()}
            report = one.step(replace(still, images=noisy))
        assert report.iterations == iterations
