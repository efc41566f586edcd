"""Probe views, the better of start and end, the light, and the relocation of an object that jumped."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from frame_cases.footage import ANGLE, SyntheticFootage
from frame_cases.scene import BALL, GOES, first_state, gone

from scas4d_core.cameras import rig_inside
from scas4d_core.captures.frame import Frame
from scas4d_core.effects.switches import register_effects
from scas4d_core.engines.cpu.engine import CpuEngine
from scas4d_core.engines.cpu.renderer import CpuRenderer
from scas4d_core.engines.views import TrainingView
from scas4d_core.frame_outcome import Candidate
from scas4d_core.gaussians import Gaussians
from scas4d_core.robust.checks import compensate_exposure, measure_light_gain, with_light_gain
from scas4d_core.robust.relocation import find_jump, shift_moving
from scas4d_core.settings import SceneSettings, UpdateSettings
from scas4d_core.structure.hierarchy import build_hierarchy
from scas4d_core.update.best_state import VIEWS, BestState, ProbeViews, label_by_size, mean_error, spread_cameras
from scas4d_core.update.frame_update import FrameUpdate
from scas4d_core.update.parts import PlanBuilder
from scas4d_core.update.result import AttemptOptions
from scas4d_core.update.schedule import Stopping
from scas4d_core.update.view_factory import ViewFactory

FOOTAGE = SyntheticFootage()
BEFORE = first_state(resting_may_move=False)
FACTORY = ViewFactory(rig_inside(FOOTAGE.rig.world_frame(1.0), FOOTAGE.rig.cameras))
RENDERER = CpuRenderer((0.0, 0.0, 0.0))
SETTINGS = UpdateSettings(iterations=30, clusters=(2, 12), match_patches=False)


def updater(settings: UpdateSettings = SETTINGS, engine: CpuEngine | None = None) -> FrameUpdate:
    hierarchy = build_hierarchy(BEFORE.means, BEFORE.moving, settings.clusters, 8)
    built = register_effects(PlanBuilder(SceneSettings(metres_per_unit=1.0), settings, FACTORY, hierarchy, BEFORE))
    return FrameUpdate(engine or CpuEngine(), built, None)


def compared(iterations: int, skip_below: Mapping[str, float] | None = None) -> AttemptOptions:
    return AttemptOptions(stopping=Stopping(iterations), compare=True, skip_below=skip_below)


def views(frame: Frame) -> list[TrainingView]:
    return FACTORY.views(frame, {})


def error(state: Gaussians, frame: Frame) -> float:
    engine = CpuEngine()
    updater(engine=engine)
    probes = ProbeViews(FACTORY, engine, views(frame))
    engine.load_views(views(frame), probes.views)
    engine.load_state(state)
    (found,) = probes.start_errors(warm=False)
    return mean_error(found, list(found))


def test_probe_views_are_spread_and_the_same_in_every_frame() -> None:
    names = list(FOOTAGE.rig.names)
    chosen = spread_cameras(FACTORY.rig, names)
    assert len(set(chosen)) == VIEWS
    assert chosen == spread_cameras(FACTORY.rig, names)
    centres = np.array([FACTORY.rig[name].centre for name in chosen])
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=-1)[~np.eye(VIEWS, dtype=bool)]
    assert apart.min() > 1.0
    assert spread_cameras(FACTORY.rig, []) == []
    assert len(spread_cameras(FACTORY.rig, names[:2])) == 2


def test_probe_views_tell_the_nearer_of_two_states() -> None:
    frame = FOOTAGE.frame(3)
    errors = [error(gone(BEFORE, angle), frame) for angle in (0.0, 1.5 * ANGLE, 2.7 * ANGLE, 3 * ANGLE)]
    assert errors == sorted(errors, reverse=True)


@pytest.mark.parametrize("iterations", [1, 3, 30])
@pytest.mark.parametrize("index", [0, 1, 2])
def test_an_update_is_never_worse_than_standing_or_going_on(iterations: int, index: int) -> None:
    settings = SETTINGS.model_copy(update={"cold_start_rates": 8.0})  # few steps of this size only do harm
    update, frame = updater(settings), FOOTAGE.frame(index)
    moved = update.run(BEFORE, views(FOOTAGE.frame(1)), None, 0.1, 0, compared(30))
    for motion in (None, moved.motion):
        found = update.run(BEFORE, views(frame), motion, 0.1, 0, compared(iterations))
        here = error(found.gaussians, frame)
        assert here <= error(BEFORE, frame) + 1e-6
        assert here <= min(mean_error(errors, list(errors)) for errors in found.trace.errors.values()) + 1e-6
        assert found.trace.kept in found.trace.errors
        if found.trace.kept == "previous":
            assert found.gaussians is BEFORE


def test_a_motion_that_ended_is_not_gone_on_with() -> None:
    update = updater()
    moved = update.run(BEFORE, views(FOOTAGE.frame(1)), None, 0.1, 0, compared(30))
    again = update.run(
        moved.gaussians,
        views(FOOTAGE.frame(1)),
        moved.motion,
        0.1,
        0,
        compared(1),
    )
    still, warm = (mean_error(again.trace.errors[kind], list(again.trace.errors[kind])) for kind in list(Candidate)[1:])
    assert still < warm
    assert error(again.gaussians, FOOTAGE.frame(1)) <= still + 1e-6


@pytest.mark.parametrize("known", [True, False])
def test_a_coarse_layer_rests_where_the_motion_before_leads_near(known: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """In an update whose plan grows past its rest and falls back: it learns again, and rests again."""
    engine = CpuEngine()
    update, frame = updater(engine=engine), FOOTAGE.frame(4)
    if known:  # the frame is two on from where the motion led
        monkeypatch.setattr("scas4d_core.update.rates.NEAR", 10.0)
    moved = update.run(BEFORE, views(FOOTAGE.frame(1)), None, 0.1, 0, compared(60))
    errors = moved.trace.errors[Candidate.END]
    reference_errors = label_by_size(errors, moved.trace.whole) if known else None
    inside, coarse = engine._deformation, list[np.ndarray]()
    forward = inside.forward

    def record() -> None:
        coarse.append(inside.clusters[0].copy())
        forward()

    # Of two layers the first rests after three quarters.
    plan = {**dict.fromkeys(range(10), 12), 10: 20, 11: 20, **dict.fromkeys(range(12, 20), 16)}
    stopping = Stopping(20)
    monkeypatch.setattr(stopping, "planned", plan.__getitem__)
    monkeypatch.setattr(inside, "forward", record)
    options = AttemptOptions(stopping=stopping, compare=True, reference_errors=reference_errors)
    found = update.run(moved.gaussians, views(frame), moved.motion, 0.1, 0, options)
    iterations = len(found.trace.losses)
    assert (iterations, found.trace.kept) == (16, Candidate.END)
    tables = coarse[-iterations - 1 :]
    learnt = [bool((one != other).any()) for one, other in pairwise(tables)]
    assert learnt == ([True] * 9 + [False] + [True] * 2 + [False] * 4 if known else [True] * 16)


def test_a_frame_that_stands_needs_no_iteration() -> None:
    update, frame = updater(), FOOTAGE.frame(0)
    settled = update.run(BEFORE, views(frame), None, 0.1, 0, compared(30))
    skip_below = label_by_size(settled.trace.errors[settled.trace.kept], settled.trace.whole)
    stands = update.run(
        settled.gaussians,
        views(frame),
        None,
        0.1,
        1,
        compared(30, skip_below),
    )
    assert (stands.trace.losses, stands.trace.kept) == ([], "previous")
    for later, expected in ((FOOTAGE.frame(1), 30), (frame, 30)):
        asked = skip_below if expected and later is not frame else None
        moves = update.run(
            settled.gaussians,
            views(later),
            None,
            0.1,
            1,
            compared(30, asked),
        )
        assert len(moves.trace.losses) == expected


def test_cameras_that_were_left_out_have_no_say_in_what_is_best() -> None:
    assert np.isnan(mean_error({}, ["c0"]))
    assert mean_error({"c0": 1.0, "c1": 3.0}, ["c1", "c7"]) == 3.0
    engine = CpuEngine()
    hierarchy = updater(engine=engine).hierarchy
    engine.load_state(BEFORE)
    best = BestState(ProbeViews(FACTORY, engine, []), engine, hierarchy, None, 0.1, SETTINGS.momentum)
    best.start()
    assert not best.can_skip({"c0": 9.0})
    assert best.errors == {}


@pytest.mark.parametrize("gain", [0.7, 1.3, 1.6])
def test_the_gain_of_the_light_is_found_and_taken_out(gain: float) -> None:
    frame = FOOTAGE.frame(0)
    brighter = {name: (gain * picture).round().clip(0, 255).astype(np.uint8) for name, picture in frame.images.items()}
    sent = views(replace(frame, images=brighter))
    found, without, others = compensate_exposure(FACTORY, RENDERER, BEFORE, sent[2:], sent[:2])
    assert found == pytest.approx(gain, rel=0.03)
    assert measure_light_gain(RENDERER, BEFORE, sent) == pytest.approx(gain, rel=0.03)
    for view, reference_errors in zip([*others, *without], views(frame), strict=True):
        assert view.name == reference_errors.name
        assert abs(float((view.target[:3] - reference_errors.target[:3]).mean())) < 0.02
        np.testing.assert_array_equal(view.target[3:], reference_errors.target[3:])


def test_pictures_that_are_not_brighter_stay_as_they_are() -> None:
    before = views(FOOTAGE.frame(1))
    found, without, others = compensate_exposure(FACTORY, RENDERER, BEFORE, before[2:], before[:2])
    assert found == 1.0
    assert all(one is other for one, other in zip(before, [*others, *without], strict=True))


@pytest.mark.parametrize("value", [0, 255])
def test_pictures_without_a_light_tell_of_none(value: int) -> None:
    frame = FOOTAGE.frame(0)
    filled = {name: np.full_like(picture, value) for name, picture in frame.images.items()}
    assert measure_light_gain(RENDERER, BEFORE, views(replace(frame, images=filled))) is None


def test_a_state_in_another_light_is_no_brighter_than_white() -> None:
    colours = np.array([[0.2, 0.8, 1.2]], np.float32).repeat(len(BEFORE), axis=0)
    np.testing.assert_allclose(with_light_gain(BEFORE.replace(colours=colours), 2.0).colours[0], [0.4, 1.0, 1.2])
    np.testing.assert_allclose(with_light_gain(BEFORE.replace(colours=colours), 0.5).colours[0], [0.1, 0.4, 0.6])


@pytest.mark.parametrize("sizes", [0.5, 1.0, 2.0])
def test_a_jump_is_found(sizes: float) -> None:
    frame, _ = FOOTAGE.jumped(0, sizes)
    found = find_jump(BEFORE, views(frame), RENDERER, FACTORY.rig)
    assert found is not None
    true = np.array([-0.8, 0.0, -0.6]) * sizes * 2 * BALL
    assert np.linalg.norm(found - true) < 0.4 * BALL
    moved = shift_moving(BEFORE, found)
    np.testing.assert_allclose(moved.means[:GOES], BEFORE.means[:GOES] + found, atol=1e-6)
    np.testing.assert_array_equal(moved.means[GOES:], BEFORE.means[GOES:])


def test_a_camera_that_did_not_see_the_object_has_no_say_in_where_it_went() -> None:
    frame, _ = FOOTAGE.jumped(0, 1.0)
    away = BEFORE.means.copy()
    away[BEFORE.moving] = [0, -500, 0]
    images = {name: picture.copy() for name, picture in frame.images.items()}
    unseen = BEFORE.replace(means=away)
    for view in views(frame):  # as the scene is shown, but for one pixel
        shown = RENDERER.render(unseen, view.camera).features[:3]
        images[view.name] = np.rint(255 * shown.clip(0, 1)).astype(np.uint8).transpose(1, 2, 0).copy()
        images[view.name][0, 0] = 255 - images[view.name][0, 0]
    assert find_jump(unseen, views(replace(frame, images=images)), RENDERER, FACTORY.rig) is None


def test_cameras_that_disagree_find_no_jump() -> None:
    jumped = [FOOTAGE.jumped(index, sizes)[0] for index, sizes in ((0, 1.0), (0, -1.0))]
    mixed = {name: jumped[k % 2].images[name] for k, name in enumerate(FOOTAGE.rig.names)}
    assert find_jump(BEFORE, views(replace(jumped[0], images=mixed)), RENDERER, FACTORY.rig) is None


def test_an_object_that_is_gone_or_does_not_exist_is_not_found() -> None:
    frame = FOOTAGE.frame(0)
    standing = BEFORE.replace(foreground=np.zeros(len(BEFORE), np.float32))
    assert find_jump(standing, views(frame), RENDERER, FACTORY.rig) is None
    rng = np.random.default_rng(0)
    noise = {name: rng.integers(0, 256, picture.shape, np.uint8) for name, picture in frame.images.items()}
    assert find_jump(BEFORE, views(replace(frame, images=noise)), RENDERER, FACTORY.rig) is None
    few = {name: frame.images[name] for name in FOOTAGE.rig.names[:2]}
    assert find_jump(BEFORE, FACTORY.views(Frame(0, 0.0, few, {}), {}), RENDERER, FACTORY.rig) is None
