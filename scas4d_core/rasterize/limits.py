"""The named constants of a rasterizer: where a Gaussian's support ends and a pixel is finished."""

from __future__ import annotations

from typing import NamedTuple


class Limits(NamedTuple):
    """Constants that two rasterizers must share to agree.

    Attributes:
        alpha_floor: a Gaussian covers exactly the pixels where its alpha is at least this; below, 8-bit pictures
            cannot show it. Culling by this support is exact.
        alpha_cap: no single Gaussian is opaque; bounds 1/(1 − alpha) in the backward pass.
        transmittance_stop: a pixel is finished once less light than this would pass.
        low_pass: pixels², added to the diagonal of the projected covariance: a Gaussian is at least a pixel wide.
        near: metres; nearer Gaussians are culled.
        tangent_margin: in units of half the picture's width (height), how far beyond the border x/z (y/z) may lie
            before the projection's Jacobian is evaluated at the clamped place instead.
    """

    alpha_floor: float = 1.0 / 255.0
    alpha_cap: float = 0.99
    transmittance_stop: float = 1e-4
    low_pass: float = 0.3
    near: float = 0.01
    tangent_margin: float = 0.3


NEAR_SHARE = 0.1
"""Of the rig's radius: how near to a camera something may be drawn, where the scene leaves it open."""


def scene_limits(near: float | str, rig_radius: float) -> Limits:
    """The constants of a scene.

    Args:
        near: metres, or "auto" for ``NEAR_SHARE`` of the rig's radius.
        rig_radius: metres.
    """
    if isinstance(near, str):
        near = max(Limits().near, NEAR_SHARE * rig_radius)
    return Limits(near=near)


DEFAULT = Limits()
GSPLAT = Limits(alpha_cap=0.999)
"""gsplat 1.5.3, for comparisons with it."""
