"""Reconstruction of a scene, frame by frame.

``Reconstruction.start`` fits the Gaussians Θ_0 to the first frame. ``Reconstruction.step`` deforms
Θ_{t−1} to fit the next frame, and commits the result Θ_t. If ``step`` raises an error, the scene
does not change.

The state and the report of a frame are in one file, so a commit is a single rename. The checkpoint
for the next update is written before. ``Reconstruction.resume`` can therefore continue after any
crash, with bit-identical results on the CPU.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from math import isfinite
from time import perf_counter
from typing import Any

from numba import get_num_threads

from scas4d_core.cameras import Rig, rig_inside
from scas4d_core.captures.frame import Frame, InitialPoints
from scas4d_core.checkpoint import CarryOver, Checkpoints, ResumeError, ResumePoint, cold_start, find_commit
from scas4d_core.effects.evidence import FitTime, FrameObservation
from scas4d_core.effects.presence.motion_mask import first_labels, with_labels
from scas4d_core.effects.switches import committed_arrays, encode_switches
from scas4d_core.engines.choose import renderer_of, resolve_device
from scas4d_core.engines.engine import REPORT
from scas4d_core.engines.limits import rig_limits
from scas4d_core.engines.views import CameraArrays, TrainingView
from scas4d_core.errors import StepError
from scas4d_core.first_frame.calibration.refine import calibrate_first_frame
from scas4d_core.first_frame.calibration.report import CalibrationReport, effective_rig
from scas4d_core.first_frame.fit_first_frame import (
    FirstFrame,
    fit_first_frame,
    with_background,
    with_recorded_background,
)
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.frame_context import FrameContext, FrameInput
from scas4d_core.frame_report import FrameReport, report_of_first, report_of_update
from scas4d_core.frame_times import MAX_TIME
from scas4d_core.gaussians import Gaussians
from scas4d_core.preparation import Preparation, PreparedUpdate, room_for_births
from scas4d_core.progress import Progress
from scas4d_core.query.committed import CommittedScene
from scas4d_core.rig_checks import check_rig
from scas4d_core.robust.alarms import sharpness, with_first_figures
from scas4d_core.robust.checks import (
    axis_lengths,
    brightness,
    check_brightness,
    fingerprints,
    light_continues,
    record_brightness,
    with_light,
)
from scas4d_core.robust.outliers import Past
from scas4d_core.robust.solve_frame import FrameSolver
from scas4d_core.robust.update_input import RESTING, UpdateInput
from scas4d_core.settings import Settings, UpdateSettings
from scas4d_core.storage.history import Defer, History, HistoryError, run_now
from scas4d_core.update.result import Stopwatch
from scas4d_core.update.schedule import TimeBudget
from scas4d_core.update.view_factory import ViewFactory

__all__ = ["FrameReport", "Progress", "Reconstruction", "ResumeError", "ResumePoint", "StepError"]


class Reconstruction(CommittedScene):
    """Reconstruction of one scene from its first frame onward.

    Objects are created by ``start``, or from the history of an existing scene by ``resume`` or
    ``fork``. A process should call ``warm_up.compile_in_processes`` before. Otherwise, kernels may
    be compiled in this process.

    Attributes:
        calibrated: training cameras in the user's world, as given by the user or as refined in
            frame 0.
        rig: training cameras in the internal world, at the scaled image size.
        settings: settings of the scene.
        device: device that fits and updates the scene.
        world: transform from the user's to the internal world.
        history: committed states.
        static: fit of frame 0; None after ``resume`` and ``fork``.
        report: report of the last frame committed by this object, or None.
        resumed: commit from which the scene was resumed, or None.
        may_change_population: whether effects may add, retire and revive Gaussians.

    >>> from scas4d_core.captures import open_capture
    >>> capture = open_capture("samples/robot")
    >>> settings = Settings.model_validate({"scene": {"image_scale": 0.25}, "static": {"iterations": 20}})
    >>> scene = Reconstruction.start(capture.rig, capture.frame(0), settings, points=capture.points)
    >>> report = scene.step(capture.frame(1))
    >>> report.index, report.iterations, report.outcome.rejected
    (1, 300, False)
    >>> scene.render(capture.rig.cameras[0]).colour.shape
    (256, 256, 3)
    """

    def __init__(self, rig: Rig, settings: Settings, history: History, found: CalibrationReport | None = None) -> None:
        """Creates an object without a current state; callers use ``start``, ``resume`` or ``fork``.

        Args:
            rig: training cameras in the user's world, at the size of the images.
            settings: settings of the scene.
            history: history to commit to.
            found: result of the calibration check of frame 0, or None to use the result in the
                history, if there is one.
        """
        world, scale = rig.world_frame(settings.scene.metres_per_unit), settings.scene.image_scale
        limits = rig_limits(settings.scene.near, world, rig.cameras)
        self.device = resolve_device(settings.device)
        super().__init__(history, world, limits, self.device)
        self.calibrated = rig = effective_rig(
            rig, history.first_report if found is None else {"calibration": asdict(found)}
        )
        self.rig = rig_inside(world, rig.scaled(scale).cameras)
        self.settings, self._update = settings, settings.update
        self._factory = ViewFactory(self.rig, None if scale == 1.0 else rig)
        self._renderer = renderer_of(self.device, settings.scene.background_rgb, limits)
        self._preparation = Preparation(self._factory, self.settings, self.world, self._renderer)
        self.static: StaticResult | None = None
        self.report: FrameReport | None = None
        self.resumed: ResumePoint | None = None
        self._fixed: FirstFrame
        self._prepared: PreparedUpdate
        self.may_change_population = True
        self._checkpoints = None if history.directory is None else Checkpoints(history.directory)
        self._budget = TimeBudget(settings.update.budget_ms)

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
        defer: Defer = run_now,
    ) -> Reconstruction:
        """Reconstructs the first frame and commits it.

        Args:
            rig: training cameras in the user's world and units, at the size of the frame's images.
            frame: first frame. It should have images of all or nearly all cameras, and masks if
                masks are available.
            settings: settings of the scene.
            points: initial point cloud in the user's world, or None to compute one from the images.
            progress: function called with the progress of each stage.
            history: history to commit to, or None for a new history in memory.
            static: existing fit of frame 0 to use, or None to fit the frame.
            dropped: maps each camera excluded by the caller to the reason; committed with the
                report.
            notes: additional JSON data to commit.
            started: ``perf_counter`` value at which the caller began to decode images and load
                kernels, or None. The time since then is reported as the stage "load".
            defer: see ``step``.

        Raises:
            RigError: if the rig is unusable with these settings.
            ValueError: if the time of the frame is not within ±``MAX_TIME``, or an image does not
                have the size of its camera.
        """
        if not abs(frame.time) <= MAX_TIME:
            raise ValueError(f"frame {frame.index}: time must be within ±{MAX_TIME} s; got {frame.time} s")
        if static is None:
            check_rig(rig, settings.scene, None if points is None else points.positions)
        began, on_progress = perf_counter(), progress or (lambda _: None)
        frame = replace(frame, images=dict(frame.images))  # decoded only once
        calibration = calibrate_first_frame(rig, frame, settings.static, on_progress, measured=static is None)
        settings, checked = with_background(settings, frame.images), perf_counter()
        self = cls(rig, settings, History() if history is None else history, calibration)
        scaled = self._factory.scaled(frame)
        result = static or fit_first_frame(scaled, points, self._factory, self.settings, self.world, on_progress)
        self.static = result = replace(result, gaussians=first_labels(result.gaussians, self.rig, scaled.masks))
        fitted = perf_counter()
        fixed = (
            len(frame.masks) > 0,
            result.exposures,
            axis_lengths(result.gaussians),
            self.settings.scene.background_rgb,
        )
        self._fixed = FirstFrame(*fixed)
        switches, effects = self._preparation.first_frame_effects(scaled, result)
        self._prepared = self._preparation.rebuild(result.gaussians, CarryOver(switches=switches))
        seen = self._factory.views(scaled, {}, False) if self._learns_labels else ()
        load = {} if started is None else {"load": began - started}
        stages = {"calibration": checked - began, "fit": fitted - checked, "prepare": perf_counter() - fitted}
        rows = len(self._prepared.updater.hierarchy.rows)
        report = report_of_first(
            frame, result, self.rig.names, rows, self._renderer, self._cameras, {**load, **stages}, dropped, calibration
        )
        psnr, shown = {name: fit["psnr"] for name, fit in result.cameras.items()}, fingerprints(frame.images)
        past = replace(
            with_first_figures(Past.of_first(psnr, brightness(frame.images)), frame.images), fitted=frame.time
        )
        prepared = self._prepared.with_carry_over(seen=seen, past=past, shown=shown, effects=effects)
        self._commit(report, result.gaussians, prepared, {**self._fixed.record(), **(notes or {})}, defer, defer)
        return self

    @classmethod
    def resume(
        cls, rig: Rig, settings: Settings, history: History, *, held: Callable[[int], bool] = lambda index: True
    ) -> Reconstruction:
        """Resumes a scene from its last commit. On the CPU, later results are bit-identical.

        If the newest state or its checkpoint is damaged, the scene resumes from an earlier commit.
        Later frames are rolled back, and ``resumed.undone`` lists the frames to send again. If one
        of these frames cannot be sent again, the scene resumes from the newest intact state with a
        cold start instead. The results are then not bit-identical.

        Args:
            rig: training cameras that were passed to ``start``.
            settings: settings that were passed to ``start``.
            history: history of the scene on disk, opened with ``History.open``.
            held: function that returns whether the images of a committed frame can be sent again.

        Raises:
            ResumeError: if the history has no frame, or its first state or every state is damaged.
        """
        if history.directory is None or not history.indices:
            raise ResumeError("the history contains no committed frame; start the scene with its first frame")
        self = cls(rig, with_recorded_background(settings, history), history)
        assert self._checkpoints is not None
        try:
            self._fixed = FirstFrame.of(history)
        except (HistoryError, KeyError) as error:
            raise ResumeError(f"the first frame, which every update needs, cannot be read ({error})") from error
        index, left, faults = find_commit(history, self._checkpoints, self._factory, held)
        same = self._prepare_from_commit(
            index, cold_start(history, index, self._fixed.masked) if left is None else left
        )
        if left is not None and not same:
            faults.append("the clusters differ from those before the restart, so the next update starts without motion")
        self.resumed = ResumePoint(index, history.truncate(index), faults, cold=left is None or not same)
        self._checkpoints.clean(history.indices)
        if self.resumed.cold:
            with suppress(OSError):  # without disk space, the next resume is also a cold start
                self.write_checkpoint(index)
        return self

    def write_checkpoint(self, index: int) -> bool:
        """Rewrites the checkpoint of a commit, if its content is in memory.

        Args:
            index: frame index of the commit.

        Returns:
            Whether the checkpoint was written. It is not written for any commit except the newest
            one, or if the history is not on disk.
        """
        if self._checkpoints is None or index != self.history.newest_index:
            return False
        self._checkpoints.save(index, self._prepared.carried)
        return True

    @classmethod
    def fork(cls, rig: Rig, settings: Settings, history: History, index: int) -> Reconstruction:
        """Returns a copy of a scene that continues from a committed frame with a cold start.

        The copy has its own history in memory. ``history`` is only read.

        Args:
            rig: training cameras that were passed to ``start``.
            settings: settings that were passed to ``start``; the update settings may differ.
            history: history of the scene.
            index: index of a committed frame.

        Raises:
            HistoryError: if the frame or the first frame cannot be read.
        """
        copy = history.copy_frames((history.indices[0], index))
        self = cls(rig, with_recorded_background(settings, copy), copy)
        self._fixed = FirstFrame.of(copy)
        self._prepare_from_commit(index, cold_start(copy, index, self._fixed.masked))
        return self

    def _prepare_from_commit(self, index: int, carried: CarryOver) -> bool:
        """Prepares the update that follows a commit.

        Args:
            index: frame index of the commit.
            carried: state carried over from the commit.

        Returns:
            Whether the clusters and neighbours are those for which the motion in ``carried`` is
            valid.
        """
        roots = self.history.roots(index)
        self._fixed = replace(self._fixed, lengths=axis_lengths(roots))
        self._prepared = self._preparation.rebuild(roots, carried)
        return self._prepared.carried.structure == carried.structure

    def step(
        self,
        frame: Frame,
        *,
        dropped: Mapping[str, str] | None = None,
        notes: Mapping[str, Any] | None = None,
        started: float | None = None,
        defer: Defer = run_now,
        defer_cleanup: Defer | None = None,
    ) -> FrameReport:
        """Updates the state to fit a frame, and commits the result.

        Cameras whose images do not fit are excluded. If the whole frame does not fit, the frame is
        rejected, and the previous state is committed unchanged.

        Args:
            frame: frame after the last committed one, with an image of at least one camera.
            dropped: maps each camera excluded by the caller to the reason; committed with the
                report.
            notes: additional JSON data to commit.
            started: ``perf_counter`` value at which work on the frame began, or None for the
                current time. The time budget of the frame starts at this time.
            defer: function that receives each function that writes files of the commit, in order.
                By default, each of these functions is called immediately. They may also be called
                after the next frame was updated.
            defer_cleanup: function that receives a function that deletes files which the commit made
                unnecessary, to be called after all others; by default, ``defer``.

        Raises:
            StepError: if the frame is not later than the last committed one. Also if the frame has
                no image of any camera of the rig, or an image does not have the size of its camera.
        """
        seconds, watch = self._seconds_to(frame), Stopwatch(started)
        frame = replace(frame, images=dict(frame.images))  # a capture decodes images on every access
        context = FrameContext(frame, watch, dropped, notes or {})
        self._observe(context, seconds)
        self._prepare(context)
        self._solve(context)
        self._populate(context)
        report = self._report(context)
        self._commit_update(context, report, defer, defer_cleanup or defer)
        return report

    def _observe(self, context: FrameContext, seconds: float) -> None:
        """Decodes the images, and checks their brightness and the lighting."""
        frame, watch, past = context.frame, context.watch, self._prepared.carried.past
        views = self._views(frame)
        watch.lap("decode")
        bright, shown = brightness(frame.images), fingerprints(frame.images)
        judged = bright if self.settings.update.reject_outliers else {}  # otherwise every image is accepted
        exposure, left_out, unusable = check_brightness(past, judged)
        changes = exposure != 1.0 and light_continues(past, judged)
        past = record_brightness(with_light(past, exposure), bright)
        context.frame_input = FrameInput(seconds, views, bright, shown, exposure, left_out, unusable, changes, past)
        watch.lap("judge")

    def _prepare(self, context: FrameContext) -> None:
        """Detects moving Gaussians if there are no masks, and collects the input of the update."""
        observed, frame, prepared, newest = context.frame_input, context.frame, self._prepared, self.history.newest
        believed, learns = observed.believed, observed.steady and self._learns_labels
        if learns and prepared.carried.seen:
            prepared = self._preparation.learn_labels(prepared, newest, believed)
        carried, past, shown = prepared.carried, observed.past, observed.fingerprints
        context.prepared = prepared
        context.update_input = UpdateInput(
            state=with_labels(newest, carried.labels),
            motion=carried.motion,
            seconds=frame.time - past.fitted if isfinite(past.fitted) else observed.seconds,
            step=observed.seconds,
            gap=frame.index - self.history.newest_index,
            views=believed,
            suspects=[view for view in observed.views if past.is_left_out(view.name)],
            brightness=observed.bright,
            seed=frame.index,
            past=past,
            lengths=self._fixed.lengths,
            exposure=observed.exposure,
            light_moves=observed.light_changes,
            may_be_static=learns and carried.labels is None and len(self.history.indices) <= RESTING,
            same=[name for name in shown if shown[name] == carried.shown.get(name)],
            sharp=sharpness(frame.images),
            left_out=observed.left_out,
            unusable=observed.unusable,
            carried=carried.effects,
            end=self._budget.end(context.watch.began),
            iteration_seconds=self._budget.iteration_seconds,
        )

    def _solve(self, context: FrameContext) -> None:
        """Updates Θ_{t−1} to fit the frame.

        If the frame is rejected, the state, motion and labels of the previous frame are kept.
        """
        solver = FrameSolver(context.prepared.updater, self._factory, self._renderer, self._update)
        result, context.past = solver.run(context.update_input)
        context.check_seconds = solver.check_seconds
        context.watch.lap("update")
        context.watch.move("update", "judge", solver.check_seconds)
        if result.outcome.rejected:  # labels learnt from rejected images are discarded
            carried = self._prepared.carried
            context.prepared = self._prepared
            result = replace(result, gaussians=self.history.newest, motion=carried.motion, carried=carried.effects)
        context.result = result

    def _populate(self, context: FrameContext) -> None:
        """Adds and retires Gaussians, switches effects on or off, and prepares the next update."""
        observed, result, believed = context.frame_input, context.result, context.frame_input.believed
        learnt_from = believed if self._learns_labels else None
        carried = context.prepared.carried.after(
            result, context.past, context.frame.time, learnt_from, observed.fingerprints
        )
        learn_labels = context.prepared.updater is not self._prepared.updater
        context.notes = {"cold": context.update_input.motion is None, "learn_labels": learn_labels, **context.notes}
        context.prepared = replace(context.prepared, carried=carried)
        context.birth_fit_time = FitTime(self._budget.end_of_births(context.watch.began))
        if not result.outcome.learnt or result.exposure != 1.0:  # after a light change, much of the image looks new
            return
        learnt = [view for view in result.views or believed if view.name not in result.trace.left_out]
        names = {view.name for view in learnt}
        seen = FrameObservation(
            index=context.frame.index,
            before=context.update_input.state,
            result=result,
            rig=self._factory.posed,
            views=learnt,
            renderer=self._renderer,
            room=room_for_births(len(self.history.first), len(result.gaussians)),
            time=context.birth_fit_time,
            suspects=[view for view in observed.views if view.name not in names],
        )
        may_change_population = self.may_change_population and observed.exposure == 1.0
        context.result, context.prepared = self._preparation.after_frame(context.prepared, seen, may_change_population)
        self._budget.record_birth_fits(context.birth_fit_time.spent, context.birth_fit_time.postponed)
        context.watch.lap("presence")

    def _report(self, context: FrameContext) -> FrameReport:
        return report_of_update(
            context.frame, context.result, self.history.newest, context.frame_input.left_out, self.rig.names,
            self._renderer, self._cameras, context.watch, context.dropped, context.birth_fit_time.postponed,
        )  # fmt: skip

    @property
    def _cameras(self) -> list[CameraArrays]:
        """Cameras at their current poses."""
        return [CameraArrays.of(camera) for camera in self._factory.posed.cameras]

    def _commit_update(self, context: FrameContext, report: FrameReport, defer: Defer, defer_cleanup: Defer) -> None:
        """Commits the frame with the Gaussians added in it, and updates the time budget."""
        result, prepared, watch = context.result, context.prepared, context.watch
        grown = prepared.roots is not self._prepared.roots
        birth = {"roots": prepared.roots, "parents": result.parents} if grown else {}
        self._commit(report, result.gaussians, prepared, context.notes, defer, defer_cleanup, **birth)
        after = context.check_seconds + watch.seconds.get("presence", 0.0) - context.birth_fit_time.spent
        after += perf_counter() - watch.began - watch.total
        self._budget.record_frame(result.trace.iteration_ends, result.trace.seconds, after)

    @property
    def _learns_labels(self) -> bool:
        """Whether moving Gaussians are detected by comparing the images of successive frames.

        This is necessary if the scene has no masks and an effect needs the labels.
        """
        return self._prepared.plan.learns_labels and not self._fixed.masked

    def _seconds_to(self, frame: Frame) -> float:
        """Returns the time in seconds from the last committed frame to a later frame.

        Raises:
            StepError: if the frame is not later than the last committed one, or its time exceeds ``MAX_TIME``.
        """
        last = self.history.newest_index
        if frame.index <= last:
            raise StepError(f"frame {frame.index} is not after the last committed frame {last}")
        seconds = frame.time - self.history.time(last)
        if not (seconds > 0 and frame.time <= MAX_TIME):
            raise StepError(
                f"frame {frame.index}: time {frame.time} s must be after that of the last frame, "
                f"{self.history.time(last)} s, and at most {MAX_TIME} s"
            )
        return seconds

    def _views(self, frame: Frame) -> list[TrainingView]:
        """Returns the views of a frame, with current estimates of camera poses and exposures.

        Raises:
            StepError: if the images do not match the rig.
        """
        try:
            return self._preparation.views(frame, self._fixed.exposures, self._prepared)
        except ValueError as error:
            raise StepError(str(error)) from error

    def set_budget(
        self,
        *,
        iterations: int | None = None,
        budget_ms: float | None = None,
        stop_gain: float | None = None,
        skip_tolerance: float | None = None,
    ) -> None:
        """Changes the time and iteration budget of later updates.

        A value that is None is reset to the value in the settings.

        Args:
            iterations: number of iterations per frame.
            budget_ms: time budget per frame in milliseconds.
            stop_gain: relative reduction of the error below which an update ends early.
            skip_tolerance: relative increase of the error up to which an update is skipped.

        Raises:
            ValueError: if a value is outside the range specified in ``UpdateSettings``.
        """
        given = {
            "iterations": iterations,
            "budget_ms": budget_ms,
            "stop_gain": stop_gain,
            "skip_tolerance": skip_tolerance,
        }
        changes = {name: value for name, value in given.items() if value is not None}
        self._update = UpdateSettings.model_validate({**self.settings.update.model_dump(), **changes})
        self._budget.milliseconds = self._update.budget_ms

    def _commit(
        self, report: FrameReport, gaussians: Gaussians, prepared: PreparedUpdate, more: Mapping[str, Any],
        defer: Defer, defer_cleanup: Defer, **birth: Any,
    ) -> None:  # fmt: skip
        """Writes the checkpoint, and then commits the state and the report.

        Args:
            report: report of the frame.
            gaussians: state of the frame.
            prepared: input of the next update.
            more: additional JSON data to commit.
            defer, birth: see ``History.append``.
            defer_cleanup: see ``step``.
        """
        carried, checkpoints = prepared.carried, self._checkpoints
        if checkpoints is not None:
            checkpoint = carried if defer is run_now else carried.snapshot()
            defer(lambda: checkpoints.save(report.index, checkpoint))
        began = perf_counter()
        resumed = None if self.resumed is None or self.report is not None else asdict(self.resumed)
        effects = encode_switches(carried.switches)
        computed = {"device": self.device, "threads": get_num_threads()}
        record = {**report.record(), "effects": effects, **computed, "resumed": resumed, **more}
        # A record cannot contain the time of its own write. It contains that of the previous write.
        seconds = report.seconds
        seconds[REPORT] = seconds.get(REPORT, 0.0) + self.history.record_seconds + perf_counter() - began
        record["seconds"] = dict(seconds)
        kept = committed_arrays(carried.effects) if self.history.indices else carried.effects
        self.history.append(report.index, report.time, gaussians, record, effects=kept, defer=defer, **birth)
        if birth:
            prepared = replace(prepared, roots=self.history.roots())
            self._fixed = replace(self._fixed, lengths=axis_lengths(prepared.roots))
        self._prepared, self.report = prepared, report
        if checkpoints is not None:
            committed = self.history.indices
            defer_cleanup(lambda: checkpoints.clean(committed))
