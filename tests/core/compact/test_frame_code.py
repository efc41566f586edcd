"""One state told by another: errors stay within their bounds, readers get the same bits, what stands costs nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scas4d_core.compact.bounds import Bounds
from scas4d_core.compact.cluster_motion import PER_CLUSTER, ClusterMotion, Clusters, polar_rotations, quaternions_of
from scas4d_core.compact.columns import Columns
from scas4d_core.compact.frame_code import (
    MIN_VOLUME_RATIO,
    EncodedFrame,
    FrameDelta,
    apply_deltas,
    decode,
    encode,
    errors_of,
)
from scas4d_core.compact.planes import PlaneError
from scas4d_core.gaussians import Gaussians, quaternion_products

COUNT = 600
BOUNDS = Bounds()


def cloud(seed: int = 0, count: int = COUNT, flat: float = 1.0) -> Gaussians:
    """Gaussians of many shapes in a box, each turned in its own way."""
    rng = np.random.default_rng(seed)
    lengths = 0.02 * np.exp(rng.normal(0, 0.7, (count, 3))) * [1, 1, flat]
    turns = Rotation.random(count, rng=rng)
    state = Gaussians.of_points(rng.uniform(-1, 1, (count, 3)), 0.02, rng.uniform(0, 1, (count, 3)))
    return state.replace(
        factors=(turns.as_matrix() * lengths[:, None, :]).astype(np.float32),
        opacities=rng.uniform(0.01, 0.99, count).astype(np.float32),
        foreground=np.where(rng.uniform(size=count) < 0.7, 1.0, 0.0).astype(np.float32),
    )


def carried(state: Gaussians, turn: Rotation, shift: tuple[float, float, float]) -> Gaussians:
    """All that moves, as one rigid body."""
    rows = state.moving[:, None]
    rotations = quaternion_products(np.tile(np.roll(turn.as_quat(), 1), (len(state), 1)), state.rotations)
    return state.replace(
        means=np.where(rows, turn.apply(state.means) + shift, state.means).astype(np.float32),
        factors=np.where(rows[:, :, None], turn.as_matrix() @ state.factors, state.factors).astype(np.float32),
        rotations=np.where(rows, rotations, state.rotations).astype(np.float32),
    )


def jittered(state: Gaussians, size: float, seed: int = 1) -> Gaussians:
    """Each Gaussian a little elsewhere, otherwise turned, scaled and coloured."""
    rng = np.random.default_rng(seed)
    count = len(state)
    own = np.linalg.norm(state.factors, axis=(1, 2))[:, None]
    turns = Rotation.from_rotvec(rng.normal(0, size, (count, 3)))
    scales = np.exp(rng.normal(0, size, (count, 1, 3)))
    return state.replace(
        means=(state.means + size * own * rng.normal(size=(count, 3))).astype(np.float32),
        factors=(turns.as_matrix() @ state.factors * scales).astype(np.float32),
        rotations=quaternion_products(np.roll(turns.as_quat(), 1, axis=1), state.rotations).astype(np.float32),
        colours=(state.colours + size * rng.normal(size=(count, 3))).astype(np.float32),
    )


def coded(before: Gaussians, after: Gaussians, bounds: Bounds = BOUNDS) -> EncodedFrame:
    """Encodes, and checks that a reader gets the same bits and that the errors are told as they are."""
    clusters, reference = Clusters.of(before), Columns.of(before)
    result = encode(reference, Columns.of(after), clusters, bounds)
    again = decode(reference, clusters, bounds, result.body).gaussians()
    for name, array in result.decoded.gaussians().arrays().items():
        assert np.array_equal(getattr(again, "own_opacities" if name == "opacities" else name), array), name
    errors = errors_of(Columns.of(again), Columns.of(after))
    assert errors == pytest.approx(dict(result.errors), rel=1e-6)
    return result


def within(errors: dict[str, float], bounds: Bounds) -> bool:
    limits = bounds.record()
    return all(value <= 1.001 * limits[name] for name, value in errors.items())


@pytest.mark.parametrize("size", [0.0, 0.01, 0.1, 1.0])
@pytest.mark.parametrize("flat", [1.0, 0.01])
def test_errors_stay_within_the_bounds(size: float, flat: float) -> None:
    before = cloud(flat=flat)
    after = jittered(carried(before, Rotation.from_rotvec([0.1, 0.4, -0.2]), (0.3, 0, -0.1)), size)
    result = coded(before, after)
    assert within(dict(result.errors), BOUNDS), result.errors


@pytest.mark.parametrize("name", ["position", "axes", "rotation", "colour"])
def test_a_tighter_bound_is_kept_and_costs_more(name: str) -> None:
    before = cloud()
    after = jittered(before, 0.1)
    tight = replace(BOUNDS, **{name: getattr(BOUNDS, name) / 20})
    loose, result = coded(before, after), coded(before, after, tight)
    assert within(dict(result.errors), tight)
    assert not within(dict(loose.errors), tight)
    assert len(result.body) > 1.1 * len(loose.body)


def test_what_moves_as_one_costs_little() -> None:
    before = cloud(count=3000)
    together = coded(before, carried(before, Rotation.from_rotvec([0.1, 0.4, -0.2]), (0.3, 0, -0.1)))
    alone = coded(before, jittered(before, 0.3))
    assert len(together.body) < 0.25 * len(alone.body)
    assert len(together.body) < 3000  # under a byte for each of 20 numbers of each Gaussian


def test_what_stands_keeps_its_bits() -> None:
    before = cloud()
    after = carried(before, Rotation.from_rotvec([0.0, 0.5, 0.0]), (0.1, 0.2, 0.3))
    found = coded(before, after).decoded.gaussians()
    for name in ("means", "factors", "rotations", "colours", "foreground"):
        assert np.array_equal(getattr(found, name)[~before.moving], getattr(before, name)[~before.moving]), name
    assert len(coded(before, before).body) < 16 + 12 * 9 + 20


def test_thin_gaussians_keep_their_volume_and_their_handedness() -> None:
    before = cloud(flat=1e-3)
    after = jittered(before, 0.5)
    found = coded(before, after).decoded.gaussians()
    ratios = np.linalg.det(found.factors.astype(float)) / np.linalg.det(after.factors.astype(float))
    assert (ratios > 0.99 * MIN_VOLUME_RATIO).all()
    assert (ratios < 1.01 / MIN_VOLUME_RATIO).all()


def test_who_moves_is_the_same() -> None:
    before = cloud()
    labels = np.linspace(0, 1, COUNT).astype(np.float32)
    found = coded(before, before.replace(foreground=labels)).decoded.gaussians()
    assert np.array_equal(found.moving, labels > 0.5)
    assert np.abs(found.foreground - labels).max() < 1 / 100


def test_the_retired_and_what_is_mirrored_are_told() -> None:
    before = cloud()
    rng = np.random.default_rng(3)
    glossy = before.replace(
        gloss=rng.normal(0, 0.2, (400, 3)).astype(np.float32),
        environment=rng.uniform(size=(4, 8, 3)).astype(np.float32),
    )
    after = carried(glossy, Rotation.from_rotvec([0, 0, 1.0]), (0, 0, 0)).retire([3, 5, 599])
    after = after.replace(environment=rng.uniform(size=(4, 8, 3)).astype(np.float32))
    found = coded(glossy, after).decoded.gaussians()
    assert np.flatnonzero(found.retired).tolist() == [3, 5, 599]
    assert found.opacities[3] == 0
    assert np.array_equal(found.environment, after.environment)
    assert np.abs(found.gloss - after.gloss).max() <= 1.001 * BOUNDS.gloss
    back = coded(found, glossy).decoded.gaussians()
    assert not back.retired.any()


@pytest.mark.parametrize("value", [1e6, 1e30])
def test_what_is_far_away_is_told_exactly(value: float) -> None:
    before = cloud()
    means = before.means.copy()
    means[7, 1] = value
    clusters, reference = Clusters.of(before), Columns.of(before)
    result = encode(reference, Columns.of(before.replace(means=means)), clusters, BOUNDS)
    found = decode(reference, clusters, BOUNDS, result.body).gaussians()
    assert np.allclose(found.means[7], means[7], rtol=1e-5)
    assert within(dict(result.errors), BOUNDS)


def test_errors_do_not_add_up() -> None:
    """A chain of fifty frames, each told by the one before."""
    true = cloud()
    clusters, told = Clusters.of(true), Columns.of(true)
    for frame in range(50):
        true = jittered(carried(true, Rotation.from_rotvec([0.02, 0.05, 0]), (0.01, 0, 0)), 0.02, seed=frame)
        result = encode(told, Columns.of(true), clusters, BOUNDS)
        told = result.decoded
    assert within(dict(result.errors), BOUNDS)


def test_states_are_the_same_told_at_once_or_one_by_one() -> None:
    """Some of what stands is pushed, turned or lit once: whichever frames are read with it, its bits are the same."""
    true = cloud()
    standing = np.flatnonzero(~true.moving)
    clusters, told = Clusters.of(true), Columns.of(true)
    first, changes = told, []
    for frame in range(6):
        true = carried(true, Rotation.from_rotvec([0.02, 0.05, 0]), (0.01, 0, 0))
        pushed, jogged = standing[frame::7], jittered(true, 0.3, seed=frame)
        means, factors, rotations = true.means.copy(), true.factors.copy(), true.rotations.copy()
        means[pushed], factors[pushed], rotations[pushed] = (
            array[pushed] for array in (jogged.means, jogged.factors, jogged.rotations)
        )
        colours = true.colours.copy()
        colours[standing[frame::5]] *= np.float32(0.9)
        true = true.replace(means=means, factors=factors, rotations=rotations, colours=colours)
        coded_state = encode(told, Columns.of(true), clusters, BOUNDS)
        assert within(dict(coded_state.errors), BOUNDS)
        changes.append(FrameDelta.read(coded_state.body, told, clusters))
        told = coded_state.decoded
    at_once = apply_deltas(first, clusters, BOUNDS, changes)
    for name in ("means", "factors", "rotations", "colours", "foreground"):
        assert getattr(at_once, name).tobytes() == getattr(told, name).tobytes(), name
    assert within(errors_of(at_once, Columns.of(true)), BOUNDS)


@pytest.mark.parametrize("cut", [0, 5, 16, 40, 200, -1])
def test_a_body_that_is_cut_is_refused(cut: int) -> None:
    before = cloud()
    body = coded(before, jittered(before, 0.1)).body
    with pytest.raises(PlaneError):
        decode(Columns.of(before), Clusters.of(before), BOUNDS, body[:cut])
    with pytest.raises(PlaneError, match="after the state"):
        decode(Columns.of(before), Clusters.of(before), BOUNDS, body + b"more")


@pytest.mark.parametrize("step", [1e308, float("inf"), float("nan")])
def test_steps_that_cannot_be_are_refused_where_they_are(step: float) -> None:
    before = cloud()
    body = coded(before, jittered(before, 0.1)).body
    with pytest.raises(PlaneError, match="out of range"):
        FrameDelta.read(np.float64(step).tobytes() + body[8:], Columns.of(before), Clusters.of(before))


def test_maps_of_clusters_are_those_that_were_made() -> None:
    before = cloud(count=2000)
    clusters = Clusters.of(before)
    turn = Rotation.from_rotvec([0.3, -0.2, 0.1])
    motion = ClusterMotion.fit(clusters, Columns.of(before), Columns.of(carried(before, turn, (0.1, 0.2, 0.3))))
    assert np.abs(motion.matrices + np.eye(3) - turn.as_matrix()).max() < 0.02  # ridge
    assert clusters.count == -(-np.count_nonzero(before.moving) // PER_CLUSTER)


def test_turns_of_matrices() -> None:
    turns = Rotation.random(50, rng=np.random.default_rng(0))
    stretched = turns.as_matrix() @ np.diag([2.0, 1.0, 0.5])
    assert np.allclose(quaternions_of(turns.as_matrix()), np.roll(turns.as_quat(canonical=True), 1, axis=1), atol=1e-9)
    assert np.allclose(np.linalg.det(polar_rotations(stretched)), 1)
    mirrored = polar_rotations(np.diag([1.0, 1.0, -1.0])[None])
    assert np.allclose(np.linalg.det(mirrored), 1)


def test_nothing_moves_and_no_cluster_is_made() -> None:
    before = cloud().replace(foreground=np.zeros(COUNT, np.float32))
    assert Clusters.of(before).count == 0
    assert within(dict(coded(before, jittered(before, 0.1)).errors), BOUNDS)
