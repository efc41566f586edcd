"""Gradients equal central differences, in float64 and away from the kinks; pivots are held, as the method holds them.

Kinks are where the picture or a term has no derivative: the alpha floor and cap, two Gaussians at one depth, the
transmittance stop, the clamped place of the projection's Jacobian, the near plane, and absolute values at zero.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from law_cases import Motion, Splats, doubles, law, seeds, some_motion, some_splats
from torch import Tensor

from scas4d_core.engines.limits import DEFAULT
from scas4d_core.engines.torch import deformation, losses
from scas4d_core.engines.torch import rasterizer as twin
from scas4d_core.engines.torch.deformation import ClusterParams, Deltas, Layer, deform, rotation_quaternions
from scas4d_core.engines.torch.rasterizer import CameraParams

STEP = 1e-6
"""Of the central differences: their rounding is near 1e-10, and what they cut off near 1e-12."""
FAR = 1e-4
"""How far from a kink a scene has to be, relative to the quantity that has it: a hundred steps."""


def agrees(function: object, inputs: Sequence[Tensor]) -> bool:
    """Whether the gradients of all outputs by all inputs are those of central differences."""
    leaves = [tensor.detach().clone().requires_grad_() for tensor in inputs]
    result: bool = torch.autograd.gradcheck(function, leaves, eps=STEP, atol=1e-6, rtol=1e-5)  # type: ignore[arg-type]
    return result


def hold_pivots(monkeypatch: pytest.MonkeyPatch, motion: Motion) -> None:
    """Pivots follow the parameters by value, not by gradient; central differences must see them stand still."""
    held, points = {}, motion.means
    for labels, params in motion.layers:
        count = len(params.s)
        held[count] = deformation.cluster_pivots(points, labels, count)
        points = deformation.cluster_map(points, held[count], labels, params).points
    monkeypatch.setattr(deformation, "cluster_pivots", lambda points, labels, count: held[count])


def parameters(motion: Motion) -> list[Tensor]:
    return [tensor for _, params in motion.layers for tensor in params] + list(motion.deltas)


def with_parameters(motion: Motion, values: Sequence[Tensor]) -> Motion:
    layers = [Layer(labels, ClusterParams(*values[4 * k : 4 * k + 4])) for k, (labels, _) in enumerate(motion.layers)]
    return motion._replace(layers=layers, deltas=Deltas(*values[4 * len(layers) :]))


@pytest.mark.slow
@law(12)
@given(seeds, st.sampled_from([0.1, 0.3, 1.0]))
def test_of_the_cascade(seed: int, scale: float) -> None:
    motion = some_motion(seed, count=7, scale=scale)
    turns = deformation.cascade(motion.means, motion.layers).rotations
    assume(turns[:, 0].abs().min() > 0.05)  # there the sign of a turn is chosen
    with pytest.MonkeyPatch.context() as patch:
        hold_pivots(patch, motion)
        assert agrees(lambda *given: tuple(deform(*with_parameters(motion, given))), parameters(motion))
        assert agrees(lambda m, f: tuple(deform(m, f, *motion[2:])), motion[:2])


def alphas(splats: Splats) -> tuple[Tensor, Tensor, Tensor]:
    """Opacity times fall-off [P, N] before floor and cap, front to back, and the conics' camera-space x/z and y/z."""
    camera = CameraParams.of(splats.camera)
    seen = splats.means @ camera.rotation.T + camera.translation
    order = torch.argsort(seen[:, 2])
    projected = twin.project(splats.means[order], splats.factors[order], camera)
    v, u = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    d = torch.stack([u, v], -1).reshape(-1, 1, 2).to(torch.float64) - projected.means
    power = -0.5 * torch.einsum("pni,nij,pnj->pn", d, torch.linalg.inv(projected.covariances), d)
    return splats.opacities[order] * power.exp(), seen[order, 2], seen[order, :2] / seen[order, 2:]


def far_from_kinks(splats: Splats) -> bool:
    alpha, depths, tangents = alphas(splats)
    camera = splats.camera
    size, focal = doubles([camera.width, camera.height]), doubles([camera.fx, camera.fy])
    centre, margin = doubles([camera.cx, camera.cy]), DEFAULT.tangent_margin * size / (2 * focal)
    drawn = torch.where(alpha >= DEFAULT.alpha_floor, alpha.clamp(max=DEFAULT.alpha_cap), 0)
    left = torch.cumprod(1 - drawn, dim=1)
    distances = [
        alpha / DEFAULT.alpha_floor - 1,
        alpha / DEFAULT.alpha_cap - 1,
        left / DEFAULT.transmittance_stop - 1,
        depths.diff(),
        depths - DEFAULT.near,
        tangents + centre / focal + margin,
        tangents - (size - centre) / focal - margin,
    ]
    return all(distance.abs().min() > FAR for distance in distances)


