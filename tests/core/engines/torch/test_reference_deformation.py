"""Laws of the cluster map and the cascade, in float64."""

import pytest
import torch

from scas4d_core.engines.torch import deformation
from scas4d_core.engines.torch.deformation import (
    ClusterParams,
    Deltas,
    Layer,
    cascade,
    cluster_map,
    cluster_pivots,
    deform,
    material_rotations,
    polar_rotation,
    quaternion_matrices,
    quaternion_product,
    rotation_quaternions,
    scaling_factor,
)

KINDS = ("centred", "published")


def normal(*shape: int, seed: int = 0, scale: float = 1.0) -> torch.Tensor:
    return scale * torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def some_params(count: int, seed: int = 1, scale: float = 0.3) -> ClusterParams:
    return ClusterParams(
        *(normal(count, *tail, seed=seed + i, scale=scale) for i, tail in enumerate([(3,)] * 3 + [()]))
    )


def some_layers(points: int) -> list[Layer]:
    fine = torch.arange(points) % 6
    return [Layer(fine // 3, some_params(2, 10)), Layer(fine, some_params(6, 20))]


def svd_rotation(matrices: torch.Tensor) -> torch.Tensor:
    u, _, vh = torch.linalg.svd(matrices)
    return u @ vh


def test_factor_is_tanh_plus_one_without_its_cancellation() -> None:
    z = torch.linspace(-5, 5, 41, dtype=torch.float64)
    f, df = scaling_factor(z)
    torch.testing.assert_close(f, torch.tanh(z) + 1, rtol=0, atol=1e-15)
    torch.testing.assert_close(df, 1 - torch.tanh(z) ** 2, rtol=0, atol=1e-15)
    far = torch.tensor([-15.0])
    assert torch.tanh(far) + 1 == 0
    assert scaling_factor(far)[0] > 0


def test_rotation_parameters_are_axis_times_tangent_of_half_angle() -> None:
    r = torch.tensor([[0, 0, torch.tan(torch.tensor(torch.pi / 8))]], dtype=torch.float64)
    turned = quaternion_matrices(rotation_quaternions(r))[0] @ torch.tensor([1.0, 0, 0], dtype=torch.float64)
    expected = torch.tensor([0.5**0.5, 0.5**0.5, 0], dtype=torch.float64)
    torch.testing.assert_close(turned, expected, rtol=0, atol=1e-7)


def test_product_of_quaternions_is_product_of_matrices() -> None:
    a, b = rotation_quaternions(normal(5, 3, seed=3)), rotation_quaternions(normal(5, 3, seed=4))
    product = quaternion_matrices(quaternion_product(a, b))
    torch.testing.assert_close(product, quaternion_matrices(a) @ quaternion_matrices(b))


@pytest.mark.parametrize("kind", KINDS)
def test_identity_parameters_are_the_identity(kind: str) -> None:
    points, factors = normal(12, 3), normal(12, 3, 3, seed=5)
    layers = [
        Layer(torch.arange(12) // 6, ClusterParams.identity(2)),
        Layer(torch.arange(12) // 3, ClusterParams.identity(4)),
    ]
    moved = deform(points, factors, layers, Deltas.identity(12), kind)
    torch.testing.assert_close(moved.means, points)
    # The published map with f = 1 and c = 0 is the identity as well: its f' only enters through c.
    torch.testing.assert_close(moved.factors, factors)
    torch.testing.assert_close(moved.turns, torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).expand(12, 4))


@pytest.mark.parametrize("kind", KINDS)
def test_jacobian_is_the_derivative_of_the_map(kind: str) -> None:
    points, pivots, labels, params = normal(6, 3), normal(2, 3, seed=2), torch.arange(6) % 2, some_params(2)
    stated = cluster_map(points, pivots, labels, params, kind).jacobians
    full = torch.autograd.functional.jacobian(lambda x: cluster_map(x, pivots, labels, params, kind).points, points)
    torch.testing.assert_close(stated, full.diagonal(dim1=0, dim2=2).permute(2, 0, 1))


@pytest.mark.parametrize("kind", KINDS)
def test_closed_form_rotation_is_the_polar_rotation(kind: str) -> None:
    points, pivots, labels, params = (
        normal(200, 3),
        normal(4, 3, seed=2),
        torch.arange(200) % 4,
        some_params(4, scale=1.0),
    )
    moved = cluster_map(points, pivots, labels, params, kind)
    proper = torch.linalg.det(moved.jacobians) > 1e-6
    assert proper.sum() > 50
    torch.testing.assert_close(
        quaternion_matrices(moved.rotations)[proper], svd_rotation(moved.jacobians)[proper], rtol=0, atol=1e-8
    )


def test_polar_rotation_stays_finite_where_space_folds_or_vanishes() -> None:
    f = torch.tensor([0.0, 1e-30, 1.0], dtype=torch.float64, requires_grad=True)
    y = torch.tensor([[1.0, 0, 0], [1, 0, 0], [-5, 0, 0]], dtype=torch.float64)
    c = torch.tensor([[0.0, 1, 0], [0, 1, 0], [1, 0, 0]], dtype=torch.float64)
    q = polar_rotation(f, y, c)
    torch.testing.assert_close(q.norm(dim=-1), torch.ones(3, dtype=torch.float64))
    (gradient,) = torch.autograd.grad(q.sum(), f)
    assert gradient.isfinite().all()


def test_maps_agree_without_scaling_and_differ_with_it() -> None:
    points, pivots, labels, params = normal(6, 3), normal(2, 3, seed=2), torch.arange(6) % 2, some_params(2)
    rigid = params._replace(c=torch.zeros_like(params.c), s=torch.zeros_like(params.s))
    for a, b in zip(*(cluster_map(points, pivots, labels, rigid, kind) for kind in KINDS), strict=True):
        torch.testing.assert_close(a, b)
    a, b = (cluster_map(points, pivots, labels, params, kind).points for kind in KINDS)
    assert (a - b).abs().max() > 0.01


def test_only_the_centred_cascade_is_translation_equivariant() -> None:
    points, shift = normal(12, 3), torch.tensor([10.0, -3, 2], dtype=torch.float64)
    layers = some_layers(12)
    gaps = {
        kind: (cascade(points + shift, layers, kind).points - shift - cascade(points, layers, kind).points)
        for kind in KINDS
    }
    assert gaps["centred"].abs().max() < 1e-12
    assert gaps["published"].abs().max() > 0.1


def test_unknown_map_is_named() -> None:
    with pytest.raises(ValueError, match="unknown cluster map 'sideways'"):
        cascade(normal(12, 3), some_layers(12), "sideways")  # type: ignore[arg-type]


def test_pivots_are_means_without_gradient_and_empty_clusters_do_not_divide_by_zero() -> None:
    points = torch.tensor([[0.0, 0, 0], [2, 0, 0], [5, 5, 5]], dtype=torch.float64, requires_grad=True)
    pivots = cluster_pivots(points, torch.tensor([0, 0, 2]), 3)
    assert pivots.tolist() == [[1, 0, 0], [0, 0, 0], [5, 5, 5]]
    assert not pivots.requires_grad


@pytest.mark.parametrize("kind", KINDS)
def test_cascade_is_the_nested_composition(kind: str) -> None:
    points, (first, second) = normal(12, 3), some_layers(12)
    one = cluster_map(points, cluster_pivots(points, first.labels, 2), first.labels, first.params, kind)
    two = cluster_map(one.points, cluster_pivots(one.points, second.labels, 6), second.labels, second.params, kind)
    both = cascade(points, [first, second], kind)
    torch.testing.assert_close(both.points, two.points)
    torch.testing.assert_close(both.jacobians, two.jacobians @ one.jacobians)
    torch.testing.assert_close(both.rotations, quaternion_product(two.rotations, one.rotations))


def test_covariance_is_pushed_forward_and_deltas_come_last() -> None:
    points, factors, layers = normal(12, 3), normal(12, 3, 3, seed=5), some_layers(12)
    plain = deform(points, factors, layers, Deltas.identity(12))
    j = cascade(points, layers).jacobians
    torch.testing.assert_close(plain.factors @ plain.factors.mT, j @ (factors @ factors.mT) @ j.mT)
    deltas = Deltas(normal(12, 3, seed=6), normal(12, 3, seed=7, scale=0.2), normal(12, 3, seed=8, scale=0.2))
    own = deform(points, factors, layers, deltas)
    torch.testing.assert_close(own.means, plain.means + deltas.dp)
    scaled = plain.factors @ torch.diag_embed(deltas.ds.exp())
    torch.testing.assert_close(own.factors, quaternion_matrices(rotation_quaternions(deltas.dr)) @ scaled)


@pytest.mark.parametrize("kind", KINDS)
def test_a_separate_covariance_is_changed_by_what_is_the_gaussians_own_alone(kind: str) -> None:
    points, factors, layers = normal(12, 3), normal(12, 3, 3, seed=5), some_layers(12)
    deltas = Deltas(normal(12, 3, seed=6), normal(12, 3, seed=7, scale=0.2), normal(12, 3, seed=8, scale=0.2))
    entangled, separate = (deform(points, factors, layers, deltas, kind, c) for c in ("entangled", "separate"))
    torch.testing.assert_close(separate.means, entangled.means, rtol=0, atol=0)
    torch.testing.assert_close(separate.turns, entangled.turns, rtol=0, atol=0)
    assert (separate.factors - entangled.factors).abs().max() > 0.1
    own = quaternion_matrices(rotation_quaternions(deltas.dr))
    torch.testing.assert_close(separate.factors, own @ factors @ torch.diag_embed(deltas.ds.exp()))
    alone = deform(points, factors, layers, Deltas.identity(12), kind, "separate")
    torch.testing.assert_close(alone.factors, factors)
    unmoved = [deform(points, factors, [], deltas, kind, c).factors for c in ("entangled", "separate")]
    torch.testing.assert_close(*unmoved)


def test_unknown_covariance_is_named() -> None:
    with pytest.raises(ValueError, match="unknown covariance 'loose'; choose 'entangled' or 'separate'"):
        deform(normal(2, 3), normal(2, 3, 3), [], Deltas.identity(2), "centred", "loose")  # type: ignore[arg-type]


def test_turns_have_positive_w_and_the_rotation_of_the_product() -> None:
    # Two turns of 120 degrees about z make −120 degrees, whose product quaternion has w < 0.
    r = torch.tensor([[0, 0, 3**0.5]], dtype=torch.float64)
    layer = Layer(torch.zeros(1, dtype=torch.int64), ClusterParams.identity(1)._replace(r=r))
    points, factors = torch.zeros(1, 3, dtype=torch.float64), torch.eye(3, dtype=torch.float64)[None]
    moved = deform(points, factors, [layer, layer], Deltas.identity(1))
    torch.testing.assert_close(moved.turns, torch.tensor([[0.5, 0, 0, -(0.75**0.5)]], dtype=torch.float64))
    torch.testing.assert_close(quaternion_matrices(moved.turns), moved.factors)
    material = material_rotations(moved.turns, rotation_quaternions(-r))  # −120 and once more −120: +120
    torch.testing.assert_close(quaternion_matrices(material), quaternion_matrices(rotation_quaternions(r)))


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_of_the_map(kind: str) -> None:
    points, pivots, labels = normal(4, 3), normal(2, 3, seed=2), torch.tensor([0, 0, 1, 1])
    assert torch.autograd.gradcheck(
        lambda x, *p: tuple(cluster_map(x, pivots, labels, ClusterParams(*p), kind)),
        [tensor.requires_grad_() for tensor in (points, *some_params(2))],
    )


@pytest.mark.parametrize("covariance", ["entangled", "separate"])
@pytest.mark.parametrize("kind", KINDS)
def test_gradients_of_the_whole_deformation(kind: str, covariance: str, monkeypatch: pytest.MonkeyPatch) -> None:
    points, factors = normal(4, 3), normal(4, 3, 3, seed=5)
    labels = [torch.zeros(4, dtype=torch.int64), torch.tensor([0, 0, 1, 1])]
    deltas = [normal(4, 3, seed=i, scale=0.2) for i in (6, 7, 8)]
    # Pivots follow the parameters by value but not by gradient; central differences must see them stand still too.
    fixed = {1: normal(1, 3, seed=2), 2: normal(2, 3, seed=3)}
    monkeypatch.setattr(deformation, "cluster_pivots", lambda points, labels, count: fixed[count])

    def deformed(*p: torch.Tensor) -> tuple[torch.Tensor, ...]:
        layers = [Layer(labels[0], ClusterParams(*p[:4])), Layer(labels[1], ClusterParams(*p[4:8]))]
        return tuple(deform(points, factors, layers, Deltas(*p[8:]), kind, covariance))

    inputs = [*some_params(1, 30), *some_params(2), *deltas]
    assert torch.autograd.gradcheck(deformed, [tensor.requires_grad_() for tensor in inputs])
