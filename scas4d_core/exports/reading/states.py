"""Reconstructs states from one cloud per frame: assigns rows to Gaussians, and detects births and retirements.

A cloud contains the Gaussians present in its frame, with their ids. A Gaussian gets its row in the
first frame that contains it, and is retired in each later frame that does not contain it. Two
properties are missing from the files and are inferred. A Gaussian counts as moving if its position
changes. Its material rotation is the rotation of its covariance axes since its first frame; exports
order and sign these axes so that they follow the material.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import WorldFrame
from scas4d_core.compact import FileHeader
from scas4d_core.errors import InputError
from scas4d_core.exports.cloud import Cloud
from scas4d_core.exports.reading.faults import translate_read_errors
from scas4d_core.gaussians import Gaussians

Float = NDArray[np.float64]
Int = NDArray[np.int64]

STATIC = 1e-6
"""Displacement, relative to the extent of all Gaussians, below which a Gaussian counts as static; float32 resolves
a tenth of it."""


@dataclass(frozen=True, eq=False)
class _GaussianTable:
    """Constant data of each Gaussian: ids, moving flags and opacities [N], and initial axes as quaternions [N, 4]."""

    ids: Int
    moving: NDArray[np.bool_]
    opacities: NDArray[np.float32]
    turns: Float


@dataclass(eq=False)
class ExportedStates:
    """A sequence of states that is read from one cloud per frame.

    Only one frame, and the constant data of each Gaussian, are kept in memory.

    Attributes:
        frames: frame indices in increasing order.
        times: times in seconds, in increasing order.
        cloud: function that returns the cloud at a position in ``frames``, in the user's world and units, with OpenCV
            axes.
        head: header of the states; the origin of its world is zero, because files do not store one.
        part_of: maps each Gaussian id to its part label; empty if the file has no parts.
        remarks: sentences about lost or assumed information.
        damage: always None; exists for compatibility with ``CompactReader``.

    >>> from scas4d_core.exports.cloud import cloud_of
    >>> first = Gaussians.of_points([[0, 0, 2], [1, 0, 2]], radius=0.1)
    >>> world = WorldFrame(np.zeros(3))
    >>> clouds = [cloud_of(state, world) for state in (first.rows([0]), first, first.rows([1]))]
    >>> read = ExportedStates([3, 4, 5], [0.0, 0.1, 0.2], clouds.__getitem__, FileHeader(world))
    >>> [(index, state.ids.tolist(), state.present.tolist()) for index, _, state in read.states()]
    [(3, [0], [True]), (4, [0, 1], [True, True]), (5, [0, 1], [False, True])]
    """

    frames: Sequence[int]
    times: Sequence[float]
    cloud: Callable[[int], Cloud]
    head: FileHeader
    part_of: dict[int, int] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)
    damage: str | None = None
    _known: _GaussianTable | None = None

    @property
    def known(self) -> _GaussianTable:
        """Constant data of each Gaussian; the first access reads all frames."""
        if self._known is None:
            self._known = self._survey()
        return self._known

    def parts(self) -> Int | None:
        """Returns the part label of each Gaussian [N] (−1 for none), or None if the file has no parts."""
        if not self.part_of:
            return None
        return np.array([self.part_of.get(id, -1) for id in self.known.ids.tolist()], np.int64)

    def states(self, low: int = 0, high: int | None = None) -> Iterator[tuple[int, float, Gaussians]]:
        """Yields the index, time in seconds and state of frames ``low`` to ``high``, in the internal world of ``head``.

        Raises:
            InputError: if a file is damaged, or is inconsistent with previous files.
        """
        known, world = self.known, self.head.world
        row_of = {id: row for row, id in enumerate(known.ids.tolist())}
        total, born = len(known.ids), 0
        means = np.zeros((total, 3), np.float32)
        factors = np.zeros((total, 3, 3), np.float32)
        rotations, colours = np.zeros((total, 4), np.float32), np.zeros((total, 3), np.float32)
        for place, (index, time) in enumerate(zip(self.frames, self.times, strict=True)):
            if high is not None and index > high:
                return
            with translate_read_errors(f"frame {index}"):
                cloud = self.cloud(place)
            rows = np.array([row_of[id] for id in cloud.ids.tolist()], np.intp)
            of = cloud.splats
            axes = Rotation.from_quat(np.roll(of.rotations, -1, axis=1)) if len(of) else None
            born = max(born, int(rows.max(initial=-1)) + 1)
            means[rows] = world.to_inside(of.means)
            if axes is not None:
                factors[rows] = axes.as_matrix() * (of.scales * world.metres_per_unit)[:, None, :]
                since = axes * Rotation.from_quat(np.roll(known.turns[rows], -1, axis=1)).inv()
                rotations[rows] = np.roll(since.as_quat(canonical=True), 1, axis=1)
            colours[rows] = of.colours
            retired = np.ones(born, np.bool_)
            retired[rows] = False
            if index >= low:
                yield index, time, _state(known, born, retired, means, factors, rotations, colours)

    def _survey(self) -> _GaussianTable:
        ids: dict[int, int] = {}
        first, turns, opacities, moving = (np.zeros((0, n)) for n in (3, 4, 1, 1))
        for place in range(len(self.frames)):
            with translate_read_errors(f"frame {self.frames[place]}"):
                cloud = self.cloud(place)
            given = cloud.ids.tolist()
            if len(set(given)) < len(given):
                raise InputError(f"frame {self.frames[place]}: two Gaussians have the same id", "export it again")
            new = np.array([id not in ids for id in given], np.bool_)
            ids.update({id: len(ids) + k for k, id in enumerate(np.asarray(given)[new].tolist())})
            of = cloud.splats
            first = np.concatenate([first, of.means[new]])
            turns = np.concatenate([turns, of.rotations[new]])
            opacities = np.concatenate([opacities, of.opacities[new, None]])
            moving = np.concatenate([moving, np.zeros((int(new.sum()), 1))])
            rows = np.array([ids[id] for id in given], np.intp)
            away = np.linalg.norm(of.means - first[rows], axis=1)
            moving[rows, 0] = np.maximum(moving[rows, 0], away)
            opacities[rows, 0] = np.maximum(opacities[rows, 0], of.opacities)
        extent = float(np.ptp(first, axis=0).max(initial=0)) if len(first) else 0.0
        far = float(np.abs(first).max(initial=0))  # ignore differences below float32's resolution
        least = max(STATIC * extent, 4 * float(np.finfo(np.float32).eps) * far)
        return _GaussianTable(
            np.fromiter(ids, np.int64, len(ids)), moving[:, 0] > least, opacities[:, 0].astype(np.float32), turns
        )


def _state(
    known: _GaussianTable,
    born: int,
    retired: NDArray[np.bool_],
    means: NDArray[np.float32],
    factors: NDArray[np.float32],
    rotations: NDArray[np.float32],
    colours: NDArray[np.float32],
) -> Gaussians:
    own = known.opacities[:born].copy()
    return Gaussians(
        means=means[:born].copy(),
        factors=factors[:born].copy(),
        rotations=rotations[:born].copy(),
        opacities=own,
        colours=colours[:born].copy(),
        foreground=known.moving[:born].astype(np.float32),
        ids=known.ids[:born].copy(),
        retired=retired if retired.any() else None,  # type: ignore[arg-type]
        own_opacities=own,
    )


def default_header(metres_per_unit: float, frames_per_second: float | None) -> FileHeader:
    """Returns a header for states in the user's world, converted to metres.

    >>> default_header(0.01, 30.0).world.to_inside(np.array([[100.0, 0, 0]]))
    array([[1., 0., 0.]])
    """
    return FileHeader(WorldFrame(np.zeros(3), metres_per_unit=metres_per_unit), frames_per_second=frames_per_second)
