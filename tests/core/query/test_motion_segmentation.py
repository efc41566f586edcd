"""Numbers of parts on made scenes with known parts and noisy tracks."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sklearn.metrics import adjusted_rand_score

from scas4d_core.query import motion_segmentation as module
from scas4d_core.query.motion_segmentation import segment_motion

FRAMES = 12


@dataclass
class Scene:
    """Bodies with known motions, whose tracks have noise of 0.1% of a unit and 1°, smooth in space."""

    frames: int = FRAMES
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    positions: list[np.ndarray] = field(default_factory=list)
    turns: list[np.ndarray] = field(default_factory=list)
    present: list[np.ndarray] = field(default_factory=list)
    truth: list[int] = field(default_factory=list)

    def box(self, size, centre, count=250) -> np.ndarray:
        return self.rng.uniform(-0.5, 0.5, (count, 3)) * size + centre

    def add(self, truth: int, points: np.ndarray, motion: Callable, present=lambda t: True) -> None:
        """Adds a body; ``motion(t)`` returns its rotation, the fixed point and the shift since the first frame."""
        waves = self.rng.normal(size=(3, 3)) * 5
        positions, turns = [], []
        for t in range(self.frames):
            turn, pivot, shift = motion(t)
            noise = 0.001 * np.sin(points @ waves + t) + self.rng.normal(size=points.shape) * 0.0005
            positions.append(turn.apply(points - pivot) + pivot + shift + (noise if truth >= 0 else 0))
            turns.append((Rotation.from_rotvec(10 * noise * (truth >= 0)) * turn).as_quat()[:, [3, 0, 1, 2]])
        self.positions.append(np.array(positions))
        self.turns.append(np.array(turns))
        self.present.append(np.array([[present(t)] * len(points) for t in range(self.frames)]))
        self.truth += [truth] * len(points)

    def stretch(self, truth: int, points: np.ndarray, axis: int, amount: Callable, from_: float) -> None:
        """Adds a body that stretches evenly along an axis, away from a plane."""
        positions = np.repeat(points[None], self.frames, axis=0)
        for t in range(self.frames):
            positions[t, :, axis] += (points[:, axis] - from_) * amount(t)
        self.positions.append(positions + self.rng.normal(size=positions.shape) * 0.0005)
        self.turns.append(np.tile([1.0, 0, 0, 0], (self.frames, len(points), 1)))
        self.present.append(np.ones(positions.shape[:2], bool))
        self.truth += [truth] * len(points)

    def parts(self, frames: int | None = None, previous=None) -> np.ndarray:
        arrays = [np.concatenate(part, axis=1)[:frames] for part in (self.positions, self.turns, self.present)]
        return segment_motion(*arrays, np.ones(len(self.truth)), previous)


def turning(axis, rate, pivot) -> Callable:
    return lambda t: (Rotation.from_rotvec(np.array(axis) * rate * t), np.array(pivot), np.zeros(3))


def sliding(step) -> Callable:
    return lambda t: (Rotation.identity(), np.zeros(3), np.array(step) * t)


def resting(t: int):
    return Rotation.identity(), np.zeros(3), np.zeros(3)


def arm(frames: int = FRAMES) -> Scene:
    """A static base, two links in a chain, and a box that the second link carries from half of the frames on."""
    scene = Scene(frames)
    rates, half = (0.05, -0.09), frames // 2

    def lower(t):
        return Rotation.from_rotvec([0, 0, rates[0] * t]), np.zeros(3), np.zeros(3)

    def upper(t):
        elbow = lower(t)[0].apply([0, 0.5, 0]) - [0, 0.5, 0]
        return Rotation.from_rotvec([0, 0, sum(rates) * t]), np.array([0, 0.5, 0]), elbow

    def place(motion, t, point):
        turn, pivot, shift = motion(t)
        return turn.apply(point - pivot) + pivot + shift

    grip = np.array([0, 1.0, 0])

    def carried(t):
        if t < half:
            return resting(t)
        turn = upper(t)[0] * upper(half)[0].inv()
        start = place(upper, half, grip)
        return turn, start, place(upper, t, grip) - start

    scene.add(-1, scene.box([0.4, 0.1, 0.3], [0, -0.1, 0]), resting)
    scene.add(0, scene.box([0.1, 0.46, 0.1], [0, 0.25, 0]), lower)
    scene.add(1, scene.box([0.1, 0.42, 0.1], [0, 0.73, 0]), upper)
    scene.add(2, scene.box([0.15, 0.15, 0.15], place(upper, half, grip)), carried)
    return scene


def gears() -> Scene:
    scene = Scene()
    scene.add(-1, scene.box([1.2, 0.6, 0.02], [0.25, 0, 0.1], 400), resting)
    scene.add(0, scene.box([0.4, 0.4, 0.05], [0, 0, 0]), turning([0, 0, 1], 0.1, [0, 0, 0]))
    scene.add(1, scene.box([0.4, 0.4, 0.05], [0.5, 0, 0]), turning([0, 0, 1], -0.1, [0.5, 0, 0]))
    return scene


def drawers() -> Scene:
    """Two drawers that slide in the same direction at different speeds."""
    scene = Scene()
    scene.add(-1, scene.box([1, 1, 0.1], [0, 0, 0.5]), resting)
    scene.add(0, scene.box([0.8, 0.3, 0.3], [0, 0.2, 0]), sliding([0, 0, -0.02]))
    scene.add(1, scene.box([0.8, 0.3, 0.3], [0, -0.2, 0]), sliding([0, 0, -0.04]))
    return scene


def visitors() -> Scene:
    """A body that leaves, one that enters, and one that stays."""
    scene = Scene()
    scene.add(0, scene.box([0.3, 0.3, 0.3], [0, 0, 0]), turning([0, 1, 0], 0.1, [0, 0, 0]))
    scene.add(1, scene.box([0.2, 0.2, 0.2], [1, 0, 0]), sliding([0, 0.05, 0]), lambda t: t < 7)
    scene.add(2, scene.box([0.2, 0.2, 0.2], [0, 0, 1]), sliding([0.04, 0, 0.02]), lambda t: t >= 5)
    return scene


def elastic() -> Scene:
    """A band that stretches evenly between a static block and a block that moves with its end."""
    scene = Scene()
    amount = lambda t: 0.15 * np.sin(t / 3)  # noqa: E731
    scene.add(-1, scene.box([0.3, 0.1, 0.3], [0, -0.07, 0]), resting)
    scene.stretch(0, scene.box([0.01, 0.6, 0.01], [0, 0.3, 0], 800), 1, amount, 0)
    scene.add(
        1, scene.box([0.3, 0.2, 0.3], [0, 0.72, 0], 400), lambda t: (*resting(t)[:2], np.array([0, 0.6, 0]) * amount(t))
    )
    return scene


@pytest.mark.parametrize("make", [arm, gears, drawers, visitors])
def test_parts_that_move_differently_are_found_and_static_is_no_part(make):
    scene = make()
    labels = scene.parts()
    truth = np.array(scene.truth)
    assert adjusted_rand_score(truth, labels) > 0.97
    assert len(set(labels[labels >= 0])) == len(set(truth[truth >= 0]))
    assert np.mean((labels < 0) == (truth < 0)) > 0.98


def test_noise_does_not_divide_a_body():
    scene = Scene()
    scene.add(0, scene.box([0.6, 0.4, 0.3], [0, 0, 0], 1500), turning([0.3, 1, 0], 0.08, [0.1, 0, 0]))
    assert set(scene.parts()) == {0}


def test_much_of_an_elastic_band_is_one_part_beside_rigid_ones(monkeypatch):
    scene = elastic()
    truth = np.array(scene.truth)

    def largest(labels: np.ndarray) -> tuple[int, float]:
        counts = np.bincount(labels[truth == 0] + 1) / np.count_nonzero(truth == 0)
        return int(counts.argmax()) - 1, float(counts.max())

    label, share = largest(scene.parts())
    assert share > 0.5
    assert np.mean(scene.parts()[truth == 1] == label) < 0.05
    # Without the allowance for deformation, the band would be divided further.
    init = module._Merging.__init__

    def rigid(self, *given):
        init(self, *given)
        self._noise[:] = 0

    monkeypatch.setattr(module._Merging, "__init__", rigid)
    assert largest(scene.parts())[1] < 0.8 * share


def test_positions_of_absent_gaussians_do_not_matter():
    scene = visitors()
    expected = scene.parts()
    for positions, present in zip(scene.positions, scene.present, strict=True):
        positions[~present] = positions[present].mean()
    assert adjusted_rand_score(expected, scene.parts()) > 0.97


def test_what_stands_after_a_part_has_left_does_not_join_it():
    """The part has no motion in the frames in which only the other body is there."""
    scene, half = Scene(), FRAMES // 2
    scene.add(0, scene.box(0.5, [0, 0, 0]), sliding([0.1, 0, 0]), lambda t: t < half)
    scene.add(1, scene.box(0.5, [2, 0, 0]), turning([0, 0, 1], 0.1, [2, 0, 0]))
    scene.add(-1, scene.box(0.5, [0, 1, 0]), resting, lambda t: t >= half)
    parts, truth = scene.parts(), np.array(scene.truth)
    assert (parts[truth == -1] == module.STATIC).all()
    assert adjusted_rand_score(truth, parts) > 0.95


def test_an_object_that_has_just_entered_is_no_moving_part():
    scene = Scene()
    scene.add(0, scene.box(0.5, [0, 0, 0]), sliding([0.1, 0, 0]))
    scene.add(1, scene.box(0.5, [2, 0, 0]), turning([0, 0, 1], 0.1, [2, 0, 0]))
    scene.add(-1, scene.box(0.5, [0, 2, 0]), resting, lambda t: t == FRAMES - 1)
    parts, truth = scene.parts(), np.array(scene.truth)
    assert (parts[truth == -1] == module.STATIC).mean() > 0.99
    assert len(set(parts[truth >= 0].tolist())) == 2


def test_number_and_labels_are_stable_as_frames_come():
    scene = arm(20)
    labels, numbers, kept = None, [], []
    for frames in range(13, 21, 2):  # the box moves from frame 10 on
        again = scene.parts(frames, labels)
        numbers.append(len(set(again[again >= 0])))
        if labels is not None:
            kept.append(adjusted_rand_score(labels, again))
        labels = again
    assert set(numbers) == {3}
    assert min(kept) > 0.95


def test_previous_parts_change_only_with_clear_evidence(monkeypatch):
    scene = drawers()
    apart = scene.parts()
    together = np.where(apart >= 0, 0, -1)
    assert len(set(scene.parts(previous=together))) == 3  # much evidence
    number = lambda previous: len(set(scene.parts(previous=previous)))  # noqa: E731
    low, high = 4.0, 4000.0  # thresholds at which the drawers are apart and together without previous parts
    while high > 1.1 * low:
        monkeypatch.setattr(module, "SEPARATE", np.sqrt(low * high))
        low, high = (np.sqrt(low * high), high) if number(None) == 3 else (low, np.sqrt(low * high))
    threshold = np.sqrt(low * high)
    monkeypatch.setattr(module, "SEPARATE", threshold / 1.15)
    assert number(None) == 3
    assert number(together) == 2
    monkeypatch.setattr(module, "SEPARATE", threshold * 1.15)
    assert number(None) == 2
    assert number(apart) == 3


def test_residuals_are_those_of_the_best_rigid_motion():
    rng = np.random.default_rng(3)
    cross = np.concatenate([rng.normal(size=(200, 3, 3)), np.eye(3)[None], np.zeros((1, 3, 3)), -np.eye(3)[None]])
    left, sizes, right = np.linalg.svd(cross)
    expected = sizes.sum(-1) - 2 * sizes[:, 2] * (np.linalg.det(left @ right) < 0)
    np.testing.assert_allclose(module._best_trace(cross), expected, atol=1e-6)


def test_one_frame_has_one_part():
    scene = arm()
    assert set(scene.parts(frames=1)) == {0}


def test_small_parts_of_one_patch_are_separate(monkeypatch):
    """The most similar patch of such a part belongs to another part, whose relative motion is no noise."""
    scene = Scene()
    scene.add(0, scene.box([1.0, 0.6, 0.6], [0, 0, 0], 500), turning([0, 0, 1], 0.03, [0, 0, 0]))
    for part, (rate, step) in enumerate(((0.08, 0.02), (-0.08, 0.03), (0.12, -0.02), (-0.12, -0.03)), 1):
        points = scene.box([0.15, 0.15, 0.15], [0.3 * part - 0.75, 0.6, 0], 30)
        turn = turning([part % 2, 1 - part % 2, 0.5], rate, points.mean(axis=0))
        scene.add(part, points, lambda t, turn=turn, step=step: (*turn(t)[:2], np.array([0, 0, step]) * t))
    assert adjusted_rand_score(scene.truth, scene.parts()) > 0.98
    monkeypatch.setattr(module, "WITHIN", 1e6)
    assert adjusted_rand_score(scene.truth, scene.parts()) < 0.95
