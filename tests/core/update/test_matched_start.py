"""Updates that start from matches of image patches, where the motion is too large for gradients."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from box_scene import MOVING, look_at, make_box, moved, take_frame
from effect_cases import of_whole_pictures
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import Rig
from scas4d_core.engines.cpu.engine import CpuEngine
from scas4d_core.engines.engine import Tables
from scas4d_core.engines.plan import UpdatePlan
from scas4d_core.engines.views import TrainingView
from scas4d_core.frame_outcome import Candidate
from scas4d_core.gaussians import Gaussians
from scas4d_core.preparation import SMALLEST_CLUSTER
from scas4d_core.settings import UpdateSettings
from scas4d_core.structure.hierarchy import build_hierarchy
from scas4d_core.structure.neighbours import Neighbours
from scas4d_core.update.best_state import BestState, ProbeViews
from scas4d_core.update.frame_update import FrameUpdate, structure_of
from scas4d_core.update.matched_start import GAIN, matched_start
from scas4d_core.update.result import AttemptOptions, UpdateResult
from scas4d_core.update.view_factory import ViewFactory


def printed_box() -> Gaussians:
    """The box with colours that vary over 10 to 40 pixels."""
    box = make_box()
    waves = np.random.default_rng(3).normal(0, 14, (2, 3, 3))
    colours = 0.5 + 0.22 * np.sin(waves @ box.means[:MOVING].T).sum(axis=0).T
    return box.replace(colours=np.concatenate([colours, box.colours[MOVING:]]).astype(np.float32))


BOX = printed_box()
TURN, SHIFT = Rotation.from_rotvec([0.03, 0.1, -0.025]), np.array([0.05, 0.015, -0.03])
"""About 8 pixels of the images; the box is 50 pixels wide."""
FAR = moved(BOX, TURN, SHIFT)
SIZE = 128
RIG = Rig(
    tuple(
        look_at(f"c{k}", [1.3 * np.sin(k), 0.45 * (-1) ** k, 1.3 * np.cos(k)], focal=160, size=SIZE) for k in range(6)
    )
)
FACTORY = ViewFactory(RIG)
HIERARCHY = build_hierarchy(BOX.means, BOX.moving, (2, 12, 48), SMALLEST_CLUSTER)


def views_of(state: Gaussians, rig: Rig = RIG) -> list[TrainingView]:
    return ViewFactory(rig).views(take_frame(1, 1.0, state, rig), {})


def engine_of(state: Gaussians, views: list[TrainingView]) -> CpuEngine:
    engine = CpuEngine()
    engine.bind(UpdatePlan(RIG.names), structure_of(HIERARCHY, None, BOX))
    engine.load_views(views, [])
    engine.load_state(state)
    return engine


def distance(state: Gaussians, truth: Gaussians) -> np.ndarray:
    """[M] metres between the means of the moving Gaussians."""
    apart: np.ndarray = np.linalg.norm(state.means - truth.means, axis=1)[:MOVING]
    return apart


def start_of(truth: Gaussians, tables: Tables, rig: Rig = RIG) -> tuple[Gaussians, Tables | None]:
    """The state from which an update would start, and its tables."""
    views = views_of(truth, rig)
    engine = engine_of(BOX, views)
    engine.set_tables(tables)
    expected = engine.state(learnt=False)
    found = matched_start(tables, BOX, expected, HIERARCHY, views, ViewFactory(rig), engine.renderer)
    if found is not None:
        engine.set_tables(found)
    return engine.state(learnt=False), found


def test_a_jump_is_followed_to_a_tenth() -> None:
    start, found = start_of(FAR, Tables.identity(HIERARCHY))
    assert found is not None
    assert np.median(distance(start, FAR)) < 0.1 * np.median(distance(BOX, FAR))


def test_what_is_expected_is_continued_in_its_own_axes() -> None:
    """The tables already have motion in all layers. What is added moves the resulting state rigidly."""
    rng = np.random.default_rng(0)
    tables = Tables.identity(HIERARCHY)
    for table in tables.clusters:
        table[:, :3] = rng.normal(0, 0.02, (len(table), 3))
        table[:, 3:6] = rng.normal(0, 0.002, (len(table), 3)) + np.array([0.01, 0, 0.01])
    tables.deltas[:, :3] = rng.normal(0, 0.002, (len(tables.deltas), 3))
    engine = engine_of(BOX, views_of(BOX))
    engine.set_tables(tables)
    expected = engine.state(learnt=False)
    truth = moved(expected, TURN, SHIFT)
    start, found = start_of(truth, tables)
    assert found is not None
    assert np.median(distance(start, truth)) < 0.15 * np.median(distance(expected, truth))
    for part in range(2):  # each coarse cluster has moved almost rigidly from where it was expected
        rows = HIERARCHY.rows[HIERARCHY.labels[0] == part]
        before, after = expected.means[rows], start.means[rows]
        turn, left = Rotation.align_vectors(after - after.mean(axis=0), before - before.mean(axis=0))[:2]
        assert turn.magnitude() > 0.08
        assert left / np.sqrt(len(rows)) < 0.002


@pytest.mark.parametrize("shift", [0.0, 0.002])
def test_nothing_changes_where_the_expected_state_fits(shift: float) -> None:
    nearby = moved(BOX, Rotation.identity(), np.array([shift, 0, 0]))  # 0.3 pixels
    assert start_of(nearby, Tables.identity(HIERARCHY))[1] is None


def test_larger_images_are_matched_at_a_smaller_size_and_tiny_images_are_not() -> None:
    large = Rig(tuple(look_at(camera.name, camera.centre, focal=400, size=320) for camera in RIG.cameras))
    start, found = start_of(FAR, Tables.identity(HIERARCHY), large)
    assert found is not None
    assert np.median(distance(start, FAR)) < 0.1 * np.median(distance(BOX, FAR))
    tiny = Rig(tuple(look_at(camera.name, camera.centre, focal=80, size=64) for camera in RIG.cameras))
    assert start_of(FAR, Tables.identity(HIERARCHY), tiny)[1] is None


def updated(match_patches: bool) -> UpdateResult:
    settings = UpdateSettings(clusters=(2, 12, 48), match_patches=match_patches, iterations=20)
    built = of_whole_pictures(FACTORY, settings, HIERARCHY, BOX)
    updater = FrameUpdate(CpuEngine(), built, Neighbours(BOX.means[HIERARCHY.rows], 20, 200.0))
    return updater.run(BOX, views_of(FAR), None, 1.0, seed=1, options=AttemptOptions(compare=True))


def test_an_update_with_few_iterations_finds_a_jump_only_with_matches() -> None:
    with_matches, without = (np.median(distance(updated(matched).gaussians, FAR)) for matched in (True, False))
    assert with_matches < 0.005
    assert without > 2 * with_matches


Shifted = Callable[[float], Tables]


def best_of(truth: Gaussians) -> tuple[BestState, CpuEngine]:
    views = views_of(truth)
    engine = engine_of(BOX, views)
    probes = ProbeViews(FACTORY, engine, views)
    engine.load_views(views, probes.views)
    best = BestState(probes, engine, HIERARCHY, None, 1.0, 0.0)
    best.start()
    return best, engine


def test_a_start_is_replaced_only_by_a_better_one_and_can_be_kept() -> None:
    truth = moved(BOX, Rotation.identity(), np.array([0.05, 0, 0]))
    usual = Tables.identity(HIERARCHY)
    for shift, accepted in ((0.05, True), (-0.05, False), (0.0005, False)):
        best, engine = best_of(truth)
        other = Tables.identity(HIERARCHY)
        other.clusters[0][:, 3] = shift
        assert (best.start_from(usual, other, GAIN) is other) == accepted
        x = engine.state(learnt=False).means[0, 0] - BOX.means[0, 0]
        assert x == pytest.approx(shift if accepted else 0, abs=1e-6)
        engine.set_tables(usual)  # a useless update
        assert best.end(1, {}) is (Candidate.WARM if accepted else Candidate.END)
        x = engine.state(learnt=False).means[0, 0] - BOX.means[0, 0]
        assert x == pytest.approx(shift if accepted else 0, abs=1e-6)
    assert best.start_from(usual, None, GAIN) is usual


def test_patches_are_matched_where_the_start_is_far_from_usual() -> None:
    best, _ = best_of(BOX)
    errors = best.errors[Candidate.PREVIOUS]
    assert best.is_far(None, 1.3)
    assert best.is_far({"other": 1.0}, 1.3)
    names = {name + (" whole" if best.whole else ""): error for name, error in errors.items()}
    assert not best.is_far(names, 1.3)
    assert best.is_far({name: error / 2 for name, error in names.items()}, 1.3)
    best.errors.clear()
    assert not best.is_far(None, 1.3)  # nothing is compared
