"""Queries on the committed states of a scene: novel views, tracks, parts and exports of any frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Camera, WorldFrame
from scas4d_core.engines.choose import Device
from scas4d_core.engines.limits import DEFAULT, Limits
from scas4d_core.gaussians import Gaussians
from scas4d_core.query import joints as joints_of_history
from scas4d_core.query import parts as parts_of_history
from scas4d_core.query import ply
from scas4d_core.query import tracks as tracks_of_history
from scas4d_core.query.joints import Joint
from scas4d_core.query.tracks import Tracks
from scas4d_core.query.view import View, ViewRenderer
from scas4d_core.storage.history import History


class CommittedScene:
    """Committed states of a scene, which can be rendered, tracked, segmented into parts and exported.

    Cameras and points are in the user's world. If ``index`` is None, the newest frame is used.

    Args:
        history: history of committed states.
        world: transform from the user's world to the internal world.
        limits: rasterizer constants.

    >>> history = History()
    >>> history.append(0, 0.0, Gaussians.of_points([[0, 0, 2]], radius=0.1, colours=[1, 0, 0]))
    >>> committed = CommittedScene(history, WorldFrame(np.zeros(3)))
    >>> camera = Camera("front", [[100, 0, 8], [0, 100, 8], [0, 0, 1]], np.eye(4), 16, 16)
    >>> view = committed.render(camera, background=(0, 0, 1))
    >>> view.colour[8, 8].round(1), view.depth[8, 8]
    (array([0.9, 0. , 0.1], dtype=float32), np.float32(2.0))
    >>> committed.tracks_of_points(np.array([[0, 0, 2]]), 0, [0]).confidence.round(2)
    array([[0.98]])
    """

    def __init__(self, history: History, world: WorldFrame, limits: Limits = DEFAULT, device: Device = "cpu") -> None:
        self.history = history
        self.world = world
        self._limits = limits
        self._view = ViewRenderer(world, limits, device)

    def render(
        self,
        camera: Camera,
        index: int | None = None,
        *,
        background: tuple[float, float, float] | None = None,
        labels: NDArray[Any] | None = None,
    ) -> View:
        """Renders a committed frame from any camera.

        Args:
            camera: camera in the user's world.
            index: index of a committed frame, or None for the newest.
            background: RGB in [0, 1], or None for the scene's background.
            labels: [N] part label of each Gaussian, −1 for none; required for ``View.parts``. Labels of the newest
                frame can be used for any frame, because the labels of Gaussians added later are ignored.

        Raises:
            HistoryError: if the frame was not committed.
            ValueError: if the labels have the wrong shape or are out of range.
        """
        gaussians = self._state(index)
        if labels is not None and np.shape(labels) == (self.history.count,):
            labels = np.asarray(labels)[: len(gaussians)]
        return self._view.render(gaussians, camera, self._background(background), labels=labels)

    def render_levels(
        self, camera: Camera, index: int | None, background: tuple[float, float, float] | None, *, opacity: bool
    ) -> NDArray[np.uint8]:
        """Renders the colours [H, W, 3] or opacity [H, W] of a frame in 8 bits; see ``render`` and ``ViewRenderer``."""
        return self._view.render_levels(self._state(index), camera, self._background(background), opacity=opacity)

    def _background(self, given: tuple[float, float, float] | None) -> tuple[float, float, float]:
        return self.history.background if given is None else given

    def _state(self, index: int | None) -> Gaussians:
        return self.history.gaussians(self.history.indices[-1] if index is None else index)

    def _depth(self, camera: Camera, index: int) -> tuple[NDArray[Any], NDArray[Any]]:
        view = self.render(camera, index)
        return view.depth, view.alpha

    def tracks_of_points(self, points: NDArray[Any], index: int, indices: Sequence[int]) -> Tracks:
        """Tracks points [Q, 3] of frame ``index`` over the frames ``indices``; see ``tracks.tracks_of_points``."""
        return tracks_of_history.tracks_of_points(self.history, self.world, points, index, indices)

    def tracks_of_pixels(self, camera: Camera, uv: NDArray[Any], index: int, indices: Sequence[int]) -> Tracks:
        """Tracks the points seen at pixels [Q, 2] of a camera in frame ``index``; see ``tracks.tracks_of_pixels``."""
        return tracks_of_history.tracks_of_pixels(
            self.history, self.world, camera, uv, index, indices, self._depth, limits=self._limits
        )

    def tracks_of_ids(self, ids: NDArray[Any], indices: Sequence[int]) -> Tracks:
        """Returns the trajectories of the Gaussians with the given ids [Q]."""
        return tracks_of_history.tracks_of_ids(self.history, self.world, ids, indices)

    def with_visibility(self, tracks: Tracks, camera: Camera, index: int) -> Tracks:
        """Returns a copy of tracks queried at frame ``index``, with their visibility in another camera added."""
        return tracks.with_visibility(self.history, self.world, camera, index, self._limits)

    def parts(self, count: int | None = None, previous: NDArray[Any] | None = None) -> NDArray[np.int64]:
        """Returns the part label of each Gaussian [N] (largest part first, −1 if static); see ``parts.parts``.

        Args:
            count: number of parts, or None to choose it from the motion.
            previous: [N] labels computed from fewer frames, or None. Parts that persist keep their labels.
        """
        return parts_of_history.parts(self.history, count, previous=previous)

    def joints(self, labels: NDArray[Any], indices: Sequence[int]) -> list[Joint]:
        """Returns the joints between parts with labels [N], in the given frames; see ``joints.joints``."""
        return joints_of_history.joints(self.history, labels, self.world, indices)

    def write_ply(self, path: Path, index: int | None = None) -> None:
        """Writes a committed frame as a standard 3DGS .ply."""
        ply.write_ply(path, self._state(index), self.world)
