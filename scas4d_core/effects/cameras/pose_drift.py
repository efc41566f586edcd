"""Drifting camera poses: tripods sag, are knocked by a few pixels, or bend in the sun.

Once per frame, after the update, renderings of some cameras are compared with their images. The rotation that would
align them is recorded as the camera's offset from its calibration. A single frame is unreliable, because moving objects
are tracked with a delay. A camera counts as moved if offsets from earlier frames explain its current residual, and if
the offset is at least ``LEAST`` pixels. Its pose is then corrected by half of the difference in each frame. The
poses of all other cameras stay bit-identical.

Later frames use these poses for their training views: masks move with their camera, and probe views and new Gaussians
use the current pose. Views requested by users are rendered with the given camera, so a view from camera 7 uses its
calibrated pose.

``robust.outliers`` excludes cameras that do not fit, including misaligned ones, before this effect measures their
offsets. A misaligned camera is accepted again once its pose is found, and stays excluded if the correction exceeds the
limit. Camera gains are medians over pixels, so small shifts hardly affect them. ``shadows`` may update colours in
frames with misaligned cameras, but it uses all cameras.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import radians
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Camera, Rig
from scas4d_core.effects.cameras.alignment import (
    Array,
    Double,
    Equations,
    adjoint,
    align_pixels,
    pixel_offset,
    solve_twist,
    to_camera_twist,
    turn_equations,
    turn_from_pixels,
    twist_equations,
    twist_to_matrix,
)
from scas4d_core.effects.effect import Effect, EffectGroup
from scas4d_core.effects.evidence import Evidence
from scas4d_core.engines.views import LABEL
from scas4d_core.frame_outcome import Candidate
from scas4d_core.update.parts import Arrays, PlanBuilder

if TYPE_CHECKING:
    from scas4d_core.effects.evidence import FrameObservation
    from scas4d_core.engines.views import TrainingView

NAME = "pose_drift"
CAMERAS = 4
"""Minimum number of cameras for detecting a misaligned one. With fewer, moving Gaussians could explain the
difference."""
ENOUGH = 0.5
"""Minimum share of the rig's cameras that a frame must contain to be used."""
LEAST = 0.25
"""Minimum offset of a suspect camera, in pixels. Fixed cameras reach 0.15 on the captures, and 0.4 on a shaken
cloth."""
TIMES = 4.0
"""Minimum ratio of a suspect camera's offset to the median offset. If many cameras seem to be off, the
tracking lags behind the motion."""
# The effect's threshold is based on these measurements: at half size, captures with fixed cameras have shares of at
# most 0.14 on cloth played backwards, 0.07 on cloth and the wheel, and 0.03 on the others.
SHARE = 0.5
"""Share of the difference by which poses and recorded offsets are updated per frame. A drift is followed with a
lag of one frame's change. A frame in which the scene tracking lags causes only half of the error."""
FIXED_CAMERAS = 6
"""Number of fixed cameras that are rendered while the effect is on (different cameras in each frame). They show which
part of a twist is scene motion."""
LARGEST, TURN = 0.02, radians(1)
"""Maximum pose correction, as a share of the image width and as an angle in radians. A camera that is off by more has
been moved and stays excluded."""
COVERED = 0.1
"""Minimum alpha for a pixel to have a depth."""
SMALLEST = 1e-3
"""Regularization of the 3×3 equations of a rotation in pixels. It acts as a weak prior for images that do not
show the rotation, such as those of a plain wall.
"""


def rig_with_drift(rig: Rig, carried: Mapping[str, Arrays]) -> Rig:
    """Returns the rig with the current poses, or the given rig if no camera has moved.

    Args:
        rig: calibrated cameras in the internal world.
        carried: arrays carried over by the effects, keyed by effect name.
    """
    twists = carried.get(NAME, {}).get("twists")
    if twists is None or not twists.any():
        return rig
    return Rig(tuple(_moved(camera, twist) for camera, twist in zip(rig.cameras, twists, strict=True)))


