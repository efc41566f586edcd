"""Wire models of the segmentation into parts."""

from __future__ import annotations

import colorsys
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from client.wire.base import Model, Row3

GOLDEN = 0.618033988749895
"""Hue step between parts (golden ratio), which keeps the hues of any number of parts well separated."""


class PartsModel(Model):
    """Part labels of all Gaussians. Parts keep their labels and colours across frames."""

    count: int
    """Number of parts."""
    frame: int
    """Newest frame that was used to find the parts."""
    ids: list[int]
    """[N] ids of the Gaussians."""
    labels: list[int]
    """[N] labels, starting at 0; −1 for static Gaussians. If `count` was requested, some labels may be unused."""
    colours: list[tuple[int, int, int]]
    """RGB colour (0…255) of each label from 0 to the largest. A label always has the same colour."""


class JointModel(Model):
    """A joint between two parts, in the rig's world frame and units. Null while one of the parts is absent."""

    parent: int
    """Label of the parent part; −1 if the child is attached to something static."""
    child: int
    """Label of the child part."""
    kind: Literal["revolute", "prismatic", "spherical"]
    """Hinge, slider or ball joint."""
    axes: list[Row3 | None]
    """[T] unit vectors of the axis. The axis of a ball joint is that of the child's present rotation."""
    centres: list[Row3 | None]
    """[T] points on the axis where the parts meet, or centres of the ball."""
    values: list[float | None]
    """[T] angles in radians by which the child has rotated about the axis, relative to the parent, since the first
    frame with both; for sliders, distances along the axis.
    """
    error: float
    """RMS distance between the child's points and their positions by the joint."""


class JointsModel(Model):
    """Joints between the parts of a scene over T frames."""

    frames: list[int]
    """[T] frame indices."""
    times: list[float]
    """[T] frame times in seconds."""
    joints: list[JointModel]
    """Joints, parents before their children."""


def part_colour(label: int) -> tuple[int, int, int]:
    """Returns the RGB colour of a part, with values in 0…255."""
    red, green, blue = colorsys.hsv_to_rgb(
        (0.58 + label * GOLDEN) % 1, (0.65, 0.45, 0.85)[label % 3], (0.95, 0.8)[label % 2]
    )
    return round(255 * red), round(255 * green), round(255 * blue)


def parts_model(labels: NDArray[np.int64], ids: NDArray[np.int64], frame: int) -> PartsModel:
    """Converts the labels [N] of Gaussians with ids [N] to the wire model."""
    return PartsModel(
        count=len(np.unique(labels[labels >= 0])),
        frame=frame,
        ids=ids.tolist(),
        labels=labels.tolist(),
        colours=[part_colour(label) for label in range(int(labels.max(initial=-1)) + 1)],
    )
