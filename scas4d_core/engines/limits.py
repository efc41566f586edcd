"""Rasterizer constants, such as the minimum alpha of a Gaussian and the transmittance at which a pixel is complete."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from scas4d_core import guards
from scas4d_core.cameras import Camera, WorldFrame, rig_inside


class Limits(NamedTuple):
    """Rasterizer constants. Two rasterizers produce the same image only if their constants are equal.

    Attributes:
        alpha_floor: minimum alpha. A Gaussian covers exactly the pixels where its alpha is at least this value, so
            culling to this support is exact. Lower values are invisible in 8-bit images.
        alpha_cap: upper bound on a Gaussian's alpha, which bounds 1/(1 − alpha) in the backward pass.
        transmittance_stop: minimum transmittance. Blending of a pixel stops at the Gaussian that would reduce the
            transmittance below this value.
        low_pass: value added to the diagonal of the projected covariance, in pixels². It makes each Gaussian cover at
            least about one pixel.
        near: depth of the near plane, in metres. Closer Gaussians are culled.
        tangent_margin: margin around the image within which the projection's Jacobian is exact, as a fraction of half
            the image width (for x/z) or height (for y/z). Beyond the margin, the Jacobian is evaluated at a clamped
            position.
    """

    alpha_floor: float = guards.ALPHA_FLOOR
    alpha_cap: float = guards.ALPHA_CAP
    transmittance_stop: float = guards.TRANSMITTANCE_STOP
    low_pass: float = guards.LOW_PASS
    near: float = guards.NEAR
    tangent_margin: float = guards.TANGENT_MARGIN


NEAR_SHARE = 0.1
"""Depth of the near plane as a fraction of the rig's radius, used if the scene does not specify the depth."""


def scene_limits(near: float | str, rig_radius: float) -> Limits:
    """Returns the rasterizer constants for one scene.

    Args:
        near: depth of the near plane in metres, or "auto" for ``NEAR_SHARE`` times the rig's radius.
        rig_radius: radius of the camera rig, in metres.

    >>> scene_limits("auto", rig_radius=3.0).near  # metres
    0.30000000000000004
    >>> scene_limits(0.05, rig_radius=3.0).near
    0.05
    """
    if isinstance(near, str):
        # A rig with a single camera has radius 0.
        near = NEAR_SHARE * rig_radius if rig_radius > 0 else Limits().near
    return Limits(near=near)


def rig_limits(near: float | str, world: WorldFrame, cameras: Sequence[Camera]) -> Limits:
    """Returns the rasterizer constants for a scene, given its cameras.

    Args:
        near: see ``scene_limits``.
        world: transform from the user's world to the internal world.
        cameras: cameras of the rig, in user world coordinates.

    >>> import numpy as np
    >>> camera = Camera("front", [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4), 64, 48)
    >>> rig_limits(0.05, WorldFrame(np.zeros(3)), [camera]).near
    0.05
    """
    return scene_limits(near, rig_inside(world, cameras).radius)


DEFAULT = Limits()
