"""Measures the calibration of a rig on the pictures of frame 0, and refines it where that is asked for."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import Camera, Rig
from scas4d_core.captures.frame import Frame
from scas4d_core.first_frame.calibration.bundle import NOISE, build_tracks, bundle_adjust
from scas4d_core.first_frame.calibration.matches import Matches, epipolar_distances, match_by_appearance
from scas4d_core.first_frame.calibration.report import CalibrationReport, CameraResidual, RefinedCamera, Refinement
from scas4d_core.first_frame.calibration.residuals import MAX_RESIDUAL, MIN_INLIERS, NEAR, measure_residuals
from scas4d_core.posed_pictures import Float, InitialPointsError, collect_views
from scas4d_core.progress import Progress
from scas4d_core.settings import StaticSettings

MIN_CAMERAS = 3
"""Cameras at least: of two, either could be off."""
STANDARD_ERRORS = 2.0
"""Standard errors by which the loss of matches held out has to fall."""
MIN_HELD_OUT = 20
"""Matches held out, of fewer of which a standard error says little."""


def calibrate_first_frame(
    rig: Rig, frame: Frame, settings: StaticSettings, on_progress: Callable[[Progress], None], *, measured: bool
) -> CalibrationReport | None:
    """``check_calibration`` of frame 0, refined where the settings ask for it.

    Args:
        rig: as given, at the size of the frame's pictures. measured: also where no refining is asked for; else None.
    """
    if not (measured or settings.refine_calibration):
        return None
    on_progress(Progress("calibration", 0, 1))
    calibration = check_calibration(rig, frame.images, refine=settings.refine_calibration)
    on_progress(Progress("calibration", 1, 1))
    return calibration


def check_calibration(rig: Rig, images: Mapping[str, NDArray[np.uint8]], *, refine: bool) -> CalibrationReport | None:
    """Measures how far the pictures are off the calibration; None where fewer than two cameras can be compared.

    Args:
        rig: in the user's world, at the size of the pictures. images: [H, W, 3] uint8 of one moment, by camera name.
        refine: poses are refined, and kept where matches that were held out say that they are better.

    >>> from scas4d_core.captures import open_capture
    >>> capture = open_capture("samples/robot")
    >>> found = check_calibration(capture.rig, capture.frame(0).images, refine=False)
    >>> sorted(found.cameras) == sorted(capture.rig.names), found.miscalibrated, found.refined
    (True, [], None)
    """
    try:
        views = collect_views(rig, images, {})
    except InitialPointsError:  # one picture, or of another size, which is refused in words elsewhere
        return None
    matches = match_by_appearance(views)
    cameras, off = measure_residuals(matches)
    given = CalibrationReport(cameras, off, _describe_faults(cameras, off, matches))
    if not refine:
        return given
    refined = refine_rig(rig, matches)
    if not refined.accepted:
        return replace(given, refined=refined, warnings=[*given.warnings, refined.text])
    posed = [refined.apply_to(camera) for camera in matches.cameras]
    left = matches.with_cameras(posed)
    return replace(given, refined=refined, warnings=[refined.text, *_describe_faults(*measure_residuals(left), left)])


def _describe_faults(cameras: Mapping[str, CameraResidual], off: Sequence[str], matches: Matches) -> list[str]:
    """Sentences on what is off, for people."""
    known = {name: fit.pixels for name, fit in cameras.items() if np.isfinite(fit.pixels)}
    if not known:
        return []
    usual = float(np.median(list(known.values())))
    remedy = "static.refine_calibration has it refined from the pictures of frame 0"
    inside = [known[camera.name] / scale for camera, scale in zip(matches.cameras, matches.scale, strict=True)
              if camera.name in known]  # fmt: skip
    if float(np.median(inside)) > MAX_RESIDUAL:
        return [
            f"the calibration seems to be off: matching features miss their epipolar lines by {usual:.1f} px, median "
            f"over {len(known)} cameras; {remedy}"
        ]
    return [
        f"the calibration of camera {name!r} seems to be off: its matching features miss their epipolar lines by "
        f"{known[name]:.1f} px, median of {cameras[name].matches}, usual in the rig is {usual:.1f} px; {remedy}"
        for name in off
    ]


def refine_rig(rig: Rig, matches: Matches) -> Refinement:
    """Poses of a rig that agree better with the pictures, if matches that were held out say so.

    Args:
        rig: as given, of the user's world. matches: of its cameras' pictures of one moment.
    """
    learnt, held = matches.split()
    fits = list(measure_residuals(matches)[0].values())
    counts = [camera_fit.matches for camera_fit in fits]
    fixed = [
        i for i, camera_fit in enumerate(fits) if camera_fit.matches < MIN_INLIERS or not np.isfinite(camera_fit.pixels)
    ]
    if len(counts) - len(fixed) < MIN_CAMERAS:
        return _not_refined(f"only {len(counts) - len(fixed)} cameras have {MIN_INLIERS} matches or more")
    before = list(matches.cameras)
    tracks = build_tracks(learnt.without(fixed))
    best = _HeldOutTest.of(held, before, bundle_adjust(before, tracks))
    if len(best.losses) < MIN_HELD_OUT:
        return _not_refined(f"only {len(best.losses)} matches could be held out to test it")
    if not best.is_better:
        return _not_refined(
            f"{len(best.losses)} matches that were held out are not met better: {best.before:.2f} px before, "
            f"{best.after:.2f} px after"
        )
    longer = _HeldOutTest.of(held, best.cameras, bundle_adjust(before, tracks, focal=True))
    after = longer.cameras if longer.is_better else best.cameras
    best = _HeldOutTest.of(held, before, after)
    return _refinement(rig, matches, best, fixed, focal=longer.is_better)


def _not_refined(reason: str) -> Refinement:
    return Refinement(False, f"the calibration was not refined: {reason}")


@dataclass(frozen=True, eq=False)
class _HeldOutTest:
    """A rig against another one on matches that neither has learnt from.

    Attributes:
        cameras: of the rig. losses: [M] by how much the loss of each match fell. before, after: see ``Refinement``.
    """

    cameras: list[Camera]
    losses: Float
    before: float
    after: float

    @classmethod
    def of(cls, held: Matches, given: Sequence[Camera], found: list[Camera]) -> _HeldOutTest:
        """Matches that are far off in both are wrong, and say nothing."""
        pairs = list(held.pairs)
        before, after = (
            np.concatenate([np.zeros(0), *(epipolar_distances(held.with_cameras(rig), pair) for pair in pairs)])
            for rig in (given, found)
        )
        near = np.minimum(before, after) < NEAR
        losses = [np.log1p((distances[near] / NOISE) ** 2) for distances in (before, after)]
        typical = [NOISE * float(np.sqrt(np.expm1(loss.mean()))) if len(loss) else float("nan") for loss in losses]
        return cls(found, losses[0] - losses[1], *typical)

    @property
    def is_better(self) -> bool:
        """True where the loss has fallen by more than chance."""
        count = len(self.losses)
        return (
            count >= MIN_HELD_OUT
            and float(self.losses.mean()) > STANDARD_ERRORS * float(self.losses.std()) / count**0.5
        )


def _refinement(rig: Rig, matches: Matches, test: _HeldOutTest, fixed: Sequence[int], *, focal: bool) -> Refinement:
    before, after = measure_residuals(matches)[0], measure_residuals(matches.with_cameras(test.cameras))[0]
    cameras = {}
    for index, (given, fitted) in enumerate(zip(matches.cameras, test.cameras, strict=True)):
        name = given.name
        turned, moved = _pose_change(given, fitted)
        factor = fitted.fx / given.fx
        cameras[name] = RefinedCamera(
            turned, moved, factor, before[name].pixels, after[name].pixels, index in fixed,
            pose=fitted.world_to_camera.tolist() if index not in fixed else rig[name].world_to_camera.tolist(),
        )  # fmt: skip
    far = max(cameras, key=lambda name: cameras[name].rotation_deg)
    text = (
        f"the calibration was refined, as asked: {len(test.losses)} matches held out miss their epipolar lines "
        f"by {test.after:.2f} px in place of {test.before:.2f}; camera {far!r} was turned most, by "
        f"{cameras[far].rotation_deg:.2f}°: {cameras[far].after:.2f} px in place of {cameras[far].before:.2f}"
    )
    if focal:
        text += "; their focal lengths were adjusted too"
    if fixed:
        text += f"; left as given for want of matches: {', '.join(matches.cameras[index].name for index in fixed)}"
    return Refinement(True, text, test.before, test.after, len(test.losses), cameras)


def _pose_change(given: Camera, found: Camera) -> tuple[float, float]:
    """Degrees by which a camera was turned, and the distance by which its centre was moved."""
    turn = Rotation.from_matrix(found.rotation @ given.rotation.T).magnitude()
    return float(np.degrees(turn)), float(np.linalg.norm(found.centre - given.centre))
