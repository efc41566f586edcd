"""Deformation of one frame in plain PyTorch: cluster map with Jacobian, cascade, and per-Gaussian deltas.

Equation numbers refer to the SCas4D paper: (5) transport of a Gaussian, (6) cluster map, (7) cascade. All functions
are vectorized and differentiable, and preserve the dtype and device of their inputs. In float64, they are the reference
for the kernels of other engines. Quaternions are (w, x, y, z). Lengths are in metres in internal world coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import e, log2
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from scas4d_core.guards import EMPTY_CLUSTER, EXPONENT, HALF_TURN

LARGEST = EXPONENT / log2(e)
"""Bound on the magnitude of exponents."""

ClusterMap = Literal["centred", "published"]
"""Variant of equation (6), which scales about the cluster's pivot ("centred") or the world origin ("published")."""

Covariance = Literal["entangled", "separate"]
"""How a Gaussian's covariance is deformed, apart from its own ΔR and Δs.

"entangled" applies the Jacobian of the map that moves the mean, as in equation (5). "separate" leaves the covariance
undeformed, as in the paper's ablation, which learns covariances independently of positions. The Gaussians of a rotating
wheel then keep their orientation, unless ΔR rotates them. Means and rotations are the same in both variants.
"""


class ClusterParams(NamedTuple):
    """Learned parameters of one layer's K clusters, in the paper's notation. If all are 0, the map is the identity.

    Attributes:
        r: [K, 3] rotation, as the quaternion (1, r)/|(1, r)|.
        t: [K, 3] translation of the pivot in metres (t_j in the paper is pivot + t).
        c: [K, 3] gradient of the scaling argument, per metre.
        s: [K] scaling argument at the pivot.
    """

    r: Tensor
    t: Tensor
    c: Tensor
    s: Tensor

    @classmethod
    def identity(
        cls, count: int, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu"
    ) -> ClusterParams:
        """Returns all-zero parameters for ``count`` clusters."""
        zeros = torch.zeros(count, 10, dtype=dtype, device=device)
        return cls(zeros[:, :3].clone(), zeros[:, 3:6].clone(), zeros[:, 6:9].clone(), zeros[:, 9].clone())


class Layer(NamedTuple):
    """One layer of the hierarchy.

    Attributes:
        labels: [M] int64 cluster of each point.
        params: parameters of the clusters.
    """

    labels: Tensor
    params: ClusterParams


class Deltas(NamedTuple):
    """Per-Gaussian deltas applied after the cascade (Δp, ΔR, Δs in the paper). All-zero deltas represent the identity.

    Attributes:
        dp: [M, 3] offset added to the mean, in metres.
        dr: [M, 3] rotation, as the quaternion (1, dr)/|(1, dr)|.
        ds: [M, 3] natural logarithm of the scale factor of each transported axis.
    """

    dp: Tensor
    dr: Tensor
    ds: Tensor

    @classmethod
    def identity(cls, count: int, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Deltas:
        """Returns all-zero deltas for ``count`` Gaussians."""
        zeros = torch.zeros(3, count, 3, dtype=dtype, device=device)
        return cls(zeros[0].clone(), zeros[1].clone(), zeros[2].clone())


class Transported(NamedTuple):
    """Points transformed by a map, with the map's Jacobian and rotation at each point.

    Attributes:
        points: [M, 3] transformed points, in metres.
        jacobians: [M, 3, 3] Jacobian of the map at each point.
        rotations: [M, 4] polar rotations of the Jacobians as unit quaternions, multiplied over layers.
    """

    points: Tensor
    jacobians: Tensor
    rotations: Tensor


class Deformed(NamedTuple):
    """Gaussians after the deformation of one frame.

    Attributes:
        means: [M, 3] means, in metres.
        factors: [M, 3, 3] covariance factors F, with Σ = F Fᵀ.
        turns: [M, 4] rotations since the previous frame, as unit quaternions with w ≥ 0.
    """

    means: Tensor
    factors: Tensor
    turns: Tensor


def _normalized(q: Tensor) -> Tensor:
    length: Tensor = torch.linalg.vector_norm(q, dim=-1, keepdim=True)
    return q / length


def rotation_quaternions(r: Tensor) -> Tensor:
    """Converts rotation parameters [..., 3] to unit quaternions [..., 4]: (1, r)/|(1, r)|, where |r| = tan(angle/2).

    >>> rotation_quaternions(torch.tensor([[0.0, 0, 1]]))  # tan(angle/2) = 1: a quarter turn about z
    tensor([[0.7071, 0.0000, 0.0000, 0.7071]])
    """
    q = torch.cat([torch.ones_like(r[..., :1]), r], dim=-1)
    return _normalized(q)


def quaternion_matrices(q: Tensor) -> Tensor:
    """Converts unit quaternions [..., 4] to rotation matrices [..., 3, 3].

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
    """Returns the Hamilton product a∘b [..., 4] of quaternions, i.e. rotation b followed by rotation a.

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
    """Returns the factor f of equation (6) and its derivative df/dz, for z of any shape.

    f = 2σ(2z) equals tanh(z) + 1 in the paper, but avoids cancellation: in float32, tanh(z) + 1 is 0 below about −9.

    >>> scaling_factor(torch.zeros(1))
    (tensor([1.]), tensor([1.]))
    """
    f = 2 * torch.sigmoid(2 * z)
    return f, f * (2 - f)


def polar_rotation(f: Tensor, y: Tensor, c: Tensor) -> Tensor:
    """Returns the polar rotation of f·I + f(2−f)·y·cᵀ as unit quaternions [M, 4], in closed form.

    Orthogonal to y and c, the matrix only scales by f. Its polar rotation is a 2D rotation in the plane of y and c.
    With C the trace and S the skew part in the plane, the quaternion is proportional to (|(C, S)| + C, S). The common
    factor f is omitted, so the result stays accurate for f near 0.

    Args:
        f: [M] scaling factors in (0, 2).
        y: [M, 3] vectors y, in metres.
        c: [M, 3] gradients of the scaling argument, per metre.

    >>> one = torch.ones(1)
    >>> polar_rotation(one, torch.tensor([[1.0, 0, 0]]), torch.tensor([[2.0, 0, 0]]))  # a stretch turns nothing
    tensor([[1., 0., 0., 0.]])
    """
    g = (2 - f)[:, None]
    cosine = 2 + g * (c * y).sum(-1, keepdim=True)
    sine = g * torch.linalg.cross(c, y)
    radius: Tensor = torch.linalg.vector_norm(torch.cat([cosine, sine], dim=-1), dim=-1, keepdim=True)
    # A half turn (cosine < 0, sine = 0) only occurs if the map folds space; it is treated as no rotation to avoid NaN.
    return _normalized(torch.cat([(radius + cosine).clamp_min(HALF_TURN), sine], dim=-1))


def cluster_pivots(points: Tensor, labels: Tensor, count: int) -> Tensor:
    """Returns the mean position [count, 3] of each cluster, detached from autograd. It is 0 for empty clusters.

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
    """Applies equation (6) to every point, and computes the map's Jacobian and its polar rotation.

    Let d = x − p, z = c·d + s, f = 2σ(2z) and f' = f(2−f). The centred map is x' = p + t + f·R d, and the published map
    is x' = (R d + p + t)·f. The Jacobian is J = R (f·I + f'·y·cᵀ), with y = d for the centred map and
    y = Rᵀ(R d + p + t) for the published map. The published map scales about the world origin and is therefore not
    translation-equivariant. The maps agree for c = s = 0. If all parameters are 0, points are preserved bit for bit.

    Args:
        points: [M, 3] points, in metres.
        pivots: [K, 3] pivot of each cluster, in metres.
        labels: [M] int64 cluster of each point, in 0…K−1.
        params: parameters of the K clusters.
        kind: variant of the map.

    Raises:
        ValueError: if the variant is unknown.

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
    # Points are updated by adding a displacement, which is exactly 0 if all parameters are 0.
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
        raise ValueError(f"unknown cluster map {kind!r}; choose 'centred' or 'published'")
    inner = f[:, None, None] * unit
    inner = inner + df[:, None, None] * y[:, :, None] * c[:, None, :]
    return Transported(moved, rotation @ inner, quaternion_product(q[labels], polar_rotation(f, y, c)))


