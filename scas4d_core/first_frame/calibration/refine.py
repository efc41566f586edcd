"""Check of a rig's calibration against the images of frame 0, and refinement on request."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import Camera, Rig
from scas4d_core.captures.frame import Frame
from scas4d_core.first_frame.calibration.bundle import NOISE, build_tracks, bundle_adjust
from scas4d_core.first_frame.calibration.matches import Matches, epipolar_distances, match_by_appearance
from scas4d_core.first_frame.calibration.report import CalibrationReport, CameraResidual, RefinedCamera, Refinement
from scas4d_core.first_frame.calibration.residuals import MAX_RESIDUAL, MIN_INLIERS, NEAR, measure_residuals
from scas4d_core.first_frame.image_warnings import image_warnings
from scas4d_core.posed_pictures import Float, InitialPointsError, collect_views
from scas4d_core.progress import Progress
from scas4d_core.settings import StaticSettings

MIN_CAMERAS = 3
"""Minimum number of cameras for a refinement. With only two cameras, either camera could be off."""
STANDARD_ERRORS = 2.0
"""Number of standard errors by which a refinement must reduce the loss of held-out matches."""
MAX_EXCHANGED = 6
"""Maximum number of cameras among which exchanged images are searched for."""
MIN_HELD_OUT = 20
"""Minimum number of held-out matches for a meaningful standard error."""


def calibrate_first_frame(
    rig: Rig, frame: Frame, settings: StaticSettings, on_progress: Callable[[Progress], None], *, measured: bool
) -> CalibrationReport | None:
    """Runs ``check_calibration`` on frame 0, with refinement if the settings request it.

    Args:
        rig: calibrated rig, at the size of the frame's images.
        frame: frame 0.
        settings: settings of frame 0.
        on_progress: function called at the start and at the end.
        measured: whether to check the calibration even if no refinement is requested.

    Returns:
        The report, or None if neither a check nor a refinement is requested.
    """
    if not (measured or settings.refine_calibration):
        return None
    on_progress(Progress("calibration", 0, 1))
    calibration = check_calibration(rig, frame.images, refine=settings.refine_calibration)
    if calibration is not None:
        seen = image_warnings(frame.images, frame.masks)
        calibration = replace(calibration, warnings=[*seen, *calibration.warnings])
    on_progress(Progress("calibration", 1, 1))
    return calibration


def check_calibration(rig: Rig, images: Mapping[str, NDArray[np.uint8]], *, refine: bool) -> CalibrationReport | None:
    """Measures the calibration error in the images of one frame, and refines the poses on request.

    Args:
        rig: rig in the user's world, at the size of the images.
        images: maps each camera name to its image, [H, W, 3] uint8.
        refine: whether to refine the poses. The refined poses are accepted only if held-out matches
            improve.

    Returns:
        The report, or None if fewer than two cameras have an image, or an image has the wrong size.

    >>> from scas4d_core.captures import open_capture
    >>> capture = open_capture("samples/robot")
    >>> found = check_calibration(capture.rig, capture.frame(0).images, refine=False)
    >>> sorted(found.cameras) == sorted(capture.rig.names), found.miscalibrated, found.refined
    (True, [], None)
    """
    try:
        views = collect_views(rig, images, {})
    except InitialPointsError:  # fewer than two images, or a wrong size, rejected elsewhere
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
    """Returns user-facing warnings that describe the calibration errors."""
    known = {name: fit.pixels for name, fit in cameras.items() if np.isfinite(fit.pixels)}
    if not known:
        return []
    usual = float(np.median(list(known.values())))
    causes = (
        "the calibration may be inaccurate, or images may belong to another camera or time; set "
        "static.refine_calibration to refine the calibration using the images of frame 0"
    )
    inside = [known[camera.name] / scale for camera, scale in zip(matches.cameras, matches.scale, strict=True)
              if camera.name in known]  # fmt: skip
    if float(np.median(inside)) > MAX_RESIDUAL:
        return [
            f"matching features are {usual:.1f} px from their epipolar lines (median over {len(known)} cameras): "
            f"{causes}"
        ]
    exchanged = _exchanged(matches, [name for name in cameras if name not in known or name in off])
    return [
        f"the images of cameras {one!r} and {other!r} seem to be exchanged: their features agree with those of the "
        "other cameras only if they are exchanged"
        for one, other in exchanged
    ] + [
        f"matching features of camera {name!r} are {cameras[name].pixels:.1f} px from their epipolar lines (median of "
        f"{cameras[name].matches}), compared with {usual:.1f} px for the rig: {causes}"
        for name in off
        if not any(name in pair for pair in exchanged)
    ]


def _exchanged(matches: Matches, suspects: Sequence[str]) -> list[tuple[str, str]]:
    """Returns the pairs of suspects whose features agree with the other cameras if their images are exchanged."""
    names = [camera.name for camera in matches.cameras]
    sizes = [(camera.width, camera.height) for camera in matches.cameras]
    pairs = []
    for one, other in combinations(suspects[:MAX_EXCHANGED], 2):
        a, b = names.index(one), names.index(other)
        if sizes[a] != sizes[b] or not matches.descriptors:
            continue
        fits, off = measure_residuals(matches.with_exchanged_images(a, b))
        if all(name not in off and np.isfinite(fits[name].pixels) for name in (one, other)):
            pairs.append((one, other))
    return pairs


def refine_rig(rig: Rig, matches: Matches) -> Refinement:
    """Refines the poses of a rig, and also the focal lengths if they reduce the error further.

    Each change is accepted only if held-out matches improve.

    Args:
        rig: calibrated rig, in the user's world.
        matches: matches between the rig's cameras in one frame.
    """
    learnt, held = matches.split()
    fits = list(measure_residuals(matches)[0].values())
    counts = [camera_fit.matches for camera_fit in fits]
    fixed = [
        i for i, camera_fit in enumerate(fits) if camera_fit.matches < MIN_INLIERS or not np.isfinite(camera_fit.pixels)
    ]
    if len(counts) - len(fixed) < MIN_CAMERAS:
        return _not_refined(f"only {len(counts) - len(fixed)} cameras have at least {MIN_INLIERS} matches")
    before = list(matches.cameras)
    tracks = build_tracks(learnt.without(fixed))
    best = _HeldOutTest.of(held, before, bundle_adjust(before, tracks))
    if len(best.losses) < MIN_HELD_OUT:
        return _not_refined(f"only {len(best.losses)} matches could be held out for testing")
    if not best.is_better:
        return _not_refined(
            f"the error of {len(best.losses)} held-out matches did not decrease ({best.before:.2f} px before, "
            f"{best.after:.2f} px after)"
        )
    longer = _HeldOutTest.of(held, best.cameras, bundle_adjust(before, tracks, focal=True))
    after = longer.cameras if longer.is_better else best.cameras
    best = _HeldOutTest.of(held, before, after)
    return _refinement(rig, matches, best, fixed, focal=longer.is_better)


def _not_refined(reason: str) -> Refinement:
    return Refinement(False, f"the calibration was not refined: {reason}")


@dataclass(frozen=True, eq=False)
class _HeldOutTest:
    """Comparison of two calibrations on held-out matches.

    Attributes:
        cameras: cameras of the new calibration.
        losses: [M] decrease of the loss of each match.
        before: error of the old calibration in pixels, as in ``Refinement``.
        after: error of the new calibration in pixels, as in ``Refinement``.
    """

    cameras: list[Camera]
    losses: Float
    before: float
    after: float

    @classmethod
    def of(cls, held: Matches, given: Sequence[Camera], found: list[Camera]) -> _HeldOutTest:
        """Compares two calibrations on held-out matches.

        Matches that are far from their epipolar lines in both calibrations are wrong, and are
        ignored.
        """
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
        """Whether the mean loss decreased significantly."""
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
        f"the calibration was refined as requested: {len(test.losses)} held-out matches are {test.after:.2f} px from "
        f"their epipolar lines ({test.before:.2f} px before); camera {far!r} was rotated most, by "
        f"{cameras[far].rotation_deg:.2f}°, and its error is {cameras[far].after:.2f} px "
        f"({cameras[far].before:.2f} px before)"
    )
    if focal:
        text += "; focal lengths were also adjusted"
    if fixed:
        text += (
            f"; cameras with too few matches are unchanged: {', '.join(matches.cameras[index].name for index in fixed)}"
        )
    return Refinement(True, text, test.before, test.after, len(test.losses), cameras)


def _pose_change(given: Camera, found: Camera) -> tuple[float, float]:
    """Returns the rotation of a camera in degrees, and the distance by which its centre moved."""
    turn = Rotation.from_matrix(found.rotation @ given.rotation.T).magnitude()
    return float(np.degrees(turn)), float(np.linalg.norm(found.centre - given.centre))
