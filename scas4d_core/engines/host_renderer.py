"""Base class of the renderers whose pictures are in host memory."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.renderer import (
    PRIOR_PIXELS,
    Array,
    Neighbourhoods,
    Picture,
    Renderer,
    extrapolated,
    levels,
)
from scas4d_core.engines.views import LABEL, CameraArrays, TrainingView
from scas4d_core.gaussians import Gaussians


class HostRenderer(Renderer):
    """A ``Renderer`` that renders one picture at a time, and computes the residuals of one view at a time."""

    @abstractmethod
    def residuals(
        self, state: Gaussians, view: TrainingView, learnt: NDArray[np.uint8], most: float
    ) -> tuple[Array, Array]:
        """Sums the residuals of a view, weighted by each Gaussian's blending weights.

        Args:
            state: Gaussians to render.
            view: training view.
            learnt: [N] uint8 mask of the Gaussians whose sums are needed.
            most: maximum magnitude of a residual, for RGB in [0, 1]. Larger residuals are clipped.

        Returns:
            [N, 3] weighted sums of the RGB residuals before exposure, and [N] sums of the weights, in pixels.
        """

    def render_each(
        self, shots: Sequence[tuple[Gaussians, CameraArrays]], *, depth_channel: int = -1
    ) -> Iterator[Picture]:
        """See ``Renderer.render_each``."""
        return (self.render(state, camera, depth_channel=depth_channel) for state, camera in shots)

    def render_levels(
        self, state: Gaussians, camera: CameraArrays, background: Array, *, opacity: bool
    ) -> NDArray[np.uint8]:
        """See ``Renderer.render_levels``."""
        picture = self.render(state, camera, background=background)
        return levels(1 - picture.transmittance if opacity else np.moveaxis(picture.features[:LABEL], 0, -1))

    def step_colours(
        self, state: Gaussians, subsets: Sequence[Sequence[TrainingView]], learnt: NDArray[np.uint8], most: float
    ) -> Gaussians:
        """See ``Renderer.step_colours``."""
        for views in subsets:
            sums, weights = np.zeros((len(state), 3)), np.full(len(state), PRIOR_PIXELS)
            for view in views:
                more, seen = self.residuals(state, view, learnt, most)
                sums += more
                weights += seen
            state = state.replace(colours=state.colours + (sums / weights[:, None]).astype(np.float32))
        return state

    def extrapolate(self, before: Gaussians, after: Gaussians, share: float) -> Gaussians:
        """See ``Renderer.extrapolate``."""
        return extrapolated(before, after, share)

    def turn_normals(self, before: Gaussians, after: Gaussians, near: Neighbourhoods) -> Gaussians:
        """See ``Renderer.turn_normals``."""
        from scas4d_core.kernels.turns import turn_neighbourhoods  # deferred import, because it loads the kernels

        assert after.gloss is not None
        turns = np.empty((len(near.rows), 3, 3))
        turn_neighbourhoods(before.means, after.means, near.rows, turns)
        return after.replace(gloss=np.einsum("nij,nj->ni", turns, after.gloss).astype(np.float32))
