"""Access to a reconstruction as arrays: states, tracks and parts in the rig's world frame and units.

Works with files and with a running service. World axes are those of the rig's calibration. Cameras follow the OpenCV
convention (x right, y down, z forward). Requires numpy and zstandard.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from client.exports.sources import Source, frame_range, is_scene_id, opened
from client.sdk import DEFAULT_URL, Client
from scas4d_core.cameras import Rig, WorldFrame
from scas4d_core.errors import InputError
from scas4d_core.gaussians import Gaussians, moving_extent

if TYPE_CHECKING:
    from scas4d_core.query.joints import Joint
    from scas4d_core.query.part_motion import PartTrack

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
Int = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class State:
    """State of N Gaussians in one frame. Row i is the same Gaussian in every frame; new Gaussians are appended.

    Attributes:
        frame: frame index.
        seconds: frame time in seconds.
        gaussians: state in the internal world frame, float32.
        world: transform between the user's and the internal world frame.
    """

    frame: int
    seconds: float
    gaussians: Gaussians
    world: WorldFrame

    @cached_property
    def means(self) -> Float:
        """Centres [N, 3], float64, in the user's world and units."""
        return self.world.to_user(self.gaussians.means)

    @cached_property
    def covariances(self) -> Float:
        """Covariances [N, 3, 3], float64, in squared units of the user's world."""
        factors = self.gaussians.factors.astype(np.float64) / self.world.metres_per_unit
        return factors @ np.swapaxes(factors, 1, 2)

    @property
    def rotations(self) -> NDArray[np.float32]:
        """Rotations [N, 4] as unit quaternions (w, x, y, z), relative to frame 0 or the frame of creation."""
        return self.gaussians.rotations

    @property
    def colours(self) -> NDArray[np.float32]:
        """RGB colours [N, 3], nominally in [0, 1], sRGB-encoded like the images; without specular reflections."""
        return self.gaussians.colours

    @property
    def opacities(self) -> NDArray[np.float32]:
        """Opacities [N] in [0, 1]; 0 for Gaussians that are not present."""
        return self.gaussians.opacities

    @property
    def ids(self) -> Int:
        """Permanent ids [N]."""
        return self.gaussians.ids

    @property
    def present(self) -> Bool:
        """Mask [N] of Gaussians that are present in this frame, i.e. have not left the scene."""
        return self.gaussians.present

    @property
    def moving(self) -> Bool:
        """Mask [N] of moving Gaussians that are present in this frame."""
        return self.gaussians.moving


@dataclass(frozen=True, eq=False)
class GaussianTracks:
    """Trajectories of K Gaussians over T frames.

    Attributes:
        positions: centres [T, K, 3], float64, in the user's world and units; NaN in frames in which a Gaussian is not
            present.
        seconds: frame times [T] in seconds.
        frames: frame indices [T].
        ids: Gaussian ids [K].
        present: mask [T, K] of the frames in which a Gaussian is present.
    """

    positions: Float
    seconds: Float
    frames: Int
    ids: Int

    @property
    def present(self) -> Bool:
        """Mask [T, K] of the frames in which a Gaussian is present."""
        return np.isfinite(self.positions[..., 0])


@dataclass(frozen=True, eq=False)
class PartPoses:
    """Rigid motions of P parts over T frames.

    Attributes:
        parts: part labels [P].
        frames: frame indices [T].
        seconds: frame times [T] in seconds.
        motions: rigid transforms [P, T, 4, 4], float64, in the user's units. A point of part p at (x, y, z) in the
            first frame of the part is at ``motions[p, t] @ [x, y, z, 1]`` in frame t. NaN in frames in which no
            Gaussian of the part is present.
        residuals: RMS distances [P, T] between the Gaussians and the rigid motion, in the user's units.
    """

    parts: Int
    frames: Int
    seconds: Float
    motions: Float
    residuals: Float


