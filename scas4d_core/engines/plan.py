"""Plan of a scene's updates: plain values that the effects fill in when they register."""

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
"""Metres; the scale loss limits axes longer than this to their length in frame 0 (paper, scale loss)."""


@dataclass(eq=False)
class ColourPlan:
    """Selects which colours an update learns.

    Attributes:
        moving, static: whether the colours of the moving and of the static Gaussians are free.
        changing_light: whether the light changes, so that colours learn faster (``effects.appearance.light``).
    """

    moving: bool = False
    static: bool = False
    changing_light: bool = False


@dataclass(eq=False)
class UpdatePlan:
    """The loss terms, parameters and options of a scene's updates.

    A term that no effect requests is not computed: its weight is 0 or its value is None.

    Attributes:
        cameras: names of the rig's cameras, in the rig's order.
        background: RGB in 0…1 behind all Gaussians. limits: constants of the rasterizer.
        cluster_map, covariance: variants of equations (6) and (5), see ``engines.torch.deformation``.
        image, soft_colour: weights of the image loss and of the mean absolute change of colours.
        mask: weight of the mask loss. axis_length: weight of the scale loss, equation (8).
        neighbour_terms: whether any effect requests terms between neighbours.
        rigidity, isometry, rotation: weights of the neighbour terms.
        rigidity_fades: whether the weight of rigidity decays to 0 during an update (``effects.coherence.bending``).
        floor: plane (a, b, c, d) in metres of the internal world; a·x + b·y + c·z + d > 0 is below the floor.
        floor_weight: weight of the mean depth below the floor.
        freedom: the free parameters of the deformation.
        colours: the colours to learn; None: none.
        gloss: whether gloss and environment are learned (``effects.appearance.direction``).
        camera_gains: whether camera gains are estimated (``effects.appearance.camera_gain``).
        full_images: whether every pixel can change; otherwise only pixels that moving Gaussians reach.
        disables_skip: whether frames that Θ_{t−1} already reproduces well are updated too, because an effect learns
            from them.
        learns_labels: whether moving Gaussians are detected from motion if no masks are given.
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
        """Returns the plan of the colours, and creates it on the first call."""
        if self.colours is None:
            self.colours = ColourPlan()
        return self.colours


@dataclass(frozen=True, eq=False)
class Structure:
    """The clusters and neighbours of the moving Gaussians, which an update deforms.

    Attributes:
        hierarchy: clusters of the M moving Gaussians. neighbours: neighbour graph; None if no term needs it.
        roots: [N, 3] metres, positions of all Gaussians in frame 0.
        first_lengths: [M, 3] metres, axis lengths of the moving Gaussians in frame 0.
    """

    hierarchy: Hierarchy
    neighbours: Neighbours | None
    roots: Array
    first_lengths: Array

    @property
    def length_bounds(self) -> Array:
        """[M, 3] metres, the length above which the scale loss penalizes each axis."""
        bounds: Array = np.maximum(self.first_lengths, np.float32(MAX_SCALE))
        return bounds