def _moved(camera: Camera, twist: Double) -> Camera:
    return replace(camera, world_to_camera=twist_to_matrix(twist) @ camera.world_to_camera) if twist.any() else camera


@dataclass(eq=False)
class Poses:
    """Pose offsets of a rig's cameras, one row per camera.

    Attributes:
        twists: [C, 6] float64 corrections of the calibration: translation (metres) and rotation, in camera axes.
        moved: [C, 3] corrections at the last measurement, in pixels; see ``alignment.pixel_offset``.
        offsets: [C, 3] exponential moving average of the measured offsets from the calibration, in pixels.
        shares: [C] exponential moving average of the share of the residual ([0, 1]) that earlier offsets explain.
        observations: [C] number of frames in which the camera was measured.
    """

    twists: Double
    moved: Double
    offsets: Double
    shares: Double
    observations: NDArray[np.int64]

    @classmethod
    def of(cls, arrays: Arrays, count: int) -> Poses:
        """Creates the poses of ``count`` cameras from ``arrays``; missing arrays are filled with zeros."""
        shapes = {"twists": (count, 6), "moved": (count, 3), "offsets": (count, 3), "shares": (count,)}
        blank: dict[str, NDArray[Any]] = {name: np.zeros(shape) for name, shape in shapes.items()}
        blank["observations"] = np.zeros(count, np.int64)
        return cls(**{name: arrays[name].copy() if name in arrays else empty for name, empty in blank.items()})

    def arrays(self) -> Arrays:
        """Returns the arrays for the next frame, omitting the twists if no camera has moved."""
        arrays: Arrays = {name: getattr(self, name) for name in ("moved", "offsets", "shares", "observations")}
        return {**arrays, "twists": self.twists} if self.twists.any() else arrays

    def record_offset(self, row: int, turn: Equations) -> None:
        """Records a camera's offset, estimated from its residual.

        Args:
            row: row of the camera.
            turn: equations in the unknowns of ``turn_equations``, relative to the camera's current pose.
        """
        here = self.moved[row]
        now = here + np.linalg.solve(turn.matrix + SMALLEST * np.eye(3), turn.vector)
        if self.observations[row] == 0:
            self.offsets[row] = now
        else:
            without = _left(turn, -here)
            explained = 1 - _left(turn, self.offsets[row] - here) / without if without > 0 else 0.0
            self.shares[row] += SHARE * (max(0.0, explained) - self.shares[row])
            self.offsets[row] += SHARE * (now - self.offsets[row])
        self.observations[row] += 1

    def suspects(self) -> NDArray[np.bool_]:
        """Returns the [C] mask of cameras that may have moved and are therefore rendered and measured again."""
        sizes, looked = np.linalg.norm(self.offsets, axis=1), self.observations > 0
        usual = float(np.median(sizes[looked])) if looked.any() else 0.0
        off: NDArray[np.bool_] = sizes >= max(LEAST, TIMES * usual)
        return off

    def drifted(self) -> NDArray[np.bool_]:
        """Returns the [C] mask of cameras that have moved."""
        return self.twists.any(axis=1) | (self.suspects() & (self.shares >= EFFECT.on_above))


def _left(turn: Equations, way: Double) -> float:
    """Returns the weighted squared error that remains after a rotation by ``way``."""
    return float(turn.energy - 2 * turn.vector @ way + way @ turn.matrix @ way)


