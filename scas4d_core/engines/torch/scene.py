"""Tensors of one attempt: Θ_{t−1}, its cluster structure, and Θ_t as a differentiable function of the parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from scas4d_core.engines.plan import Structure, UpdatePlan
from scas4d_core.engines.torch.deformation import Layer, deform, material_rotations
from scas4d_core.engines.torch.gloss import colours_seen, no_turns
from scas4d_core.engines.torch.parameters import Parameters, leaf
from scas4d_core.engines.views import CameraArrays
from scas4d_core.gaussians import Gaussians


@dataclass(eq=False)
class Moved:
    """Θ_t as tensors, differentiable with respect to the parameters.

    Attributes:
        means: [N, 3] means of all Gaussians.
        factors: [N, 3, 3] covariance factors of all Gaussians.
        turns: [M, 4] rotations of the moving Gaussians since Θ_{t−1}.
    """

    means: Tensor
    factors: Tensor
    turns: Tensor


class Scene:
    """Θ_{t−1} in float64, with methods that derive Θ_t from it.

    Moving Gaussians with non-finite values are held back. They remain unchanged and do not affect pivots or neighbours.

    Attributes:
        rows: [M] rows of the moving Gaussians.
        sound: [M] mask of the moving Gaussians with finite values.
        static: [N − M] rows of the static Gaussians.
    """

    def __init__(self, plan: UpdatePlan, structure: Structure, previous: Gaussians) -> None:
        hierarchy = structure.hierarchy
        self.plan, self.previous = plan, previous
        moving = hierarchy.rows
        held = np.concatenate([previous.means[moving], previous.factors[moving].reshape(-1, 9)], axis=1)
        self.sound = torch.as_tensor(np.isfinite(held).all(axis=1))
        self.rows = torch.tensor(moving)  # a copy, because the array may be read-only
        self.static = torch.as_tensor(np.setdiff1d(np.arange(len(previous)), moving))
        self.means, self.factors = leaf(previous.means), leaf(previous.factors)
        self.opacities, self.labels = leaf(previous.opacities), leaf(previous.foreground)
        self.colours = leaf(previous.colours)
        self._clusters = [torch.as_tensor(labels.astype(np.int64))[self.sound] for labels in hierarchy.labels]
        self.first_lengths = leaf(structure.first_lengths[moving])
        if structure.neighbours is not None:
            graph = structure.neighbours
            self.neighbours = torch.as_tensor(graph.index.astype(np.int64))
            self.distances = leaf(graph.distances)
            pairs = self.sound[:, None] & self.sound[self.neighbours]
            self.pair_weights = torch.where(pairs, leaf(graph.weights), 0)

    def moved(self, parameters: Parameters) -> Moved:
        """Deforms Θ_{t−1} by equations (5) to (7)."""
        chosen = self.rows[self.sound]
        layers = [Layer(labels, params) for labels, params in zip(self._clusters, parameters.clusters, strict=True)]
        deltas = type(parameters.deltas)(*(values[self.sound] for values in parameters.deltas))
        plan = self.plan
        now = deform(self.means[chosen], self.factors[chosen], layers, deltas, plan.cluster_map, plan.covariance)
        return Moved(
            self.means.index_copy(0, chosen, now.means),
            self.factors.index_copy(0, chosen, now.factors),
            no_turns(len(self.rows)).index_copy(0, torch.nonzero(self.sound)[:, 0], now.turns),
        )

    def all_colours(self, parameters: Parameters) -> Tensor:
        """Returns the RGB colours [N, 3] of all Gaussians, without gloss."""
        colours = self.colours.index_copy(0, self.rows, parameters.moving_colours)
        return colours.index_copy(0, self.static, parameters.static_colours)

    def seen(
        self, moved: Moved, colours: Tensor, gloss: Tensor | None, environment: Tensor | None, camera: CameraArrays
    ) -> Tensor:
        """Returns the features [N, 4] (RGB with gloss, label) seen by a camera, detached from means and rotations."""
        turns = no_turns(len(self.means)).index_copy(0, self.rows, moved.turns.detach())
        seen = colours_seen(moved.means.detach(), turns, colours, gloss, environment, leaf(camera.centre))
        return torch.cat([seen, self.labels[:, None]], dim=1)

    def state(self, moved: Moved, parameters: Parameters | None) -> Gaussians:
        """Returns Θ_t, with the colours and gloss of Θ_{t−1} instead of the learned ones if ``parameters`` is None."""
        previous, chosen = self.previous, self.rows[self.sound].numpy()
        means, factors, rotations = previous.means.copy(), previous.factors.copy(), previous.rotations.copy()
        means[chosen] = moved.means.detach()[chosen].float().numpy()
        factors[chosen] = moved.factors.detach()[chosen].float().numpy()
        turned = material_rotations(moved.turns.detach(), leaf(previous.rotations[self.rows.numpy()]))
        rotations[self.rows.numpy()] = turned.float().numpy()
        state = previous.replace(means=means, factors=factors, rotations=rotations)
        if parameters is None:
            return state
        state = state.replace(colours=self.all_colours(parameters).detach().float().numpy())
        if parameters.gloss is None:
            return state
        learnt = parameters.gloss
        return state.replace(
            gloss=learnt.gloss.detach().float().numpy(), environment=learnt.environment.detach().float().numpy()
        )
