"""Solves one frame: the update as set, retries where it fails, a search for what jumped; else Θ_{t−1} stays.

Whatever fails, the next attempt starts from the committed state. Where no attempt gives a state that is plausible
(``checks``) and shows the frame (``outliers``), the state of the frame before stays, and the report says so.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from math import nan
from time import perf_counter

import numpy as np

from scas4d_core.engines.renderer import Renderer
from scas4d_core.engines.views import TrainingView
from scas4d_core.frame_outcome import Candidate, FrameOutcome
from scas4d_core.gaussians import Gaussians
from scas4d_core.robust import outliers, timing
from scas4d_core.robust.alarms import alarms_of, colours_by_camera
from scas4d_core.robust.checks import EXPOSURE, compensate_exposure, gain_of, relit, validated
from scas4d_core.robust.first_motion import OrderResult, best_order
from scas4d_core.robust.outliers import Past
from scas4d_core.robust.relocation import find_jump, shifted
from scas4d_core.robust.update_input import UpdateInput
from scas4d_core.settings import UpdateSettings
from scas4d_core.update.best_state import by_size, committed_errors, slow, within
from scas4d_core.update.frame_update import FrameUpdate
from scas4d_core.update.rates import all_begun
from scas4d_core.update.result import AS_SET, AttemptOptions, UpdateResult, UpdateTrace
from scas4d_core.update.schedule import MOST_TIMED, PROBE, Stopping
from scas4d_core.update.view_factory import ViewFactory
from scas4d_core.update.warm_start import Motion

LADDER = (
    AttemptOptions("smaller steps", rates=0.3, cold=True),
    AttemptOptions("rigid layers only", rates=0.3, rigid=True, hold_colours=True, cold=True),
)
"""The attempts that follow one whose state is not plausible."""

SEARCH = AttemptOptions("sought again", cold=True, longer=5.0)
"""From where the silhouettes say that the object is, or from where an update ended. Two of three frames of robot lost,
the next is met at 33.5 dB with five times the iterations, at 32.1 dB with twice."""


Solved = tuple[UpdateResult, Past]
"""The result of a frame, and the usual figures after it."""
Validated = tuple[UpdateResult, str | None]
"""The result of an attempt, and the fault of its state, or None."""


class FrameSolver:
    """Solves the frames of a scene.

    Args:
        updater: of the scene. factory: of its views. renderer: draws, with the settings' background and limits.

    Attributes:
        judging: seconds that checks took beside the updates.
    """

    def __init__(
        self, updater: FrameUpdate, factory: ViewFactory, renderer: Renderer, settings: UpdateSettings
    ) -> None:
        self._updater = updater
        self._renderer = renderer
        self._factory, self._rig = factory, factory.posed
        self._settings = settings
        self.judging = 0.0

    def run(self, given: UpdateInput) -> Solved:
        """Solve a frame; where it is held, the state and the motion are those given."""
        result, past = self._solved(given)
        with self._timed():
            return self._alarmed(given, result, past)

    def _alarmed(self, given: UpdateInput, result: UpdateResult, past: Past) -> Solved:
        """With the health of the cameras, the alarms, and when the pictures were taken."""
        if self._settings.reject_outliers:
            past = timing.noted(past, given.state, result, self._renderer, given.seconds, given.step, given.seed)
        means = {view.name: view.mean for view in result.views or given.views}
        alarms, past = alarms_of(
            given.past, past, outcome=result.outcome, reason=result.reason, exposure=result.exposure, sharp=given.sharp,
            offsets=result.offsets, colours=colours_by_camera(result.trace.cameras, means), same=given.same,
            left_out={*given.left_out, *result.trace.left_out},
        )  # fmt: skip
        fits = {name: outliers.health(given.past, off) for name, off in result.offsets.items()}
        alarms = alarms if self._settings.reject_outliers else []
        return replace(result, health=fits, alarms=alarms, timing=timing.timings(past)), past

    def _solved(self, given: UpdateInput) -> Solved:
        if (
            self._settings.skip_tolerance > -1
            and given.unusable is None
            and (why := self._scene_is_static(given)) is not None
        ):
            return _standing(given, UpdateTrace(kept=Candidate.PREVIOUS), given.exposure, why)
        stays = given.light_moves or given.past.light_frames >= self._settings.max_rejected_frames
        if stays and (solved := self._retry_with_light_gain(given)) is not None:
            return solved
        if given.unusable is not None:  # nothing is tried, and no patience is lost with it
            past = replace(given.past, behind=max(1, given.past.behind))
            nothing = UpdateTrace(kept=Candidate.PREVIOUS)
            return self._held(given, FrameOutcome.REJECTED_UNUSABLE, nothing, past, [], given.unusable, given.exposure)
        settings, attempts = self._settings, list[str]()
        exposure = 1.0
        if given.exposure != 1.0:
            exposure, views, suspects = compensate_exposure(
                self._factory, self._renderer, given.state, given.views, given.suspects
            )
            given = replace(given, views=views, suspects=suspects)
        result, fault = self._attempt(given, AS_SET, attempts)
        for options in LADDER:
            if fault is None:
                break
            result, fault = self._attempt(given, options, attempts)
        lost = replace(given.past, rejected=given.past.rejected + 1)  # patience ends
        if fault is not None:
            outcome = FrameOutcome.REJECTED_IMPLAUSIBLE
            return self._held(given, outcome, result.trace, lost, attempts, fault, exposure)
        if not result.trace.losses:
            return _standing(given, result.trace, exposure, "not moved")
        outcome, reason = FrameOutcome.UPDATED, ""
        if len(attempts) > 1:
            outcome, reason = FrameOutcome.RETRIED, attempts[-2]
        why = self._unmet(given, result)
        if why is not None:
            attempts[-1] += f": {why}"
            again = self._search(given, result, attempts)
            if again is not None:
                result, outcome, reason = again, FrameOutcome.RELOCATED, f"{why}; {attempts[-1]}"
            elif lost.rejected < settings.max_rejected_frames:
                outcome = FrameOutcome.REJECTED_MISFIT
                return self._held(given, outcome, result.trace, lost, attempts, why, exposure)
            else:
                reason = f"{why}, for {settings.max_rejected_frames} frames: taken as it is from here on"
                outcome = FrameOutcome.ACCEPTED
                given = replace(given, past=replace(given.past, level=nan, updates=0))
        elif outcome is FrameOutcome.UPDATED and (why := self._behind(given, result)) is not None:
            attempts[-1] += f": {why}"
            result = self._go_on(given, result, attempts)
        result = replace(result, outcome=outcome, reason=reason, attempts=attempts, exposure=exposure)
        return self._committed(given, result)

    def _scene_is_static(self, given: UpdateInput) -> str | None:
        """Why nothing has to be updated, as the pictures alone say, or None."""
        if given.same and len(given.same) == len(given.brightness):
            return "the same pictures again"
        if not given.rests or given.past.updates > 0:  # what was updated once is no frame 0 to rest at
            return None
        with self._timed():  # what most cameras do not agree on may still have moved
            fits = self._measured(given.views, given.state)
            level = outliers.level_of(given.past, fits)
        if outliers.misfits(given.past, fits, outliers.LAST_DB):  # an update shows what is wrong with a camera
            return None
        return "nothing is seen to move" if level > given.past.level - outliers.RESTS_DB else None

    def _retry_with_light_gain(self, given: UpdateInput) -> Solved | None:
        """A frame in a light that stays or moves: the colours take it on; None where the cameras show no other.

        Where the scene is shown as bright as it was, something new makes the pictures brighter: no reason to hold them.
        """
        gain = gain_of(self._renderer, given.state, given.views)
        same = gain is not None and not given.light_moves and 1 / EXPOSURE <= gain <= EXPOSURE
        if gain is None or (same and given.unusable is None):
            return None
        gain, light = (1.0, "the same light") if same else (gain, f"{gain:.2g} times the light")
        state, past = relit(given.state, gain), outliers.relit(given.past, gain)
        in_light = replace(given, state=state, past=past, exposure=1.0, light_moves=False, unusable=None)
        result, past = self._solved(in_light)
        if not result.outcome.rejected:
            return replace(result, attempts=[f"{light}, for good", *result.attempts]), past
        lost = replace(given.past, rejected=given.past.rejected + 1)
        why = f"in {light} {result.reason}"
        return self._held(given, result.outcome, result.trace, lost, result.attempts, why, given.exposure)

    def _attempt(self, given: UpdateInput, template: AttemptOptions, attempts: list[str]) -> Validated:
        name = template.name
        if self._decides(given, template):
            (result, fault, _), orders = best_order(lambda seed, faster: self._first(given, seed, faster), given.seed)
            name = f"{name}, the best of {orders} orders" if orders > 1 else name
        else:
            motion = None if template.cold else given.motion
            result = self._run(given, given.state, motion, self._options(given, template))
            result, fault = self._validated(given, given.state, result)
        attempts.append(name if fault is None else f"{name}: {fault}")
        return result, fault

    def _decides(self, given: UpdateInput, template: AttemptOptions) -> bool:
        """True for the first motion of a scene, where it may take longer than others and as long as it needs.

        A scene that goes on without its carry-over knows no camera; what was held was sought for longer already.
        """
        first = (
            given.motion is None and given.past.updates == 0 and len(given.past.places) > 0 and not given.past.rejected
        )
        return template is AS_SET and first and given.end is None and self._settings.cold_start_iterations > 1

    def _first(self, given: UpdateInput, seed: int, faster: float) -> OrderResult:
        options = replace(self._options(given, AS_SET), several=True, faster=faster)
        result = self._run(replace(given, seed=seed), given.state, None, options)
        result, fault = self._validated(given, given.state, result)
        with self._timed():
            views = [view for view in result.views or given.views if view.name not in result.trace.left_out]
            return OrderResult(result, fault, self._measured(views, result.gaussians) if result.trace.losses else {})

    def _run(self, given: UpdateInput, start: Gaussians, motion: Motion | None, how: AttemptOptions) -> UpdateResult:
        return self._updater.run(start, given.views, motion, given.seconds, given.seed, how, given.carried)

    def _validated(self, given: UpdateInput, start: Gaussians, result: UpdateResult) -> Validated:
        with self._timed():
            return validated(start, result, self._updater.hierarchy.rows, self._factory.rig.radius, given.lengths)

    @contextmanager
    def _timed(self) -> Iterator[None]:
        began = perf_counter()
        yield
        self.judging += perf_counter() - began

    def _options(self, given: UpdateInput, template: AttemptOptions) -> AttemptOptions:
        """The options of an attempt at a frame, in the manner of a template."""
        settings, past = self._settings, given.past
        longer = max(template.longer, settings.cold_start_iterations if given.motion is None else 1.0)
        most, end = round(longer * settings.iterations), None
        if given.end is not None:
            most, end = MOST_TIMED, self._until(given, template, given.end)
        stopping = Stopping(most, end=end, each=given.each, gain=settings.stop_gain, first=all_begun(settings))
        enough = {name: (1 + settings.skip_tolerance) * error for name, error in past.error.items()}
        return replace(
            template,
            stopping=stopping,
            gate=(lambda first: outliers.misfits(past, first, outliers.FIRST_DB)) if settings.reject_outliers else None,
            compare=settings.reject_outliers or settings.stop_gain > 0,
            enough=enough if settings.skip_tolerance > -1 and template is AS_SET else None,
            confirm=lambda: within(self._in_whole(given.views, given.state), enough),
            usual=past.error,
            step=given.step if given.step < given.seconds else None,
        )

    def _until(self, given: UpdateInput, template: AttemptOptions, end: float) -> float:
        """The moment by which an attempt has to be over: after held frames half is kept for a search."""
        now = perf_counter()
        return (now + end) / 2 if given.past.rejected and template is AS_SET and now < end else end

    def _unmet(self, given: UpdateInput, result: UpdateResult) -> str | None:
        if not self._settings.reject_outliers:
            return None
        with self._timed():
            return outliers.unmet(given.past, result.trace.met, len(result.trace.losses))

    def _behind(self, given: UpdateInput, result: UpdateResult) -> str | None:
        if not self._settings.reject_outliers or self._spent(given):
            return None
        return outliers.behind(given.past, result.trace.met, len(result.trace.losses))

    def _spent(self, given: UpdateInput, more: int = 0) -> bool:
        """True where the budget has no time left for another attempt, with ``more`` iterations before it."""
        return given.end is not None and perf_counter() + (PROBE + more) * (given.each or 0.0) > given.end

    def _search(self, given: UpdateInput, tried: UpdateResult, attempts: list[str]) -> UpdateResult | None:
        """Longer attempts, from where the silhouettes say that the object is, and from where ``tried`` ended.

        That is the validated end: from a Gaussian that is not finite none comes back. None: all were in vain.
        """
        if self._spent(given, len(given.views)):
            attempts.append("not sought: the budget is spent")
            return None
        ended = _as_coloured(tried.gaussians, given.state)
        starts = [("sought from where the update ended", ended)]
        jump = find_jump(given.state, given.views, self._renderer, self._rig)
        if jump is not None:
            length = float(np.linalg.norm(jump))
            starts.insert(0, (f"sought {length:.2f} m away", shifted(given.state, jump)))
        for name, start in starts:
            if self._spent(given):
                attempts.append(f"not {name}: the budget is spent")
                break
            options = self._options(given, replace(SEARCH, name=name))
            result = self._run(given, start, None, options)
            result, fault = self._validated(given, start, result)
            # A few iterations more are no excuse for meeting it less well.
            both = len(tried.trace.losses) + len(result.trace.losses)
            why = fault or outliers.unmet(given.past, result.trace.met, both)
            attempts.append(name if why is None else f"{name}: {why}")
            if why is None:
                return (result if start is not ended else result.joined(tried)).retold(tried)
        return None

    def _go_on(self, given: UpdateInput, tried: UpdateResult, attempts: list[str]) -> UpdateResult:
        """On from where an update ended, for longer; the better of both."""
        options = self._options(given, replace(SEARCH, name="on from where the update ended"))
        result = self._run(given, _as_coloured(tried.gaussians, given.state), None, options)
        result, fault = self._validated(given, given.state, result)
        after, before = (outliers.level_of(given.past, one.trace.met) for one in (result, tried))
        attempts.append(options.name if fault is None else f"{options.name}: {fault}")
        return result.joined(tried).retold(tried) if fault is None and after > before else tried

    def _held(
        self,
        given: UpdateInput,
        outcome: FrameOutcome,
        trace: UpdateTrace,
        past: Past,
        attempts: Sequence[str],
        reason: str,
        exposure: float,
    ) -> Solved:
        """A frame that is not believed: state and motion stay."""
        result = UpdateResult(
            given.state, given.motion, replace(trace, kept=Candidate.PREVIOUS), outcome=outcome, reason=reason,
            attempts=attempts, exposure=exposure, offsets=outliers.offsets(past, trace.fits), carried=given.carried,
        )  # fmt: skip
        return result, past

    def _committed(self, given: UpdateInput, result: UpdateResult) -> Solved:
        trace, psnr = result.trace, result.trace.fits
        with self._timed():
            # Short updates render a camera long before their end: one that does not fit is looked at once more.
            off = outliers.misfits(given.past, psnr, outliers.LAST_DB)
            again = [view for view in result.views or given.views if view.name in off]
            psnr |= self._measured([*again, *given.suspects], result.gaussians)
        moved = trace.kept is not Candidate.PREVIOUS or given.past.updates > 0
        past = outliers.settle(given.past, psnr, given.brightness, result.exposure, len(trace.losses), moved)
        if trace.errors.get(Candidate.END):
            errors = by_size(trace.errors[trace.kept], trace.whole)
            if self._settings.skip_tolerance > -1 and slow(trace.errors, trace.kept):
                errors |= self._in_whole(result.views or given.views, result.gaussians)
            past = replace(past, error=outliers.usual_errors(given.past.error, errors))
        motion = result.motion if result.motion is not None and result.motion.finite else None
        return replace(result, motion=motion, offsets=outliers.offsets(given.past, psnr)), past

    def _in_whole(self, views: Sequence[TrainingView], state: Gaussians) -> dict[str, float]:
        with self._timed():
            return committed_errors(self._factory.rig, self._renderer, views, state)

    def _measured(self, views: Sequence[TrainingView], state: Gaussians) -> dict[str, float]:
        """DB of cameras as a state shows them; those that are left out come back so, once they fit."""
        return {view.name: self._renderer.compare(state, view).psnr for view in views}


def _as_coloured(state: Gaussians, before: Gaussians) -> Gaussians:
    """A state in the colours of one before: those that followed a motion which was not met lead astray."""
    return state.replace(colours=before.colours)


def _standing(given: UpdateInput, trace: UpdateTrace, exposure: float, said: str) -> Solved:
    """Θ_{t−1} shows the frame: nothing was rendered that says how any camera fits, so the usual figures stay."""
    past = replace(
        given.past, rejected=0, behind=max(1, given.past.behind)
    )  # it may go on from here, or from further away
    outcome = FrameOutcome.UNCHANGED
    result = UpdateResult(
        given.state, given.motion, trace, outcome=outcome, attempts=[said], exposure=exposure, carried=given.carried
    )
    return result, past
