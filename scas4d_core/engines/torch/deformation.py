"""The deformation of one frame in plain torch: cluster map, its Jacobian, cascade, deltas of single Gaussians.

Equation numbers are those of the SCas4D paper: (5) transport of a Gaussian, (6) the cluster map, (7) the cascade.
Everything is vectorized, differentiable, and of the dtype and on the device of its inputs; in float64 it is the
reference that the kernels of other engines are tested against.
Quaternions are (w, x, y, z). Lengths are metres in the inside world.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import e, log2
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from scas4d_core.guards import EMPTY_CLUSTER, EXPONENT, HALF_TURN

LARGEST = EXPONENT / log2(e)
"""Of an exponential's argument."""

ClusterMap = Literal["centred", "published"]
"""Form of equation (6): scaling about the cluster's pivot, or about the world's origin as published."""

Covariance = Literal["entangled", "separate"]
"""The map that moves a Gaussian's covariance beside its own ΔR and Δs.

"entangled", equation (5): the Jacobian of the map that moves its mean. "separate": nothing, as in the paper's ablation,
which learns the covariance apart from the positions; a wheel's Gaussians then keep their orientation while they go
round, where ΔR does not turn them. The same parameters give the same means and turns in both.
"""


class ClusterParams(NamedTuple):
    """Learnt parameters of the K clusters of one layer, in the paper's symbols; all zeros is the identity when centred.

    Attributes:
        r: [K, 3] rotation as the quaternion (1, r)/|(1, r)|.
        t: [K, 3] metres, displacement relative to the pivot (the paper's t_j is pivot + t).
        c: [K, 3] per metre, gradient of the scaling's argument.
        s: [K] scaling's argument at the pivot.
    """

    r: Tensor
    t: Tensor
    c: Tensor
    s: Tensor

    @classmethod
    def identity(
        cls, count: int, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu"
    ) -> ClusterParams:
        """Zeros for ``count`` clusters."""
        zeros = torch.zeros(count, 10, dtype=dtype, device=device)
        return cls(zeros[:, :3].clone(), zeros[:, 3:6].clone(), zeros[:, 6:9].clone(), zeros[:, 9].clone())


class Layer(NamedTuple):
    """One layer of the hierarchy: the cluster of each of the M points ([M] int64), and the parameters."""

    labels: Tensor
    params: ClusterParams