def step_twists(
    twists: Double, aligned: Mapping[int, tuple[Equations, Camera, Array]], follow: NDArray[np.bool_]
) -> Double:
    """Returns the [C, 6] twists after a frame, updated for the cameras in ``follow``.

    Scene motion that the other cameras also see is removed first.

    Args:
        twists: [C, 6] twists before the frame.
        aligned: maps each camera's row to its equations, the camera with its current pose, and its lens parameters.
        follow: [C] mask of the cameras whose twists are updated.
    """
    matrix, vector = np.eye(6) * 1e-6, np.zeros(6)
    fixed = [row for row in aligned if not follow[row]] or list(aligned)
    for row in fixed:
        one, camera, _ = aligned[row]
        units = to_camera_twist(one, camera.world_to_camera)
        matrix += units.T @ one.matrix @ units
        vector += units.T @ one.vector
    scene = np.linalg.solve(matrix, vector)
    after = twists.copy()
    for row, (one, camera, lens) in aligned.items():
        if follow[row]:
            own = one.vector - one.matrix @ to_camera_twist(one, camera.world_to_camera) @ scene
            after[row] = limit_twist(after[row] + SHARE * solve_twist(one, lens, after[row], own), lens, one.depth)
    return after


def limit_twist(twist: Double, lens: Array, depth: float) -> Double:
    """Returns the twist, scaled down if it exceeds the maximum correction."""
    size = float(np.linalg.norm(pixel_offset(lens, twist, depth)[:2])) / (LARGEST * float(lens[4]))
    return twist / max(1.0, size, float(np.linalg.norm(twist[3:])) / TURN)


def remove_common_motion(twists: Double, rig: Rig, believed: NDArray[np.bool_]) -> Double:
    """Returns the [C, 6] twists without the motion that most cameras share, which is attributed to the scene.

    The shared twist is the median of each component, in world axes, over the accepted cameras. With a mean, a camera
    that is off by 3 pixels would move the other cameras, and the world with them.

    Args:
        twists: [C, 6] twists of all cameras.
        rig: rig with calibrated or current poses, which lead to the same result.
        believed: [C] mask of the accepted cameras; the twists of all others are unchanged.
    """
    worlds = [
        np.linalg.solve(adjoint(rig.cameras[row].world_to_camera), twists[row]) for row in np.flatnonzero(believed)
    ]
    middle = np.median(worlds, axis=0) if worlds else np.zeros(6)
    if not middle.any():
        return twists
    after = twists.copy()
    for row in np.flatnonzero(believed):
        after[row] -= adjoint(rig.cameras[row].world_to_camera) @ middle
    return after


@dataclass(frozen=True)
class PoseDrift(Effect):
    """Updates camera poses from the images, once per frame."""

    def record(self, seen: FrameObservation, on: bool) -> Arrays | None:
        """Returns the measured camera offsets and, while the effect is on, the poses for later frames."""
        if not _says(seen):
            return None
        poses = Poses.of(dict(seen.result.carried.get(NAME, {})), len(seen.rig))
        rows = {name: row for row, name in enumerate(seen.rig.names)}
        aligned = _aligned(seen, _looked_at(seen, poses, rows)) if on else {}
        seems = poses.suspects()
        for row, (one, _, lens) in aligned.items():
            poses.moved[row] = pixel_offset(lens, poses.twists[row], one.depth)
            turn = turn_from_pixels(lens)
            matrix = turn.T @ one.matrix[3:, 3:] @ turn
            poses.record_offset(row, Equations(matrix, turn.T @ one.vector[3:], one.energy, one.depth))
        trace = seen.result.trace
        for view in seen.views if trace.kept is Candidate.END else ():
            if rows[view.name] not in aligned and view.name in trace.shown and (on or not seems[rows[view.name]]):
                every, planes = trace.shown[view.name]
                _record_offset(poses, rows[view.name], view, planes[:3], every)
        if on and aligned:
            believed = np.isin(np.arange(len(rows)), [rows[view.name] for view in seen.views])
            poses.twists = remove_common_motion(step_twists(poses.twists, aligned, poses.drifted()), seen.rig, believed)
            for row, (one, _, lens) in aligned.items():
                poses.moved[row] = pixel_offset(lens, poses.twists[row], one.depth)
        elif not on:
            suspects = [*(view for view in seen.views if seems[rows[view.name]]), *seen.suspects]
            for view, shown, _ in _rendered(seen, suspects):
                _record_offset(poses, rows[view.name], view, shown, 1)
        return poses.arrays()

    def evidence(self, seen: FrameObservation) -> Evidence | None:
        """Returns the share of the residual explained by earlier offsets: the maximum over all suspect cameras."""
        arrays = seen.result.carried.get(NAME)
        if arrays is None or not _says(seen):
            return None
        poses = Poses.of(dict(arrays), len(seen.rig))
        shares = np.where(poses.suspects(), poses.shares, 0.0)
        row = int(shares.argmax())
        if shares[row] == 0:
            return Evidence(0.0, "")
        size = float(np.linalg.norm(poses.offsets[row]))
        return Evidence(float(shares[row]), f"camera {seen.rig.names[row]} is misaligned by {size:.1f} pixels")

    def register(self, builder: PlanBuilder) -> None:
        """Does nothing, because the update receives the poses through its views."""


