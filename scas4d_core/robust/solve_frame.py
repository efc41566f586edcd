"""A frame tried until it can be committed: the update as set, the ladder, the search for what jumped, or held."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from math import nan
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from scas4d_core.gaussians import Gaussians
from scas4d_core.robust import outliers as judge
from scas4d_core.robust.attempts import AS_SET, LADDER, SOUGHT, Checked, Course, Manner, checked
from scas4d_core.robust.exposure import evened, gain_of, relit
from scas4d_core.robust.outliers import Look, Past
from scas4d_core.robust.relocation import reacquire, shifted
from scas4d_core.settings import UpdateSettings
from scas4d_core.update.frame_update import Updater
from scas4d_core.update.picture_loss import PictureLoss
from scas4d_core.update.result import Updated
from scas4d_core.update.stopping import PROBE, Counted, Pace, Timed, UntilMet
from scas4d_core.update.views import TrainingView, ViewFactory
from scas4d_core.update.warm_start import Motion

ERROR_RISE = 1.02
"""Times that the usual error of a witness rises at most in an update."""

HELD = "held as it was: "
"""How the reason begins that the report gives for a frame whose state is the one before."""


@dataclass(frozen=True, eq=False)
class Given:
    """What a frame starts from.

    Attributes:
        state: Θ_{t−1}. motion: that was found last, or None. seconds: since then. step: since the frame before.
        views: of the frame, to learn from.
        suspects: views of cameras that are left out. brightness: mean of each camera's picture. seed: of the update.
        past: what is usual. look: what the pictures say. end: moment by which the last iteration has to be over.
        each: seconds of an iteration in the updates before, or None. lengths: [N, 3] metres, of the axes in frame 0.
    """

    state: Gaussians
    motion: Motion | None
    seconds: float
    step: float
    views: list[TrainingView]
    suspects: list[TrainingView]
    brightness: Mapping[str, float]
    seed: int
    past: Past
    look: Look
    end: float | None = None
    each: float | None = None
    lengths: NDArray[np.float32] | None = None


@dataclass(frozen=True, eq=False)
class Outcome:
    """What is committed.

    Attributes:
        updated: of the attempt that is committed; where the frame is held, of the last one before anything is sought.
        gaussians: Θ_t. motion: for the next update. past: what is usual now. fits: dB by camera above or below its
            usual place. held: Gaussians held one by one. degraded, attempts: see ``FrameReport``. bounded: axes set to
            the shortest or longest that they may be.
        exposure: of the frame. fresh: whether the frame was believed. stood: whether Θ_{t−1} showed it already.
    """

    updated: Updated
    gaussians: Gaussians
    motion: Motion | None
    past: Past
    fits: Mapping[str, float]
    held: int = 0
    degraded: str | None = None
    attempts: list[str] = field(default_factory=list)
    exposure: float = 1.0
    fresh: bool = True
    stood: bool = False
    bounded: int = 0


class Trial:
    """Tries the frames of a scene.

    Args:
        updater: of the scene. factory: of its views. picture: renders, with the settings' background and limits.

    Attributes:
        judging: seconds that checks took beside the updates.
    """

    def __init__(self, updater: Updater, factory: ViewFactory, picture: PictureLoss, settings: UpdateSettings) -> None:
        self._updater = updater
        self._picture = picture
        self._factory, self._rig = factory, factory.rig
        self._settings = settings
        self.judging = 0.0

    def run(self, given: Given) -> Outcome:
        """Try a frame."""
        if given.past.lit >= self._settings.patience and (outcome := self._relit(given)) is not None:
            return outcome
        if given.look.held:
            return self._unseen(given, given.look.held)
        settings, attempts = self._settings, list[str]()
        exposure = 1.0
        if given.look.exposure != 1.0:
            exposure, views, suspects = evened(self._factory, self._picture, given.state, given.views, given.suspects)
            given = replace(given, views=views, suspects=suspects)
        updated, check = self._attempt(given, AS_SET, attempts)
        for manner in LADDER:
            if check.fault is None:
                break
            updated, check = self._attempt(given, manner, attempts)
        if check.fault is not None:
            return self._held(given, updated, attempts, check.fault, exposure)
        degraded = attempts[-2] if len(attempts) > 1 else None
        if not updated.losses:
            return stood(given, updated, exposure, "not moved")
        why = self._unmet(given, updated)
        if why is not None:
            attempts[-1] += f": {why}"
            again = self._sought(given, updated, check.gaussians, attempts)
            if again is not None:
                updated, check = again
                degraded = f"{why}; {attempts[-1]}"
            elif given.past.held + 1 < settings.patience:
                return self._held(given, updated, attempts, why, exposure)
            else:
                degraded = f"{why}, for {settings.patience} frames: taken as it is from here on"
                given = replace(given, past=replace(given.past, level=nan, updates=0))
        elif degraded is None and (why := self._behind(given, updated)) is not None:
            attempts[-1] += f": {why}"
            updated, check = self._longer(given, updated, check, attempts)
        return self._committed(given, updated, check, degraded, attempts, exposure)

    def _unseen(self, given: Given, why: str) -> Outcome:
        """A frame whose pictures say nothing: the state stays, nothing is tried, and no patience is lost with it."""
        nothing = Updated.nothing(given.state, given.motion)
        past = replace(given.past, behind=max(1, given.past.behind))
        return self._stays(given, nothing, past, [], why, given.look.exposure)

    def _relit(self, given: Given) -> Outcome | None:
        """A frame in a light that has stayed: the colours take it on; None where the cameras tell of no other light.

        Where what is seen is as bright as it was, what is new makes the pictures brighter: no reason to hold them.
        """
        gain = gain_of(self._picture, given.state, given.views)
        same = gain is not None and 1 / judge.EXPOSURE <= gain <= judge.EXPOSURE
        if gain is None or (same and given.look.held is None):
            return None
        gain, light = (1.0, "the same light") if same else (gain, f"{gain:.2g} times the light")
        outcome = self.run(
            replace(
                given,
                state=relit(given.state, gain),
                past=judge.relit(given.past, gain),
                look=replace(given.look, exposure=1.0, held=None),
            )
        )
        if outcome.fresh:
            return replace(outcome, attempts=[f"{light}, for good", *outcome.attempts])
        why = f"in {light} {str(outcome.degraded).removeprefix(HELD)}"
        return self._held(given, outcome.updated, outcome.attempts, why, given.look.exposure)

    def _attempt(self, given: Given, manner: Manner, told: list[str]) -> tuple[Updated, Checked]:
        motion = None if manner.cold else given.motion
        course = self._course(given, manner)
        updated = self._updater.run(given.state, given.views, motion, given.seconds, given.seed, course)
        check = self._checked(given, given.state, updated)
        told.append(manner.name if check.fault is None else f"{manner.name}: {check.fault}")
        return updated, check

    def _checked(self, given: Given, start: Gaussians, updated: Updated) -> Checked:
        with self._timed():
            return checked(start, updated.gaussians, self._updater.hierarchy.rows, self._rig.radius, given.lengths)

    @contextmanager
    def _timed(self) -> Iterator[None]:
        began = perf_counter()
        yield
        self.judging += perf_counter() - began

    def _course(self, given: Given, manner: Manner) -> Course:
        settings, past = self._settings, given.past
        longer = max(manner.longer, settings.cold_longer if given.motion is None else 1.0)
        iterations = round(longer * settings.iterations)
        pace: Pace = Counted(iterations)
        if given.end is not None:
            pace = Timed(self._until(given, manner, given.end), given.each)
        if settings.stop_gain > 0:
            pace = UntilMet(pace, settings.stop_gain, max(settings.own_start, *settings.layer_starts))
        enough = {name: (1 + settings.still) * error for name, error in past.error.items()}
        return Course(
            pace, manner,
            gate=self._gate(given) if settings.judge else None,
            witness=settings.judge or settings.stop_gain > 0,
            enough=enough if settings.still > -1 and manner is AS_SET else None,
            step=given.step if given.step < given.seconds else None,
        )  # fmt: skip

    def _until(self, given: Given, manner: Manner, end: float) -> float:
        """The moment by which an attempt has to be over: after held frames half is kept for what may be sought."""
        now = perf_counter()
        return (now + end) / 2 if given.past.held and manner is AS_SET and now < end else end

    def _gate(self, given: Given) -> Callable[[Mapping[str, float]], Mapping[str, str]]:
        return lambda first: judge.misfits(given.past, first, judge.FIRST_DB)

    def _unmet(self, given: Given, updated: Updated) -> str | None:
        if not self._settings.judge:
            return None
        with self._timed():
            return judge.unmet(given.past, self._met(updated), len(updated.losses))

    def _behind(self, given: Given, updated: Updated) -> str | None:
        if not self._settings.judge or self._spent(given):
            return None
        return judge.behind(given.past, self._met(updated), len(updated.losses))

    def _spent(self, given: Given, more: int = 0) -> bool:
        """Whether the budget has no time left for another attempt, and as long as so many iterations take before it."""
        return given.end is not None and perf_counter() + (PROBE + more) * (given.each or 0.0) > given.end

    def _met(self, updated: Updated) -> dict[str, float]:
        """DB of the cameras that were learnt from to the end."""
        return {name: fit.psnr for name, fit in updated.cameras.items() if name not in updated.left_out}

    def _sought(
        self, given: Given, tried: Updated, ended: Gaussians, attempts: list[str]
    ) -> tuple[Updated, Checked] | None:
        """Longer, from where the silhouettes say that the object is, and from where the update ended; None: in vain.

        Args:
            ended: the end of ``tried`` as it might be committed: from a Gaussian that is not finite none comes back.
        """
        if self._spent(given, len(given.views)):
            attempts.append("not sought: the budget is spent")
            return None
        found = reacquire(given.state, given.views, self._picture, self._rig)
        starts = [("sought from where the update ended", ended)]
        if found is not None:
            length = float(np.linalg.norm(found.shift))
            starts.insert(0, (f"sought {length:.2f} m away", shifted(given.state, found.shift)))
        for name, start in starts:
            if self._spent(given):
                attempts.append(f"not {name}: the budget is spent")
                break
            course = self._course(given, replace(SOUGHT, name=name))
            updated = self._updater.run(start, given.views, None, given.seconds, given.seed, course)
            check = self._checked(given, start, updated)
            # A few iterations more are no excuse for meeting it less well.
            both = len(tried.losses) + len(updated.losses)
            why = check.fault or judge.unmet(given.past, self._met(updated), both)
            attempts.append(name if why is None else f"{name}: {why}")
            if why is None:
                return _told(updated if start is not ended else _after(updated, tried), tried), check
        return None

    def _longer(self, given: Given, tried: Updated, check: Checked, attempts: list[str]) -> tuple[Updated, Checked]:
        """On from where an update ended; the better of both."""
        manner = replace(SOUGHT, name="on from where the update ended")
        updated = self._updater.run(
            check.gaussians, given.views, None, given.seconds, given.seed, self._course(given, manner)
        )
        again = self._checked(given, given.state, updated)
        after, before = (judge.level_of(given.past, self._met(one)) for one in (updated, tried))
        attempts.append(manner.name if again.fault is None else f"{manner.name}: {again.fault}")
        better = again.fault is None and after > before
        return (_told(_after(updated, tried), tried), again) if better else (tried, check)

    def _held(self, given: Given, updated: Updated, attempts: list[str], why: str, exposure: float) -> Outcome:
        """A frame that could not be met; patience ends."""
        past = replace(given.past, held=given.past.held + 1)
        return self._stays(given, updated, past, attempts, why, exposure)

    def _stays(
        self, given: Given, updated: Updated, past: Past, attempts: list[str], why: str, exposure: float
    ) -> Outcome:
        fits = judge.place(past, {name: fit.psnr for name, fit in updated.cameras.items()})
        updated = replace(updated, kept="still")
        return Outcome(updated, given.state, given.motion, past, fits, 0, HELD + why, attempts, exposure, fresh=False)

    def _committed(
        self,
        given: Given,
        updated: Updated,
        check: Checked,
        degraded: str | None,
        attempts: list[str],
        exposure: float,
    ) -> Outcome:
        psnr = {name: fit.psnr for name, fit in updated.cameras.items()}
        with self._timed():
            # Short updates render a camera long before their end: what does not fit is looked at once more.
            off = judge.misfits(given.past, psnr, judge.LAST_DB)
            again = [view for view in given.views if view.name in off]
            psnr |= self._measured([*again, *given.suspects], check.gaussians)
        fits = judge.place(given.past, psnr)
        past = judge.settle(given.past, psnr, given.brightness, exposure, len(updated.losses))
        if updated.errors.get("end"):
            past = replace(past, error=_usual(given.past.error, updated.errors[updated.kept]))
        motion = updated.motion if updated.motion.finite else None
        return Outcome(
            updated,
            check.gaussians,
            motion,
            past,
            fits,
            check.held,
            degraded,
            attempts,
            exposure,
            bounded=check.bounded,
        )

    def _measured(self, views: list[TrainingView], state: Gaussians) -> dict[str, float]:
        """DB of cameras as a state shows them; those that are left out come back so, once they fit."""
        features = np.concatenate([state.colours, state.foreground[:, None]], axis=1)
        found = {}
        for view in views:
            self._picture.measure(state.means, state.factors, state.opacities, features, view)
            found[view.name] = self._picture.psnr
        return found


def stood(given: Given, updated: Updated, exposure: float, said: str) -> Outcome:
    """Θ_{t−1} shows the frame: nothing was rendered that says how any camera fits, so what is usual stays as it was."""
    past = replace(given.past, held=0, behind=max(1, given.past.behind))  # it may go on from here, or from further away
    return Outcome(updated, given.state, given.motion, past, {}, attempts=[said], exposure=exposure, stood=True)


def _after(updated: Updated, first: Updated) -> Updated:
    """An update that went on from where another ended: its motion is that of both."""
    return replace(updated, motion=updated.motion.after(first.motion))


def _told(updated: Updated, first: Updated) -> Updated:
    """An update that was tried again: "still" and "warm" are those of the frame before, "end" is what is committed."""
    errors = {kind: error for kind, error in first.errors.items() if kind != "end"}
    if updated.errors:
        errors["end"] = updated.errors[updated.kept]
    return replace(updated, errors=errors, kept="end")


def _usual(before: Mapping[str, float], now: Mapping[str, float]) -> dict[str, float]:
    """The errors by view that are usual: they fall at once and rise slowly.

    What a noisy frame was met with would else be enough for the next good one, which moved.
    """
    return {name: min(value, ERROR_RISE * before.get(name, value)) for name, value in now.items()}
