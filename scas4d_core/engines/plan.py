"""The plan of a scene's updates: values alone, filled in by the effects when they register."""

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
"""Metres; a longer axis is limited to its length in frame 0 (paper, scale loss)."""


@dataclass(eq=False)
class ColourPlan:
    """The colours that an update learns.

    Attributes:
        moving: colours of the moving Gaussians are free. static: those of the static ones are free.
        changing_light: the light changes, so colours learn faster (``effects.appearance.light``).
    """

    moving: bool = False
    static: bool = False
    changing_light: bool = False


@dataclass(eq=False)
class UpdatePlan:
    """The terms, parameters and options of a scene's updates.

    A term that no effect asked for does not exist in the engine: its weight is 0, its value None.

    Attributes:
        cameras: names of the rig's cameras, in the rig's order.
        background: RGB in 0…1 behind every Gaussian. limits: constants of the rasterizer.
        cluster_map, covariance: forms of equations (6) and (5), see ``engines.torch.deformation``.
        image, soft_colour: weights of the image loss and of the mean absolute change of colours.
        mask: weight of the mask loss. axis_length: weight of the limit of axis lengths, equation (8).
        neighbour_terms: whether any effect asked for terms between neighbours.
        rigidity, isometry, rotation: weights of these terms.
        rigidity_fades: whether the weight of rigidity falls to 0 along an update (``effects.coherence.bending``).
        floor: plane (a, b, c, d) in metres of the inside world; a·x + b·y + c·z + d > 0 is below the floor.
        floor_weight: weight of the mean depth below it.
        freedom: the parameters of the deformation that are free.
        colours: the colours that are learnt; None: none.
        gloss: whether gloss and environment are learnt (``effects.appearance.direction``).
        camera_gains: whether gains of the cameras are followed (``effects.appearance.camera_gain``).
        full_images: whether every pixel can change; else only pixels that moving Gaussians reach.
        disables_skip: whether an effect learns from frames that Θ_{t−1} already shows well enough.
        learns_labels: whether moving Gaussians are found from motion where no masks are given.
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
        """The plan of the colours; made with the first effect that asks for it."""
        if self.colours is None:
            self.colours = ColourPlan()
        return self.colours


@dataclass(frozen=True, eq=False)
class Structure:
    """What an update deforms: the clusters and neighbours of the moving Gaussians.

    Attributes:
        hierarchy: clusters of the M moving Gaussians. neighbours: graph over them; None: no term needs one.
        roots: [N, 3] metres, places of all Gaussians in frame 0.
        first_lengths: [M, 3] metres, axis lengths of the moving Gaussians in frame 0.
    """

    hierarchy: Hierarchy
    neighbours: Neighbours | None
    roots: Array
    first_lengths: Array

    @property
    def length_bounds(self) -> Array:
        """[M, 3] metres, the length that each axis may have before the scale loss acts."""
        bounds: Array = np.maximum(self.first_lengths, np.float32(MAX_SCALE))
        return bounds
