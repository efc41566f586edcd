"""Comparison of the candidates for Θ_t on a few training views: the end of an update, its warm start, Θ_{t−1}.

An update may end at any moment: what it commits is never worse than not moving, or than going on as before. The probe
views are the same in every frame; rendering them is a part of the update's time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import nan

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Rig, farthest_first
from scas4d_core.frame_outcome import Candidate
from scas4d_core.gaussians import Gaussians
from scas4d_core.rasterize.shading import features_seen, without_turn
from scas4d_core.update.deformation import CpuDeformation
from scas4d_core.update.picture_loss import PictureLoss, ViewFactory
from scas4d_core.update.training_view import TrainingView
from scas4d_core.update.warm_start import Motion, warm_start

Array = NDArray[np.float32]

VIEWS = 4
"""Probe views of a frame."""
SCALE = 0.5
"""Of their pictures: a quarter of the pixels tells as much about which state is better, ..."""
FEWEST = 80
"""... unless they would have fewer pixels on a side: with 32 a motion that merely went on was preferred for ten frames
in a row, while all cameras lost 1.2 dB; ..."""
ALIASED = 2.0
"""... or the state before is met so many times worse in small pictures than in whole ones: then they show Gaussians
smaller than their pixels, and no motion, and whole pictures are compared."""


def spread(rig: Rig, names: Sequence[str], count: int = VIEWS) -> list[str]:
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


def by_size(errors: Mapping[str, float], whole: bool) -> dict[str, float]:
    """Errors under names that tell those of whole pictures, which are smaller, from those of small ones.

    >>> by_size({"c0": 0.1}, whole=True)
    {'c0 whole': 0.1}
    """
    return {name + WHOLE if whole else name: error for name, error in errors.items()}


def probe_views(rig: Rig, views: Sequence[TrainingView], count: int = VIEWS) -> list[TrainingView]:
    """Those of the views that compare states, ``spread`` over the rig."""
    chosen = set(spread(rig, [view.name for view in views], count))
    return [view for view in views if view.name in chosen]


class ProbeViews:
    """Fixed training views for comparing states.

    Args:
        factory: of the rig. picture: renders. views: of the frame; ``spread`` of them are taken; of none
            nothing is compared.

    Attributes:
        whole: whether their whole pictures are compared; known once a state was.
    """

    def __init__(self, factory: ViewFactory, picture: PictureLoss, views: Sequence[TrainingView]) -> None:
        self._whole = probe_views(factory.rig, views)
        sides = [SCALE * min(view.camera.width, view.camera.height) for view in self._whole]
        self.whole = bool(sides) and min(sides) < FEWEST
        self._views = self._whole if self.whole else [factory.coarser(view, SCALE) for view in self._whole]
        self._picture, self._looked = picture, self.whole

    def errors(self, state: Gaussians, turns: Array | None = None) -> dict[str, float]:
        """The image loss (``losses.image_loss``) of a state in each view, by the camera's name.

        Args:
            turns: since its gloss was known, see ``shading.colours_seen``.
        """
        if not self._looked and self._views:  # the first state that is asked for is that of the frame before
            self._looked = True
            small, whole = (self._error(views[0], state, turns) for views in (self._views, self._whole))
            if small > ALIASED * whole:
                self._views, self.whole = self._whole, True
        return {view.name: self._error(view, state, turns) for view in self._views}

    def whole_errors(self, state: Gaussians, turns: Array | None = None) -> dict[str, float]:
        """As ``errors``, in whole pictures."""
        return {view.name: self._error(view, state, turns) for view in self._whole}

    def _error(self, view: TrainingView, state: Gaussians, turns: Array | None) -> float:
        features = features_seen(state, view.camera, turns)
        self._picture.measure(state.means, state.factors, state.opacities, features, view)
        return self._picture.image_part


def slow(errors: Mapping[Candidate, Mapping[str, float]], kept: Candidate) -> bool:
    """True where Θ_{t−1} shows a frame nearly (``SLOW``) as well as what was kept; ``errors`` by probe view.

    >>> slow({Candidate.STILL: {"a": 1.4}, Candidate.END: {"a": 1.0}}, Candidate.END)
    True
    """
    still, ended = errors.get(Candidate.STILL, {}), errors.get(kept, {})
    return mean_error(still, list(ended)) <= (1 + SLOW) * mean_error(ended, list(ended))


def committed_errors(
    rig: Rig, picture: PictureLoss, views: Sequence[TrainingView], state: Gaussians
) -> dict[str, float]:
    """The image loss of a committed state in a few whole pictures, by probe view, under names of their own.

    Args:
        rig: as it is given, not as cameras drift. picture: renders whole pictures. views: of the frame.
    """
    found = {}
    for view in probe_views(rig, views, CONFIRMING):
        picture.measure(state.means, state.factors, state.opacities, features_seen(state, view.camera), view)
        found[view.name + COMMITTED] = picture.image_part
    return found


class BestState:
    """Finds the best start of an update and the best state at its end.

    Args:
        probes: of the frame. deformation: has taken Θ_{t−1}. previous: Θ_{t−1}.
        motion: of the update before, or None. seconds: since it was found. momentum: see ``UpdateSettings``.

    Attributes:
        errors: by candidate, then by probe view. seconds: that the motion is taken to have gone on for.
    """

    def __init__(
        self,
        probes: ProbeViews,
        deformation: CpuDeformation,
        previous: Gaussians,
        motion: Motion | None,
        seconds: float,
        momentum: float,
    ) -> None:
        self._probes, self._deformation, self._previous = probes, deformation, previous
        self._motion, self._momentum = motion, momentum
        self.seconds = seconds
        self.errors: dict[Candidate, dict[str, float]] = {}

    @property
    def whole(self) -> bool:
        """True where whole pictures were compared."""
        return self._probes.whole

    def start(self, step: float | None = None) -> None:
        """Set the deformation to the motion before, or to none where that shows the frame better.

        Args:
            step: seconds since the frame before, where that was not moved: the motion may have rested meanwhile. None:
                as long as since the motion was found.
        """
        previous, motion = self._previous, self._motion
        self._note(Candidate.STILL, self._probes.errors(previous))
        self._set(motion)
        if motion is not None and self.errors:
            self._deformation.forward()
            self._note(Candidate.WARM, self._moved(previous))
            if step is not None:
                self._try_after_rest(motion, step)
            if self._mean(Candidate.STILL) < self._mean(Candidate.WARM):
                self._set(None)

    def _try_after_rest(self, motion: Motion, step: float) -> None:
        """The motion for the time since the frame before alone, kept where it shows the frame better."""
        whole, errors = self.seconds, self.errors[Candidate.WARM]
        self.seconds = step
        self._set(motion)
        self._deformation.forward()
        self._note(Candidate.WARM, self._moved(self._previous))
        if mean_error(errors, list(errors)) <= self._mean(Candidate.WARM):
            self.seconds, self.errors[Candidate.WARM] = whole, errors
            self._set(motion)

    def stands(self, enough: Mapping[str, float] | None, confirm: Callable[[], bool] | None = None) -> bool:
        """True where Θ_{t−1} shows this frame as well as ``enough``, errors ``by_size``, and ``confirm`` agrees.

        None: never, and without being asked.
        """
        still = self.errors.get(Candidate.STILL)
        if (
            enough is None
            or still is None
            or self._mean(Candidate.STILL) > self._mean(Candidate.WARM, otherwise=np.inf)
        ):
            return False
        return within(by_size(still, self.whole), enough) and (confirm is None or confirm())

    def unexplained(self, usual: Mapping[str, float] | None) -> float:
        """Share of what changed since Θ_{t−1} that the motion before leaves: about 0 to 1.

        1 where nothing is compared, there was no motion before, or nothing changed.

        What stands is met no better by any motion; ``usual``, errors ``by_size`` of updates at their end, takes it out.
        """
        still, warm = (self.errors.get(candidate) for candidate in (Candidate.STILL, Candidate.WARM))
        if still is None or warm is None or not usual:
            return 1.0
        names = sorted(by_size(still, self.whole).keys() & usual.keys())
        if not names:
            return 1.0
        unmoved, led = (mean_error(by_size(errors, self.whole), names) for errors in (still, warm))
        met = mean_error(usual, names)
        return (led - met) / (unmoved - met) if unmoved > met else 1.0

    def error(self, look: Gaussians) -> float:
        """Mean error on the probe views of the deformation as it is set, with its cascade brought up to date.

        Args:
            look: Θ_{t−1} with the colours, gloss and environment as the update has them now.
        """
        self._deformation.forward()
        found = self._moved(look)
        return mean_error(found, list(found))

    def error_of(self, state: Gaussians) -> float:
        """Mean error on the probe views of a state."""
        found = self._probes.errors(state)
        return mean_error(found, list(found))

    def end(self, look: Gaussians, iterations: int, left_out: Mapping[str, str]) -> Candidate:
        """The best candidate; the deformation is set to it.

        Args:
            look: a state with the colours, gloss and environment that the update leaves.
            iterations: that it had. left_out: cameras that have no say.
        """
        if not self.errors:
            return Candidate.END
        if iterations:
            self._note(Candidate.END, self._moved(look))
        names = [name for name in self.errors[Candidate.STILL] if name not in left_out]
        found = [candidate for candidate in Candidate if candidate in self.errors]  # of equal ones the first
        best = min(found, key=lambda candidate: _or_last(mean_error(self.errors[candidate], names)))
        if best is not Candidate.END and iterations and not self.whole:
            best = self._best_in_whole(best, look, left_out)
        if best is not Candidate.END:
            self._put(best)
        return best

    def _best_in_whole(self, best: Candidate, look: Gaussians, left_out: Mapping[str, str]) -> Candidate:
        """The best candidate in whole pictures: slow motion may show in them alone. Of equal ones ``best`` is taken.

        The deformation is left as it ended.
        """
        tables = (*self._deformation.clusters, self._deformation.deltas)
        errors, ended = {Candidate.END: self._in_whole(look, left_out)}, [values.copy() for values in tables]
        for candidate in self.errors.keys() - {Candidate.END}:
            self._put(candidate)
            errors[candidate] = self._in_whole(self._previous, left_out)
        for values, at_end in zip(tables, ended, strict=True):
            values[:] = at_end
        self._deformation.forward()
        return min(errors, key=lambda candidate: (errors[candidate], candidate is not best))

    def _put(self, candidate: Candidate) -> None:
        """Sets the deformation to the start that a candidate is."""
        self._set(self._motion if candidate is Candidate.WARM else None)
        self._deformation.forward()

    def _set(self, motion: Motion | None) -> None:
        self._deformation.rest(0)
        warm_start(self._deformation, motion, self.seconds, self._momentum)

    def _note(self, candidate: Candidate, errors: dict[str, float]) -> None:
        if errors:
            self.errors[candidate] = errors

    def _moved(self, look: Gaussians) -> dict[str, float]:
        """Errors of Θ_{t−1} under the deformation, with the looks of a state."""
        return self._probes.errors(*self._deformed(look))

    def _in_whole(self, look: Gaussians, left_out: Mapping[str, str]) -> float:
        """The same in whole pictures, the mean but for cameras that have no say; not a number counts as infinite."""
        found = self._probes.whole_errors(*self._deformed(look))
        return _or_last(mean_error(found, [name for name in found if name not in left_out]))

    def _deformed(self, look: Gaussians) -> tuple[Gaussians, Array | None]:
        found, turns = self._deformation, None
        if look.gloss is not None:
            turns = without_turn(len(look))
            turns[found.hierarchy.rows] = found.turns
        state = self._previous.replace(
            means=found.means, factors=found.factors,
            colours=look.colours, gloss=look.gloss, environment=look.environment,
        )  # fmt: skip
        return state, turns

    def _mean(self, candidate: Candidate, otherwise: float = np.inf) -> float:
        errors = self.errors.get(candidate)
        return otherwise if errors is None else mean_error(errors, list(errors))


def within(errors: Mapping[str, float], limits: Mapping[str, float]) -> bool:
    """True where the mean error of the views that have a limit is within the mean of these; false where none has.

    >>> within({"a": 1.0, "b": 3.0}, {"a": 2.0, "b": 2.0}), within({"a": 1.0}, {"b": 2.0})
    (True, False)
    """
    names = sorted(errors.keys() & limits.keys())
    return bool(names) and mean_error(errors, names) <= mean_error(limits, names)


def _or_last(value: float) -> float:
    """Not a number comes last."""
    return value if value == value else np.inf