def _says(seen: FrameObservation) -> bool:
    return len(seen.views) >= max(CAMERAS, ENOUGH * len(seen.rig))


def _looked_at(seen: FrameObservation, poses: Poses, rows: Mapping[str, int]) -> list[TrainingView]:
    """Returns the views of all drifted or excluded cameras, and of a few fixed ones that vary between frames."""
    off = poses.drifted()
    fixed = [view for view in seen.views if not off[rows[view.name]]]
    count = len(fixed)
    some = {(seen.index + count * k // FIXED_CAMERAS) % count for k in range(FIXED_CAMERAS)} if count else set()
    others = [view for view in seen.views if off[rows[view.name]]]
    return [*(fixed[k] for k in sorted(some)), *others, *seen.suspects]


def _aligned(seen: FrameObservation, views: list[TrainingView]) -> dict[int, tuple[Equations, Camera, Array]]:
    """Returns the equations, camera and lens of each view with enough texture, keyed by camera row."""
    rows, by_row = {name: row for row, name in enumerate(seen.rig.names)}, {}
    for view, shown, depth in _rendered(seen, views):
        compared = align_pixels(view.target[:3], view.exposed(shown))
        if compared is not None:
            equations = twist_equations(view.camera.lens, compared, depth)
            by_row[rows[view.name]] = (equations, seen.rig[view.name], view.camera.lens)
    return by_row


def _record_offset(poses: Poses, row: int, view: TrainingView, shown: Array, every: int) -> None:
    compared = align_pixels(view.target[:3], view.exposed(shown), every)
    if compared is not None:
        poses.record_offset(row, turn_equations(view.camera.lens, compared))


def _rendered(seen: FrameObservation, views: Sequence[TrainingView]) -> Iterator[tuple[TrainingView, Array, Array]]:
    """Yields each view with its rendering [3, H, W] without exposure, valid until the next one, and its depth.

    The depth [H, W] is along z in metres, or NaN where nothing is rendered.
    """
    shots = [(seen.result.gaussians, view.camera) for view in views]
    for view, (planes, rest) in zip(views, seen.renderer.render_each(shots, depth_channel=LABEL), strict=True):
        alpha = 1 - rest
        depth = np.where(alpha > COVERED, planes[LABEL] / np.maximum(alpha, np.float32(COVERED)), np.float32(np.nan))
        yield view, planes[:3], depth


EFFECT = PoseDrift(
    name=NAME,
    group=EffectGroup.CAMERAS,
    description="Cameras drift or are knocked by a few pixels; their poses are re-estimated from the images in each "
    "frame.",
    disambiguation="The median twist over the cameras is 0; motion that most cameras share is attributed to the scene.",
    cost="samples of eight renderings per frame; while on, one rendering of each misaligned camera and of six others",
    auto=True,
    on_above=0.2,
    off_below=0.08,
    committed_arrays=("twists",),
)
