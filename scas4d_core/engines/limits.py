"""Constants of a rasterizer: the alpha that bounds a Gaussian's support, and the transmittance that ends a pixel."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from scas4d_core import guards
from scas4d_core.cameras import Camera, WorldFrame, rig_inside


class Limits(NamedTuple):
    """Constants that must be equal for two rasterizers to agree.

    Attributes:
        alpha_floor: a Gaussian covers exactly the pixels where its alpha is at least this value. Smaller alphas are
            invisible in 8-bit pictures. Culling by this support is exact.
        alpha_cap: upper bound of a Gaussian's alpha; it bounds 1/(1 − alpha) in the backward pass.
        transmittance_stop: a pixel is finished when its transmittance would fall below this value.
        low_pass: pixels², added to the diagonal of the projected covariance, so that a Gaussian covers a pixel.
        near: metres; Gaussians closer than this are culled.
        tangent_margin: how far x/z (y/z) may lie beyond the picture's border before the projection's Jacobian is
            evaluated at a clamped position; in units of half the picture's width (height).
    """

    alpha_floor: float = guards.ALPHA_FLOOR
    alpha_cap: float = guards.ALPHA_CAP
    transmittance_stop: float = guards.TRANSMITTANCE_STOP
    low_pass: float = guards.LOW_PASS
    near: float = guards.NEAR
    tangent_margin: float = guards.TANGENT_MARGIN


NEAR_SHARE = 0.1
"""Near plane as a share of the rig's radius, used if the scene does not define one."""


def scene_limits(near: float | str, rig_radius: float) -> Limits:
    """Returns the rasterizer constants for one scene.

    Args:
        near: metres, or "auto" for ``NEAR_SHARE`` of the rig's radius.
        rig_radius: metres.

    >>> scene_limits("auto", rig_radius=3.0).near  # metres
    0.30000000000000004
    >>> scene_limits(0.05, rig_radius=3.0).near
    0.05
    """
    if isinstance(near, str):
        # A single camera has no radius.
        near = NEAR_SHARE * rig_radius if rig_radius > 0 else Limits().near
    return Limits(near=near)


def rig_limits(near: float | str, world: WorldFrame, cameras: Sequence[Camera]) -> Limits:
    """Returns the rasterizer constants for a scene from its cameras in the user's world; see ``scene_limits``.

    >>> import numpy as np
    >>> camera = Camera("front", [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4), 64, 48)
    >>> rig_limits(0.05, WorldFrame(np.zeros(3)), [camera]).near
    0.05
    """
    return scene_limits(near, rig_inside(world, cameras).radius)


DEFAULT = Limits()
