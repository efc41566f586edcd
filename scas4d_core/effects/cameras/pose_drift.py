"""Poses of cameras that drift: tripods sag, are knocked by a pixel or a few, and bend in the sun.

Once a frame, after its update, the renderings of some cameras are compared with their pictures: the turn of a camera
that would bring them onto each other is noted, as what the camera is off by against its calibration. One frame says
little, for what moves is followed late. A camera is believed to have moved where its earlier frames show what its
residual is now, and by ``LEAST`` pixels; then its pose follows, half of the way a frame. All others keep theirs to the
bit.

The poses are those of the training views of the frames after: masks shift with their camera, probe views and what is
new are seen from where it stands. Views that users ask for are rendered for the camera as it is given: "as camera 7"
is as that was calibrated. Who is believed is decided before (``robust.outliers``): a camera that is off is excluded
as ever, and still measured; it comes back once its pose is found, and stays excluded beyond the limit. A gain of
a camera is the median over its pixels, which hardly sees a shift of some pixels; ``shadows`` may learn in such
frames, but from all cameras.
"""

from __future__ import annotations

from collections.abc import Mapping
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
"""Cameras that are needed to find one that is off: with fewer, moving Gaussians could explain the difference."""
ENOUGH = 0.5
"""Share of the rig's cameras from which a frame teaches."""
LEAST = 0.25
"""Pixels from which a camera may be off: on captures whose cameras stand 0.15 at most, 0.4 on cloth that is shaken."""
TIMES = 4.0
"""The same, of the median over the cameras: where many seem to be off, what moves is followed late."""
# Thresholds of the effect: shares on captures whose cameras stand, at half size, are 0.14 at most on cloth played
# backwards, 0.07 on cloth and the wheel, 0.03 on the others.
SHARE = 0.5
"""Of the way to what a frame says, that poses and what is noted take: a drift is followed late by as much as it goes in
a frame, and a frame in which a thing is followed late does half of the harm."""
STANDING = 6
"""Cameras that stand, others in each frame, that are rendered where the effect is on: they show what of a twist is the
scene's own motion."""
LARGEST, TURN = 0.02, radians(1)
"""Share of the picture's width, and angle, by which a pose is moved at most: a camera that is off by more has been
moved, and is excluded as ever."""
COVERED = 0.1
"""Alpha from which a pixel has a depth."""
SMALLEST = 1e-3
"""Added to the 3×3 equations of a turn in pixels, 0.3 pixels of one that weighs nothing: a bare wall shows no turn."""


def rig_with_drift(rig: Rig, carried: Mapping[str, Arrays]) -> Rig:
    """The cameras as they stand by now; the rig itself where none has moved.

    Args:
        rig: the cameras inside, as calibrated. carried: arrays of the effects.
    """
    twists = carried.get(NAME, {}).get("twists")
    if twists is None or not twists.any():
        return rig
    return Rig(tuple(_moved(camera, twist) for camera, twist in zip(rig.cameras, twists, strict=True)))


def _moved(camera: Camera, twist: Double) -> Camera:
    return replace(camera, world_to_camera=twist_to_matrix(twist) @ camera.world_to_camera) if twist.any() else camera


@dataclass(eq=False)
class Poses:
    """The cameras of a rig, a row each.

    Attributes:
        twists: [C, 6] float64 by which each is moved against its calibration: shift (metres) and turn, camera's axes.
        moved: [C, 3] the same in pixels, see ``alignment.pixel_offset``, when last looked at.
        offsets: [C, 3] pixels that each has been off by, against its calibration: a mean that forgets.
        shares: [C] 0…1 of its residual that offsets of earlier frames explained: a mean that forgets.
        observations: [C] frames in which it was looked at.
    """

    twists: Double
    moved: Double
    offsets: Double
    shares: Double
    observations: NDArray[np.int64]

    @classmethod
    def of(cls, arrays: Arrays, count: int) -> Poses:
        """From ``arrays``; those that are not there are 0."""
        shapes = {"twists": (count, 6), "moved": (count, 3), "offsets": (count, 3), "shares": (count,)}
        blank: dict[str, NDArray[Any]] = {name: np.zeros(shape) for name, shape in shapes.items()}
        blank["observations"] = np.zeros(count, np.int64)
        return cls(**{name: arrays[name].copy() if name in arrays else empty for name, empty in blank.items()})

    def arrays(self) -> Arrays:
        """As they are carried to the next frame; no twists where no camera has moved."""
        arrays: Arrays = {name: getattr(self, name) for name in ("moved", "offsets", "shares", "observations")}
        return {**arrays, "twists": self.twists} if self.twists.any() else arrays

    def record_offset(self, row: int, turn: Equations) -> None:
        """Notes what a camera's residual says, in the numbers of ``turn_equations``, relative to its present pose."""
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
        """[C] the cameras that may have moved: they are rendered, to be looked at again at once."""
        sizes, looked = np.linalg.norm(self.offsets, axis=1), self.observations > 0
        usual = float(np.median(sizes[looked])) if looked.any() else 0.0
        off: NDArray[np.bool_] = sizes >= max(LEAST, TIMES * usual)
        return off

    def drifted(self) -> NDArray[np.bool_]:
        """[C] the cameras that have moved."""
        return self.twists.any(axis=1) | (self.suspects() & (self.shares >= EFFECT.on_above))