def cascade(points: Tensor, layers: Sequence[Layer], kind: ClusterMap = "centred") -> Transported:
    """Evaluates equation (7), the nested maps x → φ_K(… φ_2(φ_1(x))), starting with the coarsest layer.

    The pivot of a cluster is the mean of its points after the coarser layers, detached from autograd.

    Args:
        points: [M, 3] points, in metres.
        layers: layers, coarse to fine. An empty sequence represents the identity.
        kind: variant of the cluster map.

    Returns:
        Transformed points, Jacobians J_K … J_2 J_1, and rotations Q_K ∘ … ∘ Q_1.

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
    """Applies the cascade to Gaussians, followed by each Gaussian's Δp, ΔR and Δs.

    This is equation (5), expressed with factors: mean = x_K + Δp, F = R(Δr)·J·F_previous·diag(exp Δs), and
    turn = q(Δr) ∘ Q, with its sign chosen to make w ≥ 0. If the deltas are 0, Σ = F Fᵀ equals J Σ_previous Jᵀ. With
    separate covariance, J is omitted.

    Args:
        means: [M, 3] means in the previous frame, in metres.
        factors: [M, 3, 3] covariance factors in the previous frame.
        layers: layers, coarse to fine.
        deltas: per-Gaussian deltas.
        kind: variant of the cluster map.
        covariance: variant of the covariance. "separate" omits J from the factors.

    Raises:
        ValueError: if a variant is unknown.

    >>> means, factors = torch.zeros(1, 3), 0.1 * torch.eye(3)[None]
    >>> deltas = Deltas.identity(1, torch.float32)
    >>> deltas.dp[0, 0] = 0.5
    >>> deformed = deform(means, factors, [], deltas)
    >>> deformed.means, deformed.turns
    (tensor([[0.5000, 0.0000, 0.0000]]), tensor([[1., 0., 0., 0.]]))
    """
    points, jacobians, rotations = cascade(means, layers, kind)
    if covariance not in ("entangled", "separate"):
        raise ValueError(f"unknown covariance {covariance!r}; choose 'entangled' or 'separate'")
    dq = rotation_quaternions(deltas.dr)
    carried = quaternion_matrices(dq)
    if covariance == "entangled":
        carried = carried @ jacobians
    moved = carried @ factors * torch.exp(deltas.ds.clamp(-LARGEST, LARGEST))[:, None, :]
    turns = quaternion_product(dq, rotations)
    turns = torch.where(turns[:, :1] < 0, -turns, turns)
    return Deformed(points + deltas.dp, moved, turns)


def material_rotations(turns: Tensor, previous: Tensor) -> Tensor:
    """Returns the rotations [M, 4] since frame 0, i.e. the previous rotations followed by those of this frame.

    >>> quarter = torch.tensor([[0.5, 0, 0, 0.5]]) * 2**0.5
    >>> material_rotations(quarter, previous=quarter)
    tensor([[0., 0., 0., 1.]])
    """
    q = quaternion_product(turns, previous)
    return _normalized(q)
