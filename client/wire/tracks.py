"""Wire models of trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from client.wire.base import Model, Pixel, Row3
from client.wire.rigs import CameraModel


class TracksRequest(Model):
    """A request for trajectories of exactly one of `ids`, `pixels` and `points`."""

    ids: Annotated[list[int], Field(min_length=1)] | None = None
    """Ids of Gaussians."""
    pixels: Annotated[list[Pixel], Field(min_length=1)] | None = None
    """Pixel coordinates (u, v) in the image of `camera`; (0.5, 0.5) is the centre of the first pixel."""
    camera: CameraModel | str | None = None
    """Camera to whose image the pixels belong: any camera, or the name of one in the rig."""
    points: Annotated[list[Row3], Field(min_length=1)] | None = None
    """Points (x, y, z) in the rig's world frame and units."""
    at: int | None = Field(default=None, ge=0)
    """Frame to which the pixels or points refer; default: the first committed frame."""
    first: int | None = Field(default=None, ge=0)
    """First frame; default: the first committed frame."""
    last: int | None = Field(default=None, ge=0)
    """Last frame, inclusive; default: the last committed frame."""
    project: list[CameraModel | str] = Field(default_factory=list, max_length=64)
    """Cameras into which to project the trajectories, including visibility."""
    format: Literal["json", "npz"] = "json"


class TracksModel(Model):
    """Trajectories of Q points over T frames, in the rig's world frame and units."""

    frames: list[int]
    """[T] frame indices."""
    times: list[float]
    """[T] frame times in seconds."""
    ids: list[int]
    """[Q] id of the Gaussian that carries the point; −1 if the query hit nothing."""
    confidence: list[list[float]]
    """[Q][T] estimated probability, in [0, 1], that the position is within 1% of the extent of the true one
    (docs/tracks.md); 0 if there is no position.
    """
    positions: list[list[list[float] | None]]
    """[Q][T] positions (x, y, z); null if the query hit nothing, or the Gaussian is unborn or retired."""
    visible: dict[str, list[list[bool]]] = Field(default_factory=dict)
    """For each requested camera, [Q][T] whether the point is inside the image and not occluded."""
    pixels: dict[str, list[list[list[float] | None]]] = Field(default_factory=dict)
    """For each requested camera, [Q][T] pixels (u, v); null if the point is behind the camera."""


class GaussianModel(Model):
    """The lifetime of one Gaussian, which is present from its birth, and from each revival, until it is retired."""

    id: int
    born: int
    """Frame in which the Gaussian was born; the first frame for initial Gaussians."""
    retired: list[int]
    """Frames in which the Gaussian was retired."""
    revived: list[int]
    """Frames in which the Gaussian was revived."""


class GaussiansModel(Model):
    """Lifetimes of Gaussians in the requested order."""

    frame: int
    """The newest committed frame."""
    gaussians: list[GaussianModel]


def tracks_model(
    frames: Sequence[int],
    times: Sequence[float],
    ids: NDArray[np.int64],
    confidence: NDArray[np.float64],
    positions: NDArray[Any],
    pixels: dict[str, NDArray[Any]],
    visible: dict[str, NDArray[np.bool_]],
) -> TracksModel:
    """Converts arrays [T, Q, …] to the wire model's lists [Q][T]; NaN becomes null."""

    def lists(array: NDArray[Any]) -> list[list[list[float] | None]]:
        finite = np.isfinite(array).all(axis=-1)
        return [
            [point.tolist() if ok else None for point, ok in zip(track, good, strict=True)]
            for track, good in zip(array.swapaxes(0, 1), finite.T, strict=True)
        ]

    return TracksModel(
        frames=list(frames),
        times=list(times),
        ids=ids.tolist(),
        confidence=confidence.T.tolist(),
        positions=lists(positions),
        pixels={name: lists(uv) for name, uv in pixels.items()},
        visible={name: seen.T.tolist() for name, seen in visible.items()},
    )
