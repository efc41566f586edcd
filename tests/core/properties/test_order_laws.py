"""Row order is identity and no more: other orders of Gaussians and cameras give the same, to the bit.

Given the same clusters and sequence of views; where clusters are looked for anew, K-means starts from other rows.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from box_scene import MOVING, RIG, make_box, moved, take_frame
from hypothesis import given
from law_cases import law, seeds

from scas4d_core.cameras import Rig
from scas4d_core.effects.switches import register_effects
from scas4d_core.engines.cpu.engine import CpuEngine
from scas4d_core.gaussians import Gaussians
from scas4d_core.preparation import SMALLEST_CLUSTER
from scas4d_core.settings import SceneSettings, UpdateSettings
from scas4d_core.structure.hierarchy import Hierarchy, build_hierarchy
from scas4d_core.structure.neighbours import Neighbours
from scas4d_core.update import schedule
from scas4d_core.update.frame_update import FrameUpdate
from scas4d_core.update.parts import PlanBuilder
from scas4d_core.update.result import UpdateResult
from scas4d_core.update.schedule import ViewPlan
from scas4d_core.update.view_factory import ViewFactory

MADE = make_box()
JITTER = np.random.default_rng(1).normal(0, 0.003, MADE.means.shape).astype(np.float32)
BOX = MADE.replace(means=MADE.means + JITTER)
"""No two at one depth: ties go by row."""
AFTER = moved(BOX)
SETTINGS = UpdateSettings(iterations=6, clusters=(2, 12, 48))
HIERARCHY = build_hierarchy(BOX.means, BOX.moving, SETTINGS.clusters, SMALLEST_CLUSTER)
NEIGHBOURS = Neighbours(BOX.means[HIERARCHY.rows], 6, 200.0)
FRAME = take_frame(1, 1.0, AFTER, RIG)
SEQUENCE = ["0a", "2b", "1b", "3a", "0b", "1a"]


@pytest.fixture(scope="module", autouse=True)
def sample() -> Iterator[None]:
    """Fewer Gaussians than the box has: an iteration looks at some."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(schedule, "NEIGHBOUR_SAMPLE", 150)
        yield


def updated(state: Gaussians, hierarchy: Hierarchy, rig: Rig, monkeypatch: pytest.MonkeyPatch) -> UpdateResult:
    """An update that looks at the views of SEQUENCE, whatever the order of the rig's cameras."""

    sequence = iter(SEQUENCE)

    factory = ViewFactory(rig)
    views = factory.views(FRAME, {})
    names = [view.name for view in views]
    monkeypatch.setattr(ViewPlan, "take", lambda plan: [names.index(next(sequence))])
    built = register_effects(PlanBuilder(SceneSettings(), SETTINGS, factory, hierarchy, state))
    return FrameUpdate(CpuEngine(), built, NEIGHBOURS).run(state, views, None, 1.0, seed=1)


@pytest.fixture(scope="module")
def plain() -> UpdateResult:
    with pytest.MonkeyPatch.context() as patch:
        return updated(BOX, HIERARCHY, RIG, patch)


def taken(state: Gaussians, order: np.ndarray) -> Gaussians:
    return Gaussians(**{name: array[order] for name, array in state.arrays().items()})


def assert_same(found: UpdateResult, wanted: UpdateResult, order: np.ndarray) -> None:
    for name, array in wanted.gaussians.arrays().items():
        np.testing.assert_array_equal(getattr(found.gaussians, name), array[order], err_msg=name)


@law(5)
@given(seeds)
def test_the_order_of_gaussians_changes_no_bit(plain: UpdateResult, seed: int) -> None:
    order = np.random.default_rng(seed).permutation(len(BOX))
    row_of = np.argsort(order)
    hierarchy = Hierarchy(row_of[HIERARCHY.rows], HIERARCHY.labels, HIERARCHY.starts)
    with pytest.MonkeyPatch.context() as patch:
        found = updated(taken(BOX, order), hierarchy, RIG, patch)
    assert_same(found, plain, order)


@law(5)
@given(seeds)
def test_the_order_of_cameras_changes_no_bit(plain: UpdateResult, seed: int) -> None:
    cameras = [RIG.cameras[k] for k in np.random.default_rng(seed).permutation(len(RIG))]
    with pytest.MonkeyPatch.context() as patch:
        found = updated(BOX, HIERARCHY, Rig(tuple(cameras)), patch)
    assert_same(found, plain, np.arange(len(BOX)))
    assert found.trace.losses == plain.trace.losses
    assert found.trace.cameras == plain.trace.cameras


def test_the_plain_update_moves(plain: UpdateResult) -> None:
    assert np.median(np.linalg.norm(plain.gaussians.means - BOX.means, axis=1)[:MOVING]) > 1e-3
