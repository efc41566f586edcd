"""The Gaussians of one frame, prepared for export: decomposed covariances in the user's world, harmonics and ids.

OpenCV axes are x right, y down, z forward. The axes of glTF, SPZ and USD are x right, y up, z
towards the viewer. A half turn about x converts between the two conventions. The half turn is a
rotation, so it does not mirror the scene, and it is its own inverse.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import WorldFrame
from scas4d_core.gaussians import Gaussians
from scas4d_core.query.harmonics import basis_of, harmonics
from scas4d_core.query.ply import SH_DEGREE_0, Splats, splats

Float = NDArray[np.float64]

HALF_TURN = np.diag([1.0, -1.0, -1.0])
"""[3, 3] rotation by 180° about x."""
_SOME_DIRECTION = np.array([[0.48, 0.6, 0.64]])
"""A direction in which no harmonic up to degree 3 is zero."""
HARMONIC_SIGNS: Float = np.sign(basis_of(_SOME_DIRECTION @ HALF_TURN) / basis_of(_SOME_DIRECTION))[0]
"""[16] sign of each harmonic's coefficient under the half turn; each harmonic is even or odd in (y, z)."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """The exported Gaussians of one frame.

    Attributes:
        splats: means, scales, rotations, opacities and colours. If colours depend on the view, they
            are those of the harmonic of degree 0.
        harmonics: [N, K, 3] spherical harmonic coefficients of RGB − 0.5; K = 1, or 16 for view-dependent colours.
        ids: [N] int64 Gaussian ids.
    """

    splats: Splats
    harmonics: Float
    ids: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.ids)

    def half_turned(self) -> Cloud:
        """Returns the cloud in axes rotated by 180° about x: y points up, and z towards the viewer.

        >>> seen = cloud_of(Gaussians.of_points([[1, 2, 3]], radius=0.1), WorldFrame(np.zeros(3)))
        >>> seen.half_turned().splats.means
        array([[ 1., -2., -3.]])
        """
        w, x, y, z = self.splats.rotations.T
        return replace(
            self,
            splats=replace(
                self.splats,
                means=self.splats.means @ HALF_TURN,
                rotations=np.stack([-x, w, -z, y], axis=1),  # (0, 1, 0, 0) ∘ q
            ),
            harmonics=self.harmonics * HARMONIC_SIGNS[: self.harmonics.shape[1], None],
        )

    def scaled(self, length: float) -> Cloud:
        """Returns the cloud with all lengths multiplied by ``length``, such as the metres per unit.

        >>> seen = cloud_of(Gaussians.of_points([[1, 2, 3]], radius=0.5), WorldFrame(np.zeros(3)))
        >>> seen.scaled(100).splats.scales
        array([[50., 50., 50.]])
        """
        return replace(
            self, splats=replace(self.splats, means=self.splats.means * length, scales=self.splats.scales * length)
        )

    def rows(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> Cloud:
        """Returns the Gaussians at the given rows ([N] bool, or indices)."""
        kept = {name: getattr(self.splats, name)[chosen] for name in Splats.__dataclass_fields__}
        return Cloud(Splats(**kept), self.harmonics[chosen], self.ids[chosen])


def cloud_of(gaussians: Gaussians, world: WorldFrame, *, retired: bool = False) -> Cloud:
    """Converts a state to the exported Gaussians, in the user's world and units with OpenCV axes.

    Args:
        gaussians: N Gaussians in the internal world.
        world: transform from the user's world to the internal world.
        retired: whether to keep retired Gaussians, with opacity 0, instead of omitting them.

    Raises:
        InputError: if some Gaussians have non-finite values or no volume. The message gives their
            number, and the rows and ids of the first five.

    >>> state = Gaussians.of_points([[0, 0, 2], [1, 0, 2]], radius=0.1).retire([0])
    >>> found = cloud_of(state, WorldFrame(np.zeros(3), metres_per_unit=0.5))
    >>> found.ids, found.splats.means
    (array([1]), array([[2., 0., 4.]]))
    """
    if gaussians.retired.any() and not retired:
        gaussians = gaussians.rows(gaussians.present)
    split = splats(gaussians, world)
    if gaussians.gloss is None:
        return Cloud(split, (split.colours[:, None] - 0.5) / SH_DEGREE_0, gaussians.ids)
    sums = harmonics(gaussians)
    return Cloud(replace(split, colours=0.5 + SH_DEGREE_0 * sums[:, 0]), sums, gaussians.ids)


def linear_light(colours: NDArray[np.floating]) -> Float:
    """Converts sRGB colours (IEC 61966-2-1) to linear light, after clipping them to [0, 1].

    >>> linear_light(np.array([0.0, 0.5, 1.0])).round(4)
    array([0.   , 0.214, 1.   ])
    """
    clipped = np.clip(np.asarray(colours, np.float64), 0, 1)
    return np.where(clipped <= 0.04045, clipped / 12.92, ((clipped + 0.055) / 1.055) ** 2.4)
