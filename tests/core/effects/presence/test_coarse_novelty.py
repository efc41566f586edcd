"""What an update rendered last tells whether anything can be new: no picture is rendered where nothing is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from box_scene import moved, take_frame
from effect_cases import BEFORE, RIG, UPDATE, builder, updater_of

from scas4d_core.effects.evidence import FrameObservation
from scas4d_core.effects.presence import entering, novelty, uncovered
from scas4d_core.effects.presence.novelty import SCREENED_CAMERAS, screen_novelty
from scas4d_core.effects.switches import register_effects
from scas4d_core.engines.cpu.engine import CpuEngine
from scas4d_core.engines.cpu.renderer import CpuRenderer
from scas4d_core.engines.engine import KEPT_PICTURES, KEPT_ROWS, IterationLog, StepScalars, Thinned
from scas4d_core.engines.renderer import Picture
from scas4d_core.engines.views import CameraArrays
from scas4d_core.frame_outcome import Candidate
from scas4d_core.gaussians import Gaussians
from scas4d_core.update.result import UpdateTrace
from tests.helpers.effect_cases.visited_room import known, make_rig, scene, seen, visitor

ROOM = make_rig()


def shown(frame: FrameObservation, kept: Candidate = Candidate.END, most: int = KEPT_PICTURES) -> FrameObservation:
    """The frame with the renderings that an update leaves, of every other camera."""
    log, state = IterationLog(), frame.result.gaussians
    for number in range(0, len(frame.views), 2)[:most]:
        frame.renderer.compare(state, [frame.views[number]])
        log.keep(number, Thinned.of(*frame.renderer.shown(frame.views[number])))  # type: ignore[attr-defined]
    trace = UpdateTrace(kept=kept)
    trace.load_log(log, frame.views)
    return replace(frame, result=replace(frame.result, trace=trace))


@pytest.fixture
def rendered(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the cameras whose pictures are rendered for the evidence."""
    names: list[str] = []
    render, cameras = (
        CpuRenderer.render,
        {CameraArrays.of(camera).pose.tobytes(): camera.name for camera in ROOM.cameras},
    )

    def counted(self: CpuRenderer, state: Gaussians, camera: CameraArrays, *given: Any, **named: Any) -> Picture:
        names.append(cameras[camera.pose.tobytes()])
        return render(self, state, camera, *given, **named)

    monkeypatch.setattr(CpuRenderer, "render", counted)
    return names


@pytest.mark.parametrize("masks", [True, False])
def test_where_nothing_is_new_nothing_is_rendered(rendered: list[str], masks: bool) -> None:
    frame = shown(seen(scene(known()), scene(known()), masks=masks))
    for one in (entering.EFFECT, uncovered.EFFECT):
        found = one.evidence(frame)
        assert found is not None
        assert found.share == 0
    assert rendered == []


@pytest.mark.parametrize("masks", [True, False])
def test_what_enters_is_found_by_the_cameras_that_see_it(rendered: list[str], masks: bool) -> None:
    plain, frame = (seen(scene(known()), scene(known(), visitor()), masks=masks) for _ in range(2))
    said = screen_novelty(shown(frame), entering.MIN_CAMERAS, new=entering.SMALLEST)
    assert len(said) > entering.MIN_CAMERAS
    assert {one.view.name for one in said} == set(rendered)
    assert all(one.surplus >= entering.SMALLEST * one.new.size for one in said)
    found, wanted = entering.EFFECT.evidence(shown(frame)), entering.EFFECT.evidence(plain)
    assert found == wanted  # with the renderings as without them
    assert found is not None
    assert found.share > entering.SHARE


def test_what_is_uncovered_is_found(rendered: list[str]) -> None:
    plain, frame = (seen(scene(known(), hole=0.25), scene(known())) for _ in range(2))
    frame = shown(frame)
    found = uncovered.EFFECT.evidence(frame)
    assert found == uncovered.EFFECT.evidence(plain)
    assert found is not None
    assert found.share > uncovered.SHARE