class Scene:
    """Reconstruction opened from a compact file, its folder, or a scene on the service.

    States are read one at a time. For a scene on the service, all states are downloaded on opening; in that case, close
    the object or use it as a context manager.

    Attributes:
        frames: frame indices.
        seconds: frame times [T] in seconds.

    >>> with Scene.open(scene, url=url) as given:  # a folder, a .s4d file, or an id
    ...     shapes = [(state.frame, state.means.shape) for state in given.states("0:1")]
    ...     tracks = given.tracks()
    >>> given.frames, shapes, tracks.positions.shape
    ([0, 1, 2], [(0, (2, 3)), (1, (2, 3))], (3, 2, 3))
    """

    def __init__(self, given: Source, low: int, high: int, closing: ExitStack) -> None:
        self._given, self._closing = given, closing
        self._times = given.within(low, high)
        self._asked: tuple[str, str, str | None] | None = None

    @classmethod
    def open(
        cls, source: Path | str, *, frames: str | None = None, url: str = DEFAULT_URL, token: str | None = None
    ) -> Scene:
        """Opens a reconstruction.

        Args:
            source: .s4d file, output folder of `scas4d reconstruct`, export with Gaussian ids (docs/exports.md), or id
                of a scene on the service.
            frames: inclusive range ``A:B``, as for `scas4d export`; None for all frames.
            url: service URL.
            token: access token for the service.

        Raises:
            InputError: the source does not exist, or contains none of these frames.
            ServiceError: the service refused the request.
        """
        low, high = frame_range(frames)
        with ExitStack() as stack:
            given = stack.enter_context(opened(str(source), low, high, False, url, token))
            scene = cls(given, low, high, stack)
            scene._asked = (str(source), url, token) if is_scene_id(str(source)) else None
            scene._closing = stack.pop_all()
        return scene

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Deletes states downloaded from a service; they cannot be read afterwards."""
        self._closing.close()

    @property
    def frames(self) -> list[int]:
        """Frame indices in ascending order."""
        return list(self._times)

    @property
    def seconds(self) -> Float:
        """Frame times [T] in seconds."""
        return np.array(list(self._times.values()))

    @property
    def rig(self) -> Rig | None:
        """Cameras in the user's world, as refined by the reconstruction; None if the file has none."""
        return self._given.head.rig

    @property
    def metres_per_unit(self) -> float:
        """Length of one user unit in metres."""
        return self._given.head.world.metres_per_unit

    def states(self, frames: str | None = None) -> Iterator[State]:
        """Yields the states in frame order.

        Args:
            frames: inclusive range ``A:B``; None for all frames.

        Raises:
            InputError: none of these frames exists.

        >>> with Scene.open(scene, url=url) as given:
        ...     for state in given.states("2:2"):
        ...         print(state.frame, round(state.seconds, 3), state.covariances.shape, state.present)
        2 0.067 (2, 3, 3) [ True  True]
        """
        chosen = list(self._within(frames))
        world = self._given.head.world
        for index, seconds, gaussians in self._given.states(chosen[0], chosen[-1]):
            yield State(index, seconds, gaussians, world)

    def tracks(self, ids: ArrayLike | None = None, frames: str | None = None) -> GaussianTracks:
        """Returns the trajectories of Gaussians, which occupy 24 bytes per Gaussian and frame.

        Args:
            ids: Gaussian ids [K]; None for all Gaussians that are moving in the last of these frames.
            frames: inclusive range ``A:B``; None for all frames.

        Raises:
            InputError: one of the ids does not exist, or none of these frames exists.

        >>> with Scene.open(scene, url=url) as given:
        ...     tracks = given.tracks(ids=[0])
        >>> tracks.positions.shape, tracks.ids, tracks.seconds.shape, bool(tracks.present.all())
        ((3, 1, 3), array([0]), (3,), True)
        """
        chosen = self._within(frames)
        rows, known = self._rows(ids, list(chosen)[-1])
        positions = np.full((len(chosen), len(rows), 3), np.nan)
        for place, state in zip(positions, self.states(frames), strict=True):
            there = rows < len(state.ids)
            there[there] = state.present[rows[there]]
            place[there] = self._given.head.world.to_user(state.gaussians.means[rows[there]])
        return GaussianTracks(positions, np.array(list(chosen.values())), np.array(list(chosen), np.int64), known)

    def parts(self) -> Int:
        """Returns the part label [N] of each row in the last frame; −1 if a Gaussian belongs to no part.

        For a scene on the service, the labels refer to its newest frame. The service computes them on demand,
        which takes a few seconds.

        >>> with Scene.open(scene, url=url) as given:
        ...     given.parts()
        array([0, 1])
        """
        count = len(next(self.states(str(self.frames[-1]))).ids)
        if self._asked is None:
            given_labels = self._given.parts()
        else:
            id, url, token = self._asked
            with Client(url, token=token, outage=0) as client:
                given_labels = np.array(client.parts(id).labels, np.int64)
        labels = np.full(count, -1, np.int64)
        if given_labels is not None:
            labels[: len(given_labels)] = given_labels[:count]
        return labels

    def part_poses(self, frames: str | None = None) -> PartPoses:
        """Returns the rigid motion of each part since its first frame, fitted to its Gaussians (docs/exports.md).

        Requires scipy, which the extra `server` installs.

        Raises:
            InputError: there are no parts, or none of these frames exists.

        >>> with Scene.open(scene, url=url) as given:
        ...     poses = given.part_poses()
        >>> poses.parts, poses.motions.shape, bool(np.allclose(poses.motions[:, 0], np.eye(4)))
        (array([0, 1]), (2, 3, 4, 4), True)
        """
        chosen = self._within(frames)
        tracks = [track for track in self._part_tracks(frames) if track.part >= 0]
        if not tracks:
            raise InputError("the scene has no parts in these frames", "use frames in which something moves")
        return PartPoses(
            np.array([track.part for track in tracks], np.int64),
            np.array(list(chosen), np.int64),
            np.array(list(chosen.values())),
            np.stack([track.motions for track in tracks]),
            np.stack([track.residuals for track in tracks]),
        )

    def joints(self, frames: str | None = None) -> list[Joint]:
        """Returns the joints between parts: hinges, sliders and ball joints (docs/tracks.md), found in these frames.

        Requires scipy, which the extra `server` installs.

        Raises:
            InputError: none of these frames exists.

        >>> with Scene.open(scene, url=url) as given:
        ...     given.joints()  # the sample's boxes do not touch
        []
        """
        from scas4d_core.query.joints import find_joints

        first = next(self.states(str(next(iter(self._within(frames))))))
        return find_joints(self._part_tracks(frames), moving_extent(first.gaussians) / self.metres_per_unit)

    def _part_tracks(self, frames: str | None) -> list[PartTrack]:
        from scas4d_core.query.part_motion import part_tracks

        return part_tracks((state.gaussians for state in self.states(frames)), self.parts(), self._given.head.world)

    def _within(self, frames: str | None) -> dict[int, float]:
        """Returns the time of each opened frame in a range, keyed by frame index."""
        low, high = frame_range(frames)
        times = {index: time for index, time in self._times.items() if low <= index <= high}
        if not times:
            raise InputError(f"no frames in the range {frames}", f"use frames {self.frames[0]} to {self.frames[-1]}")
        return times

    def _rows(self, ids: ArrayLike | None, last: int) -> tuple[NDArray[np.intp], Int]:
        state = next(self.states(str(last)))
        if ids is None:
            rows = np.flatnonzero(state.moving)
            return rows, state.ids[rows]
        asked: NDArray[Any] = np.atleast_1d(np.asarray(ids))
        order = np.argsort(state.ids)
        places = np.minimum(np.searchsorted(state.ids, asked, sorter=order), len(order) - 1)
        rows = order[places]
        missing = asked[state.ids[rows] != asked]
        if missing.size:
            raise InputError(f"ids: no Gaussian {missing[0]} in frame {last}", "use ids from a state's `ids`")
        return rows, state.ids[rows]