class Deltas(NamedTuple):
    """Deltas of single Gaussians after the cascade (Δp, ΔR, Δs of the paper); zeros are the identity.

    Attributes:
        dp: [M, 3] metres, added to the mean.
        dr: [M, 3] rotation as the quaternion (1, dr)/|(1, dr)|.
        ds: [M, 3] natural logarithm of the scaling of each transported axis.
    """

    dp: Tensor
    dr: Tensor
    ds: Tensor

    @classmethod
    def identity(cls, count: int, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Deltas:
        """Zeros for ``count`` Gaussians."""
        zeros = torch.zeros(3, count, 3, dtype=dtype, device=device)
        return cls(zeros[0].clone(), zeros[1].clone(), zeros[2].clone())


class Transported(NamedTuple):
    """Points after a map, with the Jacobian and rotation of the map at each.

    Attributes:
        points: [M, 3] metres.
        jacobians: [M, 3, 3] of the map at each point.
        rotations: [M, 4] unit quaternions: polar rotations of the Jacobians (through the layers, their product).
    """

    points: Tensor
    jacobians: Tensor
    rotations: Tensor


class Deformed(NamedTuple):
    """Gaussians after one frame's deformation.

    Attributes:
        means: [M, 3] metres.
        factors: [M, 3, 3]; Σ = F Fᵀ.
        turns: [M, 4] unit quaternions with w ≥ 0: rotation of this frame relative to the one before.
    """

    means: Tensor
    factors: Tensor
    turns: Tensor


def _normalized(q: Tensor) -> Tensor:
    length: Tensor = torch.linalg.vector_norm(q, dim=-1, keepdim=True)
    return q / length


def rotation_quaternions(r: Tensor) -> Tensor:
    """[..., 3] rotation parameters to unit quaternions [..., 4]: (1, r)/|(1, r)|, the half-angle's tangent and axis.

    >>> rotation_quaternions(torch.tensor([[0.0, 0, 1]]))  # tan(angle/2) = 1: a quarter turn about z
    tensor([[0.7071, 0.0000, 0.0000, 0.7071]])
    """
    q = torch.cat([torch.ones_like(r[..., :1]), r], dim=-1)
    return _normalized(q)


def quaternion_matrices(q: Tensor) -> Tensor:
    """Unit quaternions [..., 4] to rotation matrices [..., 3, 3].

    >>> quaternion_matrices(torch.tensor([0.0, 0, 0, 1]))  # a half turn about z
    tensor([[-1.,  0.,  0.],
            [ 0., -1.,  0.],
            [ 0.,  0.,  1.]])
    """
    w, x, y, z = q.unbind(-1)
    entries = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(entries, dim=-1).reshape(*q.shape[:-1], 3, 3)


def quaternion_product(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product [..., 4] of quaternions: the rotation b first, then a.

    >>> about_x, about_z = torch.tensor([0.0, 1, 0, 0]), torch.tensor([0.0, 0, 0, 1])  # half turns
    >>> quaternion_product(about_z, about_x)  # a half turn about y
    tensor([0., 0., 1., 0.])
    """
    aw, av = a[..., :1], a[..., 1:]
    bw, bv = b[..., :1], b[..., 1:]
    w = aw * bw - (av * bv).sum(-1, keepdim=True)
    v = aw * bv + bw * av + torch.linalg.cross(av, bv)
    return torch.cat([w, v], dim=-1)


def scaling_factor(z: Tensor) -> tuple[Tensor, Tensor]:
    """The factor f of equation (6) and its derivative df/dz, any shape.

    f = 2σ(2z) is the paper's tanh(z) + 1 without its cancellation: in float32 the latter is exactly 0 from about −9.

    >>> scaling_factor(torch.zeros(1))
    (tensor([1.]), tensor([1.]))
    """
    f = 2 * torch.sigmoid(2 * z)
    return f, f * (2 - f)


def polar_rotation(f: Tensor, y: Tensor, c: Tensor) -> Tensor:
    """Polar rotation of f·I + f(2−f)·y·cᵀ as unit quaternions [M, 4], in closed form.

    The matrix acts in the plane of y and c, so its rotation is that plane's two-dimensional polar rotation: with
    C the trace and S the skew part within the plane, the quaternion is proportional to (|(C, S)| + C, S). The common
    factor f is left out, which keeps it exact where f comes near 0.

    Args:
        f: [M] scaling factors in (0, 2).
        y: [M, 3] metres.
        c: [M, 3] per metre.

    >>> one = torch.ones(1)
    >>> polar_rotation(one, torch.tensor([[1.0, 0, 0]]), torch.tensor([[2.0, 0, 0]]))  # a stretch turns nothing
    tensor([[1., 0., 0., 0.]])
    """
    g = (2 - f)[:, None]
    cosine = 2 + g * (c * y).sum(-1, keepdim=True)
    sine = g * torch.linalg.cross(c, y)
    radius: Tensor = torch.linalg.vector_norm(torch.cat([cosine, sine], dim=-1), dim=-1, keepdim=True)
    # A half turn (cosine < 0, sine = 0) needs a map that folds space; it then counts as no rotation instead of NaN.
    return _normalized(torch.cat([(radius + cosine).clamp_min(HALF_TURN), sine], dim=-1))


def cluster_pivots(points: Tensor, labels: Tensor, count: int) -> Tensor:
    """[count, 3] means of the clusters' points, detached: no gradient flows through a pivot. Empty clusters get 0.

    >>> cluster_pivots(torch.tensor([[0.0, 0, 0], [2, 0, 0], [5, 5, 5]]), torch.tensor([0, 0, 1]), 2)
    tensor([[1., 0., 0.],
            [5., 5., 5.]])
    """
    points = points.detach()
    sums = torch.zeros(count, 3, dtype=points.dtype, device=points.device).index_add_(0, labels, points)
    sizes = torch.bincount(labels, minlength=count).clamp_min(int(EMPTY_CLUSTER))
    return sums / sizes[:, None].to(points.dtype)


def cluster_map(
    points: Tensor, pivots: Tensor, labels: Tensor, params: ClusterParams, kind: ClusterMap = "centred"
) -> Transported:
    """Equation (6) for every point, with its Jacobian and the Jacobian's polar rotation.

    With d = x − p, z = c·d + s, f = 2σ(2z), f' = f(2−f):
    centred x' = p + t + f·R d; published x' = (R d + p + t)·f. Both have J = R (f·I + f'·y·cᵀ), y = d for the first,
    y = Rᵀ(R d + p + t) for the second. The published map scales about the world's origin and so is not
    translation-equivariant; the two agree where c = s = 0. Where every parameter is 0, points keep their bits.

    Args:
        points: [M, 3] metres.
        pivots: [K, 3] metres.
        labels: [M] int64 in 0…K−1.
        params: of the K clusters.
        kind: form of the map.

    Raises:
        ValueError: an unknown form.

    >>> points = torch.tensor([[1.0, 0, 0], [-1, 0, 0]])
    >>> params = ClusterParams.identity(1, torch.float32)
    >>> params.t[0, 2] = 3  # 3 m along z
    >>> cluster_map(points, torch.zeros(1, 3), torch.tensor([0, 0]), params).points
    tensor([[ 1.,  0.,  3.],
            [-1.,  0.,  3.]])
    """
    pivot, t, c = pivots[labels], params.t[labels], params.c[labels]
    q = rotation_quaternions(params.r)
    rotation = quaternion_matrices(q)[labels]
    offset = points - pivot
    f, df = scaling_factor((c * offset).sum(-1) + params.s[labels])
    # Points go by their change: every term but the point itself is 0 where the parameters are.
    unit = torch.eye(3, dtype=points.dtype, device=points.device)
    step = ((rotation - unit) @ offset[..., None])[..., 0]
    placed = points + (t + step)
    if kind == "centred":
        moved = placed + (f - 1)[:, None] * (offset + step)
        y = offset
    elif kind == "published":
        moved = placed + (f - 1)[:, None] * placed
        y = (rotation.mT @ placed[..., None])[..., 0]
    else:
        raise ValueError(f"cluster map {kind!r} is unknown; give 'centred' or 'published'")
    inner = f[:, None, None] * unit
    inner = inner + df[:, None, None] * y[:, :, None] * c[:, None, :]
    return Transported(moved, rotation @ inner, quaternion_product(q[labels], polar_rotation(f, y, c)))


def cascade(points: Tensor, layers: Sequence[Layer], kind: ClusterMap = "centred") -> Transported:
    """Equation (7), nested: x → φ_K(… φ_2(φ_1(x))), coarsest layer first.

    The pivots of a layer are the means of its clusters' points as moved by the layers above, without gradient.

    Args:
        points: [M, 3] metres.
        layers: coarse to fine; none is the identity.
        kind: form of the cluster map.

    Returns:
        Points, J_K … J_2 J_1, and Q_K ∘ … ∘ Q_1.

    >>> points = torch.tensor([[1.0, 0, 0], [-1, 0, 0]])
    >>> coarse, fine = ClusterParams.identity(1, torch.float32), ClusterParams.identity(2, torch.float32)
    >>> coarse.t[0, 2] = 3
    >>> fine.t[1, 2] = -1
    >>> moved = cascade(points, [Layer(torch.tensor([0, 0]), coarse), Layer(torch.tensor([0, 1]), fine)])
    >>> moved.points
    tensor([[ 1.,  0.,  3.],
            [-1.,  0.,  2.]])
    """
    jacobians = torch.eye(3, dtype=points.dtype, device=points.device).expand(len(points), 3, 3)
    rotations = torch.zeros(len(points), 4, dtype=points.dtype, device=points.device)
    rotations[:, 0] = 1
    for labels, params in layers:
        pivots = cluster_pivots(points, labels, len(params.s))
        points, jacobian, rotation = cluster_map(points, pivots, labels, params, kind)
        jacobians = jacobian @ jacobians
        rotations = quaternion_product(rotation, rotations)
    return Transported(points, jacobians, rotations)


def deform(
    means: Tensor,
    factors: Tensor,
    layers: Sequence[Layer],
    deltas: Deltas,
    kind: ClusterMap = "centred",
    covariance: Covariance = "entangled",
) -> Deformed:
    """Equation (5) on factors: the cascade, then Δp, ΔR, Δs of each Gaussian.

    mean = x_K + Δp; F = R(Δr)·J·F_previous·diag(exp Δs); turn = q(Δr) ∘ Q, flipped to w ≥ 0. Then Σ = F Fᵀ is
    J Σ_previous Jᵀ where the deltas are 0. Where the covariance is separate, J is left out.

    Args:
        means: [M, 3] metres, of the previous frame.
        factors: [M, 3, 3] of the previous frame.
        layers: coarse to fine.
        deltas: per Gaussian.
        kind: form of the cluster map. covariance: "separate" leaves J out of the factors.

    Raises:
        ValueError: an unknown form.

    >>> means, factors = torch.zeros(1, 3), 0.1 * torch.eye(3)[None]
    >>> deltas = Deltas.identity(1, torch.float32)
    >>> deltas.dp[0, 0] = 0.5
    >>> deformed = deform(means, factors, [], deltas)
    >>> deformed.means, deformed.turns
    (tensor([[0.5000, 0.0000, 0.0000]]), tensor([[1., 0., 0., 0.]]))
    """
    points, jacobians, rotations = cascade(means, layers, kind)
    if covariance not in ("entangled", "separate"):
        raise ValueError(f"covariance {covariance!r} is unknown; give 'entangled' or 'separate'")
    dq = rotation_quaternions(deltas.dr)
    carried = quaternion_matrices(dq)
    if covariance == "entangled":
        carried = carried @ jacobians
    moved = carried @ factors * torch.exp(deltas.ds.clamp(-LARGEST, LARGEST))[:, None, :]
    turns = quaternion_product(dq, rotations)
    turns = torch.where(turns[:, :1] < 0, -turns, turns)
    return Deformed(points + deltas.dp, moved, turns)


def material_rotations(turns: Tensor, previous: Tensor) -> Tensor:
    """[M, 4] unit quaternions since frame 0: this frame's turns after the previous material rotations.

    >>> quarter = torch.tensor([[0.5, 0, 0, 0.5]]) * 2**0.5
    >>> material_rotations(quarter, previous=quarter)
    tensor([[0., 0., 0., 1.]])
    """
    q = quaternion_product(turns, previous)
    return _normalized(q)