def test_fewer_cameras_than_are_asked_for_render_nothing(rendered: list[str]) -> None:
    frame = shown(seen(scene(known()), scene(known())))
    assert screen_novelty(frame, 2, new=entering.SMALLEST) == []
    assert rendered == []


def test_too_few_renderings_say_nothing_and_cameras_are_looked_at(rendered: list[str]) -> None:
    frame = shown(seen(scene(known()), scene(known(), visitor())), most=SCREENED_CAMERAS - 1)
    assert len(screen_novelty(frame, 2, new=entering.SMALLEST)) == SCREENED_CAMERAS
    assert len(rendered) == SCREENED_CAMERAS


def test_without_renderings_of_what_was_kept_some_cameras_are_looked_at(rendered: list[str]) -> None:
    assert (
        len(screen_novelty(seen(scene(known()), scene(known())), 2, new=entering.SMALLEST)) == SCREENED_CAMERAS
    )  # as on another device
    assert (
        len(screen_novelty(shown(seen(scene(known()), scene(known())), Candidate.WARM), 2, new=entering.SMALLEST))
        == SCREENED_CAMERAS
    )
    assert len(rendered) == 2 * SCREENED_CAMERAS


def test_a_region_counts_without_its_rims() -> None:
    frame = shown(seen(scene(known()), scene(known(), visitor())))
    said = {one.view.name: one for one in novelty.novelty_of_views(frame, frame.views)}
    for one in novelty._coarse_novelties(frame):
        share = float(said[one.view.name].new.mean())
        assert novelty.COARSE_SHARE * share <= one.new <= share


def test_a_trace_keeps_the_last_views_and_thins_large_pictures() -> None:
    frame = seen(scene(known()), scene(known()))
    log, state = IterationLog(), frame.result.gaussians
    trace = UpdateTrace()
    trace.load_log(log, frame.views)
    assert trace.shown == {}

    def drawn(number: int) -> Picture:
        features, transmittance = frame.renderer.render(state, frame.views[number].camera)
        return Picture(features.copy(), transmittance.copy())

    for number in [*range(10), 1]:  # more than are kept, and one of them again
        log.keep(number, Thinned.of(*drawn(number)))
    trace.load_log(log, frame.views)
    assert list(trace.shown) == [frame.views[number].name for number in (3, 4, 5, 6, 7, 8, 9, 1)]
    every, planes = trace.shown[frame.views[1].name]
    assert every == 1
    large = drawn(1)
    np.testing.assert_array_equal(planes[:4], large.features)
    np.testing.assert_array_equal(planes[4], large.transmittance)
    tiled = Picture(np.tile(large.features, (1, 6, 8)), np.tile(large.transmittance, (6, 8)))
    log.keep(1, Thinned.of(*tiled))
    trace.load_log(log, frame.views)
    every, planes = trace.shown[frame.views[1].name]
    assert every == 480 // KEPT_ROWS == 3
    assert planes.shape == (5, 160, 214)
    np.testing.assert_array_equal(planes[0], tiled.features[0, ::3, ::3])


def test_an_update_keeps_the_renderings_of_its_last_iterations() -> None:
    built = register_effects(builder(update=UPDATE.model_copy(update={"iterations": KEPT_PICTURES + 2})))
    views = built.factory.views(take_frame(1, 1.0, moved(BEFORE), RIG, True), {})
    engine = Noting()
    found = updater_of(built, engine).run(BEFORE, views, None, 1.0, seed=3)
    assert [step.keep_pictures for _, step in engine.steps] == [False] * 2 + [True] * KEPT_PICTURES
    last = [views[index].name for taken, _ in engine.steps[2:] for index in taken]
    assert len(set(last)) < len(last)  # some twice: the newest counts
    assert list(found.trace.shown) == sorted(set(last), key=lambda name: len(last) - last[::-1].index(name))


class Noting(CpuEngine):
    """Notes the views and numbers of each iteration."""

    def __init__(self) -> None:
        self.steps: list[tuple[Sequence[int], StepScalars]] = []

    def iterate(self, views: Sequence[int], step: StepScalars) -> None:
        self.steps.append((views, step))
        super().iterate(views, step)
