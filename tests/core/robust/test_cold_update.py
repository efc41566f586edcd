"""Where no motion is known an update goes on once more from where it ended: there is far to go."""

from __future__ import annotations

import numpy as np
from box_scene import MOVING, make_box, make_rig, moved, take_frame
from scipy.spatial.transform import Rotation

from scas4d_core.first_frame.static_scene import StaticResult
from scas4d_core.frame_outcome import FrameOutcome
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings, UpdateSettings

RIG = make_rig()
BOX = make_box()
FAR = moved(BOX, Rotation.from_rotvec([0.05, 0.25, 0.0]), np.array([0.08, 0.0, -0.05]))
FURTHER = moved(BOX, Rotation.from_rotvec([0.1, 0.5, 0.0]), np.array([0.16, 0.0, -0.1]))
TWICE = ["as set", "on from where the update ended"]


def scene(**update: float) -> Reconstruction:
    settings = Settings(update=UpdateSettings(iterations=15, clusters=(2, 12), **update))  # type: ignore[arg-type]
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