def render(splats: Splats, means: Tensor, factors: Tensor, opacities: Tensor, features: Tensor) -> Tensor:
    camera = CameraParams.of(splats.camera)
    picture = twin.render(means, factors, opacities, features, camera, splats.background)
    return torch.cat([picture.features, picture.alpha[..., None]], dim=-1)


@law(12)
@given(seeds, st.sampled_from(["ordinary", "opaque", "near and wide"]))
def test_of_the_rasterizer(seed: int, kind: str) -> None:
    splats = some_splats(seed)
    if kind == "opaque":  # the cap holds some, and the stop hides some
        splats = splats._replace(opacities=doubles(np.random.default_rng(seed).uniform(0.9, 1.0, 5)))
    if kind == "near and wide":  # some lie beside the picture, where the Jacobian is evaluated at a clamped place
        splats = splats._replace(means=3 * splats.means)
    assume(far_from_kinks(splats))
    assert agrees(lambda *given: render(splats, *given), splats[:4])


def test_a_scene_at_a_kink_is_left_out() -> None:
    splats = some_splats(0)
    assert far_from_kinks(splats)
    same_depth = splats.means.clone()
    same_depth[1] = same_depth[0] + doubles(splats.camera.rotation[0]) * 0.1
    assert not far_from_kinks(splats._replace(means=same_depth))
    alpha, _, _ = alphas(splats)
    at_floor = splats.opacities * (DEFAULT.alpha_floor / alpha.max(dim=0).values.min())
    assert not far_from_kinks(splats._replace(opacities=at_floor))


COUNT, NEAREST = 6, 3


class Neighbourhood:
    """Six Gaussians, three neighbours of each, turned and moved: no pair at rest, where the roots have their kinks."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.previous, self.means = doubles(rng.normal(size=(2, COUNT, 3)))
        self.turns = rotation_quaternions(doubles(rng.normal(0, 0.3, (COUNT, 3))))
        others = [rng.permutation(np.delete(np.arange(COUNT), i))[:NEAREST] for i in range(COUNT)]
        self.index = torch.tensor(np.array(others))
        self.weights = doubles(rng.uniform(0.1, 1, (COUNT, NEAREST)))
        self.distances = doubles(rng.uniform(0.2, 3, (COUNT, NEAREST)))
        self.rows = torch.tensor(np.sort(rng.choice(COUNT, 4, replace=False)))

    @property
    def stretch(self) -> Tensor:
        """[6, 3] metres that each pair is longer than when the graph was built."""
        return (self.means[self.index] - self.means[:, None]).norm(dim=-1) - self.distances


@law(12)
@given(seeds)
def test_of_the_neighbour_terms(seed: int) -> None:
    g = Neighbourhood(seed)
    assume(g.stretch.abs().min() > FAR)
    pairs = (g.index, g.weights, g.rows)
    assert agrees(lambda m, q: losses.rigidity_loss(m, q, g.previous, *pairs), [g.means, g.turns])
    assert agrees(lambda m: losses.isometry_loss(m, g.distances, *pairs), [g.means])
    assert agrees(lambda q: losses.rotation_loss(q, *pairs), [g.turns])


@pytest.mark.slow
@law(12)
@given(seeds)
def test_of_the_picture_terms(seed: int) -> None:
    rng = np.random.default_rng(seed)
    image, target = doubles(rng.uniform(0, 1, (2, 13, 12, 2)))
    assume((image - target).abs().min() > FAR)
    assert agrees(lambda i: losses.image_loss(i, target), [image])
    small = target[:5, :4]
    assert agrees(lambda i: losses.ssim_map(i, small), [image[:5, :4]])


@law(12)
@given(seeds)
def test_of_the_terms_of_single_gaussians(seed: int) -> None:
    rng = np.random.default_rng(seed)
    factors, first = doubles(rng.normal(0, 0.5, (COUNT, 3, 3))), doubles(rng.uniform(0.2, 1.0, (COUNT, 3)))
    plane = rng.normal(size=4).tolist()
    means, colours, before = doubles(rng.normal(size=(3, COUNT, 3)))
    excess = losses.axis_lengths(factors) - first.clamp_min(0.5)
    below = means @ doubles(plane[:3]) + plane[3]
    assume(min(values.abs().min() for values in (excess, below, colours - before)) > FAR)
    assert agrees(lambda f: losses.scale_loss(f, first, 0.5), [factors])
    assert agrees(lambda m: losses.floor_loss(m, plane), [means])
    assert agrees(lambda c: losses.soft_colour_loss(c, before), [colours])
