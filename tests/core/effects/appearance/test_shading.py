"""Shading: the colours of what moves follow the pictures once a frame, where the motion is what is kept."""

from __future__ import annotations

import numpy as np
import pytest
from box_scene import MOVING, make_box, make_rig, moved, take_frame
from scipy.spatial.transform import Rotation

from scas4d_core.effects.appearance import shading
from scas4d_core.effects.appearance.closed_form import MOST, SUBSETS, follow_pictures, from_all_sides
from scas4d_core.engines.cpu.changed_pixels import ChangedPixels
from scas4d_core.engines.cpu.renderer import CpuRenderer
from scas4d_core.engines.renderer import PRIOR_PIXELS
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.frame_outcome import Candidate
from scas4d_core.gaussians import Gaussians
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings
from scas4d_core.update.view_factory import ViewFactory

RIG, BOX = make_rig(), make_box()
MOVES = BOX.moving.astype(np.uint8)
FRAMES = 6


def turned(index: int, darker: float = 0.0) -> Gaussians:
    """The box after so many frames of a turn that takes it out of the light."""
    found = moved(BOX, Rotation.from_rotvec([0, 0.04 * index, 0]), np.array([0.004 * index, 0, 0]))
    colours = found.colours.copy()
    colours[found.moving] *= 1 - darker * index
    return found.replace(colours=colours)


def followed(mode: str, darker: float) -> Gaussians:
    effects = {"shading": mode, "light": "off", "camera_gain": "off", "shadows": "off", "uncovered": "off"}
    settings = Settings.model_validate({"update": {"clusters": (2, 12), "iterations": 30}, "effects": effects})
    first = take_frame(0, 0.0, BOX, RIG)
    scene = Reconstruction.start(RIG, first, settings, static=StaticResult(BOX, {}, []))
    for index in range(1, FRAMES + 1):
        scene.step(take_frame(index, index / 30, turned(index, darker), RIG))
    return scene.history.newest


def missed(state: Gaussians, truth: Gaussians) -> tuple[float, float]:
    """Mean error of the colours of what moves, and of their places, metres."""
    moves = truth.moving
    return (
        float(np.abs(state.colours - truth.colours)[moves].mean()),
        float(np.linalg.norm(state.means - truth.means, axis=1)[moves].mean()),
    )


def test_what_turns_out_of_the_light_is_followed_and_its_motion_is_no_worse() -> None:
    truth = turned(FRAMES, 0.06)
    (colour, place), (colour_off, place_off) = (missed(followed(mode, 0.06), truth) for mode in ("auto", "off"))
    assert colour < 0.8 * colour_off
    assert place < 1.2 * place_off


def test_it_is_on_unless_it_is_pinned_or_the_colours_are_held() -> None:
    from scas4d_core.effects.switches import find_contradictions, first_switches

    assert first_switches(Settings(), 0)["shading"].on
    held = Settings.model_validate({"update": {"rate_colour": 0}})
    assert not first_switches(held, 0)["shading"].on
    pinned = Settings.model_validate({"update": {"rate_colour": 0}, "effects": {"shading": "on"}})
    assert [name for name, *_ in find_contradictions(pinned)] == ["shading"]


@pytest.mark.parametrize(
    ("kept", "stepped"), [(Candidate.END, True), (Candidate.WARM, True), (Candidate.PREVIOUS, False)]
)
def test_a_state_that_did_not_move_keeps_its_colours(
    kept: Candidate, stepped: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []
    monkeypatch.setattr(shading, "follow_pictures", lambda state, *_: asked.append(1) or state)
    monkeypatch.setattr("scas4d_core.update.best_state.BestState.end", lambda self, iterations, left_out: kept)
    settings = Settings.model_validate({"update": {"clusters": (2, 12), "iterations": 3}})
    scene = Reconstruction.start(RIG, take_frame(0, 0.0, BOX, RIG), settings, static=StaticResult(BOX, {}, []))
    scene.step(take_frame(1, 0.1, turned(1), RIG))
    assert bool(asked) is stepped


def test_steps_are_those_of_a_dense_twin() -> None:
    """SIRT written out: blending weights by pixel, from pictures of one Gaussian's colour at a time."""
    shown, views, picture = turned(0, 0.0), *pictures(turned(3, 0.1))
    rows = np.flatnonzero(BOX.moving)[:: MOVING // 12]
    learnt = np.zeros(len(BOX), np.uint8)
    learnt[rows] = 1
    state = shown
    for first in range(SUBSETS):
        sums, weights = np.zeros((len(BOX), 3)), np.full(len(BOX), PRIOR_PIXELS)
        for view in from_all_sides(views)[first::SUBSETS]:
            features = state.features(state.colours)
            residual = view.target[:3].astype(np.float64) - picture.render(state, view.camera, features).features[:3]
            residual = residual.clip(-MOST, MOST)
            for row in rows:
                marked = np.zeros_like(features)
                marked[row] = 1
                share = picture.render(state, view.camera, marked).features[3].astype(np.float64)
                sums[row] += (share * residual).sum(axis=(1, 2))
                weights[row] += share.sum()
        state = state.replace(colours=(state.colours + sums / weights[:, None]).astype(np.float32))
    found = follow_pictures(shown, views, picture, learnt)
    np.testing.assert_allclose(found.colours, state.colours, atol=2e-5)
    still = np.setdiff1d(np.arange(len(BOX)), rows)
    np.testing.assert_array_equal(found.colours[still], shown.colours[still])
    assert np.abs(found.colours - shown.colours)[rows].max() > 0.01


def pictures(shown: Gaussians) -> tuple[list, CpuRenderer]:  # type: ignore[type-arg]
    factory = ViewFactory(RIG)
    return factory.views(take_frame(1, 0.1, shown, RIG), {}), CpuRenderer((0.1, 0.2, 0.3))


def test_the_pixels_that_move_alone_give_the_same_bits() -> None:
    views, whole = pictures(turned(2, 0.05))
    rows = np.flatnonzero(BOX.moving)
    part = ChangedPixels((0.1, 0.2, 0.3), 1.0, 0.0, rows, len(BOX))
    part.load_state(BOX)
    for one, other in zip(
        *(follow_pictures(BOX, views, by, MOVES).arrays().values() for by in (whole, part)), strict=True
    ):
        np.testing.assert_array_equal(one, other)


def test_each_subset_looks_from_all_sides_in_whatever_order_cameras_come() -> None:
    views = pictures(BOX)[0]
    names = [view.name for view in from_all_sides(views)]
    assert sorted(names) == sorted(view.name for view in views)
    assert names == [view.name for view in from_all_sides(views[::-1])]
    centres = {name: RIG[name].centre for name in names}
    apart = [
        min(np.linalg.norm(centres[name] - centres[other]) for other in names[:k]) for k, name in enumerate(names) if k
    ]
    assert np.allclose(apart, sorted(apart, reverse=True))  # the farthest that is left comes next
    assert from_all_sides([]) == []


def test_what_is_not_light_counts_for_little() -> None:
    """A thing that is in no state yet stands before some of the cameras."""
    views, picture = pictures(BOX)
    covered = [view.name for view in views][:2]
    for view in views:
        if view.name in covered:
            view.target[:3] = 1 - np.round(view.target[:3])
    found = follow_pictures(BOX, views, picture, MOVES)
    assert 0.01 < np.abs(found.colours - BOX.colours).max() <= SUBSETS * MOST
    assert np.abs(found.colours - BOX.colours)[BOX.moving].mean() < MOST / 2
