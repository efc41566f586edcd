"""Writes a sequence as USD (usd-core 26.03 or later): UsdVol.ParticleField3DGaussianSplat with time samples.

``/World/Gaussians`` contains one fixed set of Gaussians for all frames; opacity is 0 before birth and during
retirement. As the schema requires, scales and opacities are linear, and harmonics are grouped by Gaussian. Colours are
sRGB image values, which the schema cannot express; they are declared by the ``colorSpace`` of the harmonics.
``primvars:scas4d:id`` and ``primvars:scas4d:part`` store the ids and part labels. ``/World/Parts/part_k`` are Xforms
with the rigid motion of each part since the first frame, and its residual (``part_motion``). ``/World/Tracks`` shows
the centres of some moving Gaussians (``track_rows``) as UsdGeomPoints with purpose guide. ``/World/Cameras`` contains
the cameras of the rig.

The stage is y-up, that is, the user's world rotated by 180° about x. Its unit is the user's, given by
``metersPerUnit``. A time code is the number of seconds since the first frame times ``timeCodesPerSecond``.

Frames are saved one by one, so memory use does not grow with the number of frames. In return, a
temporary copy next to the target doubles the disk space needed during the export.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Rig, WorldFrame
from scas4d_core.errors import InputError, exact
from scas4d_core.exports.atomic_files import atomic_path, import_optional, translate_write_errors
from scas4d_core.exports.cloud import Cloud, cloud_of, linear_light
from scas4d_core.exports.track_rows import evenly_spaced_moving_rows
from scas4d_core.exports.usd_values import (
    AnimatedValues,
    floats_of,
    points_of,
    quaternions_of,
    set_camera,
    to_stage_pose,
    translate_usd_errors,
)
from scas4d_core.gaussians import Gaussians
from scas4d_core.query.part_motion import PartMotion, part_labels, quaternion_of

SUFFIXES = (".usdc", ".usda", ".usdz", ".usd")
TRACK_WIDTH = 0.005
"""Diameter of a track point, relative to the extent of the tracks."""
REACH = 3.0
"""Number of standard deviations covered by the extent of the Gaussians."""
COLOUR_SPACE = "srgb_rec709_scene"
"""USD's name for the primaries and transfer function of sRGB."""
DEFAULT_RATE = 24.0
"""Time codes per second if the rate is unknown, as for a single frame; this is USD's default."""


