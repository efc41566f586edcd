"""Solves one frame: a regular update, retries if it fails, and a search for objects that jumped.

Every new attempt starts from the committed state. If no attempt produces a state that is plausible (``checks``) and
fits the frame (``outliers``), the previous state is kept and the report states the reason.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from math import nan
from time import perf_counter

import numpy as np

from scas4d_core.engines.renderer import Renderer
from scas4d_core.engines.views import TrainingView
from scas4d_core.frame_outcome import Candidate, FrameOutcome
from scas4d_core.gaussians import Gaussians
from scas4d_core.robust import outliers, timing
from scas4d_core.robust.alarms import CAMERA_GAIN, alarms_of, colours_by_camera, log_gains, mean_differences
from scas4d_core.robust.checks import (
    EXPOSURE,
    check_plausible,
    compensate_exposure,
    measure_light_gain,
    with_light_gain,
)
from scas4d_core.robust.confirmed_errors import MAX_WITNESSES, ImageErrors
from scas4d_core.robust.first_motion import OrderResult, best_order
from scas4d_core.robust.lens_dirt import ShiftedRegion, shifted_region
from scas4d_core.robust.outliers import Past
from scas4d_core.robust.relocation import find_jump, shift_moving
from scas4d_core.robust.update_input import UpdateInput
from scas4d_core.settings import UpdateSettings
from scas4d_core.update.best_state import (
    committed_errors,
    is_slow_motion,
    label_by_size,
    mean_is_within,
    spread_cameras,
)
from scas4d_core.update.frame_update import FrameUpdate
from scas4d_core.update.rates import latest_start
from scas4d_core.update.result import AS_CONFIGURED, AttemptOptions, Current, UpdateResult, UpdateTrace
from scas4d_core.update.schedule import MAX_TIMED, PROBE, Stopping
from scas4d_core.update.view_factory import ViewFactory
from scas4d_core.update.warm_start import Motion

LADDER = (
    AttemptOptions("smaller steps", rates=0.3, cold=True, match_patches=False),
    AttemptOptions("rigid layers only", rates=0.3, rigid=True, freeze_colours=True, cold=True, match_patches=False),
)
"""Options of additional attempts, which are made in order until the resulting state is plausible."""

SEARCH = AttemptOptions("longer search", cold=True, iteration_factor=5.0)
"""Options of a search from the position that silhouettes suggest, or from the end of the update. If two of three frames
of `robot` are lost, the next one reaches 33.5 dB with this factor, and 32.1 dB with a factor of 2."""

REFERENCES = 6
"""Approximate number of cameras whose confirmed errors count as usual."""

LONGEST_GAP = 3
"""Largest factor on the iterations of an update after missing frames; the factor is the gap between the frames."""

Solved = tuple[UpdateResult, Past]
"""The result of a frame, and the usual values after it."""
Validated = tuple[UpdateResult, str | None]
"""The result of an attempt, and the problem with its state, or None."""


class FrameSolver:
    """Solves the frames of a scene with updates, retries and searches.

    Args:
        updater: runs the updates of the scene.
        factory: factory that creates the scene's training views.
        renderer: renderer with the background and limits of the settings.
        settings: update settings.

    Attributes:
        check_seconds: time spent on checks outside the updates, in seconds.
    """

    def __init__(
        self, updater: FrameUpdate, factory: ViewFactory, renderer: Renderer, settings: UpdateSettings
    ) -> None:
        self._updater = updater
        self._renderer = renderer
        self._factory, self._rig = factory, factory.posed
        self._settings = settings
        self.check_seconds = 0.0

    def run(self, given: UpdateInput) -> Solved:
        """Returns the result of a frame, and the usual values after it.

        If the frame is rejected, the result contains the state and the motion of the input.
        """
        result, past = self._solve(given)
        with self._time_checks():
            return self._with_alarms(given, result, past)

    def _with_alarms(self, given: UpdateInput, result: UpdateResult, past: Past) -> Solved:
        """Returns a result with the camera health, the alarms and the camera timing added, and the usual values."""
        health = {name: outliers.health(given.past, off) for name, off in result.offsets.items()}
        if not self._settings.reject_outliers:
            return replace(result, health=health, timing=timing.timings(past)), past
        past = timing.record_timing(past, given.state, result, self._renderer, given.seconds, given.step, given.seed)
        views, trace = result.views or given.views, result.trace
        means = {view.name: view.mean for view in views}
        used = [view for view in views if view.name not in trace.left_out]
        images = ImageErrors(used, self._factory, self._renderer, result.gaussians)

        def region(name: str) -> ShiftedRegion | None:
            spent = self._budget_is_spent(given, MAX_WITNESSES)
            return None if spent else shifted_region(images, name)

        alarms, past = alarms_of(
            given.past, past, outcome=result.outcome, reason=result.reason, exposure=result.exposure, sharp=given.sharp,
            offsets=result.offsets, colours=colours_by_camera(trace.cameras, means), same=given.same,
            gains=(log_gains(given.views) if CAMERA_GAIN in given.carried else {}, log_gains(views)),
            differences=mean_differences({name: fit for name, fit in trace.cameras.items() if name in trace.met}),
            region=region, left_out={*given.left_out, *trace.left_out},
        )  # fmt: skip
        return replace(result, health=health, alarms=alarms, timing=timing.timings(past)), past

    def _solve(self, given: UpdateInput) -> Solved:
        if (
            self._settings.skip_tolerance > -1
            and given.unusable is None
            and (why := self._scene_is_static(given)) is not None
        ):
            return _skipped(given, UpdateTrace(kept=Candidate.PREVIOUS), given.exposure, why)
        stays = given.light_moves or given.past.light_frames >= self._settings.max_rejected_frames
        if stays and (solved := self._retry_with_light_gain(given)) is not None:
            return solved
        if given.unusable is not None:  # nothing is tried, and the frame does not count as rejected
            past = replace(given.past, lagging_frames=max(1, given.past.lagging_frames))
            nothing = UpdateTrace(kept=Candidate.PREVIOUS)
            return self._rejected(
                given, FrameOutcome.REJECTED_UNUSABLE, nothing, past, [], given.unusable, given.exposure
            )
        settings, attempts = self._settings, list[str]()
        exposure = 1.0
        if given.exposure != 1.0:
            exposure, views, suspects = compensate_exposure(
                self._factory, self._renderer, given.state, given.views, given.suspects
            )
            given = replace(given, views=views, suspects=suspects)
        result, fault = self._attempt(given, AS_CONFIGURED, attempts)
        for options in LADDER:
            if fault is None:
                break
            result, fault = self._attempt(given, options, attempts)
        lost = replace(given.past, rejected=given.past.rejected + 1)  # counts towards max_rejected_frames
        if fault is not None:
            outcome = FrameOutcome.REJECTED_IMPLAUSIBLE
            return self._rejected(given, outcome, result.trace, lost, attempts, fault, exposure)
        if not result.trace.losses:
            return _skipped(given, result.trace, exposure, "no motion")
        outcome, reason = FrameOutcome.UPDATED, ""
        if len(attempts) > 1:
            outcome, reason = FrameOutcome.RETRIED, attempts[-2]
        why = self._misfit_reason(given, result)
        if why is not None:
            attempts[-1] += f": {why}"
            again = self._search(given, result, attempts)
            if again is not None:
                result, outcome, reason = again, FrameOutcome.RELOCATED, f"{why}; {attempts[-1]}"
            elif self._misfit_is_confirmed(given, result):
                reason = f"{why}; accepted, because several cameras show the same new content"
                outcome = FrameOutcome.ACCEPTED
                given = replace(given, past=replace(given.past, level=nan, updates=0))
            elif lost.rejected < settings.max_rejected_frames:
                outcome = FrameOutcome.REJECTED_MISFIT
                return self._rejected(given, outcome, result.trace, lost, attempts, why, exposure)
            else:
                reason = f"{why}, for {settings.max_rejected_frames} frames; accepted as the new normal"
                outcome = FrameOutcome.ACCEPTED
                given = replace(given, past=replace(given.past, level=nan, updates=0))
        elif outcome is FrameOutcome.UPDATED and (why := self._lag_reason(given, result)) is not None:
            attempts[-1] += f": {why}"
            result = self._continue_update(given, result, attempts)
        result = replace(result, outcome=outcome, reason=reason, attempts=attempts, exposure=exposure)
        return self._accepted(given, result)

    def _scene_is_static(self, given: UpdateInput) -> str | None:
        """Returns the reason why the images do not require an update, or None."""
        if given.same and len(given.same) == len(given.brightness):
            return "repeated images"
        if not given.may_be_static or given.past.updates > 0:  # only a scene without any update can still be at frame 0
            return None
        with self._time_checks():  # there may be motion that most cameras do not confirm
            fits = self._psnr_by_camera(given.views, given.state)
            level = outliers.level_of(given.past, fits)
        if outliers.misfits(given.past, fits, outliers.LAST_DB):  # an update will show what is wrong with the camera
            return None
        return "no motion detected" if level > given.past.level - outliers.RESTS_DB else None

    def _retry_with_light_gain(self, given: UpdateInput) -> Solved | None:
        """Solves a frame under permanently changed lighting by scaling the colours of the scene.

        If the lighting is unchanged, a frame that seemed unusable is solved without scaling, because only a new object
        made its images brighter or darker. Returns None if the frame is usable and its lighting is unchanged, or if no
        gain can be measured.
        """
        gain = measure_light_gain(self._renderer, given.state, given.views)
        same = gain is not None and not given.light_moves and 1 / EXPOSURE <= gain <= EXPOSURE
        if gain is None or (same and given.unusable is None):
            return None
        gain, light = (1.0, "unchanged lighting") if same else (gain, f"lighting scaled by {gain:.2g}")
        state, past = with_light_gain(given.state, gain), outliers.past_in_light(given.past, gain)
        in_light = replace(given, state=state, past=past, exposure=1.0, light_moves=False, unusable=None)
        result, past = self._solve(in_light)
        if not result.outcome.rejected:
            return replace(result, attempts=[f"{light}, permanently", *result.attempts]), past
        lost = replace(given.past, rejected=given.past.rejected + 1)
        why = f"with {light}, {result.reason}"
        return self._rejected(given, result.outcome, result.trace, lost, result.attempts, why, given.exposure)

    def _attempt(self, given: UpdateInput, template: AttemptOptions, attempts: list[str]) -> Validated:
        name = template.name
        if self._is_first_motion(given, template):
            (result, fault, _), orders = best_order(
                lambda seed, layer_rate_factor: self._run_one_order(given, seed, layer_rate_factor), given.seed
            )
            name = f"{name}, best of {orders} view orders" if orders > 1 else name
        else:
            motion = None if template.cold else given.motion
            result = self._run(given, given.state, motion, self._options(given, template))
            result, fault = self._check_plausible(given, given.state, result)
        attempts.append(name if fault is None else f"{name}: {fault}")
        return result, fault

    def _is_first_motion(self, given: UpdateInput, template: AttemptOptions) -> bool:
        """Returns whether an attempt is the first with motion in its scene, and is not limited in time.

        A scene that resumes without its carry-over does not count, because it has no usual values for its cameras. Nor
        does a scene after rejected frames, for which a longer search has already been made.
        """
        first = (
            given.motion is None
            and given.past.updates == 0
            and len(given.past.camera_levels) > 0
            and not given.past.rejected
        )
        return template is AS_CONFIGURED and first and given.end is None and self._settings.cold_start_iterations > 1

    def _run_one_order(self, given: UpdateInput, seed: int, layer_rate_factor: float) -> OrderResult:
        options = replace(
            self._options(given, AS_CONFIGURED),
            several_orders=True,
            layer_rate_factor=layer_rate_factor,
            match_patches=seed == given.seed,  # the orders start differently, because matches may be wrong
        )
        result = self._run(replace(given, seed=seed), given.state, None, options)
        result, fault = self._check_plausible(given, given.state, result)
        with self._time_checks():
            views = [view for view in result.views or given.views if view.name not in result.trace.left_out]
            return OrderResult(
                result, fault, self._psnr_by_camera(views, result.gaussians) if result.trace.losses else {}
            )

    def _run(self, given: UpdateInput, start: Gaussians, motion: Motion | None, how: AttemptOptions) -> UpdateResult:
        return self._updater.run(start, given.views, motion, given.seconds, given.seed, how, given.carried)

    def _check_plausible(self, given: UpdateInput, start: Gaussians, result: UpdateResult) -> Validated:
        with self._time_checks():
            return check_plausible(start, result, self._updater.hierarchy.rows, self._factory.rig.radius, given.lengths)

    @contextmanager
    def _time_checks(self) -> Iterator[None]:
        began = perf_counter()
        yield
        self.check_seconds += perf_counter() - began

    def _options(self, given: UpdateInput, template: AttemptOptions) -> AttemptOptions:
        """Returns the options of an attempt at a frame, based on a template."""
        settings, past = self._settings, given.past
        iteration_factor = max(
            template.iteration_factor,
            settings.cold_start_iterations if given.motion is None else 1.0,
            min(given.gap, LONGEST_GAP),
        )
        most, end = round(iteration_factor * settings.iterations), None
        if given.end is not None:
            most, end = MAX_TIMED, self._attempt_deadline(given, template, given.end)
        stopping = Stopping(
            most,
            end=end,
            iteration_seconds=given.iteration_seconds,
            gain=settings.stop_gain,
            first=latest_start(settings),
        )
        skip_below = {name: (1 + settings.skip_tolerance) * error for name, error in past.error.items()}
        return replace(
            template,
            stopping=stopping,
            gate=partial(self._find_outliers, given) if settings.reject_outliers else None,
            compare=settings.reject_outliers or settings.stop_gain > 0,
            skip_below=skip_below if settings.skip_tolerance > -1 and template is AS_CONFIGURED else None,
            confirm_skip=lambda: mean_is_within(self._full_size_errors(given.views, given.state), skip_below),
            reference_errors=past.error,
            step=given.step if given.step < given.seconds else None,
        )

    def _attempt_deadline(self, given: UpdateInput, template: AttemptOptions, end: float) -> float:
        """Returns the deadline of an attempt. After rejected frames, it reserves half of the time left for a search."""
        now = perf_counter()
        return (now + end) / 2 if given.past.rejected and template is AS_CONFIGURED and now < end else end

    def _misfit_reason(self, given: UpdateInput, result: UpdateResult) -> str | None:
        if not self._settings.reject_outliers:
            return None
        with self._time_checks():
            return outliers.misfit_reason(given.past, result.trace.met, len(result.trace.losses))

    def _misfit_is_confirmed(self, given: UpdateInput, result: UpdateResult) -> bool:
        """Returns whether a state fits its frame as usual without the errors that other cameras confirm.

        An object that the state does not contain yet causes such errors. A damaged image has errors everywhere, which
        are not confirmed, because they do not stand out.
        """
        if self._budget_is_spent(given, len(given.views)):
            return False
        with self._time_checks():
            views = [view for view in result.views or given.views if view.name in result.trace.met]
            names = spread_cameras(self._rig, [view.name for view in views], MAX_WITNESSES)
            views = [view for view in views if view.name in names]
            images = ImageErrors(views, self._factory, self._renderer, result.gaussians)
            credits = images.credited_decibels(names)
            credited = {name: result.trace.met[name] + credit for name, credit in credits.items()}
            return outliers.misfit_reason(given.past, credited, len(result.trace.losses)) is None

    def _lag_reason(self, given: UpdateInput, result: UpdateResult) -> str | None:
        if not self._settings.reject_outliers or self._budget_is_spent(given):
            return None
        return outliers.lag_reason(given.past, result.trace.met, len(result.trace.losses))

    def _budget_is_spent(self, given: UpdateInput, more: int = 0) -> bool:
        """Returns whether the time budget leaves no room for another attempt after ``more`` iterations."""
        return given.end is not None and perf_counter() + (PROBE + more) * (given.iteration_seconds or 0.0) > given.end

    def _search(self, given: UpdateInput, tried: UpdateResult, attempts: list[str]) -> UpdateResult | None:
        """Runs longer attempts from the position that silhouettes suggest, and from the end of ``tried``.

        The end of ``tried`` has been validated, because non-finite Gaussians cannot recover. Returns None if all
        attempts fail or there is no time for any.
        """
        if self._budget_is_spent(given, len(given.views)):
            attempts.append("no search: the time budget is used up")
            return None
        ended = _with_colours_of(tried.gaussians, given.state)
        starts = [("search from the end of the update", ended)]
        jump = find_jump(given.state, given.views, self._renderer, self._rig)
        if jump is not None:
            length = float(np.linalg.norm(jump))
            starts.insert(0, (f"search from a position {length:.2f} m away", shift_moving(given.state, jump)))
        for name, start in starts:
            if self._budget_is_spent(given):
                attempts.append(f"no {name}: the time budget is used up")
                break
            options = self._options(given, replace(SEARCH, name=name))
            result = self._run(given, start, None, options)
            result, fault = self._check_plausible(given, start, result)
            # The tolerance for fewer iterations must not excuse a worse fit, so both attempts' iterations count.
            both = len(tried.trace.losses) + len(result.trace.losses)
            why = fault or outliers.misfit_reason(given.past, result.trace.met, both)
            attempts.append(name if why is None else f"{name}: {why}")
            if why is None:
                return (result if start is not ended else result.with_motion_after(tried)).with_errors_of(tried)
        return None

    def _continue_update(self, given: UpdateInput, tried: UpdateResult, attempts: list[str]) -> UpdateResult:
        """Continues an update from its end with more iterations, and returns the better of both results."""
        options = self._options(given, replace(SEARCH, name="continued from the end of the update"))
        result = self._run(given, _with_colours_of(tried.gaussians, given.state), None, options)
        result, fault = self._check_plausible(given, given.state, result)
        after, before = (outliers.level_of(given.past, one.trace.met) for one in (result, tried))
        attempts.append(options.name if fault is None else f"{options.name}: {fault}")
        return result.with_motion_after(tried).with_errors_of(tried) if fault is None and after > before else tried

    def _rejected(
        self,
        given: UpdateInput,
        outcome: FrameOutcome,
        trace: UpdateTrace,
        past: Past,
        attempts: Sequence[str],
        reason: str,
        exposure: float,
    ) -> Solved:
        """Returns the result of a rejected frame, with the state and the motion unchanged."""
        result = UpdateResult(
            given.state, given.motion, replace(trace, kept=Candidate.PREVIOUS), outcome=outcome, reason=reason,
            attempts=attempts, exposure=exposure, offsets=outliers.offsets(past, trace.fits), carried=given.carried,
        )  # fmt: skip
        return result, past

    def _accepted(self, given: UpdateInput, result: UpdateResult) -> Solved:
        trace, psnr = result.trace, result.trace.fits
        with self._time_checks():
            # The last renderings are from different iterations. If a camera fits badly, all are compared in one state.
            off, views = outliers.offsets(given.past, psnr), result.views or given.views
            doubtful = [name for name, value in off.items() if outliers.in_doubt(given.past, value)]
            psnr |= self._psnr_by_camera([*(views if doubtful else ()), *given.suspects], result.gaussians)
            if doubtful and self._settings.reject_outliers:
                used = [view for view in views if view.name not in trace.left_out]
                psnr = self._with_credit(given.past, psnr, doubtful, used, result.gaussians)
        moved = trace.kept is not Candidate.PREVIOUS or given.past.updates > 0
        past = outliers.past_after_update(given.past, psnr, given.brightness, result.exposure, len(trace.losses), moved)
        if trace.errors.get(Candidate.END):
            errors = label_by_size(trace.errors[trace.kept], trace.whole)
            if self._settings.skip_tolerance > -1 and is_slow_motion(trace.errors, trace.kept):
                errors |= self._full_size_errors(result.views or given.views, result.gaussians)
            past = replace(past, error=outliers.usual_errors(given.past.error, errors))
        motion = result.motion if result.motion is not None and result.motion.finite else None
        return replace(result, motion=motion, offsets=outliers.offsets(given.past, psnr)), past

    def _full_size_errors(self, views: Sequence[TrainingView], state: Gaussians) -> dict[str, float]:
        with self._time_checks():
            return committed_errors(self._factory.rig, self._renderer, views, state)

    def _find_outliers(self, given: UpdateInput, first: Mapping[str, float], current: Current) -> Mapping[str, str]:
        """Returns the cameras that contradict the others, with the reasons; see ``AttemptOptions.gate``.

        The first renderings are from different iterations. The cameras that fit worst are therefore compared with the
        others again, in one state.
        """
        doubtful = outliers.misfits(given.past, first, outliers.FIRST_DB)
        if not doubtful:
            return {}
        state, views = current()
        psnr = self._with_credit(given.past, self._psnr_by_camera(views, state), list(doubtful), views, state)
        out = outliers.misfits(given.past, psnr, outliers.FIRST_DB)
        return {name: reason for name, reason in out.items() if name in doubtful}

    def _with_credit(
        self,
        past: Past,
        psnr: Mapping[str, float],
        doubtful: Sequence[str],
        views: Sequence[TrainingView],
        state: Gaussians,
    ) -> dict[str, float]:
        """Returns the PSNR of each camera in dB, for doubtful ones without the errors that other cameras confirm.

        Only confirmed errors in excess of those of the other cameras count. A credited camera fits at most as usual.

        Args:
            past: usual values of the cameras.
            psnr: PSNR of each camera in dB.
            doubtful: names of the cameras that may be faulty.
            views: views of the cameras that are used.
            state: state to compare the views with.
        """
        low = {name: -off for name, off in outliers.offsets(past, psnr).items() if name in doubtful and off < 0}
        if not low:
            return dict(psnr)
        views = [view for view in views if not past.is_left_out(view.name)]
        others = [view.name for view in views if view.name not in doubtful]
        others = others[:: max(1, len(others) // REFERENCES)]
        credits = ImageErrors(views, self._factory, self._renderer, state).credited_decibels([*low, *others])
        usual = float(np.median([credits[name] for name in others])) if others else 0.0
        excess = {name: min(max(credits[name] - usual, 0.0), low[name]) for name in low if name in credits}
        return {**psnr, **{name: psnr[name] + credit for name, credit in excess.items()}}

    def _psnr_by_camera(self, views: Sequence[TrainingView], state: Gaussians) -> dict[str, float]:
        """Returns the PSNR of a state in each view in dB, keyed by camera name."""
        compared = self._renderer.compare(state, views)
        return {view.name: one.psnr for view, one in zip(views, compared, strict=True)}


def _with_colours_of(state: Gaussians, before: Gaussians) -> Gaussians:
    """Returns the state with the colours of ``before``, because colours fitted to a wrong motion are misleading."""
    return state.replace(colours=before.colours)


def _skipped(given: UpdateInput, trace: UpdateTrace, exposure: float, reason: str) -> Solved:
    """Returns the result of a skipped frame, with the state, the motion and the usual fit of cameras unchanged."""
    past = replace(
        given.past, rejected=0, lagging_frames=max(1, given.past.lagging_frames)
    )  # the motion may continue from here or from farther away
    outcome = FrameOutcome.UNCHANGED
    result = UpdateResult(
        given.state, given.motion, trace, outcome=outcome, attempts=[reason], exposure=exposure, carried=given.carried
    )
    return result, past
