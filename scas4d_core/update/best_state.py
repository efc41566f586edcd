"""Comparison of the candidates for Θ_t on a few training views: the end of an update, its warm start, Θ_{t−1}.

An update may end at any moment: what it commits is never worse than not moving, or than going on as before. The probe
views are the same in every frame; rendering them is a part of the update's time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import nan

import numpy as np

from scas4d_core.cameras import Rig, farthest_first
from scas4d_core.engines.engine import Tables, UpdateEngine
from scas4d_core.engines.renderer import Renderer
from scas4d_core.engines.views import TrainingView
from scas4d_core.frame_outcome import Candidate
from scas4d_core.gaussians import Gaussians
from scas4d_core.structure.hierarchy import Hierarchy
from scas4d_core.update.view_factory import ViewFactory
from scas4d_core.update.warm_start import Motion, warm_start

VIEWS = 4
"""Probe views of a frame."""
SCALE = 0.5
"""Of their pictures: a quarter of the pixels decides as well which state is better, ..."""
FEWEST = 80
"""... unless they would have fewer pixels on a side: with 32 a motion that merely went on was preferred for ten frames
in a row, while all cameras lost 1.2 dB; ..."""
ALIASED = 2.0
"""... or the state before is met so many times worse in small pictures than in whole ones: then they show Gaussians
smaller than their pixels, and no motion, and whole pictures are compared."""


def spread_cameras(rig: Rig, names: Sequence[str], count: int = VIEWS) -> list[str]:
    """So many of the cameras, as far apart as can be: each next one is the farthest from those taken."""
    centres = np.array([rig[name].centre for name in names])
    return [names[index] for index in farthest_first(centres, count)]


def mean_error(errors: Mapping[str, float], names: Sequence[str]) -> float:
    """Mean over the named views that there are; NaN where there is none."""
    values = [errors[name] for name in names if name in errors]
    return float(np.mean(values)) if values else nan


WHOLE = " whole"
"""Behind the names of views whose whole pictures were compared, where errors of several frames stand together."""

COMMITTED = " committed"
"""Behind the names of views in whose whole pictures a committed state was looked at."""
CONFIRMING = 2
"""Such views: whole pictures have four times the pixels of small ones."""
SLOW = 0.5
"""Share that Θ_{t−1} has more error than Θ_t in small pictures, where the next frame may stand: only then are whole
ones looked at."""


def label_by_size(errors: Mapping[str, float], whole: bool) -> dict[str, float]:
    """Errors under names that distinguish whole pictures, whose errors are smaller, from small ones.

    >>> label_by_size({"c0": 0.1}, whole=True)
    {'c0 whole': 0.1}
    """
    return {name + WHOLE if whole else name: error for name, error in errors.items()}


def probe_views(rig: Rig, views: Sequence[TrainingView], count: int = VIEWS) -> list[TrainingView]:
    """Those of the views that compare states, ``spread_cameras`` over the rig."""
    chosen = set(spread_cameras(rig, [view.name for view in views], count))
    return [view for view in views if view.name in chosen]


class ProbeViews:
    """Fixed training views for comparing states: the engine gets ``views`` as the probes of a frame.

    Args:
        factory: of the rig. engine: compares. views: of the frame; ``spread_cameras`` of them are taken; of none
            nothing is compared.

    Attributes:
        views: the whole pictures, then the small ones, if these are compared.
        whole: whether whole pictures are compared; known once a state was.
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
        self._engine, self._looked = engine, self.whole

    def errors(self, *, moved: bool, learnt: bool) -> dict[str, float]:
        """The image loss of a state in each view, by the camera's name.

        Args:
            moved, learnt: which state, see ``UpdateEngine.probe``.
        """
        if not self._looked and self._names:  # the first state that is asked for is that of the frame before
            self._looked = True
            small, whole = (
                self._engine.probe([views[0]], moved=moved, learnt=learnt)[0] for views in (self._compared, self._whole)
            )
            if small > ALIASED * whole:
                self._compared, self.whole = self._whole, True
        return self._errors(self._compared, moved, learnt)

    def full_size_errors(self, *, moved: bool, learnt: bool) -> dict[str, float]:
        """As ``errors``, in whole pictures."""
        return self._errors(self._whole, moved, learnt)

    def _errors(self, which: Sequence[int], moved: bool, learnt: bool) -> dict[str, float]:
        return dict(zip(self._names, self._engine.probe(which, moved=moved, learnt=learnt), strict=True))


def is_slow_motion(errors: Mapping[Candidate, Mapping[str, float]], kept: Candidate) -> bool:
    """True where Θ_{t−1} shows a frame nearly (``SLOW``) as well as what was kept; ``errors`` by probe view.

    >>> is_slow_motion({Candidate.PREVIOUS: {"a": 1.4}, Candidate.END: {"a": 1.0}}, Candidate.END)
    True
    """
    still, ended = errors.get(Candidate.PREVIOUS, {}), errors.get(kept, {})
    return mean_error(still, list(ended)) <= (1 + SLOW) * mean_error(ended, list(ended))


def committed_errors(rig: Rig, renderer: Renderer, views: Sequence[TrainingView], state: Gaussians) -> dict[str, float]:
    """The image loss of a committed state in a few whole pictures, by probe view, under names of their own.

    Args:
        rig: as it is given, not as cameras drift. renderer: compares whole pictures. views: of the frame.
    """
    chosen = probe_views(rig, views, CONFIRMING)
    return {view.name + COMMITTED: renderer.compare(state, view).image_loss for view in chosen}