def _left(turn: Equations, way: Double) -> float:
    """The weighted squares that a turn leaves."""
    return float(turn.energy - 2 * turn.vector @ way + way @ turn.matrix @ way)


def step_twists(
    twists: Double, aligned: Mapping[int, tuple[Equations, Camera, Array]], follow: NDArray[np.bool_]
) -> Double:
    """[C, 6] the twists after a frame, for the cameras that follow.

    A motion of the scene that its other cameras see as well is taken out before.

    Args:
        twists: before. aligned: by row, the equations of a camera, the camera as it is posed, and its lens.
        follow: [C].
    """
    matrix, vector = np.eye(6) * 1e-6, np.zeros(6)
    standing = [row for row in aligned if not follow[row]] or list(aligned)
    for row in standing:
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
    """The twist, or as much of it as a pose may be moved by."""
    size = float(np.linalg.norm(pixel_offset(lens, twist, depth)[:2])) / (LARGEST * float(lens[4]))
    return twist / max(1.0, size, float(np.linalg.norm(twist[3:])) / TURN)


def remove_common_motion(twists: Double, rig: Rig, believed: NDArray[np.bool_]) -> Double:
    """[C, 6] the twists without what most cameras share: that is a motion of the scene.

    The median is taken of each number, in the world's axes, over the cameras that are believed. With a mean, a camera
    that is off by 3 pixels would move the others, and the world with them.

    Args:
        rig: as calibrated, or as posed: a motion does not turn its own twist. believed: [C].
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
    """Poses that follow the pictures, once a frame."""

    def record(self, seen: FrameObservation, on: bool) -> Arrays | None:
        """What each camera is off by; where it is on, the poses of the frames after."""
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
            for view in [*(view for view in seen.views if seems[rows[view.name]]), *seen.suspects]:
                _record_offset(poses, rows[view.name], view, _rendered(seen, view)[0], 1)
        return poses.arrays()

    def evidence(self, seen: FrameObservation) -> Evidence | None:
        """The share of its residual that a shift found in earlier frames explains, of the camera with the largest."""
        arrays = seen.result.carried.get(NAME)
        if arrays is None or not _says(seen):
            return None
        poses = Poses.of(dict(arrays), len(seen.rig))
        shares = np.where(poses.suspects(), poses.shares, 0.0)
        row = int(shares.argmax())
        if shares[row] == 0:
            return Evidence(0.0, "")
        size = float(np.linalg.norm(poses.offsets[row]))
        return Evidence(float(shares[row]), f"camera {seen.rig.names[row]} is off by {size:.1f} pixels")

    def register(self, builder: PlanBuilder) -> None:
        """Adds nothing: updates know nothing of it, for the poses are those of their views."""


def _says(seen: FrameObservation) -> bool:
    return len(seen.views) >= max(CAMERAS, ENOUGH * len(seen.rig))


def _looked_at(seen: FrameObservation, poses: Poses, rows: Mapping[str, int]) -> list[TrainingView]:
    """Views to be aligned: of cameras that are off or excluded, and of some that stand, others in each frame."""
    off = poses.drifted()
    standing = [view for view in seen.views if not off[rows[view.name]]]
    count = len(standing)
    some = {(seen.index + count * k // STANDING) % count for k in range(STANDING)} if count else set()
    others = [view for view in seen.views if off[rows[view.name]]]
    return [*(standing[k] for k in sorted(some)), *others, *seen.suspects]


def _aligned(seen: FrameObservation, views: list[TrainingView]) -> dict[int, tuple[Equations, Camera, Array]]:
    """By row, the equations of each view, its camera and lens; without those that show too little."""
    rows, by_row = {name: row for row, name in enumerate(seen.rig.names)}, {}
    for view in views:
        shown, depth = _rendered(seen, view)
        compared = align_pixels(view.target[:3], _exposed(view, shown))
        if compared is not None:
            equations = twist_equations(view.camera.lens, compared, depth)
            by_row[rows[view.name]] = (equations, seen.rig[view.name], view.camera.lens)
    return by_row


def _record_offset(poses: Poses, row: int, view: TrainingView, shown: Array, every: int) -> None:
    compared = align_pixels(view.target[:3], _exposed(view, shown), every)
    if compared is not None:
        poses.record_offset(row, turn_equations(view.camera.lens, compared))


def _exposed(view: TrainingView, shown: Array) -> Array:
    return view.exposure[:3, 0, None, None] * shown + view.exposure[:3, 1, None, None]


def _rendered(seen: FrameObservation, view: TrainingView) -> tuple[Array, Array]:
    """[3, H, W] as a view is rendered, without its exposure, and [H, W] metres along z; NaN where nothing is."""
    state = seen.result.gaussians
    planes, rest = seen.renderer.render(state, view.camera, depth_channel=LABEL)
    alpha = 1 - rest
    depth = np.where(alpha > COVERED, planes[LABEL] / np.maximum(alpha, np.float32(COVERED)), np.float32(np.nan))
    return planes[:3].copy(), depth


EFFECT = PoseDrift(
    name=NAME,
    group=EffectGroup.CAMERAS,
    description="Cameras drift, or are knocked by a few pixels: their poses follow the pictures once per frame.",
    disambiguation="The median twist over the cameras is 0: what most cameras share is motion of the scene.",
    cost="samples of eight renderings per frame; where on, one render of each camera that is off, and of six others",
    auto=True,
    on_above=0.2,
    off_below=0.08,
    committed_arrays=("twists",),
)
