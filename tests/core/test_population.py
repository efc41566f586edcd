"""Scenes in which an effect bears, retires and revives Gaussians: and that they resume with their bits."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from box_scene import MOVING, SHIFT, make_box, make_rig, moved, take_frame
from effect_cases.populating import NAME, install, plan
from scipy.spatial.transform import Rotation

from scas4d_core.captures.frame import Frame, InitialPoints
from scas4d_core.effects import effect as effect_module
from scas4d_core.effects.evidence import FrameObservation
from scas4d_core.engines.cpu.engine import CpuEngine
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.recompute import recompute
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.robust.solve_frame import FrameSolver, Solved
from scas4d_core.robust.update_input import UpdateInput
from scas4d_core.settings import SceneSettings, Settings, StaticSettings, UpdateSettings
from scas4d_core.storage.births import Life
from scas4d_core.storage.history import History
from scas4d_core.update.frame_update import structure_of
from scas4d_core.update.result import UpdateResult
from scas4d_core.update.schedule import FOR_BIRTHS
from scas4d_core.update.warm_start import Motion, motion_between, warm_start

BOX = make_box()
RIG = make_rig()
TURN = Rotation.from_rotvec([0, 0.03, 0])
MASKED = [take_frame(k, 0.1 * k, moved(BOX, TURN**k, 0.5 * k * SHIFT), RIG) for k in range(6)]
FRAMES = {True: MASKED, False: [replace(frame, masks={}) for frame in MASKED]}
POINTS = InitialPoints(BOX.means.astype(np.float64), BOX.colours, BOX.foreground)
SETTINGS = Settings(
    scene=SceneSettings(metres_per_unit=1.0),
    static=StaticSettings(iterations=12, max_gaussians=400),
    update=UpdateSettings(iterations=6, clusters=(2, 12), momentum=0.5),
)
COUNT = len(BOX)
BIRTHS = {2: ([3, 50, 200, COUNT - 1], [3, -1, 3, COUNT - 1]), 3: ([10, COUNT], [10, COUNT])}
RETIRED = {3: [0, 1, COUNT - 2, COUNT + 1], 4: [COUNT + 4]}
REVIVED = {5: [1, COUNT + 1]}
PLAN = plan(BIRTHS, RETIRED, REVIVED)


@pytest.fixture
def add_and_retire_gaussians(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    install(monkeypatch, PLAN)
    yield
    effect_module.effect.cache_clear()


def start(history: History, masks: bool, settings: Settings = SETTINGS) -> Reconstruction:
    state = BOX if masks else BOX.replace(foreground=np.ones(COUNT, np.float32))
    static = StaticResult(state, {}, [0.5])
    return Reconstruction.start(RIG, FRAMES[masks][0], settings, points=POINTS, history=history, static=static)


def go_on(scene: Reconstruction, frames: list[Frame]) -> Reconstruction:
    for frame in frames:
        if frame.index > scene.history.indices[-1]:
            scene.step(frame)
    return scene


def assert_same(one: History, other: History) -> None:
    assert one.indices == other.indices
    for index in one.indices:
        here, there = one.gaussians(index), other.gaussians(index)
        for name, array in here.arrays().items():
            np.testing.assert_array_equal(array, there.arrays()[name], err_msg=f"{index} {name}")
    assert one.lives(one.ids) == other.lives(other.ids)


def test_they_come_and_go(add_and_retire_gaussians: None) -> None:
    scene = start(History(), masks=True)
    rows = [len(scene._prepared.updater.hierarchy.rows)]
    reports = []
    for frame in FRAMES[True][1:]:
        reports.append(scene.step(frame))
        rows.append(len(scene._prepared.updater.hierarchy.rows))
    assert [(r.born, r.retired, r.revived) for r in reports] == [(0, 0, 0), (4, 0, 0), (2, 4, 0), (0, 1, 0), (0, 0, 2)]
    assert [r.gaussians for r in reports] == [COUNT, COUNT + 4, COUNT + 2, COUNT + 1, COUNT + 3]
    assert rows == [MOVING, MOVING, MOVING + 3, MOVING + 2, MOVING + 1, MOVING + 3]
    assert [r.moving for r in reports] == rows[1:]
    history = scene.history
    assert history.ids.tolist() == list(range(COUNT + 6))
    assert history.lives([1, COUNT + 4]) == [Life(1, 0, (3,), (5,)), Life(COUNT + 4, 3, (4,))]
    # What is retired stays as it was; what was born moves from the next frame on.
    gone = [0, COUNT - 2]
    for name in ("means", "factors", "rotations", "colours"):
        np.testing.assert_array_equal(getattr(history.newest, name)[gone], getattr(history.gaussians(3), name)[gone])
    born = history.gaussians(2).means[COUNT], history.gaussians(3).means[COUNT]
    assert np.linalg.norm(born[1] - born[0]) > 1e-3
    assert not any(history.report(index)["cold"] for index in (3, 4, 5))  # the motion went over to the new clusters
    carried = scene._prepared.carried.effects[NAME]
    assert len(carried["rows"]) == COUNT + 6
    assert carried["seen"].shape == ()


def test_what_effects_carry_is_lengthened_by_the_founders(add_and_retire_gaussians: None) -> None:
    scene = go_on(start(History(), masks=True), FRAMES[True][:3])
    assert scene._prepared.carried.effects[NAME]["rows"][-4:].tolist() == [3, 0, 3, COUNT - 1]


@pytest.mark.slow
@pytest.mark.parametrize("masks", [True, False])
def test_resumed_after_any_frame_it_goes_on_with_the_same_bits(
    add_and_retire_gaussians: None, masks: bool, tmp_path: Path
) -> None:
    whole = start(History(tmp_path / "live"), masks)
    frames = FRAMES[masks]
    for frame in frames[1:]:
        whole.step(frame)
        shutil.copytree(tmp_path / "live", tmp_path / f"after {frame.index}")
    if not masks:
        assert whole._prepared.carried.labels is not None
        assert len(whole._prepared.carried.labels) == COUNT + 6
    for index in range(2, len(frames) - 1):
        folder = shutil.copytree(tmp_path / f"after {index}", tmp_path / f"again {index}")
        scene = Reconstruction.resume(RIG, SETTINGS, History.open(folder))
        assert scene.resumed is not None
        assert (scene.resumed.index, scene.resumed.faults, scene.resumed.cold) == (index, [], False)
        assert_same(go_on(scene, frames).history, whole.history)
    for index in (2, 3, 5):  # a newest state that is damaged is made again, and its births have their ids again
        folder = shutil.copytree(tmp_path / f"after {index}", tmp_path / f"damaged {index}")
        (folder / f"frame_{index:06d}.npz").write_bytes(b"")
        scene = Reconstruction.resume(RIG, SETTINGS, History.open(folder))
        assert scene.resumed is not None
        assert (scene.resumed.undone, scene.resumed.cold) == ([index], False)
        assert_same(go_on(scene, frames).history, whole.history)
    folder = tmp_path / "after 2"  # it ended between the file of the born and the commit
    (folder / "frame_000002.npz").unlink()
    scene = Reconstruction.resume(RIG, SETTINGS, History.open(folder))
    assert_same(go_on(scene, frames).history, whole.history)


def test_an_effect_that_leaves_rows_alone_changes_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    without = go_on(start(History(), masks=True), FRAMES[True][:4])
    install(monkeypatch, plan())
    assert_same(go_on(start(History(), masks=True), FRAMES[True][:4]).history, without.history)
    install(monkeypatch, PLAN)
    off = SETTINGS.model_copy(update={"effects": {NAME: "off"}})
    assert_same(go_on(start(History(), True, off), FRAMES[True][:4]).history, without.history)
    effect_module.effect.cache_clear()


def test_a_state_made_again_has_the_born_of_its_frame(add_and_retire_gaussians: None, tmp_path: Path) -> None:
    whole = go_on(start(History(tmp_path), masks=True), FRAMES[True])
    (tmp_path / "frame_000003.npz").write_bytes(b"")
    history = History.open(tmp_path)
    report = recompute(RIG, SETTINGS, history, 2, FRAMES[True][3], {})
    assert report["recomputed"]
    made = History.load(tmp_path).gaussians(3)
    assert len(made) == COUNT + 6
    np.testing.assert_array_equal(made.retired, whole.history.gaussians(3).retired)
    np.testing.assert_array_equal(made.ids, whole.history.ids)
    assert history.lives(history.ids) == whole.history.lives(whole.history.ids)


def test_a_state_made_again_has_what_came_back_where_it_was_then(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    rows, far = np.array([3, 4, 5, 40]), np.float32([0.4, -0.3, 0.0])

    def add_and_retire_gaussians(seen: FrameObservation) -> UpdateResult:
        state = seen.result.gaussians
        if seen.index == 2:
            state = state.retire(rows)
        if seen.index == 4:
            means = state.means.copy()
            means[rows] += far
            state = state.replace(means=means).revive(rows)
        return replace(seen.result, gaussians=state)

    install(monkeypatch, add_and_retire_gaussians)
    whole = go_on(start(History(tmp_path), masks=True), FRAMES[True])
    then = whole.history.gaussians(4)
    (tmp_path / "frame_000004.npz").write_bytes(b"")
    history = History.open(tmp_path)
    recompute(RIG, SETTINGS, history, 3, FRAMES[True][4], {})
    made = History.load(tmp_path).gaussians(4)
    assert not made.retired.any()
    off = np.linalg.norm(made.means - then.means, axis=1)
    assert off[rows].max() < 0.2 * np.linalg.norm(far)
    assert off.max() < 0.2 * np.linalg.norm(far)  # all others, too
    effect_module.effect.cache_clear()


def test_a_copy_aside_goes_on_with_the_born(add_and_retire_gaussians: None) -> None:
    scene = go_on(start(History(), masks=True), FRAMES[True][:4])
    aside = Reconstruction.fork(RIG, SETTINGS, scene.history, 3)
    aside.step(FRAMES[True][4])
    assert len(aside.history.newest) == COUNT + 6
    assert scene.history.indices == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("births", "fault"),
    [(([3], [COUNT]), "parent"), (([3], [3, 4]), "parents"), (([3], []), "parents")],
)
def test_an_effect_that_breaks_the_rules_is_named(
    births: tuple[list[int], list[int]], fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(monkeypatch, plan({1: births}))
    scene = start(History(), masks=True)
    with pytest.raises(ValueError, match=f"effect {NAME}: .*{fault}"):
        scene.step(FRAMES[True][1])
    assert scene.history.indices == [0]
    install(
        monkeypatch, lambda seen: replace(seen.result, gaussians=seen.result.gaussians.rows(np.arange(COUNT)[::-1]))
    )
    with pytest.raises(ValueError, match="rows were removed or reordered"):
        scene.step(FRAMES[True][1])
    effect_module.effect.cache_clear()


def test_births_have_their_time_in_the_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    ends, asked = [], FrameSolver.run

    def run(self: FrameSolver, given: UpdateInput) -> Solved:
        assert given.end is not None
        ends.append(given.end)
        return asked(self, given)

    def add_and_retire_gaussians(seen: FrameObservation) -> UpdateResult:
        assert seen.time.end is not None
        ends.append(seen.time.end)
        if seen.index == 2:
            seen.time.postponed.append("a ball was not born")
        return seen.result

    monkeypatch.setattr(FrameSolver, "run", run)
    install(monkeypatch, add_and_retire_gaussians)
    scene = start(History(), masks=True, settings=SETTINGS)
    scene.set_budget(budget_ms=1000.0)
    reports = [scene.step(frame) for frame in FRAMES[True][1:5]]
    assert [report.postponed for report in reports] == [[], ["a ball was not born"], [], []]
    assert scene.history.report(2)["postponed"] == ["a ball was not born"]
    assert all("presence" in report.seconds for report in reports)
    left = [births - iterations for iterations, births in zip(ends[::2], ends[1::2], strict=True)]
    assert left == pytest.approx([0, 0, FOR_BIRTHS, 0], abs=1e-6)
    effect_module.effect.cache_clear()


def test_the_motion_between_two_states_goes_on_in_other_clusters(monkeypatch: pytest.MonkeyPatch) -> None:
    """A body that turns and shifts alike from frame to frame: the start of the next frame is where it will be."""
    scene = start(History(), masks=True)
    hierarchy = scene._prepared.updater.hierarchy
    engine = CpuEngine()
    engine.bind(scene._prepared.plan, structure_of(hierarchy, None, BOX))
    turn, shift = Rotation.from_rotvec([0.02, 0.05, -0.01]), np.array([0.02, -0.01, 0.015])

    def after(steps: int) -> np.ndarray:
        points = BOX.means[:MOVING].astype(np.float64)
        for _ in range(steps):  # about the body's own middle
            middle = points.mean(axis=0)
            points = turn.apply(points - middle) + middle + (turn ** (_ + 1)).apply(shift)
        return points

    quaternion = np.roll(turn.as_quat(), 1).astype(np.float32)
    now = BOX.replace(
        means=np.concatenate([after(1), BOX.means[MOVING:]]).astype(np.float32),
        rotations=np.concatenate([np.tile(quaternion, (MOVING, 1)), BOX.rotations[MOVING:]]),
        factors=np.concatenate([turn.as_matrix() @ BOX.factors[:MOVING], BOX.factors[MOVING:]]).astype(np.float32),
    )
    known = np.random.default_rng(0).random(MOVING) > 0.3  # the others were born meanwhile
    motion = motion_between(hierarchy, BOX, now, known, 0.1)
    assert isinstance(motion, Motion)
    assert np.abs(motion.own_shifts[known]).max() < 1e-3
    assert (motion.own_shifts[~known] == 0).all()
    engine.load_state(now)
    engine.set_tables(warm_start(hierarchy, motion, 0.1, 1.0))
    means = engine.state(learnt=False).means
    moved_on = np.linalg.norm(after(2) - after(1), axis=1).mean()
    off = np.linalg.norm(means[:MOVING] - after(2), axis=1)
    assert off.mean() < 0.05 * moved_on
    nothing = motion_between(hierarchy, BOX, now, np.zeros(MOVING, np.bool_), 0.1)
    assert all((array == 0).all() for array in (*nothing.turns, *nothing.shifts, nothing.own_shifts))
