"""Forward and backward pass of a deformation, on every backend."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hard_cases.case import (
    CPU,
    REFERENCE,
    BackendResult,
    Values,
    apart,
    beyond,
    not_finite,
    unexpected_counts,
)
from scas4d_core.engines.cpu.deformation import CpuDeformation
from scas4d_core.gaussians import Gaussians
from scas4d_core.structure.hierarchy import Hierarchy
from scas4d_core.structure.neighbours import Neighbours

Array = NDArray[np.float32]

STRENGTHS = (4.0, 2.0, 4.0)
"""Weights of the rigidity, isometry and rotation terms."""


@dataclass(frozen=True, eq=False)
class Deforming:
    """Gaussians that are deformed by layers of clusters.

    The loss is a randomly weighted sum of the moved means and factors, plus the neighbour terms, which depend on the
    rotations.

    Attributes:
        means: [M, 3] means in frame t−1.
        factors: [M, 3, 3] covariance factors in frame t−1.
        labels: [M] ascending cluster labels per layer, coarse to fine and nested.
        clusters: [K, 10] cluster parameters per layer.
        deltas: [M, 9] parameters of each Gaussian.
        bad: [M] mask of rows with non-finite values. Such rows stay unchanged and must not affect the others.
        guards: expected counts of the guards; None accepts any counts.
        value: tolerance of the means in metres; 100 times this value is the relative tolerance of the factors. Neither
            is checked if None.
        turn: tolerance of the rotations in radians; not checked if None.
        gradient: relative tolerance of the gradients; not checked if None.
        bound: largest allowed gradient.
        kind: cluster map to use.
    """

    means: Array
    factors: Array
    labels: Sequence[NDArray[np.int32]]
    clusters: Sequence[Array]
    deltas: Array
    bad: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    guards: Mapping[str, int] | None = field(default_factory=dict)
    value: float | None = 1e-5
    turn: float | None = 1e-4
    gradient: float | None = 2e-3
    bound: float = 1e6
    kind: Literal["centred", "published"] = "centred"

    def weights(self) -> tuple[Array, Array]:
        """Returns random loss weights for the means [M, 3] and factors [M, 3, 3], which are 0 for invalid rows."""
        rng = np.random.default_rng(7)
        pulls = rng.normal(size=(len(self.means), 3)), rng.normal(size=(len(self.means), 3, 3))
        by_mean, by_factor = (pull.astype(np.float32) for pull in pulls)
        if self.bad.any():
            by_mean[self.bad], by_factor[self.bad] = 0, 0
        return by_mean, by_factor

    def neighbours(self) -> Neighbours | None:
        """Returns the neighbour graph of the valid Gaussians, or None if there are fewer than two."""
        sound = ~self.bad if self.bad.size else np.ones(len(self.means), bool)
        if sound.sum() < 2:
            return None
        where = np.where(sound[:, None], self.means, 0)
        spread = float(np.square(where[sound] - where[sound].mean(axis=0)).sum(axis=1).mean())
        return Neighbours(where, 4, 1 / max(spread, 1e-30))

    def run(self, backend: str) -> BackendResult | None:
        """Runs the forward and backward pass on a backend."""
        if backend == CPU:
            return self._cpu()
        return self._torch(backend)

    def _cpu(self) -> BackendResult:
        count = len(self.means)
        starts = tuple(np.searchsorted(k, np.arange(k.max() + 2)).astype(np.int64) for k in self.labels)
        hierarchy = Hierarchy(np.arange(count), tuple(k.astype(np.int32) for k in self.labels), starts)
        model = CpuDeformation(hierarchy, self.neighbours(), np.full((count, 3), 1e30, np.float32), self.kind)
        model.start(state(self.means, self.factors))
        for table, given in zip([*model.clusters, model.deltas], [*self.clusters, self.deltas], strict=True):
            table[:] = given
        model.forward()
        values: Values = {"means": model.means.copy(), "factors": model.factors.copy(), "turns": model.turns.copy()}
        values["terms"] = model.neighbour_losses(np.arange(count), STRENGTHS).copy()
        model.backward(*self.weights(), 0.0)
        gradients: Values = {f"layer {k}": g.copy() for k, g in enumerate(model.cluster_gradients)}
        gradients["own"] = model.delta_gradients.copy()
        return BackendResult(values, gradients, dict(model.guards))

    def _torch(self, backend: str) -> BackendResult:
        import torch

        from scas4d_core.engines.torch import deformation, losses

        dtype = torch.float64 if backend == REFERENCE else torch.float32
        sound = np.flatnonzero(~self.bad) if self.bad.size else np.arange(len(self.means))

        def tensor(values: NDArray[Any], leaf: bool = False) -> torch.Tensor:
            kind = torch.int64 if values.dtype.kind == "i" else dtype
            return torch.tensor(values, dtype=kind, requires_grad=leaf)

        leaves = [tensor(values, True) for values in self.clusters]
        own = tensor(self.deltas, True)
        layers = [
            deformation.Layer(
                tensor(labels[sound]),
                deformation.ClusterParams(leaf[:, :3], leaf[:, 3:6], leaf[:, 6:9], leaf[:, 9]),
            )
            for labels, leaf in zip(self.labels, leaves, strict=True)
        ]
        deltas = deformation.Deltas(own[sound, :3], own[sound, 3:6], own[sound, 6:])
        previous = tensor(self.means[sound])
        moved = deformation.deform(previous, tensor(self.factors[sound]), layers, deltas, self.kind)
        by_mean, by_factor = (tensor(pull[sound]) for pull in self.weights())
        loss = (moved.means * by_mean).sum() + (moved.factors * by_factor).sum()
        terms = torch.zeros(3, dtype=dtype)
        graph = self.neighbours()
        if graph is not None:
            order = np.zeros(len(self.means), np.int64)
            order[sound] = np.arange(len(sound))
            pairs = np.isin(graph.index[sound], sound)
            index, weights = tensor(order[graph.index[sound]]), tensor(graph.weights[sound] * pairs)
            terms = torch.stack(
                [
                    losses.rigidity_loss(moved.means, moved.turns, previous, index, weights),
                    losses.isometry_loss(moved.means, tensor(graph.distances[sound]), index, weights),
                    losses.rotation_loss(moved.turns, index, weights),
                ]
            )
            terms = terms * (len(sound) / len(self.means))  # averaged over all pairs, including rows held back
            loss = loss + (terms * tensor(np.array(STRENGTHS))).sum()
        gradient_list = torch.autograd.grad(loss, [*leaves, own], allow_unused=True)
        gradients = {f"layer {k}": g for k, g in enumerate(gradient_list[:-1])}
        gradients["own"] = gradient_list[-1]
        values = {"means": self.means.copy(), "factors": self.factors.copy(), "turns": no_turn(len(self.means))}
        for name in values:
            values[name] = values[name].astype(np.float64 if backend == REFERENCE else np.float32)
            values[name][sound] = getattr(moved, name).detach().numpy()
        values["terms"] = terms.detach().numpy()
        return BackendResult(values, {name: np.zeros(1) if g is None else g.numpy() for name, g in gradients.items()})

    def violations(self, outcomes: Mapping[str, BackendResult]) -> list[str]:
        """Returns a line for each violated check.

        The checks cover finite values, bounded gradients, unit rotations, unchanged invalid rows, guard counts, and
        agreement with the reference.
        """
        faults = []
        for backend, outcome in outcomes.items():
            sound = ~self.bad if self.bad.size else np.ones(len(self.means), bool)
            rows = {name: v[sound] for name, v in outcome.values.items() if name != "terms"}
            faults += not_finite(BackendResult(rows, outcome.gradients), backend) + beyond(outcome, backend, self.bound)
            norms = np.linalg.norm(rows["turns"], axis=1)
            if norms.size and np.abs(norms - 1).max() > 1e-4:
                faults.append(f"{backend}: a rotation quaternion has length {norms[np.abs(norms - 1).argmax()]:.4g}")
            if self.bad.any():
                held = all(np.array_equal(outcome.values[n][self.bad], getattr(self, n)[self.bad], equal_nan=True)
                           for n in ("means", "factors"))  # fmt: skip
                faults += [] if held else [f"{backend}: a non-finite row was changed"]
        if CPU in outcomes:
            faults += unexpected_counts(outcomes[CPU], self.guards)
        for backend in set(outcomes) - {REFERENCE}:
            faults += self._disagreement(outcomes[backend], outcomes[REFERENCE], backend, sound)
        return faults

    def _disagreement(
        self, outcome: BackendResult, truth: BackendResult, backend: str, sound: NDArray[np.bool_]
    ) -> list[str]:
        faults = []
        if self.value is not None and sound.any():
            off = np.abs(outcome.values["means"][sound] - truth.values["means"][sound]).max()
            faults += [] if off <= self.value else [f"{backend}: means differ by {off:.2g} m"]
            distance = apart(outcome.values["factors"][sound], truth.values["factors"][sound])
            faults += [] if distance <= 100 * self.value else [f"{backend}: factors differ by {distance:.2g}"]
        if self.turn is not None and sound.any():
            # q and −q are the same rotation.
            dots = (outcome.values["turns"] * truth.values["turns"]).sum(axis=1)[sound]
            angle = 2 * np.arccos(np.clip(np.abs(dots.astype(np.float64)), 0, 1)).max()
            faults += [] if angle <= max(self.turn, 2e-3) else [f"{backend}: a rotation differs by {angle:.2g} rad"]
        if self.gradient is not None:
            for name, expected in truth.gradients.items():
                distance = apart(outcome.gradients[name], expected, least=1e-9)
                faults += (
                    [] if distance <= self.gradient else [f"{backend}: gradient of {name} differs by {distance:.2g}"]
                )
        return faults


def no_turn(count: int) -> Array:
    """Returns identity quaternions, [count, 4]."""
    return np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1))


def state(means: Array, factors: Array) -> Gaussians:
    """Returns Gaussians with the given means and factors, all of which are labelled as moving."""
    ones = np.ones(len(means), np.float32)
    return Gaussians(means, factors, no_turn(len(means)), ones, np.zeros_like(means), ones, np.arange(len(means)))