class UsdSequence:
    """Writer of a USD file, frame by frame. ``finish`` gives the file its final name.

    Args:
        path: output path with suffix ``.usdc`` or ``.usd`` (binary), ``.usda`` (text, about three times as large) or
            ``.usdz``.
        world: transform from the user's world to the internal world.
        rig: rig in the user's world, or None.
        labels: [N] part label of each Gaussian (negative for none), or None to store no parts.
        frames_per_second: time codes per second, or None to derive them from the first two frames.

    Raises:
        InputError: if usd-core is missing or too old, the suffix is not a USD suffix, or the folder is not writable.

    >>> from tempfile import TemporaryDirectory
    >>> state = Gaussians.of_points([[0, 0, 2]], radius=0.1)
    >>> with TemporaryDirectory() as folder:
    ...     sequence = UsdSequence(f"{folder}/a.usda", WorldFrame(np.zeros(3)))
    ...     for index in range(2):
    ...         sequence.add(index, index / 30, state.replace(means=state.means + np.float32(index)))
    ...     sequence.finish()
    ...     'def ParticleField3DGaussianSplat "Gaussians"' in Path(f"{folder}/a.usda").read_text()
    True
    """

    def __init__(
        self,
        path: Path | str,
        world: WorldFrame,
        rig: Rig | None = None,
        labels: NDArray[Any] | None = None,
        frames_per_second: float | None = None,
    ) -> None:
        self.path = Path(path)
        if self.path.suffix not in SUFFIXES:
            raise InputError(f"out {self.path.name!r} has no USD suffix", f"use one of {', '.join(SUFFIXES)}")
        self._usd = import_optional("pxr.Usd", "usd")
        self._geometry, volume = import_optional("pxr.UsdGeom", "usd"), import_optional("pxr.UsdVol", "usd")
        self._sdf, self._tf, self._vt, self._gf = (
            import_optional(f"pxr.{name}", "usd") for name in ("Sdf", "Tf", "Vt", "Gf")
        )
        if not hasattr(volume, "ParticleField3DGaussianSplat"):
            raise InputError(
                "usd-core does not support ParticleField3DGaussianSplat", "run pip install 'usd-core>=26.3'"
            )
        self._world, self._labels, self._rate = world, labels, frames_per_second
        self._rig = rig
        self._splat = volume.ParticleField3DGaussianSplat
        with translate_write_errors(self.path):
            self._folder = Path(tempfile.mkdtemp(prefix=f".part-{self.path.stem}-", dir=self.path.parent))
        try:
            with translate_usd_errors(self.path):
                self._layer = self._sdf.Layer.CreateNew(str(self._folder / f"{self.path.stem}.usdc"))
                self._stage = self._usd.Stage.Open(self._layer)
            self._motion: PartMotion | None = None
            self._channels: dict[str, AnimatedValues] = {}
            self._poses: dict[int, tuple[Any, Any, Any]] = {}
            self._tracked, self._width = np.zeros(0, np.intp), 0.0
            self._begin = self._latest = 0.0
            self._first_index: int | None = None
            self._ids = np.zeros(0, np.int64)
            self._head()
        except BaseException:
            self.discard()
            raise

    def add(self, index: int, time: float, gaussians: Gaussians) -> None:
        """Adds a frame.

        Args:
            index: frame index.
            time: time in seconds, later than all previous times.
            gaussians: state in the internal world. Each row must always refer to the same Gaussian; new Gaussians are
                appended.

        Raises:
            InputError: if the time does not increase, some Gaussians have non-finite values or no volume, or the disk
                is full.
        """
        if self._first_index is not None and not time > self._latest:
            raise InputError(
                f"time {exact(time)} s of frame {index} is not later than the previous frame, {exact(self._latest)} s",
                "add frames in chronological order",
            )
        cloud = cloud_of(gaussians, self._world, retired=True).half_turned()
        if self._first_index is None:
            self._first_index, self._begin = index, time
            self._define(gaussians, cloud)
        elif self._rate is None:
            self._rate = float(f"{1 / (time - self._begin):.5g}")  # absorb rounding of large times, but keep 29.97
        self._latest = time
        code = self._code(time)
        of = cloud.splats
        self._ids = cloud.ids
        tracked = of.means[self._tracked]
        for name, values in (
            ("positions", of.means),
            ("orientations", np.roll(of.rotations, -1, axis=1)),
            ("scales", of.scales),
            ("opacities", np.where(gaussians.present, np.clip(of.opacities, 0, 1), 0)),
            ("harmonics", cloud.harmonics.reshape(-1, 3)),
            ("extent", _extent(of.means, REACH * of.scales.max(axis=1, initial=0))),
            ("tracks", tracked),
            ("widths", np.where(gaussians.present[self._tracked], self._width, 0)),
            ("track extent", _extent(tracked, np.full(len(tracked), self._width / 2))),
        ):
            if name in self._channels:
                self._channels[name].set(values, code)
        self._add_poses(gaussians, code)
        self._save()

    def finish(self) -> None:
        """Completes the stage, and writes it to the output path in the format of the suffix.

        Raises:
            InputError: if no frame was added, or the file cannot be written.
        """
        try:
            if self._first_index is None:
                raise InputError("there are no frames to export", "add at least one frame")
            with translate_usd_errors(self.path):
                self._complete()
                with atomic_path(self.path) as beside:
                    self._convert(beside)
        finally:
            self.discard()

    def discard(self) -> None:
        """Removes the temporary files next to the target."""
        self._channels, self._poses, self._stage, self._layer = {}, {}, None, None
        shutil.rmtree(self._folder, ignore_errors=True)

    def _code(self, time: float) -> float:
        return round((time - self._begin) * (self._rate or DEFAULT_RATE), 4)

    def _save(self) -> None:
        """Saves new samples to disk and frees their memory; USD reads saved arrays from the file on demand."""
        with translate_usd_errors(self.path):
            self._layer.Save()

    def _head(self) -> None:
        """Defines the world prim, axes, unit and cameras."""
        geometry, names = self._geometry, self._tf.MakeValidIdentifier
        geometry.SetStageUpAxis(self._stage, geometry.Tokens.y)
        geometry.SetStageMetersPerUnit(self._stage, self._world.metres_per_unit)
        world = geometry.Xform.Define(self._stage, "/World")
        self._stage.SetDefaultPrim(world.GetPrim())
        if self._rig is not None:
            geometry.Scope.Define(self._stage, "/World/Cameras")
            taken: set[str] = set()
            for number, camera in enumerate(self._rig.cameras):
                name = names(f"cam_{camera.name}" if camera.name[:1].isdigit() else camera.name)
                name = f"{name}_{number}" if name in taken else name
                taken.add(name)
                prim = geometry.Camera.Define(self._stage, f"/World/Cameras/{name}")
                set_camera(prim, camera, self._world.metres_per_unit)

    def _define(self, first: Gaussians, cloud: Cloud) -> None:
        """Defines the Gaussians, tracks and parts from the first frame."""
        gaussians = self._splat.Define(self._stage, "/World/Gaussians")
        gaussians.CreateRadianceSphericalHarmonicsDegreeAttr(round(cloud.harmonics.shape[1] ** 0.5) - 1)
        gaussians.CreateProjectionModeHintAttr("perspective")
        gaussians.CreateSortingModeHintAttr("zDepth")
        harmonics = gaussians.CreateRadianceSphericalHarmonicsCoefficientsAttr()
        harmonics.SetColorSpace(COLOUR_SPACE)
        primvar = self._geometry.Primvar(harmonics)
        primvar.SetElementSize(cloud.harmonics.shape[1])
        primvar.SetInterpolation(self._geometry.Tokens.vertex)
        self._channels = {
            "positions": AnimatedValues(gaussians.CreatePositionsAttr(), points_of),
            "orientations": AnimatedValues(gaussians.CreateOrientationsAttr(), quaternions_of),
            "scales": AnimatedValues(gaussians.CreateScalesAttr(), points_of),
            "opacities": AnimatedValues(gaussians.CreateOpacitiesAttr(), floats_of, unborn=0),
            "harmonics": AnimatedValues(harmonics, points_of),
            "extent": AnimatedValues(gaussians.CreateExtentAttr(), points_of),
        }
        self._tracked = evenly_spaced_moving_rows(first)
        if self._tracked.size:
            means = cloud.splats.means[self._tracked]
            self._width = max(TRACK_WIDTH * float(np.ptp(means, axis=0).max()), float(np.finfo(np.float32).tiny))
            tracks = self._geometry.Points.Define(self._stage, "/World/Tracks")
            tracks.CreatePurposeAttr(self._geometry.Tokens.guide)
            tracks.CreateIdsAttr(self._vt.Int64Array.FromNumpy(cloud.ids[self._tracked]))
            colours = tracks.CreateDisplayColorPrimvar(self._geometry.Tokens.vertex)
            colours.Set(points_of(linear_light(cloud.splats.colours[self._tracked])))  # displayColor is linear
            tracks.SetWidthsInterpolation(self._geometry.Tokens.vertex)
            self._channels["tracks"] = AnimatedValues(tracks.CreatePointsAttr(), points_of)
            self._channels["widths"] = AnimatedValues(tracks.CreateWidthsAttr(), floats_of)
            self._channels["track extent"] = AnimatedValues(tracks.CreateExtentAttr(), points_of)
        if self._labels is not None:
            self._motion = PartMotion(self._labels, first, self._world)
            self._geometry.Scope.Define(self._stage, "/World/Parts")
            for part in self._motion.parts:
                xform = self._geometry.Xform.Define(self._stage, f"/World/Parts/part_{part}")
                precise = self._geometry.XformOp.PrecisionDouble
                residual = xform.GetPrim().CreateAttribute("scas4d:residual", self._sdf.ValueTypeNames.Double)
                self._poses[part] = (xform.AddTranslateOp(precise), xform.AddOrientOp(precise), residual)

    def _add_poses(self, gaussians: Gaussians, code: float) -> None:
        """Sets the transforms of the parts at a time code."""
        for pose in self._motion.poses(gaussians) if self._motion is not None else ():
            translate, orient, residual = self._poses[pose.part]
            rotation, position = to_stage_pose(pose.rotation, pose.position)
            translate.Set(self._gf.Vec3d(*position.tolist()), code)
            orient.Set(self._gf.Quatd(*quaternion_of(rotation).tolist()), code)
            residual.Set(pose.residual, code)

    def _complete(self) -> None:
        """Pads early samples, and writes ids, parts and the time range."""
        for channel in self._channels.values():
            for _ in channel.lengthen():
                self._layer.Save()
            channel.store_constant_as_default()
        primvars = self._geometry.PrimvarsAPI(self._stage.GetPrimAtPath("/World/Gaussians"))
        attributes = {"scas4d:id": (self._sdf.ValueTypeNames.Int64Array, self._vt.Int64Array.FromNumpy(self._ids))}
        if self._labels is not None:
            parts = part_labels(self._labels, len(self._ids)).astype(np.int32)
            attributes["scas4d:part"] = (self._sdf.ValueTypeNames.IntArray, self._vt.IntArray.FromNumpy(parts))
        for name, (kind, values) in attributes.items():
            primvars.CreatePrimvar(name, kind, self._geometry.Tokens.vertex).Set(values)
        self._stage.SetTimeCodesPerSecond(self._rate or DEFAULT_RATE)
        self._stage.SetFramesPerSecond(self._rate or DEFAULT_RATE)
        self._stage.SetStartTimeCode(0)
        self._stage.SetEndTimeCode(self._code(self._latest))
        origin = {"first_frame": self._first_index, "first_time_s": self._begin}
        self._layer.customLayerData = {"scas4d": origin}
        self._layer.Save()

    def _convert(self, beside: Path) -> None:
        """Converts the stage to the target's format."""
        if beside.suffix == ".usdz":
            done = import_optional("pxr.UsdUtils", "usd").CreateNewUsdzPackage(self._layer.realPath, str(beside))
        else:
            done = self._layer.Export(str(beside))  # exporting drops replaced samples
        if not done:
            raise InputError(f"out {str(self.path)!r} cannot be written by USD", "use a writable path")


def _extent(means: NDArray[Any], reach: NDArray[Any]) -> NDArray[Any]:
    """Returns the bounding box corners [2, 3] of points [N, 3] with radii [N], or zeros if there are no points."""
    if not len(means):
        return np.zeros((2, 3))
    return np.stack([np.min(means - reach[:, None], axis=0), np.max(means + reach[:, None], axis=0)])