class BestState:
    """Picks the best start of an update and the best state at its end.

    Args:
        probes: of the frame. engine: has taken Θ_{t−1}. hierarchy: of the moving Gaussians.
        motion: of the update before, or None. seconds: since it was measured. momentum: see ``UpdateSettings``.

    Attributes:
        errors: by candidate, then by probe view. seconds: that the motion is taken to have gone on for.
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

    @property
    def whole(self) -> bool:
        """True where whole pictures were compared."""
        return self._probes.whole

    def start(self, step: float | None = None) -> Tables:
        """The motion before as a start, or no motion where that shows the frame better; the engine has it.

        Args:
            step: seconds since the frame before, where that was not moved: the motion may have rested meanwhile. None:
                as long as since the motion was measured.
        """
        motion = self._motion
        self._record(Candidate.PREVIOUS, self._probes.errors(moved=False, learnt=False))
        tables = self._set(motion)
        if motion is not None and self.errors:
            self._record(Candidate.WARM, self._probes.errors(moved=True, learnt=False))
            if step is not None:
                tables = self._try_after_pause(motion, step)
            if self._mean(Candidate.PREVIOUS) < self._mean(Candidate.WARM):
                tables = self._set(None)
        return tables

    def _try_after_pause(self, motion: Motion, step: float) -> Tables:
        """The motion for the time since the frame before alone, kept where it shows the frame better."""
        whole, errors = self.seconds, self.errors[Candidate.WARM]
        self.seconds = step
        tables = self._set(motion)
        self._record(Candidate.WARM, self._probes.errors(moved=True, learnt=False))
        if mean_error(errors, list(errors)) <= self._mean(Candidate.WARM):
            self.seconds, self.errors[Candidate.WARM] = whole, errors
            tables = self._set(motion)
        return tables

    def can_skip(self, skip_below: Mapping[str, float] | None, confirm_skip: Callable[[], bool] | None = None) -> bool:
        """True where Θ_{t−1} shows this frame as well as ``skip_below``, errors ``label_by_size``, and
        ``confirm_skip`` agrees.

        None: never, and without being asked.
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
        """Share of what changed since Θ_{t−1} that the motion before leaves: about 0 to 1.

        1 where nothing is compared, there was no motion before, or nothing changed.

        What stands is met no better by any motion; ``reference_errors``, errors ``label_by_size`` of updates at their
        end, takes it out.
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
        """Mean error on the probe views of the state that the update has now."""
        errors = self._probes.errors(moved=True, learnt=True)
        return mean_error(errors, list(errors))

    def end(self, iterations: int, left_out: Mapping[str, str]) -> Candidate:
        """The best candidate; the engine's tables are set to it.

        Args:
            iterations: of the update. left_out: cameras that have no say.
        """
        if not self.errors:
            return Candidate.END
        if iterations:
            self._record(Candidate.END, self._probes.errors(moved=True, learnt=True))
        names = [name for name in self.errors[Candidate.PREVIOUS] if name not in left_out]
        compared = [candidate for candidate in Candidate if candidate in self.errors]  # of equal ones the first
        best = min(compared, key=lambda candidate: _nan_to_inf(mean_error(self.errors[candidate], names)))
        if best is not Candidate.END and iterations and not self.whole:
            best = self._best_at_full_size(best, left_out)
        if best is not Candidate.END:
            self._set_candidate(best)
        return best

    def _best_at_full_size(self, best: Candidate, left_out: Mapping[str, str]) -> Candidate:
        """The best candidate in whole pictures: slow motion may show in them alone. Of equal ones ``best`` is taken.

        The tables are left as they ended.
        """
        ended = self._engine.tables()
        errors = {Candidate.END: self._full_size_error(True, left_out)}
        for candidate in self.errors.keys() - {Candidate.END}:
            self._set_candidate(candidate)
            errors[candidate] = self._full_size_error(False, left_out)
        self._engine.set_tables(ended)
        return min(errors, key=lambda candidate: (errors[candidate], candidate is not best))

    def _set_candidate(self, candidate: Candidate) -> None:
        """Sets the engine's tables to the start that a candidate is."""
        self._set(self._motion if candidate is Candidate.WARM else None)

    def _set(self, motion: Motion | None) -> Tables:
        tables = warm_start(self._hierarchy, motion, self.seconds, self._momentum)
        self._engine.set_tables(tables)
        return tables

    def _record(self, candidate: Candidate, errors: dict[str, float]) -> None:
        if errors:
            self.errors[candidate] = errors

    def _full_size_error(self, learnt: bool, left_out: Mapping[str, str]) -> float:
        """Mean error in whole pictures, but for cameras that have no say; not a number counts as infinite."""
        errors = self._probes.full_size_errors(moved=True, learnt=learnt)
        return _nan_to_inf(mean_error(errors, [name for name in errors if name not in left_out]))

    def _mean(self, candidate: Candidate, otherwise: float = np.inf) -> float:
        errors = self.errors.get(candidate)
        return otherwise if errors is None else mean_error(errors, list(errors))


def mean_is_within(errors: Mapping[str, float], limits: Mapping[str, float]) -> bool:
    """True where the mean error of the views that have a limit is within the mean of these; false where none has.

    >>> mean_is_within({"a": 1.0, "b": 3.0}, {"a": 2.0, "b": 2.0}), mean_is_within({"a": 1.0}, {"b": 2.0})
    (True, False)
    """
    names = sorted(errors.keys() & limits.keys())
    return bool(names) and mean_error(errors, names) <= mean_error(limits, names)


def _nan_to_inf(value: float) -> float:
    """Not a number comes last."""
    return value if value == value else np.inf
