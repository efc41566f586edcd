"""Names and modules of all effects, and the modes that settings can assign to effects.

To add an effect, add a file to ``effects/`` and an entry to ``EFFECTS``. This module imports no
effects, because the settings only need the names. ``effects.effect.effect`` imports the module of
an effect on first use.
"""

from __future__ import annotations

from typing import Literal

Mode = Literal["auto", "on", "off"]
""""auto" lets evidence in the images decide whether an effect is on; "on" and "off" are fixed."""

EFFECTS = {
    "cluster_rotation": "scas4d_core.effects.motion.cluster_rotation",
    "cluster_translation": "scas4d_core.effects.motion.cluster_translation",
    "cluster_scaling": "scas4d_core.effects.motion.cluster_scaling",
    "own_position": "scas4d_core.effects.motion.own_position",
    "own_rotation": "scas4d_core.effects.motion.own_rotation",
    "own_scale": "scas4d_core.effects.motion.own_scale",
    "prediction": "scas4d_core.effects.motion.prediction",
    "rigidity": "scas4d_core.effects.coherence.rigidity",
    "isometry": "scas4d_core.effects.coherence.isometry",
    "rotation": "scas4d_core.effects.coherence.rotation",
    "bending": "scas4d_core.effects.coherence.bending",
    "axis_length": "scas4d_core.effects.coherence.axis_length",
    "floor": "scas4d_core.effects.coherence.floor",
    "mask_term": "scas4d_core.effects.presence.mask_term",
    "motion_labels": "scas4d_core.effects.presence.motion_labels",
    "moving_colour": "scas4d_core.effects.appearance.moving_colour",
    "static_colour": "scas4d_core.effects.appearance.static_colour",
    "direction": "scas4d_core.effects.appearance.direction",
    "shading": "scas4d_core.effects.appearance.shading",
    "shadows": "scas4d_core.effects.appearance.shadows",
    "camera_gain": "scas4d_core.effects.appearance.camera_gain",
    "light": "scas4d_core.effects.appearance.light",
    "pose_drift": "scas4d_core.effects.cameras.pose_drift",
    "uncovered": "scas4d_core.effects.presence.uncovered",
    "entering": "scas4d_core.effects.presence.entering",
    "leaving": "scas4d_core.effects.presence.leaving",
}
"""Maps each effect's name to its module, in the order in which the effects run in an iteration."""
