"""Comparison of the candidates for Θ_t on a few training views: the end of an update, its warm start, and Θ_{t−1}.

An update may end at any time. The committed state is never worse than the previous state or the extrapolated motion.
The probe views are the same in every frame, and the time to render them counts towards the update.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import nan

import numpy as np

from scas4d_core.cameras import Rig, farthest_first
from scas4d_core.engines.engine import Probe, Tables, UpdateEngine
from scas4d_core.engines.renderer import Renderer
from scas4d_core.engines.views import TrainingView
from scas4d_core.frame_outcome import Candidate
from scas4d_core.gaussians import Gaussians
from scas4d_core.structure.hierarchy import Hierarchy
from scas4d_core.update.view_factory import ViewFactory
from scas4d_core.update.warm_start import Motion, warm_start

VIEWS = 4
"""Number of probe views per frame."""
SCALE = 0.5
"""Scale of probe-view images. A quarter of the pixels is sufficient for comparing states."""
FEWEST = 80
"""Minimum side of the scaled images, in pixels. If they are smaller, full-size images are compared. With a minimum of
32, the extrapolated motion was preferred for ten consecutive frames while all cameras lost 1.2 dB."""
ALIASED = 2.0
"""Ratio between the previous state's errors in small and full-size images above which full-size images are compared.
Small images then show aliasing from Gaussians smaller than their pixels."""


def spread_cameras(rig: Rig, names: Sequence[str], count: int = VIEWS) -> list[str]:
    """Returns the names of ``count`` cameras, selected by farthest-point sampling of their centres."""
    centres = np.array([rig[name].centre for name in names])
    return [names[index] for index in farthest_first(centres, count)]


def mean_error(errors: Mapping[str, float], names: Sequence[str]) -> float:
    """Returns the mean error over the named views that have an error, or NaN if there are none."""
    values = [errors[name] for name in names if name in errors]
    return float(np.mean(values)) if values else nan


WHOLE = " whole"
"""Suffix of the names of views compared at full size, in the errors kept across frames."""

COMMITTED = " committed"
"""Suffix of the names of views in which a committed state was evaluated at full size, in the errors kept across
frames."""
CONFIRMING = 2
"""Number of views in which a committed state is evaluated. Full-size images have four times as many pixels."""
SLOW = 0.5
"""Relative excess error of Θ_{t−1} over Θ_t in small images up to which the next frame may be static. Full-size images
are evaluated only in this case."""


def label_by_size(errors: Mapping[str, float], whole: bool) -> dict[str, float]:
    """Returns errors under names that distinguish full-size images, whose errors are smaller, from scaled images.

    >>> label_by_size({"c0": 0.1}, whole=True)
    {'c0 whole': 0.1}
    """
    return {name + WHOLE if whole else name: error for name, error in errors.items()}


def probe_views(rig: Rig, views: Sequence[TrainingView], count: int = VIEWS) -> list[TrainingView]:
    """Returns the probe views, selected from the views with ``spread_cameras``."""
    chosen = set(spread_cameras(rig, [view.name for view in views], count))
    return [view for view in views if view.name in chosen]


class ProbeViews:
    """Fixed training views for comparing states. The engine loads ``views`` as the probes of a frame.

    Args:
        factory: factory of the rig's training views.
        engine: engine that computes the errors.
        views: views of the frame, from which the probe views are selected. If empty, nothing is compared.

    Attributes:
        views: the probe views at full size, followed by the scaled ones if they are used.
        whole: whether full-size images are compared; known after ``start_errors``.
    """

    def __init__(self, factory: ViewFactory, engine: UpdateEngine, views: Sequence[TrainingView]) -> None:
        whole = probe_views(factory.rig, views)
        sides = [SCALE * min(view.camera.width, view.camera.height) for view in whole]
        self.whole = bool(sides) and min(sides) < FEWEST
        small = [] if self.whole else [factory.coarser(view, SCALE) for view in whole]
        self.views = [*whole, *small]
        self._names = [view.name for view in whole]
        self._whole = range(len(whole))
        self._compared = self._whole if self.whole else range(len(whole), 2 * len(whole))
        self._engine = engine

    def start_errors(self, warm: bool) -> list[dict[str, float]]:
        """Returns the errors of Θ_{t−1} and, if ``warm``, of Θ_{t−1} deformed by the current tables.

        If the small images show aliasing in Θ_{t−1}, this call and all later ones compare full-size images.
        """
        states = [False, True] if warm else [False]
        if not self._names:
            return [{} for _ in states]
        probes = [Probe(self._compared, moved, learnt=False) for moved in states]
        if self.whole:
            losses = self._engine.probe(*probes)
        else:
            *losses, (full_size_loss,) = self._engine.probe(*probes, Probe(self._whole[:1], moved=False, learnt=False))
            if losses[0][0] > ALIASED * full_size_loss:
                self._compared, self.whole = self._whole, True
                losses = self._engine.probe(*[probe._replace(views=self._whole) for probe in probes])
        return [dict(zip(self._names, each, strict=True)) for each in losses]

    def errors(self, *, moved: bool, learnt: bool, state_next: bool = False) -> dict[str, float]:
        """Returns the image loss of a state in each probe view, keyed by camera name.

        Args:
            moved, learnt: select the state; see ``Probe``.
            state_next: whether the learnt state is read next; see ``UpdateEngine.probe``.
        """
        return self._errors(self._compared, moved, learnt, state_next)

    def full_size_errors(self, *, learnt: bool) -> dict[str, float]:
        """Returns the ``errors`` of the deformed state on full-size images."""
        return self._errors(self._whole, moved=True, learnt=learnt)

    def _errors(self, views: Sequence[int], moved: bool, learnt: bool, state_next: bool = False) -> dict[str, float]:
        if not self._names:
            return {}
        (losses,) = self._engine.probe(Probe(views, moved, learnt), state_next=state_next)
        return dict(zip(self._names, losses, strict=True))


def is_slow_motion(errors: Mapping[Candidate, Mapping[str, float]], kept: Candidate) -> bool:
    """Returns whether Θ_{t−1} fits a frame nearly as well as the kept state (``SLOW``).

    Args:
        errors: error of each candidate in each probe view.
        kept: candidate that became Θ_t.

    >>> is_slow_motion({Candidate.PREVIOUS: {"a": 1.4}, Candidate.END: {"a": 1.0}}, Candidate.END)
    True
    """
    still, ended = errors.get(Candidate.PREVIOUS, {}), errors.get(kept, {})
    return mean_error(still, list(ended)) <= (1 + SLOW) * mean_error(ended, list(ended))


def committed_errors(rig: Rig, renderer: Renderer, views: Sequence[TrainingView], state: Gaussians) -> dict[str, float]:
    """Returns the image loss of a committed state in a few full-size probe views, under separate names.

    Args:
        rig: calibrated rig, without pose drift.
        renderer: renderer that computes the image loss.
        views: views of the frame.
        state: the committed state.
    """
    chosen = probe_views(rig, views, CONFIRMING)
    compared = renderer.compare(state, chosen)
    return {view.name + COMMITTED: one.image_loss for view, one in zip(chosen, compared, strict=True)}


class BestState:
    """Selects the best start of an update and the best state at its end.

    Args:
        probes: probe views of the frame.
        engine: engine that has loaded Θ_{t−1}.
        hierarchy: hierarchy of the moving Gaussians.
        motion: motion of the previous update, or None.
        seconds: time since that motion was measured, in seconds.
        momentum: share of the motion of individual Gaussians that is extrapolated; see ``warm_start``.

    Attributes:
        errors: error of each candidate in each probe view.
        seconds: duration over which the motion is extrapolated, in seconds.
    """

    def __init__(
        self,
        probes: ProbeViews,
        engine: UpdateEngine,
        hierarchy: Hierarchy,
        motion: Motion | None,
        seconds: float,
        momentum: float,
    ) -> None:
        self._probes, self._engine, self._hierarchy = probes, engine, hierarchy
        self._motion, self._momentum = motion, momentum
        self.seconds = seconds
        self.errors: dict[Candidate, dict[str, float]] = {}
        self._warm: tuple[float, Tables] | None = None
        self._matched: Tables | None = None

    @property
    def whole(self) -> bool:
        """Whether full-size images were compared."""
        return self._probes.whole

    def start(self, step: float | None = None) -> Tables:
        """Sets the engine to the previous motion, or to no motion if that fits better, and returns the deformation.

        Args:
            step: time since the previous frame in seconds, if that frame was skipped and the motion may have paused. If
                None, the motion is extrapolated over the whole time since it was measured.
        """
        motion = self._motion
        tables = self._set(motion)
        starts = [Candidate.PREVIOUS] if motion is None else [Candidate.PREVIOUS, Candidate.WARM]
        for candidate, errors in zip(starts, self._probes.start_errors(warm=motion is not None), strict=True):
            self._record(candidate, errors)
        if motion is not None and self.errors:
            if step is not None:
                tables = self._try_after_pause(motion, step)
            if self._mean(Candidate.PREVIOUS) < self._mean(Candidate.WARM):
                tables = self._set(None)
        return tables

    def _try_after_pause(self, motion: Motion, step: float) -> Tables:
        """Extrapolates the motion only over the last ``step`` seconds if that fits better; returns the deformation."""
        whole, errors = self.seconds, self.errors[Candidate.WARM]
        self.seconds = step
        tables = self._set(motion)
        self._record(Candidate.WARM, self._probes.errors(moved=True, learnt=False))
        if mean_error(errors, list(errors)) <= self._mean(Candidate.WARM):
            self.seconds, self.errors[Candidate.WARM] = whole, errors
            tables = self._set(motion)
        return tables

    def is_far(self, reference_errors: Mapping[str, float] | None, ratio: float) -> bool:
        """Returns whether the start's error exceeds the usual error of updates by a factor, or no error is usual yet.

        Args:
            reference_errors: errors at the end of previous updates, named as by ``label_by_size``.
            ratio: the factor.
        """
        if not self.errors:
            return False
        started = min(self.errors.values(), key=lambda errors: _nan_to_inf(mean_error(errors, list(errors))))
        named = label_by_size(started, self.whole)
        names = sorted(named.keys() & (reference_errors or {}).keys())
        return not names or mean_error(named, names) > ratio * mean_error(reference_errors or {}, names)

    def start_from(self, tables: Tables, matched: Tables | None, gain: float) -> Tables:
        """Sets the engine to another start if its error is lower by at least the share ``gain``.

        Returns the deformation from which the update starts, which is ``tables`` if the other does not fit better.
        """
        if matched is None:
            return tables
        self._engine.set_tables(matched)
        errors = self._probes.errors(moved=True, learnt=False)
        now = min(self._mean(Candidate.PREVIOUS), self._mean(Candidate.WARM))
        if mean_error(errors, list(errors)) <= (1 - gain) * now:
            self._matched = matched
            self._record(Candidate.WARM, errors)
            return matched
        self._engine.set_tables(tables)
        return tables

    def can_skip(self, skip_below: Mapping[str, float] | None, confirm_skip: Callable[[], bool] | None = None) -> bool:
        """Returns whether Θ_{t−1} fits this frame within ``skip_below`` and ``confirm_skip`` agrees.

        Args:
            skip_below: maximum error of each view, named as by ``label_by_size``. If None, the result is false.
            confirm_skip: function that confirms the skip, called only if the errors allow it, or None for no
                confirmation.
        """
        still = self.errors.get(Candidate.PREVIOUS)
        if (
            skip_below is None
            or still is None
            or self._mean(Candidate.PREVIOUS) > self._mean(Candidate.WARM, otherwise=np.inf)
        ):
            return False
        return mean_is_within(label_by_size(still, self.whole), skip_below) and (confirm_skip is None or confirm_skip())

    def unexplained(self, reference_errors: Mapping[str, float] | None) -> float:
        """Returns the share of the change since Θ_{t−1} that the previous motion does not explain, about 0 to 1.

        The result is 1 if nothing is compared, there was no previous motion, or nothing has changed.

        Args:
            reference_errors: errors at the end of previous updates, named as by ``label_by_size``. They are subtracted,
                because no motion can reduce the error of the static scene.
        """
        still, warm = (self.errors.get(candidate) for candidate in (Candidate.PREVIOUS, Candidate.WARM))
        if still is None or warm is None or not reference_errors:
            return 1.0
        names = sorted(label_by_size(still, self.whole).keys() & reference_errors.keys())
        if not names:
            return 1.0
        unmoved, led = (mean_error(label_by_size(errors, self.whole), names) for errors in (still, warm))
        met = mean_error(reference_errors, names)
        return (led - met) / (unmoved - met) if unmoved > met else 1.0

    def error(self) -> float:
        """Returns the mean error of the update's current state on the probe views."""
        errors = self._probes.errors(moved=True, learnt=True)
        return mean_error(errors, list(errors))

    def end(self, iterations: int, left_out: Mapping[str, str]) -> Candidate:
        """Returns the best candidate, and sets the engine's tables to it.

        Args:
            iterations: number of iterations in the update.
            left_out: maps each camera to ignore to the reason.
        """
        if not self.errors:
            return Candidate.END
        if iterations:
            self._record(Candidate.END, self._probes.errors(moved=True, learnt=True, state_next=True))
        names = [name for name in self.errors[Candidate.PREVIOUS] if name not in left_out]
        # the first of equal candidates wins
        compared = [candidate for candidate in Candidate if candidate in self.errors]
        best = min(compared, key=lambda candidate: _nan_to_inf(mean_error(self.errors[candidate], names)))
        if best is not Candidate.END and iterations and not self.whole:
            best = self._best_at_full_size(best, left_out)
        if best is not Candidate.END:
            self._set_candidate(best)
        return best

    def _best_at_full_size(self, best: Candidate, left_out: Mapping[str, str]) -> Candidate:
        """Returns the best candidate on full-size images, which may reveal slow motion; ``best`` wins ties.

        The engine's tables are unchanged afterwards.
        """
        ended = self._engine.tables()
        errors = {Candidate.END: self._full_size_error(True, left_out)}
        for candidate in self.errors.keys() - {Candidate.END}:
            self._set_candidate(candidate)
            errors[candidate] = self._full_size_error(False, left_out)
        self._engine.set_tables(ended)
        return min(errors, key=lambda candidate: (errors[candidate], candidate is not best))

    def _set_candidate(self, candidate: Candidate) -> None:
        """Sets the engine's tables to the start of a candidate."""
        if candidate is Candidate.WARM and self._matched is not None:
            self._engine.set_tables(self._matched)
        else:
            self._set(self._motion if candidate is Candidate.WARM else None)

    def _set(self, motion: Motion | None) -> Tables:
        if motion is None:
            tables = Tables.identity(self._hierarchy)
        elif self._warm is not None and self._warm[0] == self.seconds:
            tables = self._warm[1]
        else:
            tables = warm_start(self._hierarchy, motion, self.seconds, self._momentum)
            self._warm = self.seconds, tables  # an engine uploads the same tables only once
        self._engine.set_tables(tables)
        return tables

    def _record(self, candidate: Candidate, errors: dict[str, float]) -> None:
        if errors:
            self.errors[candidate] = errors

    def _full_size_error(self, learnt: bool, left_out: Mapping[str, str]) -> float:
        """Returns the mean error on full-size images of all cameras not in ``left_out``, or infinity for NaN."""
        errors = self._probes.full_size_errors(learnt=learnt)
        return _nan_to_inf(mean_error(errors, [name for name in errors if name not in left_out]))

    def _mean(self, candidate: Candidate, otherwise: float = np.inf) -> float:
        errors = self.errors.get(candidate)
        return otherwise if errors is None else mean_error(errors, list(errors))


def mean_is_within(errors: Mapping[str, float], limits: Mapping[str, float]) -> bool:
    """Returns whether the mean error of the views that have a limit is at most the mean limit; false if there are none.

    >>> mean_is_within({"a": 1.0, "b": 3.0}, {"a": 2.0, "b": 2.0}), mean_is_within({"a": 1.0}, {"b": 2.0})
    (True, False)
    """
    names = sorted(errors.keys() & limits.keys())
    return bool(names) and mean_error(errors, names) <= mean_error(limits, names)


def _nan_to_inf(value: float) -> float:
    """Returns the value, or infinity for NaN, which then sorts last."""
    return value if value == value else np.inf
