"""Comparison of the candidates for Θ_t on a few training views: the end of an update, its warm start, Θ_{t−1}.

An update may end at any moment: what it commits is never worse than not moving, or than going on as before. The probe
views are the same in every frame; rendering them is a part of the update's time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import nan

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Rig, farthest_first
from scas4d_core.frame_outcome import Candidate
from scas4d_core.gaussians import Gaussians
from scas4d_core.rasterize.shading import features_seen, without_turn
from scas4d_core.update.deformation import CpuDeformation
from scas4d_core.update.picture_loss import PictureLoss, TrainingView, ViewFactory
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
"""Behind the names of views in whose whole pictures a state was compared as it was committed."""


def by_size(errors: Mapping[str, float], whole: bool) -> dict[str, float]:
    """Errors under names that tell those of whole pictures, which are smaller, from those of small ones.

    >>> by_size({"c0": 0.1}, whole=True)
    {'c0 whole': 0.1}
    """
    return {name + WHOLE if whole else name: error for name, error in errors.items()}


class ProbeViews:
    """Fixed training views for comparing states.

    Args:
        factory: of the rig. picture: renders. views: of the frame; ``spread`` of them are taken; of none
            nothing is compared.

    Attributes:
        whole: whether their whole pictures are compared; known once a state was.
    """

    def __init__(self, factory: ViewFactory, picture: PictureLoss, views: Sequence[TrainingView]) -> None:
        chosen = set(spread(factory.rig, [view.name for view in views]))
        self._whole = [view for view in views if view.name in chosen]
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

    def stands(self, enough: Mapping[str, float] | None) -> bool:
        """True where Θ_{t−1} shows this frame as well as ``enough``, in small pictures and in whole ones; None: never.

        Small pictures alone do not tell: what they cannot show weighs more in them than a slow motion.

        Args:
            enough: errors ``by_size`` at the end of an update, and of what it ``committed``.
        """
        still = self.errors.get(Candidate.STILL)
        if (
            enough is None
            or still is None
            or self._mean(Candidate.STILL) > self._mean(Candidate.WARM, otherwise=np.inf)
        ):
            return False
        return _within(by_size(still, self.whole), enough) and _within(self.committed(self._previous), enough)

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

    def committed(self, state: Gaussians) -> dict[str, float]:
        """``ProbeViews.whole_errors`` of a committed state, by the camera's name and ``COMMITTED``."""
        return {name + COMMITTED: error for name, error in self._probes.whole_errors(state).items()}

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
        if best is Candidate.END:
            return best
        doubtful = iterations > 0 and not self.whole  # a slow motion may show in whole pictures alone
        reached = self._in_whole(look, left_out) if doubtful else np.inf
        tables = (*self._deformation.clusters, self._deformation.deltas)
        ended = [values.copy() for values in tables]
        self._set(self._motion if best is Candidate.WARM else None)
        self._deformation.forward()
        if not doubtful or self._in_whole(self._previous, left_out) <= reached:
            return best
        for values, at_end in zip(tables, ended, strict=True):
            values[:] = at_end
        self._deformation.forward()
        return Candidate.END

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


def _within(errors: Mapping[str, float], limits: Mapping[str, float]) -> bool:
    """True where the mean error of the views that have a limit is within the mean of these; false where none has.

    >>> _within({"a": 1.0, "b": 3.0}, {"a": 2.0, "b": 2.0}), _within({"a": 1.0}, {"b": 2.0})
    (True, False)
    """
    names = sorted(errors.keys() & limits.keys())
    return bool(names) and mean_error(errors, names) <= mean_error(limits, names)


def _or_last(value: float) -> float:
    """Not a number comes last."""
    return value if value == value else np.inf
