"""Converts arrays, poses and cameras to USD values and axes, and writes time samples."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Camera
from scas4d_core.errors import InputError, message_of
from scas4d_core.exports.atomic_files import import_optional, translate_write_errors
from scas4d_core.exports.cloud import HALF_TURN

Array = NDArray[Any]

FOCAL_LENGTH = 50.0
"""Focal length of every camera, in tenths of a stage unit, as defined by USD. Apertures scale with it."""
NEAREST, FARTHEST = 0.01, 1000.0
"""Clipping range of cameras in metres."""


class AnimatedValues:
    """Writer of the time samples of a USD attribute, such as one value per Gaussian.

    A sample is written only when values change. USD interpolates between samples, so the previous
    frame's values are also written before a change. Gaussians born later make samples longer, so
    shorter samples are padded before the file is completed (``lengthen``).

    Args:
        attribute: USD attribute.
        typed: function that converts a NumPy array to a USD array.
        unborn: value of a Gaussian before its birth, or None to use its value at birth.
    """

    def __init__(self, attribute: Any, typed: Callable[[Array], Any], unborn: float | None = None) -> None:
        self._attribute, self._typed, self._unborn = attribute, typed, unborn
        self._last: Array | None = None
        self._unwritten: float | None = None
        self._births: list[Array] = []
        self._born = 0

    def set(self, values: Array, code: float) -> None:
        """Sets the values [N, …] at a time code; N never decreases."""
        given = np.asarray(values, np.float32)
        if len(given) > self._born:
            self._births.append(given[self._born :].copy())
            self._born = len(given)
        if self._last is not None and self._is_stored(self._last, given):
            self._last, self._unwritten = given, code
            return
        if self._unwritten is not None and self._last is not None:
            self._attribute.Set(self._typed(self._last), self._unwritten)
        self._attribute.Set(self._typed(given), code)
        self._last, self._unwritten = given, None

    def _is_stored(self, before: Array, after: Array) -> bool:
        """Returns whether the previous sample, after padding, already has these values."""
        grown = len(after) > len(before)
        return not (grown and self._unborn is not None) and np.array_equal(before, after[: len(before)])

    def lengthen(self) -> Iterator[None]:
        """Pads all samples to the full length; yields after each so that the caller can save it."""
        if len(self._births) < 2:
            return
        full = np.concatenate(self._births)
        if self._unborn is not None:
            full[:] = self._unborn
        for code in self._attribute.GetTimeSamples():
            sample = np.asarray(self._attribute.Get(code), np.float32).reshape(-1, *full.shape[1:])
            if len(sample) < len(full):
                self._attribute.Set(self._typed(np.concatenate([sample, full[len(sample) :]])), code)
                yield

    def store_constant_as_default(self) -> None:
        """Replaces a single time sample by a default value, for readers without time support."""
        codes = self._attribute.GetTimeSamples()
        if len(codes) == 1:
            value = self._attribute.Get(codes[0])
            self._attribute.Clear()
            self._attribute.Set(value)


def points_of(values: Array) -> Any:
    """Converts values [N, 3] to a USD array."""
    return import_optional("pxr.Vt", "usd").Vec3fArray.FromNumpy(np.ascontiguousarray(values, np.float32))


def floats_of(values: Array) -> Any:
    """Converts values [N] to a USD array."""
    return import_optional("pxr.Vt", "usd").FloatArray.FromNumpy(np.ascontiguousarray(values, np.float32))


def quaternions_of(values: Array) -> Any:
    """Converts [N, 4] quaternions (x, y, z, w), USD's memory layout, to a USD array."""
    return import_optional("pxr.Vt", "usd").QuatfArray.FromNumpy(np.ascontiguousarray(values, np.float32))


def to_stage_pose(rotation: Array, position: Array) -> tuple[Array, Array]:
    """Converts a part's rotation [3, 3] and position [3] from the user's axes to the stage's axes.

    In the result, both the world and the part's local coordinates have the stage's axes.

    >>> to_stage_pose(np.eye(3), np.array([1.0, 2, 3]))[1]
    array([ 1., -2., -3.])
    """
    return HALF_TURN @ rotation @ HALF_TURN, HALF_TURN @ position


def set_camera(prim: Any, camera: Camera, metres_per_unit: float) -> None:
    """Sets the attributes of a UsdGeomCamera from a camera in the user's world.

    A USD camera looks along −z with y up, like an OpenCV camera after a half turn about x. At the
    focal length f, the aperture has the size (w/fx, h/fy)·f and the offset
    ((w/2 − cx)/fx, (cy − h/2)/fy)·f.
    """
    gf, geometry = import_optional("pxr.Gf", "usd"), import_optional("pxr.UsdGeom", "usd")
    pose = np.eye(4)
    pose[:3, :3] = HALF_TURN @ camera.rotation.T @ HALF_TURN
    pose[:3, 3] = HALF_TURN @ camera.centre
    prim.AddTransformOp().Set(gf.Matrix4d(*pose.T.ravel().tolist()))  # USD uses row vectors
    prim.CreateProjectionAttr(geometry.Tokens.perspective)
    prim.CreateFocalLengthAttr(FOCAL_LENGTH)
    prim.CreateHorizontalApertureAttr(FOCAL_LENGTH * camera.width / camera.fx)
    prim.CreateVerticalApertureAttr(FOCAL_LENGTH * camera.height / camera.fy)
    prim.CreateHorizontalApertureOffsetAttr(FOCAL_LENGTH * (camera.width / 2 - camera.cx) / camera.fx)
    prim.CreateVerticalApertureOffsetAttr(FOCAL_LENGTH * (camera.cy - camera.height / 2) / camera.fy)
    prim.CreateClippingRangeAttr(gf.Vec2f(NEAREST / metres_per_unit, FARTHEST / metres_per_unit))
    prim.GetPrim().SetDisplayName(camera.name)


@contextmanager
def translate_usd_errors(path: Path) -> Iterator[None]:
    """Converts USD and system errors during writing to an ``InputError`` that names the output."""
    failure = import_optional("pxr.Tf", "usd").ErrorException
    try:
        with translate_write_errors(path):
            yield
    except failure as error:
        raise InputError(
            f"out {str(path)!r} cannot be written (USD: {message_of(error)})", "use a writable path"
        ) from error
