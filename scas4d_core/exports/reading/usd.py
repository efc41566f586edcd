"""Reads a sequence from USD as written by ``exports.usd``: Gaussians with ids over time, and their parts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.errors import InputError, message_of
from scas4d_core.exports.atomic_files import import_optional
from scas4d_core.exports.cloud import Cloud
from scas4d_core.exports.reading.states import ExportedStates, default_header
from scas4d_core.query.ply import SH_DEGREE_0, Splats

GAUSSIANS = "/World/Gaussians"
PARTS = "/World/Parts"
REMEDY = "use a file written by scas4d export --format usd"


def open_usd(path: Path) -> ExportedStates:
    """Opens a USD file as a sequence of states; frames are read on demand.

    Raises:
        InputError: if usd-core is missing, or the file was not written by ``exports.usd`` or has no ids.
    """
    usd, geometry, volume = (import_optional(f"pxr.{name}", "usd") for name in ("Usd", "UsdGeom", "UsdVol"))
    failure = import_optional("pxr.Tf", "usd").ErrorException
    try:
        stage = usd.Stage.Open(str(path))
    except failure as error:
        raise InputError(f"{path.name} is not a USD file ({message_of(error)})", REMEDY) from None
    prim = stage.GetPrimAtPath(GAUSSIANS)
    if not prim or not prim.IsA("ParticleField3DGaussianSplat"):
        raise InputError(f"{path.name} has no Gaussians at {GAUSSIANS}", REMEDY)
    primvars = geometry.PrimvarsAPI(prim)
    ids = primvars.GetPrimvar("scas4d:id").Get() if primvars.HasPrimvar("scas4d:id") else None
    if ids is None:
        raise InputError(f"{path.name} has no ids (primvars:scas4d:id), so Gaussians cannot be identified", REMEDY)
    reader = _Reader(stage, volume.ParticleField3DGaussianSplat(prim), np.array(ids, np.int64))
    origin = stage.GetRootLayer().customLayerData.get("scas4d", {})
    rate = float(stage.GetTimeCodesPerSecond())
    if not 0 < rate < float("inf"):
        raise InputError(f"{path.name}: invalid timeCodesPerSecond {rate!r}", REMEDY)
    codes = _codes(stage, prim)
    first, begin = int(origin.get("first_frame", 0)), float(origin.get("first_time_s", 0.0))
    frames = [first + round(code) for code in codes]
    if len(set(frames)) < len(frames):  # indices collide, so the rate is not the frame rate
        frames = list(range(first, first + len(codes)))
    parts = primvars.GetPrimvar("scas4d:part").Get() if primvars.HasPrimvar("scas4d:part") else None
    part_of = {} if parts is None else dict(zip(reader.ids.tolist(), np.array(parts).tolist(), strict=True))
    unit = float(geometry.GetStageMetersPerUnit(stage))
    return ExportedStates(
        frames,
        [begin + code / rate for code in codes],
        lambda place: reader.cloud(codes[place]),
        default_header(unit, rate),
        part_of,
        ["gloss is averaged over all directions"] if reader.degree else [],
    )


def _codes(stage: Any, prim: Any) -> list[float]:
    """Collects the frames' time codes from the samples of all attributes; constant attributes have only one sample."""
    codes = {float(stage.GetStartTimeCode()), float(stage.GetEndTimeCode())}
    scope = stage.GetPrimAtPath(PARTS)
    for each in [prim, *(scope.GetChildren() if scope else ())]:
        for attribute in each.GetAttributes():
            codes.update(attribute.GetTimeSamples())
    return sorted(codes)


class _Reader:
    """Reader of the Gaussians that are present at a time code."""

    def __init__(self, stage: Any, prim: Any, ids: NDArray[np.int64]) -> None:
        self._stage = stage  # the stage must outlive its prims
        self._prim, self.ids = prim, ids
        self.degree = int(prim.GetRadianceSphericalHarmonicsDegreeAttr().Get() or 0)

    def cloud(self, code: float) -> Cloud:
        prim, count = self._prim, len(self.ids)
        means, scales = (
            np.array(attribute.Get(code), np.float64).reshape(-1, 3)
            for attribute in (prim.GetPositionsAttr(), prim.GetScalesAttr())
        )
        quaternions = np.array(
            [(q.GetReal(), *q.GetImaginary()) for q in prim.GetOrientationsAttr().Get(code)], np.float64
        ).reshape(-1, 4)
        opacities = np.array(prim.GetOpacitiesAttr().Get(code), np.float64)
        harmonics = np.array(prim.GetRadianceSphericalHarmonicsCoefficientsAttr().Get(code), np.float64)
        if not len(means) == len(scales) == len(quaternions) == len(opacities) == count:
            raise InputError(f"the file has {len(means)} positions but {count} ids", REMEDY)
        harmonics = harmonics.reshape(count, -1, 3)
        colours = 0.5 + SH_DEGREE_0 * harmonics[:, 0]
        there = opacities > 0
        cloud = Cloud(Splats(means, scales, quaternions, opacities, colours), harmonics, self.ids)
        return cloud.half_turned().rows(there)
