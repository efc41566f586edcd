"""An update without a motion to start from has more iterations: there is far to go."""

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


def scene(effects: dict[str, Any] | None = None, **update: float) -> Reconstruction:
    made = UpdateSettings(iterations=15, clusters=(2, 12), **update)  # type: ignore[arg-type]
    settings = Settings(update=made, effects=effects or {})
    return Reconstruction.start(RIG, take_frame(0, 0.0, BOX, RIG), settings, static=StaticResult(BOX, {}, []))


def missed(one: Reconstruction, truth: np.ndarray) -> float:
    return float(np.linalg.norm(one.history.newest.means - truth, axis=1)[:MOVING].mean())


def test_the_first_update_is_longer_and_the_next_is_not() -> None:
    short, iteration_factor = scene(cold_start_iterations=1.0), scene()
    reports = [one.step(take_frame(1, 0.1, FAR, RIG)) for one in (short, iteration_factor)]
    assert [report.attempts for report in reports] == [["as set"], ["as set, best of 3 view orders"]]
    assert [(report.iterations, report.outcome) for report in reports] == [
        (15, FrameOutcome.UPDATED),
        (45, FrameOutcome.UPDATED),
    ]
    assert missed(iteration_factor, FAR.means) < 0.8 * missed(short, FAR.means)
    assert iteration_factor.step(take_frame(2, 0.2, FURTHER, RIG)).iterations == 15


def test_its_motion_is_gone_on_with() -> None:
    one = scene()
    one.step(take_frame(1, 0.1, FAR, RIG))
    motion = one._prepared.carried.motion
    assert motion is not None
    gone = np.linalg.norm(motion.shifts[0], axis=1).mean()
    way = np.linalg.norm(FAR.means - BOX.means, axis=1)[:MOVING].mean()
    assert 0.5 * way < gone < 2 * way


def test_a_budget_in_milliseconds_is_kept() -> None:
    one = scene(budget_ms=1.0)
    assert one.step(take_frame(1, 0.1, FAR, RIG)).iterations < 45


def test_where_nothing_moves_there_is_nothing_to_go_on_with() -> None:
    one = scene()
    report = one.step(take_frame(1, 0.1, BOX, RIG))
    assert (report.outcome, report.iterations) == (FrameOutcome.UNCHANGED, 0)
    np.testing.assert_array_equal(one.history.newest.means, BOX.means)


def test_a_later_update_without_a_motion_is_longer_too() -> None:
    one = scene()
    one.step(take_frame(1, 0.1, FAR, RIG))
    one._prepared = one._prepared.with_carry_over(motion=None)  # as where the motion that was found is not finite
    assert one.step(take_frame(2, 0.2, FURTHER, RIG)).iterations == 45


def test_while_the_light_changes_no_frame_stands() -> None:
    rng = np.random.default_rng(0)
    for mode, iterations in (("off", 0), ("on", 15)):
        one = scene(effects={"light": mode}, skip_tolerance=1.0)
        for index in (1, 2, 3):
            still = take_frame(index, 0.1 * index, FAR, RIG)
            noisy = {name: image ^ rng.integers(0, 2, image.shape, np.uint8) for name, image in still.images.items()}
            report = one.step(replace(still, images=noisy))
        assert report.iterations == iterations
