"""An update may end at any moment: what it commits is never worse than not moving, or than going on as before.

Judged on a few training views (``witness``), whose rendering is a part of the update's time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from scas4d_core.gaussians import Gaussians
from scas4d_core.settings import UpdateSettings
from scas4d_core.update.deformation import CpuDeformation
from scas4d_core.update.picture_loss import PictureLoss
from scas4d_core.update.probe_views import Witness, mean_error
from scas4d_core.update.result import Story
from scas4d_core.update.views import TrainingView, ViewFactory
from scas4d_core.update.warm_start import Motion, warm_start

Array = NDArray[np.float32]


@dataclass
class Anytime:
    """The start of an update and its end, compared.

    Attributes:
        errors: by what was measured ("still", "warm", "end"), then by view.
    """

    deformation: CpuDeformation
    previous: Gaussians
    witness: Witness
    errors: dict[str, dict[str, float]] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        factory: ViewFactory,
        picture: PictureLoss,
        deformation: CpuDeformation,
        previous: Gaussians,
        views: Sequence[TrainingView],
    ) -> Anytime:
        """For a deformation that has taken Θ_{t−1}; without views nothing is compared."""
        return cls(deformation, previous, Witness(factory, picture, views))

    def start(
        self, motion: Motion | None, seconds: float, settings: UpdateSettings, step: float | None = None
    ) -> float:
        """Set the deformation to the motion before, or to none where that shows the frame better.

        Args:
            seconds: since the motion before was found. step: since the frame before, where that was not moved: the
                motion may have rested meanwhile. None: the same.

        Returns:
            The seconds that the motion is taken to have gone on for.
        """
        previous = self.previous
        self._motion, self._seconds, self._settings = motion, seconds, settings
        self._measure("still", previous.means, previous.factors, previous.colours)
        self._set(motion)
        if motion is not None and self.errors:
            self.deformation.forward()
            self._measure("warm", self.deformation.means, self.deformation.factors, previous.colours)
            if step is not None:
                self._try_after_rest(motion, step)
            if self._mean("still") < self._mean("warm"):
                self._set(None)
        return self._seconds

    def _try_after_rest(self, motion: Motion, step: float) -> None:
        """The motion for the time since the frame before alone, kept where it shows the frame better."""
        whole, errors = self._seconds, self.errors["warm"]
        self._seconds = step
        self._set(motion)
        self.deformation.forward()
        self._measure("warm", self.deformation.means, self.deformation.factors, self.previous.colours)
        if mean_error(errors, list(errors)) <= self._mean("warm"):
            self._seconds, self.errors["warm"] = whole, errors
            self._set(motion)

    def stands(self, enough: Mapping[str, float] | None) -> bool:
        """Whether the frame before shows this one as well as ``enough``, errors by view; None: never."""
        still = self.errors.get("still")
        if enough is None or still is None or self._mean("still") > self._mean("warm", self._mean("still")):
            return False
        names = sorted(still.keys() & enough.keys())
        return bool(names) and mean_error(still, names) <= mean_error(enough, names)

    def error(self, colours: Array) -> float:
        """Mean error of the witnesses for the deformation as it is set, with its cascade brought up to date."""
        self.deformation.forward()
        features = np.concatenate([colours, self.previous.foreground[:, None]], axis=1)
        deformation = self.deformation
        found = self.witness.errors(deformation.means, deformation.factors, self.previous.opacities, features)
        return mean_error(found, list(found))

    def error_of(self, state: Gaussians) -> float:
        """Mean error of the witnesses for a state."""
        features = np.concatenate([state.colours, state.foreground[:, None]], axis=1)
        found = self.witness.errors(state.means, state.factors, state.opacities, features)
        return mean_error(found, list(found))

    def end(self, colours: Array, story: Story) -> str:
        """Which state is best of "still", "warm" and "end"; the deformation is set to it.

        Args:
            colours: as the update leaves them. story: cameras that it left out have no say.
        """
        if not self.errors:
            return "end"
        if story.iterations:
            self._measure("end", self.deformation.means, self.deformation.factors, colours)
        names = [name for name in self.errors["still"] if name not in story.left_out]
        order = ("end", "still", "warm")  # of equal ones the first
        found = [kind for kind in order if kind in self.errors]
        best = min(found, key=lambda kind: _or_last(mean_error(self.errors[kind], names)))
        if best != "end":
            self._set(self._motion if best == "warm" else None)
            self.deformation.forward()
        return best

    def _set(self, motion: Motion | None) -> None:
        warm_start(self.deformation, motion, self._seconds, self._settings)

    def _measure(self, kind: str, means: Array, factors: Array, colours: Array) -> None:
        features = np.concatenate([colours, self.previous.foreground[:, None]], axis=1)
        errors = self.witness.errors(means, factors, self.previous.opacities, features)
        if errors:
            self.errors[kind] = errors

    def _mean(self, kind: str, otherwise: float = np.inf) -> float:
        errors = self.errors.get(kind)
        return otherwise if errors is None else mean_error(errors, list(errors))


def _or_last(value: float) -> float:
    """What is not a number comes last."""
    return value if value == value else np.inf
