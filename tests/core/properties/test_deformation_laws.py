"""Laws of the centred cluster map and its cascade: in float64 (the twin), and in float32 (the kernels) where exact."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st
from law_cases import Motion, doubles, law, on_cpu, seeds, some_motion, some_rotation
from torch.testing import assert_close

from scas4d_core.engines.torch.deformation import (
    ClusterParams,
    Deformed,
    Deltas,
    Layer,
    cascade,
    cluster_map,
    cluster_pivots,
    deform,
    material_rotations,
    quaternion_matrices,
    quaternion_product,
    scaling_factor,
)

ROUNDING = {"rtol": 1e-11, "atol": 1e-11}
SMALLEST_DETERMINANT = 1e-3
"""δ of the law of definite covariances: well above the rounding of a determinant of factors of size 1."""


def deformed(motion: Motion) -> Deformed:
    return deform(*motion)


def identity(motion: Motion) -> Motion:
    layers = [Layer(labels, ClusterParams.identity(len(params.s))) for labels, params in motion.layers]
    return motion._replace(layers=layers, deltas=Deltas.identity(len(motion.means)))


def with_params(motion: Motion, change: object) -> list[Layer]:
    return [Layer(labels, change(params)) for labels, params in motion.layers]  # type: ignore[operator]


@law(30)
@given(seeds)
def test_the_identity_deformation_is_the_identity(seed: int) -> None:
    still = identity(some_motion(seed))
    after = deformed(still)
    assert_close(after.means, still.means, rtol=0, atol=0)
    torch.testing.assert_close(after.factors, still.factors, rtol=0, atol=0)
    assert_close(after.turns, doubles([1, 0, 0, 0]).expand(12, 4), rtol=0, atol=0)
    kernel = on_cpu(still)
    np.testing.assert_array_equal(kernel.means, still.means.numpy().astype(np.float32))
    np.testing.assert_array_equal(kernel.factors, still.factors.numpy().astype(np.float32))
    np.testing.assert_array_equal(kernel.turns, np.tile(np.float32([1, 0, 0, 0]), (12, 1)))


@law(30)
@given(seeds, st.integers(1, 2))
def test_a_cascade_is_the_composition_of_its_layers(seed: int, cut: int) -> None:
    motion = some_motion(seed, count=24, layers=3)
    whole = cascade(motion.means, motion.layers)
    first = cascade(motion.means, motion.layers[:cut])
    second = cascade(first.points, motion.layers[cut:])
    assert_close(second.points, whole.points, **ROUNDING)
    assert_close(second.jacobians @ first.jacobians, whole.jacobians, **ROUNDING)
    assert_close(quaternion_product(second.rotations, first.rotations), whole.rotations, **ROUNDING)


@law(30)
@given(seeds)
def test_frames_compose(seed: int) -> None:
    """What two frames do to factors and material rotations is the product of what each does."""
    one, two = some_motion(seed), some_motion(seed + 1)
    no_scaling = Deltas.identity(12)
    first = deform(one.means, one.factors, one.layers, no_scaling)
    second = deform(first.means, first.factors, two.layers, no_scaling)
    j1 = cascade(one.means, one.layers).jacobians
    j2 = cascade(first.means, two.layers).jacobians
    assert_close(second.factors, j2 @ j1 @ one.factors, **ROUNDING)
    before = doubles(np.tile([1, 0, 0, 0], (12, 1)))
    material = material_rotations(second.turns, material_rotations(first.turns, before))
    expected = quaternion_matrices(second.turns) @ quaternion_matrices(first.turns)
    assert_close(quaternion_matrices(material), expected, **ROUNDING)


@law(30)
@given(seeds)
def test_rigid_layers_compose_to_a_rigid_layer_and_have_an_inverse(seed: int) -> None:
    """Each layer one cluster: its pivot moves along, so that rotations multiply and displacements add."""
    motion, rng = some_motion(seed), np.random.default_rng(seed)
    labels = torch.zeros(12, dtype=torch.int64)
    r, t = doubles(rng.normal(size=(2, 1, 3))), doubles(rng.normal(size=(2, 1, 3)))
    zeros = ClusterParams.identity(1)
    both = [Layer(labels, zeros._replace(r=r[k], t=t[k])) for k in range(2)]
    pivot = motion.means.mean(0)
    turn = torch.eye(3, dtype=torch.float64)
    for layer in both:
        turn = cascade(motion.means, [layer]).jacobians[0] @ turn
    found = cascade(motion.means, both)
    assert_close(found.points, (motion.means - pivot) @ turn.T + pivot + t.sum((0, 1)), **ROUNDING)
    assert_close(quaternion_matrices(found.rotations), turn.expand(12, 3, 3), **ROUNDING)
    back = Layer(labels, zeros._replace(r=-r[0], t=-t[0]))
    assert_close(cascade(motion.means, [both[0], back]).points, motion.means, **ROUNDING)


@law(60)
@given(seeds, st.sampled_from([0.1, 0.3, 1.0, 3.0]))
def test_covariances_are_positive_semidefinite_and_definite_where_space_is_not_flattened(
    seed: int, scale: float
) -> None:
    motion = some_motion(seed, scale=scale)
    for factors in (deformed(motion).factors, doubles(on_cpu(motion).factors)):
        sigma = factors @ factors.mT
        assert_close(sigma, sigma.mT, rtol=0, atol=0)
        lengths = torch.linalg.eigvalsh(sigma)
        largest = lengths[:, 2]
        assert (lengths[:, 0] >= -1e-14 * largest).all()
        # det Σ = (det F)² is at most the smallest eigenvalue times the square of the largest.
        determinant = torch.linalg.det(factors / largest.sqrt()[:, None, None])
        definite = determinant.abs() > SMALLEST_DETERMINANT
        assert (lengths[:, 0] / largest >= 0.99 * determinant**2)[definite].all()
        assert (lengths[:, 0] > 0)[definite].all()


@law(60)
@given(seeds, st.sampled_from([0.3, 1.0, 3.0]))
def test_the_determinant_tells_where_space_folds(seed: int, scale: float) -> None:
    """det J = f³ (1 + (2 − f) cᵀ(x − p)): a positive factor does not keep the map from turning inside out."""
    motion = some_motion(seed, scale=scale, layers=1)
    labels, params = motion.layers[0]
    offset = motion.means - cluster_pivots(motion.means, labels, 2)[labels]
    along = (params.c[labels] * offset).sum(-1)
    f, _ = scaling_factor(along + params.s[labels])
    jacobians = cascade(motion.means, motion.layers).jacobians
    assert_close(torch.linalg.det(jacobians), f**3 * (1 + (2 - f) * along), rtol=1e-9, atol=1e-11)
    after = deformed(motion)
    assert all(tensor.isfinite().all() for tensor in after)
    assert_close(after.turns.norm(dim=1), torch.ones(12, dtype=torch.float64), **ROUNDING)


@law(30)
@given(seeds)
def test_the_map_is_equivariant_to_shifts_and_rotations(seed: int) -> None:
    motion = some_motion(seed)
    turn, shift = doubles(some_rotation(seed)), doubles(np.random.default_rng(seed).normal(size=3))

    def turned(params: ClusterParams) -> ClusterParams:
        return ClusterParams(params.r @ turn.T, params.t @ turn.T, params.c @ turn.T, params.s)

    dp, dr, ds = motion.deltas
    other = deform(
        motion.means @ turn.T + shift,
        turn @ motion.factors,
        with_params(motion, turned),
        Deltas(dp @ turn.T, dr @ turn.T, ds),
    )
    plain = deformed(motion)
    assert_close(other.means, plain.means @ turn.T + shift, **ROUNDING)
    assert_close(other.factors, turn @ plain.factors, **ROUNDING)
    assert_close(quaternion_matrices(other.turns), turn @ quaternion_matrices(plain.turns) @ turn.T, **ROUNDING)


def scaled(motion: Motion, factor: float) -> Motion:
    """The same in other units: lengths times a factor, the gradient of the scaling divided by it."""
    layers = with_params(motion, lambda params: params._replace(t=factor * params.t, c=params.c / factor))
    deltas = motion.deltas._replace(dp=factor * motion.deltas.dp)
    return Motion(factor * motion.means, factor * motion.factors, layers, deltas)


@law(30)
@given(seeds, st.integers(-12, 12))
def test_a_power_of_two_as_the_unit_changes_no_bit(seed: int, power: int) -> None:
    motion, factor = some_motion(seed), 2.0**power
    plain, other = deformed(motion), deformed(scaled(motion, factor))
    for found, wanted in ((other.means, plain.means), (other.factors, plain.factors)):
        assert_close(found, factor * wanted, rtol=0, atol=0)
    assert_close(other.turns, plain.turns, rtol=0, atol=0)
    in_kernel, other_in_kernel = on_cpu(motion), on_cpu(scaled(motion, factor))
    np.testing.assert_array_equal(other_in_kernel.means, np.float32(factor) * in_kernel.means)
    np.testing.assert_array_equal(other_in_kernel.factors, np.float32(factor) * in_kernel.factors)
    np.testing.assert_array_equal(other_in_kernel.turns, in_kernel.turns)


@law(30)
@given(seeds, st.floats(1e-3, 1e3))
def test_any_other_unit_only_rounds(seed: int, factor: float) -> None:
    motion = some_motion(seed)
    plain, other = deformed(motion), deformed(scaled(motion, factor))
    assert_close(other.means / factor, plain.means, **ROUNDING)
    assert_close(other.factors / factor, plain.factors, **ROUNDING)
    assert_close(other.turns, plain.turns, **ROUNDING)


@law(30)
@given(seeds)
def test_the_order_of_gaussians_does_not_matter(seed: int) -> None:
    motion, order = some_motion(seed), np.random.default_rng(seed).permutation(12)
    layers = [Layer(labels[order], params) for labels, params in motion.layers]
    deltas = Deltas(*(tensor[order] for tensor in motion.deltas))
    for found, wanted in zip(
        deform(motion.means[order], motion.factors[order], layers, deltas), deformed(motion), strict=True
    ):
        assert_close(found, wanted[order], **ROUNDING)


@law(20)
@given(seeds)
def test_one_cluster_moves_only_what_is_its_own(seed: int) -> None:
    motion = some_motion(seed, layers=1)
    labels, params = motion.layers[0]
    first = doubles([1, 0])
    r, t, c = (first[:, None] * values for values in params[:3])
    alone = ClusterParams(r, t, c, first * params.s)
    after = cluster_map(motion.means, cluster_pivots(motion.means, labels, 2), labels, alone)
    assert_close(after.points[labels == 1], motion.means[labels == 1], rtol=0, atol=0)
    assert (after.points[labels == 0] - motion.means[labels == 0]).abs().max() > 1e-3
