"""Parameters of one attempt as leaf tensors, with Adam optimizers for the free ones (algorithm 1, last line)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from scas4d_core.engines.engine import AttemptStart, StepScalars, Tables
from scas4d_core.engines.plan import ColourPlan
from scas4d_core.engines.torch.deformation import ClusterParams, Deltas
from scas4d_core.guards import ADAM_EPSILON

GLOSS_BETAS = (0.9, 0.999)
"""Adam decay rates of the gloss and environment, which are the same in every update."""


def leaf(values: object) -> Tensor:
    """Copies an array or tensor to a new float64 leaf tensor."""
    given = values if isinstance(values, torch.Tensor) else np.array(values)  # PyTorch warns about read-only arrays
    return torch.as_tensor(given, dtype=torch.float64).detach().clone()


@dataclass(eq=False)
class GlossParameters:
    """Gloss and environment parameters; see ``kernels.appearance.direction``.

    Attributes:
        gloss: [M, 3] normal of each Gaussian, scaled by its gloss strength.
        light: rows of the environment that contain light.
        nearness: [1, 3] row of the environment that contains the nearness in its first column.
        middle: [1, 3] row of the environment that contains the scene centre, in metres. It is not learned.
        rates: Adam learning rates of gloss, light and nearness.
    """

    gloss: Tensor
    light: Tensor
    nearness: Tensor
    middle: Tensor
    rates: tuple[float, float, float]

    @property
    def environment(self) -> Tensor:
        """Environment [ROWS, 3]: light, middle and nearness."""
        return torch.cat([self.light, self.middle, self.nearness])


@dataclass(eq=False)
class Parameters:
    """All learnable parameters of an attempt. Only free parameters are updated.

    Attributes:
        clusters: parameters r, t, c, s of equation (6) for each layer, coarse to fine.
        deltas: per-Gaussian deltas Δp, ΔR, Δs of equation (7).
        moving_colours: [M, 3] RGB colours of the moving Gaussians.
        static_colours: [N − M, 3] RGB colours of the static Gaussians.
        gloss: gloss and environment, or None if they are not learned.
        optimizers: optimizers of the free parameters.
    """

    clusters: list[ClusterParams]
    deltas: Deltas
    moving_colours: Tensor
    static_colours: Tensor
    gloss: GlossParameters | None = None
    optimizers: list[FreeParameter] = field(default_factory=list)

    def set_tables(self, tables: Tables) -> None:
        """Sets the deformation parameters from host tables."""
        self.clusters, self.deltas = deformation_of(tables)

    def tables(self) -> Tables:
        """Returns the deformation parameters as host tables."""
        clusters = [torch.cat([p.r, p.t, p.c, p.s[:, None]], dim=1) for p in self.clusters]
        return Tables(
            [values.detach().float().numpy() for values in clusters],
            torch.cat(list(self.deltas), dim=1).detach().float().numpy(),
        )

    def free(self, start: AttemptStart, learnt: ColourPlan | None) -> None:
        """Creates an optimizer with zero moments for each parameter with a positive learning rate.

        Args:
            start: settings of the attempt, with learning rates and Adam decay rates.
            learnt: colours to learn, or None if no colours are learned.
        """
        betas = start.beta1, start.beta2
        self.optimizers = []
        for layer, (params, (rotation, translation, scaling)) in enumerate(
            zip(self.clusters, start.layers, strict=True)
        ):
            rates = zip(params, (rotation, translation, scaling, scaling), strict=True)
            self._free(rates, betas, f"layer {layer}")
        self._free(zip(self.deltas, (start.position, start.rotation, start.scale), strict=True), betas, "own")
        if learnt is not None:
            self._free(iter([(self.moving_colours, start.colour)]), betas, "colour")
            if learnt.static:
                self._free(iter([(self.static_colours, start.static_colour)]), betas, "colour")
        if self.gloss is not None:
            own = (self.gloss.gloss, self.gloss.light, self.gloss.nearness)
            self._free(zip(own, self.gloss.rates, strict=True), GLOSS_BETAS, "gloss")

    def _free(self, rates: Iterator[tuple[Tensor, float]], betas: tuple[float, float], stage: str) -> None:
        for tensor, rate in rates:
            if rate > 0 and tensor.numel():
                self.optimizers.append(FreeParameter(tensor.requires_grad_(), rate, betas, stage))

    def step(self, step: StepScalars) -> None:
        """Takes an Adam step for all free parameters, with the learning rate factors of an iteration."""
        factors = {f"layer {layer}": factor for layer, factor in enumerate(step.layers)}
        factors |= {"own": step.own, "colour": step.colour, "gloss": step.gloss}
        for parameter in self.optimizers:
            parameter.step(factors[parameter.stage])


class FreeParameter:
    """Adam optimizer for one parameter tensor.

    Attributes:
        stage: name of the ``StepScalars`` factor that scales the learning rate: "layer k", "own", "colour" or "gloss".
    """

    def __init__(self, tensor: Tensor, rate: float, betas: tuple[float, float], stage: str) -> None:
        self._rate, self.stage = rate, stage
        self._adam = torch.optim.Adam([tensor], lr=rate, betas=betas, eps=ADAM_EPSILON)

    def step(self, factor: float) -> None:
        """Performs one optimization step. If ``factor`` is 0, skips the step and leaves the moments unchanged."""
        if factor:
            self._adam.param_groups[0]["lr"] = self._rate * factor
            self._adam.step()


def deformation_of(tables: Tables) -> tuple[list[ClusterParams], Deltas]:
    """Converts deformation tables to leaf tensors."""
    clusters = [ClusterParams(leaf(v[:, :3]), leaf(v[:, 3:6]), leaf(v[:, 6:9]), leaf(v[:, 9])) for v in tables.clusters]
    own = tables.deltas
    return clusters, Deltas(leaf(own[:, :3]), leaf(own[:, 3:6]), leaf(own[:, 6:]))
