import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sklearn.metrics import adjusted_rand_score

from scas4d_core.gaussians import Gaussians
from scas4d_core.query import parts as module
from scas4d_core.query.parts import NO_PART, match_labels, part_features, parts
from scas4d_core.storage.births import extend_roots
from scas4d_core.storage.history import History


def bodies(frames: int = 12, n: int = 300, unit: float = 1.0, standing: int = 0) -> tuple[History, np.ndarray]:
    """Three rods in a chain, each turning about its own joint, and things that stand."""
    rng = np.random.default_rng(0)
    which = rng.permutation(np.repeat([0, 1, 2], [3 * n // 2, n, n // 2]))
    rest = rng.uniform(-1, 1, size=(len(which), 3)) * [0.05, 0.2, 0.05] + np.array([0, 0.42, 0]) * which[:, None]
    stand = rng.uniform(-1, 1, size=(standing, 3))
    history = History()
    for t in range(frames):
        means, quaternions = np.empty_like(rest), np.empty((len(which), 4))
        for body, rate in enumerate((0.06, -0.08, 0.09)):
            turn = Rotation.from_rotvec([0.3 * rate * t, 0, rate * t])
            joint = np.array([0, 0.42 * body - 0.2, 0])
            rows = which == body
            means[rows] = turn.apply(rest[rows] - joint) + joint
            quaternions[rows] = np.roll(turn.as_quat(), 1)
        total = len(which) + standing
        history.append(
            t,
            t / 30,
            Gaussians(
                means=(unit * np.vstack([means, stand])).astype(np.float32),
                factors=np.tile(0.01 * unit * np.eye(3, dtype=np.float32), (total, 1, 1)),
                rotations=np.vstack([quaternions, np.tile([1, 0, 0, 0], (standing, 1))]).astype(np.float32),
                opacities=np.full(total, 0.8, np.float32),
                colours=np.zeros((total, 3), np.float32),
                foreground=np.repeat([1, 0], [len(which), standing]).astype(np.float32),
                ids=np.arange(total, dtype=np.int64),
            ),
        )
    return history, which


def test_bodies_that_turn_apart_are_told_apart_and_ordered_by_size():
    history, which = bodies()
    labels = parts(history, 3)
    assert np.array_equal(labels, which)  # 450, 300 and 150 Gaussians of equal weight: the largest is part 0


@pytest.mark.parametrize("unit", [0.01, 100.0])
def test_the_same_lambdas_serve_every_scale(unit):
    history, which = bodies(unit=unit)
    assert np.array_equal(parts(history, 3), which)


def test_standing_gaussians_belong_to_no_part():
    history, which = bodies(standing=500)
    labels = parts(history, 3)
    assert np.all(labels[len(which) :] == NO_PART)
    assert np.array_equal(labels[: len(which)], which)


def test_count_is_found_and_a_sample_labels_everyone(monkeypatch):
    history, which = bodies()
    monkeypatch.setattr(module, "MERGING_SAMPLE", 700)
    labels = parts(history)
    assert len(labels) == len(which)
    assert labels.max() + 1 == 3
    assert adjusted_rand_score(which, labels) > 0.99


def test_long_histories_are_thinned_evenly(monkeypatch):
    history, which = bodies(frames=40)
    monkeypatch.setattr(module, "MAX_FRAMES", 5)
    asked: list[list[int]] = []
    stacked = history.stacked
    history.stacked = lambda name, indices=None, rows=None: (asked.append(list(indices)), stacked(name, indices, rows))[
        1
    ]
    assert np.array_equal(parts(history, 3), which)
    assert asked == [[0, 10, 20, 29, 39]] * 2


def test_features_have_the_papers_distances(monkeypatch):
    rng = np.random.default_rng(1)
    positions = rng.normal(size=(6, 2, 3))
    rotations = np.roll(Rotation.random(12, random_state=1).as_quat().reshape(6, 2, 4), 1, axis=-1)
    for name, value in (("POSITION", 0.7), ("ROTATION", 0.4), ("INITIAL", 1.3)):
        monkeypatch.setattr(module, f"LAMBDA_{name}", value)
    features = part_features(positions, rotations, 2.0)
    matrices = Rotation.from_quat(np.roll(rotations, -1, axis=-1).reshape(-1, 4)).as_matrix().reshape(6, 2, 9)
    paper = np.concatenate(
        [0.7 * positions / 2, 0.4 * matrices, np.repeat(1.3 * positions[:1] / 2, 6, axis=0)], axis=-1
    )  # [T, 2, 15]
    expected = np.linalg.norm(paper[:, 0] - paper[:, 1]) / np.sqrt(6)
    np.testing.assert_allclose(np.linalg.norm(features[0] - features[1]), expected, rtol=1e-6)


def first_frames(history: History, frames: int) -> History:
    short = History()
    for index in history.indices[:frames]:
        short.append(index, history.time(index), history.gaussians(index))
    return short


def test_labels_go_on_when_more_frames_come():
    history, _ = bodies()
    early = parts(first_frames(history, 6), 3)
    order = np.array([2, 0, 1])  # as if they had been numbered otherwise, when other parts were the largest
    later = parts(history, 3, previous=order[early])
    assert np.array_equal(later, order[parts(history, 3)])
    # From one frame to the next, nearly every Gaussian keeps its label.
    labels = parts(first_frames(history, 4), 3)
    for frames in range(5, 13):
        again = parts(first_frames(history, frames), 3, previous=labels)
        assert np.mean(again == labels) > 0.98
        labels = again


def test_without_the_parts_before_labels_would_not_be_stable():
    # Two rods of nearly the same size: which is the larger one turns on a hair.
    rng = np.random.default_rng(4)
    labels = np.repeat([0, 1], [500, 498])
    swapped = 1 - labels
    swapped[rng.choice(998, 20, replace=False)] ^= 1
    assert np.mean(match_labels(swapped, labels, np.ones(998)) == labels) > 0.97


def test_a_scene_without_motion_is_one_part_and_static_things_are_none_beside_others():
    history, which = bodies(frames=1)
    assert set(parts(history)) == {0}
    history, which = bodies()
    still = History()
    for t in history.indices:  # the last rod rests
        state, rows = history.gaussians(t), which == 2
        still.append(t, t / 30, state.replace(**{
            name: np.where(rows.reshape(-1, *[1] * (getattr(state, name).ndim - 1)), getattr(history.first, name),
                           getattr(state, name))
            for name in ("means", "rotations")
        }))  # fmt: skip
    labels = parts(still)
    assert (labels[which == 2] == NO_PART).mean() > 0.98
    assert adjusted_rand_score(which, labels) > 0.98


def test_what_has_left_keeps_a_part_if_the_number_is_found():
    whole, which = bodies()
    history = History()
    for t in whole.indices:
        history.append(
            t, t / 30, whole.gaussians(t).retire(np.flatnonzero(which == 2)) if t >= 8 else whole.gaussians(t)
        )
    labels = parts(history)
    assert adjusted_rand_score(which, labels) > 0.98
    assert (labels >= 0).all()
    assert (parts(history, 2)[which == 2] == NO_PART).all()


def test_parts_are_numbered_as_before_when_more_frames_come():
    history, which = bodies()
    early = parts(first_frames(history, 8))
    order = np.array([2, 0, 1])
    assert adjusted_rand_score(which, early) > 0.98
    assert np.mean(parts(history, previous=order[early]) == order[which]) > 0.98


def test_labels_are_matched_by_weight_as_a_whole():
    previous = np.array([0, 0, 0, 1, 1, 1, -1])
    labels = np.array([1, 1, 0, 0, 0, 0, 0])
    assert match_labels(labels, previous, np.ones(7)).tolist() == [0, 0, 1, 1, 1, 1, 1]
    # One heavy Gaussian decides against two light ones.
    heavy = match_labels(np.array([0, 1, 1]), np.array([1, 1, 0]), np.array([1.0, 1.0, 9.0]))
    assert heavy.tolist() == [1, 0, 0]
    # A part too many takes the lowest label that is free; what belongs to no part stays so.
    assert match_labels(np.array([0, 1, 2, -1]), np.array([4, 0, -1, 0]), np.ones(4)).tolist() == [4, 0, 1, -1]
    assert match_labels(np.array([-1, -1]), np.array([0, 1]), np.ones(2)).tolist() == [-1, -1]
    assert match_labels(np.array([0, 1]), np.array([-1, -1]), np.ones(2)).tolist() == [0, 1]


def test_refusals():
    history, _ = bodies(frames=2, n=4)
    with pytest.raises(ValueError, match="count 99 is not between 1 and 12, the number of moving"):
        parts(history, 99)
    with pytest.raises(ValueError, match="history is empty"):
        parts(History(), 2)
    still = History()
    theta = history.gaussians(0)
    still.append(0, 0.0, theta.replace(foreground=np.zeros(len(theta), np.float32)))
    with pytest.raises(ValueError, match="no Gaussian moves"):
        parts(still, 2)
    with pytest.raises(ValueError, match=r"previous labels must have shape \[12\], one per Gaussian; got \(3,\)"):
        parts(history, 2, previous=np.zeros(3))


def test_gaussians_born_later_belong_to_the_part_of_their_founders():
    whole, which = bodies()
    born, count, birth = np.arange(0, len(which), 3), len(which), 5
    parents = np.array([int(np.flatnonzero(which == which[row])[1]) for row in born])
    history, roots = History(), None
    for t in whole.indices:
        state = whole.gaussians(t)
        if t >= birth:
            there = state.rows(born)
            ids = np.full(len(born), -1) if t == birth else history.ids[count:]
            state = state.concatenate(there).replace(ids=np.concatenate([state.ids, ids]))
            roots = extend_roots(history.roots(), state, parents) if t == birth else None
        given = {} if t != birth else {"parents": parents, "roots": roots}
        history.append(t, t / 30, state.retire([0, 1]) if t == whole.indices[-1] else state, **given)
    positions, rotations = module.motion(history, np.arange(count, count + len(born)), 12)
    then, turned = module.motion(whole, born, 12)
    np.testing.assert_allclose(positions, then, atol=1e-5)  # before their birth they were where their parents led
    assert np.abs(np.sum(rotations * turned, axis=-1)).min() > 1 - 1e-5
    labels = parts(history, 3)
    assert np.array_equal(labels[2:count], which[2:])
    assert np.array_equal(labels[count:], which[born])
    assert (labels[:2] == NO_PART).all()


def test_gaussians_born_without_a_founder_stay_where_they_were_born():
    whole, _ = bodies(frames=4)
    history = History()
    for t in whole.indices:
        state = whole.gaussians(t)
        if t >= 2:
            state = state.concatenate(state.rows([7]))
            state = state if t == 2 else state.replace(ids=history.ids)
        history.append(t, t / 30, state)
    positions, _ = module.motion(history, np.array([len(whole.newest)]), 4)
    np.testing.assert_array_equal(positions[:3, 0], np.repeat(whole.gaussians(2).means[[7]], 3, axis=0))
    assert np.isfinite(positions).all()
