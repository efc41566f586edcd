"""Names of all effects, and the modes that settings can pin them to.

``effects.registry`` has the module of each name.
"""

from __future__ import annotations

from typing import Literal

Mode = Literal["auto", "on", "off"]
"""Left to the evidence, pinned on, pinned off."""

EFFECT_NAMES = (
    "cluster_rotation",
    "cluster_translation",
    "cluster_scaling",
    "own_position",
    "own_rotation",
    "own_scale",
    "prediction",
    "rigidity",
    "isometry",
    "rotation",
    "bending",
    "axis_length",
    "floor",
    "mask_term",
    "motion_labels",
    "moving_colour",
    "standing_colour",
    "direction",
    "shading",
    "shadows",
    "camera_gain",
    "light",
    "pose_drift",
    "uncovered",
    "entering",
    "leaving",
)
"""In the order in which they take part in an iteration."""
