"""Optimization of colours during an update, with the soft-colour loss."""

from __future__ import annotations

import warp as wp

from scas4d_core.engines.engine import AttemptStart
from scas4d_core.engines.plan import UpdatePlan
from scas4d_core.engines.warp.adam import Adam, Optimizer, step_element

wp.set_module_options({"enable_backward": False})


@wp.kernel
def step_colours(
    adam: Adam,
    weight: wp.float32,
    entries: wp.array[wp.int32],
    everywhere: wp.int32,
    before: wp.array2d[wp.float32],
    g_features: wp.array2d[wp.float32],
    features: wp.array2d[wp.float32],
    gradients: wp.array2d[wp.float32],
    iteration: wp.array[wp.int32],
    losses: wp.array[wp.float32],
) -> None:
    """Adds the soft-colour loss and takes an Adam step for the colours, with one thread per element of [N, 3].

    Args:
        adam: optimizer for the colours.
        weight: weight of each element's absolute change.
        entries: [N] index of each Gaussian among the moving ones, or −1 for static Gaussians.
        everywhere: 1 if the colours of static Gaussians are learned too, otherwise 0.
        before: [N, 4] features of Θ_{t−1}.
        g_features: [N, 4] gradients of the rendering losses.
        features: [N, 4] features. The first three columns are updated.
        gradients: [N, 3] output, gradients of the colours.
        iteration: [1] row of ``losses`` for this iteration.
        losses: weighted losses of each iteration, to which the soft-colour loss is added.
    """
    i, k = wp.tid()
    g = wp.float32(0.0)
    if everywhere == 1 or entries[i] >= 0:
        change = features[i, k] - before[i, k]
        g = g_features[i, k]
        if change != 0.0:
            g += weight * wp.sign(change)
            wp.atomic_add(losses, iteration[0], weight * wp.abs(change))
    gradients[i, k] = g
    step_element(adam, features, i, k, g)


@wp.kernel
def set_rates(
    entries: wp.array[wp.int32], moving: wp.float32, others: wp.float32, rates: wp.array[wp.float32]
) -> None:  # fmt: skip
    """Sets the learning rates of moving and static Gaussians, with one thread per Gaussian."""
    i = wp.tid()
    rates[i] = wp.where(entries[i] >= 0, moving, others)


class WarpColours:
    """Colours learned during an attempt, i.e. the first three columns of the features.

    Args:
        plan: plan of the scene's updates, with a colour plan.
        entries: [N] index of each Gaussian among the moving ones, or −1 for static Gaussians.
        scalars: [3] device array with the optimizer's scalars.

    Attributes:
        gradients: [N, 3] gradients of the colours, filled by ``step``.
        optimizer: optimizer for the colours.
    """

    def __init__(self, plan: UpdatePlan, entries: wp.array, scalars: wp.array) -> None:
        assert plan.colours is not None
        count = len(entries)
        self._static, self._count, self._device = plan.colours.static, count, scalars.device
        self._weight = plan.soft_colour / max(3 * count, 1)
        self._entries = entries
        self.gradients = wp.zeros((count, 3), dtype=wp.float32, device=self._device)
        self.optimizer = Optimizer((count, 3), scalars, varies_by_row=True)

    def begin(self, start: AttemptStart) -> None:
        """Starts an attempt, with zero moments."""
        rates = start.colour, start.static_colour if self._static else 0.0
        inputs = [self._entries, *rates, self.optimizer.adam.by_row]
        wp.launch(set_rates, self._count, inputs, device=self._device)
        self.optimizer.begin([1.0] * 3, (start.beta1, start.beta2))

    def step(
        self, before: wp.array, g_features: wp.array, features: wp.array, iteration: wp.array, losses: wp.array
    ) -> None:
        """Performs one optimization step; see ``step_colours``."""
        given = [self.optimizer.adam, self._weight, self._entries, int(self._static), before, g_features, features]
        wp.launch(step_colours, (self._count, 3), [*given, self.gradients, iteration, losses], device=self._device)
