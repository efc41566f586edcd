"""Labels from motion: what moves is told apart from what stands without any mask."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from box_scene import MOVING, make_box, make_rig, moved, take_frame
from scipy.spatial.transform import Rotation

from scas4d_core.captures.frame import Frame
from scas4d_core.effects.presence import motion_mask
from scas4d_core.effects.presence.motion_mask import INSIDE_SHARE, changed_pixels, first_labels, with_reliable_labels
from scas4d_core.engines.cpu.renderer import CpuRenderer
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.frame_outcome import FrameOutcome
from scas4d_core.gaussians import Gaussians
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings, UpdateSettings
from scas4d_core.update.result import camera_fit

RIG = make_rig()
BOX = make_box()
SETTINGS = Settings(update=UpdateSettings(iterations=20, clusters=(2, 12, 48)))


def start(iterations: int = 20) -> Reconstruction:
    everything: Gaussians = BOX.replace(foreground=np.ones(len(BOX), np.float32))
    frame = take_frame(0, 0.0, BOX, RIG, False)
    cameras = {name: camera_fit(35.0) for name in RIG.names}
    settings = SETTINGS.model_copy(update={"update": SETTINGS.update.model_copy(update={"iterations": iterations})})
    return Reconstruction.start(RIG, frame, settings, static=StaticResult(everything, {}, [], cameras=cameras))


def test_what_moves_is_found_and_committed() -> None:
    scene = start()
    assert scene.history.gaussians(0).moving.all()
    report = scene.step(take_frame(1, 1.0, moved(BOX), RIG, False))
    moving = scene.history.gaussians(1).moving
    assert moving[:MOVING].mean() > 0.9
    assert moving[MOVING:].mean() < 0.1
    assert report.moving == moving.sum()
    standing = ~moving
    np.testing.assert_array_equal(
        scene.history.gaussians(1).means[standing], scene.history.gaussians(0).means[standing]
    )


def test_nothing_is_decided_while_nothing_moves() -> None:
    scene = start()
    scene.step(take_frame(1, 1.0, BOX, RIG, False))
    assert scene.history.gaussians(1).moving.all()
    scene.step(take_frame(2, 2.0, moved(BOX), RIG, False))
    assert scene.history.gaussians(2).moving[MOVING:].mean() < 0.1


def noisy(index: int, state: Gaussians = BOX, *, knocked: str = "") -> Frame:
    """A frame with the noise of its sensor; the picture of one camera may be shifted by five pixels."""
    frame, random = take_frame(index, float(index), state, RIG, False), np.random.default_rng(index)
    images = {
        name: np.clip(image + random.normal(0, 3, image.shape), 0, 255).astype(np.uint8)
        for name, image in frame.images.items()
    }
    if knocked:
        images[knocked] = np.roll(images[knocked], 5, axis=1)
    return replace(frame, images=images)


def test_until_something_is_seen_to_move_nothing_does() -> None:
    scene = start()
    reports = [scene.step(noisy(index)) for index in (1, 2)]
    assert [report.outcome for report in reports] == 2 * [FrameOutcome.UNCHANGED]
    assert [report.attempts for report in reports] == 2 * [["no motion detected"]]
    np.testing.assert_array_equal(scene.history.newest.means, BOX.means)
    assert len(scene._prepared.carried.seen) == len(RIG)


def test_a_camera_that_is_off_ends_the_rest() -> None:
    scene = start()
    assert scene.step(noisy(1)).outcome is FrameOutcome.UNCHANGED
    report = scene.step(noisy(2, knocked="c2"))
    assert report.outcome is not FrameOutcome.UNCHANGED
    assert "c2" in [alarm.camera for alarm in report.alarms]


def test_a_rest_has_an_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """What enters is born only where frames are updated, and no label tells of it."""
    monkeypatch.setattr("scas4d_core.reconstruction.RESTING", 2)
    scene = start()
    found = [scene.step(noisy(index)).outcome for index in (1, 2, 3)]
    assert found == [FrameOutcome.UNCHANGED, FrameOutcome.UNCHANGED, FrameOutcome.UPDATED]


def test_what_is_too_slow_to_be_seen_from_frame_to_frame_adds_up() -> None:
    scene, seen = start(iterations=80), []
    for index in range(1, 11):
        creep = moved(BOX, Rotation.identity(), np.array([0.002 * index, 0.0, 0.0]))
        seen.append(scene.step(take_frame(index, float(index), creep, RIG, False)).outcome)
    assert seen[0] is FrameOutcome.UNCHANGED
    assert seen[-1] is FrameOutcome.UPDATED
    assert scene.history.newest.moving[MOVING:].mean() < 0.1
    went = (scene.history.newest.means - BOX.means)[scene.history.newest.moving]
    np.testing.assert_allclose(np.median(went, axis=0), [0.02, 0, 0], atol=0.005)


def test_pictures_that_are_met_much_worse_are_no_rest() -> None:
    scene = start()
    # What each camera has changed in another place than the others: no two agree on a Gaussian that moves.
    frame = take_frame(1, 1.0, BOX, RIG, False)
    images = {}
    for number, (name, image) in enumerate(frame.images.items()):
        images[name] = image.copy()
        images[name][number * 3 : number * 3 + 14] = 255 - images[name][number * 3 : number * 3 + 14]
    assert scene.step(replace(frame, images=images)).outcome is not FrameOutcome.UNCHANGED


@pytest.mark.parametrize(
    ("moving", "new", "learnt"), [(0, 31, False), (0, 32, True), (100, 32, False), (100, 33, True)]
)
def test_labels_are_learnt_of_enough(moving: int, new: int, learnt: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    found = np.zeros(10_000, np.bool_)
    found[moving : moving + new] = True
    monkeypatch.setattr(motion_mask, "find_moving", lambda *_: found)
    many = Gaussians.of_points(np.zeros((10_000, 3)), radius=0.1)
    known = np.arange(10_000) < moving if moving else None
    labels = motion_mask.learn_labels_from_motion(many, known, (), (), CpuRenderer((0, 0, 0)))
    assert (labels is not None) == learnt
    assert labels is None or labels.sum() == moving + new


def test_what_has_moved_stays_in_the_hierarchy() -> None:
    scene = start()
    after = moved(BOX)
    scene.step(take_frame(1, 1.0, after, RIG, False))
    scene.step(take_frame(2, 2.0, after, RIG, False))
    np.testing.assert_array_equal(scene.history.gaussians(2).moving, scene.history.gaussians(1).moving)


def test_masks_have_the_word_where_there_are_any() -> None:
    frame = take_frame(0, 0.0, BOX, RIG, True)
    scene = Reconstruction.start(RIG, frame, SETTINGS, static=StaticResult(BOX, {}, []))
    scene.step(take_frame(1, 1.0, moved(BOX), RIG, True))
    np.testing.assert_array_equal(scene.history.gaussians(1).foreground, BOX.foreground)


def test_a_changed_pixel_marks_its_surroundings() -> None:
    before, now = np.zeros((3, 20, 20), np.float32), np.zeros((3, 20, 20), np.float32)
    now[1, 10, 4] = 0.5
    now[2, 0, 19] = 0.01
    marked = changed_pixels(before, now)
    assert marked.sum() == 25
    assert marked[8:13, 2:7].all()


@pytest.mark.parametrize(("standing", "all_move"), [(0, True), (5, True), (10, False), (50, False)])
def test_the_few_that_stand_in_an_object_move_with_it(standing: int, all_move: bool) -> None:
    rows = np.linspace(0, len(BOX) - 1, 100).astype(int)
    labels = np.full(100, 0.9, np.float32)
    labels[:standing] = 0.2
    hundred = Gaussians(**{name: array[rows] for name, array in BOX.arrays().items()}).replace(foreground=labels)
    after = with_reliable_labels(hundred)
    assert after.moving.all() == all_move
    np.testing.assert_array_equal(after.foreground[standing:], labels[standing:])
    if not all_move:
        assert after is hundred


def with_one_at(*places: list[float]) -> Gaussians:
    """The box and the plate, and behind them standing Gaussians at places in the world."""
    row = Gaussians(**{name: array[-1:] for name, array in BOX.arrays().items()})
    rows = [row.replace(means=np.float32([place]), ids=np.int64([len(BOX) + k])) for k, place in enumerate(places)]
    return Gaussians(**{
        name: np.concatenate([getattr(part, name) for part in (BOX, *rows)]) for name in BOX.arrays()
    })  # fmt: skip


def test_what_stands_inside_of_what_moves_moves_with_it() -> None:
    inside, above, beside = [0.0, 0.02, 0.0], [0.0, -0.5, 0.0], [0.5, 0.0, 0.0]
    state, masks = with_one_at(inside, above, beside), take_frame(0, 0.0, BOX, RIG).masks
    labelled = first_labels(state, RIG, masks)
    np.testing.assert_array_equal(labelled.moving[-3:], [True, False, False])
    plate = slice(MOVING, len(BOX))
    np.testing.assert_array_equal(labelled.moving[plate], False)
    np.testing.assert_array_equal(labelled.foreground[:-3], state.foreground[:-3])
    scene = Reconstruction.start(RIG, take_frame(0, 0.0, BOX, RIG), SETTINGS, static=StaticResult(state, {}, []))
    scene.step(take_frame(1, 1.0, moved(BOX), RIG))
    went = np.linalg.norm(scene.history.gaussians(1).means - state.means, axis=1)
    assert went[-3] > 0.01
    np.testing.assert_array_equal(went[-2:], 0)


def test_masks_that_few_cameras_have_tell_of_no_inside() -> None:
    state, masks = with_one_at([0.0, 0.02, 0.0]), take_frame(0, 0.0, BOX, RIG).masks
    assert first_labels(state, RIG, {}) is state
    assert first_labels(state, RIG, {name: masks[name] for name in list(masks)[:2]}) is state
    assert first_labels(state, RIG, {name: masks[name] for name in list(masks)[:3]}).moving[-1]


@pytest.mark.parametrize("ragged", [1, 2])
def test_a_mask_that_misses_a_place_is_outvoted(ragged: int) -> None:
    state, masks = with_one_at([0.0, 0.02, 0.0]), dict(take_frame(0, 0.0, BOX, RIG).masks)
    for name in list(masks)[:ragged]:
        masks[name] = np.zeros_like(masks[name])
    assert first_labels(state, RIG, masks).moving[-1] == (1 - ragged / len(masks) >= INSIDE_SHARE)
