"""Kernels that scenes call, with their argument types, grouped by the stage that needs them.

Numba compiles a kernel on its first call, for the argument types of that call. This list declares
the types in advance, so that several processes can share the work. A test compares the list with
the kernels that a scene calls. A kernel that is missing from the list still works, but the first
process that calls the kernel must compile it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum


class KernelGroup(StrEnum):
    """Groups of kernels, one for each stage that needs them."""

    FIRST_FRAME = "first frame"
    """Needed for frame 0, to render any view, and for the visibility of tracks."""
    UPDATE = "update"
    """Needed for updates with any combination of effects."""
    ENTANGLED = "update, entangled covariance"
    SEPARATE = "update, separate covariance"
    STEREO = "stereo"
    """Needed to compute initial points from images alone."""


@dataclass(frozen=True)
class Kernel:
    """A kernel with specific argument types.

    Attributes:
        group: group to which the kernel belongs.
        module: module of the function, relative to ``scas4d_core``.
        name: name of the function.
        arguments: one word per argument. The first letter is the type: f, d for float32, float64;
            i, s for int64, int32; u, w, y for uint32, uint64, uint8; b for bool. A number after the
            letter is the number of array axes. The word i*2 is a tuple of two int64, and the word
            none is None.
    """

    group: KernelGroup
    module: str
    name: str
    arguments: str

    @property
    def key(self) -> str:
        """Unique file name for this kernel and its argument types."""
        return f"{self.module}.{self.name}-{hashlib.sha256(self.arguments.encode()).hexdigest()[:8]}"


def _of(group: KernelGroup, *rows: str) -> tuple[Kernel, ...]:
    split = ((*function.rsplit(".", 1), arguments) for function, arguments in (row.split(" ", 1) for row in rows))
    return tuple(Kernel(group, module, name, arguments) for module, name, arguments in split)


# In each group, kernels with the longest compilation time come first, because this order balances
# the load.
KERNELS = (
    *_of(
        KernelGroup.FIRST_FRAME,
        "kernels.projection.project_backward f2 f3 f2 f1 f1 f2 s1 i1 f2 i i1 f2 f3 f1 f2 f2 i2",
        "kernels.image_loss.image_loss i f3 f2 f3 f3 f3 f1 i f4 y2 f3 f3 f3",
        "kernels.projection.project f2 f3 f1 f2 f2 f1 f1 f2 s2 s1 i2",
        "kernels.blend.blend_backward f2 f2 i*1 i1 s1 s1 w1 y1 i1 i1 i*2 f1 f3 f2 f3 f2 f2",
        "kernels.blend.blend f2 f2 i*1 i1 s1 w1 w1 i1 i1 i*2 f1 f1 f3 f2",
        "kernels.appearance.direction.shade_rows_backward f2 f2 f2 f2 f2 f1 f2 f2 f3",
        "kernels.image_loss.target_moments f3 f4 f3 f3",
        "kernels.feature_gradients.blend_features f2 i1 s1 s1 w1 y1 i1 i1 i*2 f1 f3 f2",
        "kernels.front_transmittance.front_transmittance d2 d2 d3 d1 d2 d3 d1 d1 d2 d1 i1 d d d d d1",
        "kernels.pairs.count_pairs f2 i1 s1 w1 i1 i1 i*2 f1 f2",
        "kernels.appearance.direction.shade_rows f2 f2 f2 f2 f2 f1 f2",
        "kernels.tiles.cover_tiles f2 s2 s1 i i w1 y1 i1 i1 i1 s1 i1 s2 w1 s2",
        "kernels.activation.activate_backward f2 f3 f1 f2 f2 f3 f1 f2 f2",
        "kernels.activation.activate_rows f2 f2 f3 f1 f2 i2",
        "kernels.adam.adam_rows f2 f2 f2 f2 f1 f1 f f i i2",
        "kernels.adam.adam_few_rows f2 f2 f2 f2 f1 f1 f f i i2",
        "kernels.tiles.depth_order f2 s1 u1 s1 u1 s1 i1",
        "kernels.feature_gradients.sum_features s1 i1 f2 f2 i2",
        "kernels.tiles.fill_tiles i1 i1 s2 w1 i2 s1 s1 w1",
        "kernels.tiles.tile_offsets s2 i1 i2",
        "kernels.balance.distribute i1 i",
        "kernels.tiles.share_pairs s1 i s1 i1 i1",
        "kernels.pictures.fill_planes y3 f3",
    ),
    *_of(
        KernelGroup.ENTANGLED,
        "kernels.deform.deform_backward i1 i1 i i2 i2 i2 i2 i2 f2 f2 f2 f none f4 f2 f f2 f2 f3 f3 f2 f3 f2 f2 f1",
        "kernels.deform.deform i1 i1 i f2 i2 i2 i2 i2 i2 f2 f2 f2 f none f4 f3 f2 f2 f3 f2 i2",
        "kernels.deform.freeze_layer i1 i1 i f2 i2 i2 i2 f2 f2 f none f4 f3 f2",
    ),
    *_of(
        KernelGroup.UPDATE,
        "kernels.box_loss.box_loss i f3 f3 w1 i i*4 f3 f3 f3 f2 f3 f3 f3 f1 i f4 y2 f3 f3 d1",
        "kernels.neighbour_terms.neighbour_terms f2 i1 s2 f2 f2 f1 f3 f2",
        "kernels.patch_matches.match_patches f1 f1 f1 i1 i2 d2 d1 d d2 d3 d2 d1",
        "kernels.patch_matches.fit_clusters d2 d3 d2 d1 i1 d d d2 d2 d2",
        "kernels.deform.block_sums f4 f2 f3",
        "kernels.soft_colour.soft_colour f2 f2 i1 f2 f f2",
        "kernels.tiles.mark_blocks f2 s2 y1 i w1",
        "kernels.tiles.find_meeting f2 s2 i w1 b1",
        "kernels.turns.turn_neighbourhoods f2 f2 i2 d3",
        "kernels.turns.shortest_axes f3 d2",
        "kernels.pictures.mark_changes y3 y3 i i f2",
        "kernels.states.find_implausible f2 f3 f2 f3 f2 f2 i1 f f f b1 f2",
        "kernels.deform.load_blocks f2 f3 i2 f4 f2",
    ),
    *_of(
        KernelGroup.SEPARATE,
        "kernels.deform.deform_backward i1 i1 i i2 i2 i2 i2 i2 f2 f2 f2 f b f4 f2 f f2 f2 f3 f3 f2 f3 f2 f2 f1",
        "kernels.deform.deform i1 i1 i f2 i2 i2 i2 i2 i2 f2 f2 f2 f b f4 f3 f2 f2 f3 f2 i2",
        "kernels.deform.freeze_layer i1 i1 i f2 i2 i2 i2 f2 f2 f b f4 f3 f2",
    ),
    *_of(
        KernelGroup.STEREO,
        "first_frame.points.patch_match._sweep f2 b2 d2 d2 d3 d2 d1 f3 i2 d3 d2 d d i i i i",
    ),
)


def kernels_of(groups: Iterable[KernelGroup]) -> list[Kernel]:
    """Returns the kernels of the given groups, in the order of the groups."""
    return [kernel for group in groups for kernel in KERNELS if kernel.group == group]


def groups_of_update(covariance: str) -> tuple[KernelGroup, ...]:
    """Returns the groups that updates need for a given value of the update setting ``covariance``."""
    return (KernelGroup.SEPARATE if covariance == "separate" else KernelGroup.ENTANGLED), KernelGroup.UPDATE
