"""Plan of a scene's updates, which effects modify when they register, and the structure of the moving Gaussians."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.freedom import Freedom
from scas4d_core.engines.limits import DEFAULT, Limits

if TYPE_CHECKING:
    from scas4d_core.structure.hierarchy import Hierarchy
    from scas4d_core.structure.neighbours import Neighbours

Array = NDArray[np.float32]
Plane = tuple[float, float, float, float]

MAX_SCALE = 0.02
"""Axis length in metres up to which the scale loss is always 0, as in the paper. See ``Structure.length_bounds``."""


@dataclass(eq=False)
class ColourPlan:
    """Selection of the colours that an update learns.

    Attributes:
        moving, static: whether the colours of moving and static Gaussians are learned.
        changing_light: whether the lighting changes, which requires higher colour learning rates
            (``effects.appearance.light``).
    """

    moving: bool = False
    static: bool = False
    changing_light: bool = False


@dataclass(eq=False)
class UpdatePlan:
    """Loss terms, free parameters and options for a scene's updates.

    A term that no effect requests has weight 0 (or value None) and is not computed.

    Attributes:
        cameras: names of the rig's cameras, in rig order.
        background: background colour, RGB in [0, 1].
        limits: rasterizer constants.
        cluster_map: variant of equation (6); see ``engines.torch.deformation``.
        covariance: variant of equation (5); see ``engines.torch.deformation``.
        image: weight of the image loss.
        soft_colour: weight of the soft-colour loss, the mean absolute colour change.
        mask: weight of the mask loss.
        axis_length: weight of the scale loss, equation (8).
        neighbour_terms: whether any effect requests a neighbour term.
        rigidity, isometry, rotation: weights of the neighbour terms.
        rigidity_fades: whether the rigidity weight decays to 0 during an update (``effects.coherence.bending``).
        floor: floor plane (a, b, c, d) in internal world coordinates, in metres. Points with
            a·x + b·y + c·z + d > 0 are below the floor.
        floor_weight: weight of the floor loss, the mean depth below the floor.
        freedom: free parameters of the deformation.
        colours: colours to learn, or None if no colours are learned.
        gloss: whether the gloss and environment are learned (``effects.appearance.direction``).
        camera_gains: whether camera gains are estimated (``effects.appearance.camera_gain``).
        full_images: whether any pixel may change. If false, only pixels covered by moving Gaussians can change.
        disables_skip: whether frames that Θ_{t−1} already reproduces well must still be updated, because an effect
            learns from them.
        learns_labels: whether moving Gaussians are detected by their motion if no masks are given.
    """

    cameras: tuple[str, ...]
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    limits: Limits = DEFAULT
    cluster_map: Literal["centred", "published"] = "centred"
    covariance: Literal["entangled", "separate"] = "entangled"
    image: float = 1.0
    soft_colour: float = 0.0
    mask: float = 0.0
    axis_length: float = 0.0
    neighbour_terms: bool = False
    rigidity: float = 0.0
    isometry: float = 0.0
    rotation: float = 0.0
    rigidity_fades: bool = False
    floor: Plane | None = None
    floor_weight: float = 0.0
    freedom: Freedom = field(default_factory=Freedom)
    colours: ColourPlan | None = None
    gloss: bool = False
    camera_gains: bool = False
    full_images: bool = False
    disables_skip: bool = False
    learns_labels: bool = False

    def learns_colours(self) -> ColourPlan:
        """Returns the colour plan, creating it on the first call."""
        if self.colours is None:
            self.colours = ColourPlan()
        return self.colours


@dataclass(frozen=True, eq=False)
class Structure:
    """Clusters and neighbour graph of the moving Gaussians.

    Attributes:
        hierarchy: cluster hierarchy of the M moving Gaussians.
        neighbours: neighbour graph, or None if no loss term needs it.
        roots: [N, 3] positions of all Gaussians in frame 0, in metres.
        first_lengths: [N, 3] axis lengths of all Gaussians in frame 0, in metres.
    """

    hierarchy: Hierarchy
    neighbours: Neighbours | None
    roots: Array
    first_lengths: Array

    @property
    def length_bounds(self) -> Array:
        """Axis lengths [M, 3] of the moving Gaussians above which the scale loss applies, in metres."""
        bounds: Array = np.maximum(self.first_lengths[self.hierarchy.rows], np.float32(MAX_SCALE))
        return bounds
