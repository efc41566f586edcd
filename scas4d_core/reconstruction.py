"""A ``Reconstruction`` holds Θ_t; ``step(frame)`` commits Θ_t = D_t(Θ_{t−1}), or raises and changes nothing.

A commit is one rename: a frame's state and report are in one file. What the next update needs beside it is on disk
before (``checkpoint``), so that ``resume`` goes on after any end of the process, with the same bits on the CPU.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from math import inf, isfinite
from time import perf_counter
from typing import Any

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray

from scas4d_core.cameras import Rig, WorldFrame, rig_inside
from scas4d_core.captures.frame import Frame, InitialPoints
from scas4d_core.first_frame.start import FirstFrame, fit_first
from scas4d_core.first_frame.static_scene import StaticResult
from scas4d_core.frame_report import FrameReport, Progress, report_of_first, report_of_update
from scas4d_core.gaussians import Gaussians
from scas4d_core.query.committed import CommittedScene, View
from scas4d_core.rasterize.limits import scene_limits
from scas4d_core.robust import outliers as judge
from scas4d_core.robust.attempts import axis_lengths
from scas4d_core.robust.repeats import fingerprints, same_again
from scas4d_core.robust.solve_frame import Given, Trial
from scas4d_core.settings import Settings, UpdateSettings
from scas4d_core.storage.checkpoint import CarryOver, Checkpoints, ResumeError, ResumePoint, find_commit
from scas4d_core.storage.history import History, HistoryError
from scas4d_core.structure.motion_mask import labelled, labels_learnt, with_reliable_labels
from scas4d_core.torch_backend.device import require_device
from scas4d_core.update.budget import Budget
from scas4d_core.update.frame_update import Updater
from scas4d_core.update.picture_loss import PictureLoss
from scas4d_core.update.prepare import prepare
from scas4d_core.update.result import REPORT, Stopwatch
from scas4d_core.update.schedule import mask_weight
from scas4d_core.update.views import TrainingView, ViewFactory, scaled_to
from scas4d_core.warm_up import warm_up_elsewhere

__all__ = ["FrameReport", "Progress", "Reconstruction", "ResumeError", "ResumePoint", "StepError", "View"]


class StepError(ValueError):
    """A frame that cannot be stepped to; the state is as it was."""


class Reconstruction(CommittedScene):
    """One scene, from frame 0 on. Made by ``start`` or, from what another process left on disk, by ``resume``.

    Attributes:
        rig: the training cameras inside, image-scaled. world: user's world to inside. history: what was committed.
        report: of the last frame committed by this object. resumed: where it was taken up again, or None.
    """

    def __init__(self, settings: Settings, rig: Rig, world: WorldFrame, history: History) -> None:
        super().__init__(history, world, scene_limits(settings.scene.near, rig.radius))
        self.settings = settings
        self.rig = rig
        self._factory = ViewFactory(rig)
        self._sizes: dict[str, tuple[int, int]] = {}
        self.static: StaticResult | None = None
        self.report: FrameReport | None = None
        self.resumed: ResumePoint | None = None
        self._fixed: FirstFrame
        self._carried = CarryOver()
        self._checkpoints = None if history.directory is None else Checkpoints(history.directory)
        limits = scene_limits(settings.scene.near, rig.radius)
        self._picture = PictureLoss(self._factory, settings.scene.background, 1.0, 0.0, limits=limits)
        self._updater: Updater
        self._effort = settings.update
        self._budget = Budget(settings.update.budget_ms)

    @classmethod
    def _of(cls, rig: Rig, settings: Settings, history: History) -> Reconstruction:
        """Without a frame yet; ``rig`` in the user's world."""
        require_device(settings.device)
        if settings.device == "cpu":
            warm_up_elsewhere()
        world = rig.world_frame(settings.scene.metres_per_unit)
        scaled = rig_inside(world, rig.scaled(settings.scene.image_scale).cameras)
        self = cls(settings, scaled, world, history)
        self._sizes = {camera.name: (camera.width, camera.height) for camera in rig.cameras}
        return self

    @classmethod
    def start(
        cls,
        rig: Rig,
        frame: Frame,
        settings: Settings,
        *,
        points: InitialPoints | None = None,
        progress: Callable[[Progress], None] | None = None,
        history: History | None = None,
        static: StaticResult | None = None,
        dropped: Mapping[str, str] | None = None,
        notes: Mapping[str, Any] | None = None,
        started: float | None = None,
    ) -> Reconstruction:
        """Reconstruct the first frame and commit it.

        Args:
            rig: training cameras, user's world, at the size of the frame's pictures.
            frame: with a picture of every camera, or of most; masks where there are.
            points: a first cloud in the user's world; without it one is made from the pictures.
            progress: told of each stage.
            history: where to commit to; in memory when left out.
            static: a frame 0 that was fitted before, taken as it is.
            dropped, notes, started: see ``step``; the stage "load" is what went before: decoding, loading the kernels.

        Raises:
            DeviceError: the settings' device cannot be had here.
            ValueError: a time that is not finite, or pictures of another size.
        """
        if not isfinite(frame.time):
            raise ValueError(f"frame {frame.index}: time {frame.time} s must be finite")
        self = cls._of(rig, settings, History() if history is None else history)
        began = perf_counter()
        result = static or fit_first(
            self._scaled(frame), points, self._factory, settings, self.world, progress or (lambda _: None)
        )
        result = replace(result, gaussians=with_reliable_labels(result.gaussians))
        fitted = perf_counter()
        self.static = result
        self._fixed = FirstFrame(len(frame.masks) > 0, result.exposures, axis_lengths(result.gaussians))
        self._updater, structure = self._prepared(result.gaussians, None)
        seen = () if self._fixed.masked else self._factory.views(self._scaled(frame), {}, use_masks=False)
        load = {} if started is None else {"load": began - started}
        seconds = {**load, "fit": fitted - began, "prepare": perf_counter() - fitted}
        report = report_of_first(frame, result, self.rig.names, len(self._updater.hierarchy.rows), seconds, dropped)
        psnr = {name: fit.psnr for name, fit in result.cameras.items()}
        past = replace(judge.Past.of_first(psnr, judge.brightness(frame.images)), fitted=frame.time)
        carried = CarryOver(seen=seen, structure=structure, past=past, shown=fingerprints(frame.images))
        self._commit(report, result.gaussians, carried, {**self._fixed.record(), **(notes or {})})
        return self

    @classmethod
    def resume(
        cls, rig: Rig, settings: Settings, history: History, *, held: Callable[[int], bool] = lambda index: True
    ) -> Reconstruction:
        """Take a scene up again where its last commit left it; on the CPU it goes on with the same bits.

        Where the newest state or its checkpoint is damaged, it goes on from the one before, and what came after is
        taken back from the history: ``resumed.undone`` names the frames that have to be given again. If one of them is
        not ``held``, a whole newest state is worth more than the same bits: it goes on from that with a cold start.

        Args:
            rig: training cameras, user's world, as given to ``start``. settings: as given to ``start``.
            history: of the scene, on disk, opened with ``History.open``.
            held: whether the pictures of a committed frame can be given again.

        Raises:
            ResumeError: the history has no frame, or its first state or every state is damaged.
        """
        if history.directory is None or not history.indices:
            raise ResumeError("the history holds no committed frame; start the scene with its first frame")
        self = cls._of(rig, settings, history)
        assert self._checkpoints is not None
        try:
            self._fixed = FirstFrame.of(history)
        except (HistoryError, KeyError) as error:
            raise ResumeError(f"the first frame, which every update needs, cannot be read ({error})") from error
        index, left, faults = find_commit(history, self._checkpoints, self._factory, held)
        same = self._go_on(CarryOver(labels=self._labels_of(index)) if left is None else left)
        if left is not None and not same:
            faults.append("clusters came out otherwise than before: the next update starts without a motion")
        self.resumed = ResumePoint(index, history.cut(index), faults, cold=left is None or not same)
        self._checkpoints.clean(history.indices)
        if self.resumed.cold:
            with suppress(OSError):  # for want of room: the next start is as cold as this one
                self.write_checkpoint(index)
        return self

    def write_checkpoint(self, index: int) -> bool:
        """Writes the checkpoint of the newest commit again; False for another one, which is not in memory."""
        if self._checkpoints is None or index != self.history.indices[-1]:
            return False
        self._checkpoints.save(index, self._carried)
        return True

    @classmethod
    def aside(cls, rig: Rig, settings: Settings, history: History, index: int) -> Reconstruction:
        """A copy in memory that goes on from a committed frame with a cold start; ``history`` is read, not changed.

        Args:
            rig: training cameras, user's world, as given to ``start``. settings: as given to ``start``, or with other
                ones of the update.
            history: of the scene. index: a committed frame.

        Raises:
            HistoryError: the frame or the first one cannot be read.
        """
        first = history.indices[0]
        copy = History()
        for one in sorted({first, index}):
            copy.append(one, history.time(one), history.gaussians(one), history.report(one))
        self = cls._of(rig, settings, copy)
        self._fixed = FirstFrame.of(copy)
        self._go_on(CarryOver(labels=self._labels_of(index)))
        return self

    def _go_on(self, carried: CarryOver) -> bool:
        """Prepare the updates after a committed one; whether the motion that it left fits the clusters of now."""
        first = self.history.gaussians(self.history.indices[0])
        self._updater, structure = self._prepared(first, carried.labels)
        same = carried.structure == structure
        self._carried = carried if same else replace(carried, motion=None, structure=structure)
        return same

    def _labels_of(self, index: int) -> NDArray[np.bool_] | None:
        """The labels learnt, as far as the state tells."""
        moving = self.history.gaussians(index).moving
        return None if self._fixed.masked or moving.all() else moving

    def step(
        self,
        frame: Frame,
        *,
        dropped: Mapping[str, str] | None = None,
        notes: Mapping[str, Any] | None = None,
        started: float | None = None,
    ) -> FrameReport:
        """Update to a frame and commit; a frame that does not fit is held or left out in part, and its report says so.

        Args:
            frame: later than the last; with the pictures of some cameras or all.
            dropped: cameras that the caller has left out, with the reason; committed with the report.
            notes: further facts to commit with the report, as JSON; they stand beside its own.
            started: ``perf_counter`` when the work on the frame began, where that was before; a budget counts from it.

        Raises:
            StepError: not later than the last frame, no picture of the rig, or a picture of another size.
        """
        seconds = self._seconds_to(frame)
        watch = Stopwatch() if started is None else Stopwatch(began=started, last=started)
        frame = replace(frame, images=dict(frame.images))  # decoded once: a capture's pictures are, whenever looked at
        views = self._views(frame)
        watch.lap("decode")

        brightness = judge.brightness(frame.images)
        look = judge.look(self._carried.past, brightness) if self.settings.update.judge else judge.Look()
        past = judge.lit(self._carried.past, look)
        watch.lap("judge")

        updater, carried = self._learn_what_moves(views, look)
        given = Given(
            state=labelled(self._state(None), carried.labels),
            motion=carried.motion,
            seconds=frame.time - past.fitted if isfinite(past.fitted) else seconds,
            step=seconds,
            views=[view for view in views if view.name not in look.left_out],
            suspects=[view for view in views if past.of(view.name).out],
            brightness=brightness,
            seed=frame.index,
            past=past,
            look=look,
            end=self._budget.end(watch.began),
            each=self._budget.each,
            lengths=self._fixed.lengths,
        )
        trial = Trial(updater, self._factory, self._picture, self._effort)
        shown = fingerprints(frame.images)
        again = not look.held and shown == carried.shown and self._effort.still > -1
        outcome = same_again(given) if again else trial.run(given)
        watch.lap("update")
        watch.move("update", "judge", trial.judging)

        if not outcome.fresh:  # what seemed to move in its pictures is as little believed as they are
            updater, carried = self._updater, self._carried
            outcome = replace(outcome, gaussians=self._state(None), motion=carried.motion)
        report = report_of_update(frame, outcome, look, self.rig.names, watch, dropped)
        how = {"cold": given.motion is None, "relabelled": updater is not self._updater}
        carried = carried.after(outcome, frame.time, None if self._fixed.masked else given.views, shown)
        self._commit(report, outcome.gaussians, carried, {**how, **(notes or {})})
        self._updater = updater
        self._budget.learn(outcome.updated, trial.judging + perf_counter() - watch.began - watch.total)
        return report

    def _seconds_to(self, frame: Frame) -> float:
        """Seconds from the last committed frame to one that comes after it."""
        last = self.history.indices[-1]
        if frame.index <= last:
            raise StepError(f"frame {frame.index} is not after the last committed frame {last}")
        seconds = frame.time - self.history.time(last)
        if not 0 < seconds < inf:
            raise StepError(f"frame {frame.index}: time {frame.time} s is not after {self.history.time(last)} s")
        return seconds

    def _views(self, frame: Frame) -> list[TrainingView]:
        """The views of a frame; without masks where no term asks for them: they are not even read."""
        settings, moving = self.settings.update, len(self._updater.hierarchy.rows)
        try:
            use_masks = settings.use_masks and mask_weight(settings, moving, len(self._state(None))) > 0
            return self._factory.views(self._scaled(frame), self._fixed.exposures, use_masks)
        except ValueError as error:
            raise StepError(str(error)) from error

    def spend(
        self,
        *,
        iterations: int | None = None,
        budget_ms: float | None = None,
        stop_gain: float | None = None,
        still: float | None = None,
    ) -> None:
        """Give the updates from here on another budget, see ``UpdateSettings``; what is None is as the scene was made.

        Raises:
            ValueError: a value out of range.
        """
        told = {"iterations": iterations, "budget_ms": budget_ms, "stop_gain": stop_gain, "still": still}
        changes = {name: value for name, value in told.items() if value is not None}
        self._effort = UpdateSettings.model_validate({**self.settings.update.model_dump(), **changes})
        self._budget.milliseconds = self._effort.budget_ms

    def _commit(self, report: FrameReport, gaussians: Gaussians, carried: CarryOver, more: Mapping[str, Any]) -> None:
        """The checkpoint first, then state and report in one rename."""
        if self._checkpoints is not None:
            self._checkpoints.save(report.index, carried)
        began = perf_counter()
        resumed = None if self.resumed is None or self.report is not None else asdict(self.resumed)
        record = {**report.record(), "threads": get_num_threads(), "resumed": resumed, **more}
        seconds = report.seconds  # a record cannot tell its own writing: it has that of the one before
        seconds[REPORT] = seconds.get(REPORT, 0.0) + self.history.record_seconds + perf_counter() - began
        record["seconds"] = dict(seconds)
        self.history.append(report.index, report.time, gaussians, record)
        self._carried = carried
        self.report = report
        if self._checkpoints is not None:
            self._checkpoints.clean(self.history.indices)

    def _learn_what_moves(self, views: list[TrainingView], look: judge.Look) -> tuple[Updater, CarryOver]:
        """Where frame 0 had no mask, the pictures tell what moves; what has moved once stays in the hierarchy.

        The labels become part of the state with the commit of this frame. A hierarchy of other Gaussians is a new one:
        the motion before does not fit it, and the update starts cold.
        """
        carried = self._carried
        if self._fixed.masked or not carried.seen or look.held or look.exposure != 1.0:
            return self._updater, carried
        believed = [view for view in views if view.name not in look.left_out]
        labels = labels_learnt(self._state(None), carried.labels, carried.seen, believed, self._picture)
        if labels is None:
            return self._updater, carried
        updater, structure = self._prepared(self.history.gaussians(self.history.indices[0]), labels)
        return updater, replace(carried, labels=labels, motion=None, structure=structure)

    def _prepared(self, first: Gaussians, labels: NDArray[np.bool_] | None) -> tuple[Updater, int]:
        """The updater for what moves in Θ_0, and the digest of its clusters and neighbours."""
        return prepare(labelled(first, labels), self._factory, self.settings, self.world)

    def _scaled(self, frame: Frame) -> Frame:
        """The frame with its pictures at the size of ``rig``."""
        return frame if self.settings.scene.image_scale == 1.0 else scaled_to(self.rig, frame, self._sizes)
