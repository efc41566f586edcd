"""Colours as parameters of an update, with the soft-colour term."""

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import NDArray

from scas4d_core.engines.engine import AttemptStart
from scas4d_core.engines.plan import UpdatePlan
from scas4d_core.engines.warp.adam import Adam
from scas4d_core.guards import GuardCounts

wp.set_module_options({"enable_backward": False})

Array = NDArray[np.float32]


@wp.kernel
def colour_gradients(
    weight: wp.float32,
    counted: wp.array[wp.int32],
    before: wp.array2d[wp.float32],
    colours: wp.array2d[wp.float32],
    g_features: wp.array2d[wp.float32],
    gradients: wp.array2d[wp.float32],
    loss: wp.array[wp.float32],
) -> None:
    """Adds the soft-colour term to the gradients of the rendering losses, with one thread per element of N × 3.

    Args:
        weight: weight of one element's absolute change. counted: [N] 1 for Gaussians whose colours are learned.
        before, colours: [N, 3] of Θ_{t−1} and [N, 4] current. g_features: [N, 4] gradients of the rendering losses.
        gradients: out [N, 3]. loss: [1], to which the weighted term is added.
    """
    i, k = wp.tid()
    g = wp.float32(0.0)
    if counted[i] == 1:
        change = colours[i, k] - before[i, k]
        g = g_features[i, k]
        if change != 0.0:
            g += weight * wp.sign(change)
            wp.atomic_add(loss, 0, weight * wp.abs(change))
    gradients[i, k] = g


class WarpColours:
    """The colours learned in an attempt, which are the first three columns of the features.

    Args:
        plan: plan of the updates; it must include colours. features: [N, 4], updated in place.
        before: [N, 3] colours of Θ_{t−1}. rows: [M] moving Gaussians. start: learning rates and decay rates.

    Attributes:
        gradients: [N, 3], filled by ``backward``.
    """

    def __init__(
        self, plan: UpdatePlan, features: wp.array, before: Array, rows: NDArray[np.int64], start: AttemptStart
    ) -> None:
        assert plan.colours is not None
        device, count = features.device, len(before)
        rates = np.full(count, start.static_colour if plan.colours.static else 0.0, np.float32)
        rates[rows] = start.colour
        counted = np.full(count, plan.colours.static, np.int32)
        counted[rows] = 1
        self._features, self._weight = features, plan.soft_colour / max(3 * count, 1)
        self._counted = wp.array(counted, dtype=wp.int32, device=device)
        self._before = wp.array(before, dtype=wp.float32, ndim=2, device=device)
        self.gradients = wp.zeros((count, 3), dtype=wp.float32, device=device)
        self._adam = Adam(features, [1.0] * 3, (start.beta1, start.beta2), rates)

    def backward(self, g_features: wp.array, loss: wp.array) -> None:
        """Fills ``gradients`` from the gradients of the features [N, 4]; adds the weighted term to ``loss`` [1]."""
        inputs = [self._weight, self._counted, self._before, self._features, g_features, self.gradients, loss]
        wp.launch(colour_gradients, self.gradients.shape, inputs, device=self._features.device)

    def step(self, factor: float) -> None:
        """Performs one optimization step; ``factor`` scales all learning rates."""
        self._adam.step(self.gradients, factor)

    def guards(self) -> GuardCounts:
        """Returns the number of times that each guard was triggered; waits for the device."""
        return self._adam.guards()
