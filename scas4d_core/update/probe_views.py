"""A few training views, the same in every frame, that say which of two states shows a frame better."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import nan

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Rig
from scas4d_core.update.picture_loss import PictureLoss
from scas4d_core.update.views import TrainingView, ViewFactory

Array = NDArray[np.float32]

VIEWS = 4
"""Views that are looked at."""
SCALE = 0.5
"""Of their pictures: a quarter of the pixels tells as much about which state is better."""


def spread(rig: Rig, names: Sequence[str], count: int = VIEWS) -> list[str]:
    """So many of the cameras, as far apart as can be: each next one is the farthest from those taken."""
    if not names:
        return []
    centres = np.array([rig[name].centre for name in names])
    taken = [0]
    while len(taken) < min(count, len(names)):
        distances = np.linalg.norm(centres[:, None] - centres[None, taken], axis=-1).min(axis=1)
        distances[taken] = -1
        taken.append(int(distances.argmax()))
    return [names[index] for index in taken]


class Witness:
    """Measures states against a frame.

    Args:
        factory: of the rig. picture: renders. views: of the frame; ``spread`` of them are looked at.
    """

    def __init__(self, factory: ViewFactory, picture: PictureLoss, views: Sequence[TrainingView]) -> None:
        chosen = set(spread(factory.rig, [view.name for view in views]))
        self._views = [factory.coarser(view, SCALE) for view in views if view.name in chosen]
        self._picture = picture

    def errors(self, means: Array, factors: Array, opacities: Array, features: Array) -> dict[str, float]:
        """The image loss (``losses.image_loss``) of a state in each view, by the camera's name.

        Args:
            means, factors, opacities, features: [N, 3], [N, 3, 3], [N], [N, 4] float32.
        """
        found = {}
        for view in self._views:
            self._picture.measure(means, factors, opacities, features, view)
            found[view.name] = self._picture.image_part
        return found


def mean_error(errors: Mapping[str, float], names: Sequence[str]) -> float:
    """Mean over the named views that there are; NaN where there is none."""
    values = [errors[name] for name in names if name in errors]
    return float(np.mean(values)) if values else nan
