"""What an update rendered last tells whether anything can be new: no picture is rendered where nothing is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scas4d_core.effects.evidence import Seen
from scas4d_core.effects.presence import entering, novelty, uncovered
from scas4d_core.effects.presence.novelty import GLANCE, glance
from scas4d_core.engines.cpu.renderer import CpuRenderer
from scas4d_core.engines.renderer import Picture
from scas4d_core.engines.views import TrainingView
from scas4d_core.frame_outcome import Candidate
from scas4d_core.gaussians import Gaussians
from scas4d_core.update.result import ROWS, SHOWN, UpdateTrace
from tests.helpers.effect_cases.visited_room import known, scene, seen, visitor


def shown(frame: Seen, kept: Candidate = Candidate.END, most: int = SHOWN) -> Seen:
    """The frame with the renderings that an update leaves, of every other camera."""
    trace, state = UpdateTrace(kept=kept), frame.result.gaussians
    features = state.features(state.colours)
    for left, view in enumerate(frame.views[::2][:most]):
        frame.picture.measure(state.means, state.factors, state.opacities, features, view)
        trace.see(view, frame.picture, left)
    return replace(frame, result=replace(frame.result, trace=trace))


@pytest.fixture
def rendered(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the cameras whose pictures are rendered for the evidence."""
    names: list[str] = []
    render = CpuRenderer.render

    def counted(
        self: CpuRenderer, state: Gaussians, features: np.ndarray, view: TrainingView, depth_channel: int = -1
    ) -> Picture:
        names.append(view.name)
        return render(self, state, features, view, depth_channel)

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
    said = glance(shown(frame), entering.GLANCED, new=entering.SMALLEST)
    assert len(said) > entering.GLANCED
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
    assert glance(frame, 2, new=entering.SMALLEST) == []
    assert rendered == []


def test_too_few_renderings_say_nothing_and_cameras_are_looked_at(rendered: list[str]) -> None:
    frame = shown(seen(scene(known()), scene(known(), visitor())), most=GLANCE - 1)
    assert len(glance(frame, 2, new=entering.SMALLEST)) == GLANCE
    assert len(rendered) == GLANCE


def test_without_renderings_of_what_was_kept_some_cameras_are_looked_at(rendered: list[str]) -> None:
    assert len(glance(seen(scene(known()), scene(known())), 2, new=entering.SMALLEST)) == GLANCE  # as on another device
    assert len(glance(shown(seen(scene(known()), scene(known())), Candidate.WARM), 2, new=entering.SMALLEST)) == GLANCE
    assert len(rendered) == 2 * GLANCE


def test_a_region_counts_without_its_rims() -> None:
    frame = shown(seen(scene(known()), scene(known(), visitor())))
    said = {one.view.name: one for one in novelty.said(frame, frame.views)}
    for one in novelty._glimpses(frame):
        share = float(said[one.view.name].new.mean())
        assert novelty.SEEMS * share <= one.new <= share


def test_a_trace_keeps_the_last_views_and_thins_large_pictures() -> None:
    frame = seen(scene(known()), scene(known()))
    trace, state = UpdateTrace(), frame.result.gaussians
    given = (state.means, state.factors, state.opacities, state.features(state.colours))
    for left in (SHOWN + 1, SHOWN):
        frame.picture.measure(*given, frame.views[0])
        trace.see(frame.views[0], frame.picture, left)
    assert trace.shown == {}
    order = [*range(10), 1]  # more than were planned, and one of them again
    for left, number in zip((2, 1, 0, 5, 4, 3, 2, 1, 0, 0, 0), order, strict=True):
        frame.picture.measure(*given, frame.views[number])
        trace.see(frame.views[number], frame.picture, left)
    assert list(trace.shown) == [frame.views[number].name for number in (3, 4, 5, 6, 7, 8, 9, 1)]
    every, planes = trace.shown[frame.views[1].name]
    assert every == 1
    np.testing.assert_array_equal(planes[:4], frame.picture.shown(frame.views[1]).features)
    np.testing.assert_array_equal(planes[4], frame.picture.shown(frame.views[1]).rest)
    large = frame.picture.shown(frame.views[1])
    tiled = Picture(np.tile(large.features, (1, 6, 8)), np.tile(large.rest, (6, 8)))
    trace.see(frame.views[1], Large(tiled), 0)  # type: ignore[arg-type]
    every, planes = trace.shown[frame.views[1].name]
    assert every == 480 // ROWS == 3
    assert planes.shape == (5, 160, 214)
    np.testing.assert_array_equal(planes[0], tiled.features[0, ::3, ::3])


class Large:
    """A picture loss that has rendered something larger."""

    psnr = 30.0

    def __init__(self, shown: Picture) -> None:
        self._shown = shown

    def shown(self, view: TrainingView) -> Picture:
        return self._shown

    def colour_shift(self, view: TrainingView) -> tuple[float, float, float]:
        return 0.0, 0.0, 0.0
