"""A reconstruction as arrays: its states, tracks and parts, in the rig's world and unit, without a service or with one.

Axes are those of the rig's calibration, cameras are OpenCV's (x right, y down, z forward). Needs numpy and zstandard.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from client.exports.sources import Source, frame_range, is_scene_id, opened
from client.sdk import DEFAULT_URL, Client
from scas4d_core.cameras import Rig, WorldFrame
from scas4d_core.errors import InputError
from scas4d_core.gaussians import Gaussians

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
Int = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class State:
    """N Gaussians in one frame. Row i is the same Gaussian in every frame; rows are only ever added at the end.

    Attributes:
        frame: its index. seconds: its time. gaussians: the state in the inside world, float32. world: from the user's.
    """

    frame: int
    seconds: float
    gaussians: Gaussians
    world: WorldFrame

    @cached_property
    def means(self) -> Float:
        """[N, 3] float64 centres, user's unit."""
        return self.world.to_user(self.gaussians.means)

    @cached_property
    def covariances(self) -> Float:
        """[N, 3, 3] float64, squares of the user's unit."""
        factors = self.gaussians.factors.astype(np.float64) / self.world.metres_per_unit
        return factors @ np.swapaxes(factors, 1, 2)

    @property
    def rotations(self) -> NDArray[np.float32]:
        """[N, 4] unit quaternions (w, x, y, z): how each has turned since frame 0, or since its birth."""
        return self.gaussians.rotations

    @property
    def colours(self) -> NDArray[np.float32]:
        """[N, 3] RGB, nominally 0…1, on the curve of the pictures (sRGB); without gloss."""
        return self.gaussians.colours

    @property
    def opacities(self) -> NDArray[np.float32]:
        """[N] in 0…1; 0 for what is not there."""
        return self.gaussians.opacities

    @property
    def ids(self) -> Int:
        """[N] id of each, for ever."""
        return self.gaussians.ids

    @property
    def present(self) -> Bool:
        """[N] whether it is there; what has left the scene is not."""
        return self.gaussians.present

    @property
    def moving(self) -> Bool:
        """[N] whether it belongs to what moves, and is there."""
        return self.gaussians.moving


@dataclass(frozen=True, eq=False)
class GaussianTracks:
    """Centres of K Gaussians over T frames.

    Attributes:
        positions: [T, K, 3] float64, user's world and unit; NaN in frames in which a Gaussian is not there.
        seconds: [T] time of the frames. frames: [T] their indices. ids: [K]. present: [T, K] bool.
    """

    positions: Float
    seconds: Float
    frames: Int
    ids: Int

    @property
    def present(self) -> Bool:
        """[T, K] whether a Gaussian is there."""
        return np.isfinite(self.positions[..., 0])


@dataclass(frozen=True, eq=False)
class PartPoses:
    """Rigid motion of P parts over T frames.

    Attributes:
        parts: [P] labels. frames: [T] indices. seconds: [T].
        motions: [P, T, 4, 4] float64: ``motions[p, t] @ [x, y, z, 1]`` is where a point of the part is in frame t that
            is at (x, y, z) in the first of the frames; user's unit. NaN where no Gaussian of the part is there.
        residuals: [P, T] RMS distance that the rigid motion leaves, user's unit.
    """

    parts: Int
    frames: Int
    seconds: Float
    motions: Float
    residuals: Float


class Scene:
    """A reconstruction to compute with: a compact file, the folder that holds one, or a scene of the service.

    One state is read at a time. Of a scene of the service the states are fetched when it is opened; close it then, or
    use it in a ``with``.

    Attributes:
        frames: indices of its frames. seconds: [T] their times.

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
            source: a file that ends in .s4d, the folder of `scas4d reconstruct`, or the id of a scene of the service.
            frames: ``A:B``, the frames from A to B, both counted in, as for `scas4d export`; None: all.
            url, token: of the service.

        Raises:
            InputError: it is not there, or has none of these frames. ServiceError: the service refused.
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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Removes what was fetched from a service; it cannot be read any more."""
        self._closing.close()

    @property
    def frames(self) -> list[int]:
        """Indices of the frames, rising."""
        return list(self._times)

    @property
    def seconds(self) -> Float:
        """[T] times of the frames."""
        return np.array(list(self._times.values()))

    @property
    def rig(self) -> Rig | None:
        """The cameras in the user's world, as the reconstruction has refined them; None where the file has none."""
        return self._given.head.rig

    @property
    def metres_per_unit(self) -> float:
        """Metres in one of the user's units."""
        return self._given.head.world.metres_per_unit

    def states(self, frames: str | None = None) -> Iterator[State]:
        """The states, one after the other.

        Args:
            frames: ``A:B``; None: all.

        Raises:
            InputError: there is none of these frames.

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
        """Centres of Gaussians over time: 24 bytes for each of them and each frame.

        Args:
            ids: [K] of the Gaussians; None: all that move in the last of the frames. frames: ``A:B``; None: all.

        Raises:
            InputError: there is no Gaussian of an id, or none of these frames.

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
        """[N] part of each Gaussian by row, N as in the last frame; −1 for those that belong to none.

        Of a scene of the service they are those of its newest frame; the service looks for them, which takes seconds.

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
        """Rigid motion of the parts since the first of the frames, fitted to their Gaussians (docs/exports.md).

        Needs scipy, of the extra `server`.

        Raises:
            InputError: there is no part, or none of these frames.

        >>> with Scene.open(scene, url=url) as given:
        ...     poses = given.part_poses()
        >>> poses.parts, poses.motions.shape, bool(np.allclose(poses.motions[:, 0], np.eye(4)))
        (array([0, 1]), (2, 3, 4, 4), True)
        """
        from scas4d_core.exports.part_motion import PartMotion

        chosen, labels = self._within(frames), self.parts()
        world = self._given.head.world
        motion: PartMotion | None = None
        motions = residuals = np.zeros(0)
        for place, state in enumerate(self.states(frames)):
            if motion is None:
                motion = PartMotion(labels, state.gaussians, world)
                motions = np.full((len(motion.parts), len(chosen), 4, 4), np.nan)
                residuals = np.full(motions.shape[:2], np.nan)
            for pose in motion.poses(state.gaussians):
                part = motion.parts.index(pose.part)
                motions[part, place] = np.eye(4)
                motions[part, place, :3, :3] = pose.rotation
                motions[part, place, :3, 3] = pose.position - pose.rotation @ motion.origins[pose.part]
                residuals[part, place] = pose.residual
        assert motion is not None
        return PartPoses(
            np.array(motion.parts, np.int64),
            np.array(list(chosen), np.int64),
            np.array(list(chosen.values())),
            motions,
            residuals,
        )

    def _within(self, frames: str | None) -> dict[int, float]:
        """Index and time of the frames of a range, of those that were opened."""
        low, high = frame_range(frames)
        times = {index: time for index, time in self._times.items() if low <= index <= high}
        if not times:
            raise InputError(f"frames {frames} are not there", f"frames {self.frames[0]} to {self.frames[-1]} are")
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
            raise InputError(f"ids: there is no Gaussian {missing[0]} in frame {last}", "give ids of a state's `ids`")
        return rows, state.ids[rows]
