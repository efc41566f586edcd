"""Footage for the frame cases: a synthetic scene, which can show any fault, and captures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from ball import rig
from numpy.typing import NDArray

from frame_cases.scene import BALL, first_state, gone
from scas4d_core.cameras import Camera, Rig
from scas4d_core.captures import Capture
from scas4d_core.captures.frame import Frame, InitialPoints
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.gaussians import Gaussians
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import SceneSettings, Settings, StaticSettings, UpdateSettings
from scas4d_core.storage.history import History
from studies.constants import all_varied
from studies.quality.first_frame import started
from studies.wall import photograph

Pictures = Mapping[str, NDArray[np.uint8]]

CAMERAS, SIZE = 10, 64
"""Number of cameras in the synthetic rig, and width and height of its images in pixels."""
ANGLE = 0.08
"""Angle in radians through which the ball circles per frame: about 5 degrees, or 11 mm."""
NOISE = 3.0
"""Standard deviation of the noise in the training images, in 8-bit levels."""
RATE = 30.0
"""Frames per second."""


class SyntheticFootage:
    """Footage of a ball that circles over a floor, next to a resting ball.

    Reconstructions start from a frame 0 with errors of a few millimetres.

    Attributes:
        name: footage name.
        count: number of frames.
        settings: reconstruction settings.
        rig: training cameras.
    """

    name = "synthetic"
    count = 24
    constants = (("scas4d_core.preparation.NEIGHBOUR_FALLOFF", 200.0),)
    """Constants that are overridden when a scene starts or resumes, as pairs of dotted name and value.

    The neighbour weights are changed because the Gaussians are far apart.
    """

    def __init__(self, settings: Settings | None = None) -> None:
        self.settings = settings or Settings(
            scene=SceneSettings(metres_per_unit=1.0),
            static=StaticSettings(iterations=600, max_gaussians=1200),
            update=UpdateSettings(iterations=60, clusters=(2, 12, 48)),
        )
        self.rig = rig(SIZE, CAMERAS)
        self._others = rig(SIZE, 4, turned=0.4, names="h")
        self._true = first_state(resting_may_move=False)
        self.frame = cache(self.frame)  # type: ignore[method-assign]
        self.truth = cache(self.truth)  # type: ignore[method-assign]

    @property
    def held_out(self) -> tuple[Camera, ...]:
        """The held-out cameras, which are placed between those of the rig."""
        return self._others.cameras

    def frame(self, index: int) -> Frame:
        """Returns a frame with noisy training images."""
        return self._shown(index, (0.0, 0.0, 0.0))[0]

    def truth(self, index: int) -> Pictures:
        """Returns the true images of the held-out cameras."""
        return self._shown(index, (0.0, 0.0, 0.0))[1]

    def jumped(self, index: int, sizes: float) -> tuple[Frame, Pictures]:
        """Returns a frame and its true images, with the ball moved by ``sizes`` diameters and still in view."""
        return self._shown(index, (-0.8 * sizes * 2 * BALL, 0.0, -0.6 * sizes * 2 * BALL))

    @property
    def points(self) -> InitialPoints:
        """The initial points for fitting frame 0."""
        true = self._true
        return InitialPoints(true.means.astype(np.float64), true.colours.copy(), true.foreground.copy())

    def start(self, folder: Path) -> Reconstruction:
        """Returns a reconstruction whose frame 0 is committed to ``folder``."""
        history, static = History.open(folder), StaticResult(self._fitted(), {}, [])
        with all_varied(self.constants):
            return Reconstruction.start(self.rig, self.frame(0), self.settings, history=history, static=static)

    def _fitted(self) -> Gaussians:
        """Returns the true frame 0 with small errors, as after a fit."""
        rng, true = np.random.default_rng(1), self._true
        means = true.means + rng.normal(0, 0.004, true.means.shape)
        factors = true.factors * np.exp(rng.normal(0, 0.1, (len(true), 1, 3)))
        colours = (true.colours + rng.normal(0, 0.04, true.colours.shape)).clip(0, 1)
        return true.replace(
            means=means.astype(np.float32), factors=factors.astype(np.float32), colours=colours.astype(np.float32)
        )

    def _shown(self, index: int, shift: tuple[float, float, float]) -> tuple[Frame, Pictures]:
        state, rng = gone(self._true, ANGLE * index, shift), np.random.default_rng(index)
        shown = photograph(state, self.rig)
        images = {
            name: (picture + rng.normal(0, NOISE, picture.shape)).round().clip(0, 255).astype(np.uint8)
            for name, picture in shown.images.items()
        }
        return Frame(index, index / RATE, images, shown.masks), photograph(state, self._others).images


class CapturedFootage:
    """Footage of a capture with test cameras. Frame 0 is fitted once and stored.

    Args:
        capture: capture that provides the frames.
        settings: reconstruction settings.
        study: study folder in which frame 0 is stored, such as the one of ``scripts/bench targets``.
    """

    constants = ()

    def __init__(self, capture: Capture, settings: Settings, study: Path) -> None:
        self._capture = capture
        self.points = capture.points
        self.name, self.count, self.settings = capture.name, capture.frame_count, settings
        self.rig: Rig = capture.full_rig
        self._study = study

    @property
    def held_out(self) -> tuple[Camera, ...]:
        """The test cameras."""
        rig = self._capture.full_test_rig
        return () if rig is None else rig.cameras

    def frame(self, index: int) -> Frame:
        """Returns a frame with the training images."""
        return self._capture.frame(index)

    def truth(self, index: int) -> Pictures:
        """Returns the images of the test cameras."""
        return self._capture.test_frame(index).images

    def jumped(self, index: int, sizes: float) -> tuple[Frame, Pictures] | None:
        """Returns None, because captures do not contain jumping objects."""
        return None

    def start(self, folder: Path) -> Reconstruction:
        """Returns a reconstruction whose frame 0 is committed to ``folder``."""
        return started(self._capture, self.settings, self._study, folder)


AnyFootage = SyntheticFootage | CapturedFootage


def shown_out_of_step(footage: SyntheticFootage, index: int, offsets: Mapping[str, float]) -> Frame:
    """Returns a synthetic frame in which some cameras are a number of frames ahead (+) or behind (−)."""
    frame, rng = footage.frame(index), np.random.default_rng([index, 1])
    images, masks = dict(frame.images), dict(frame.masks)
    for name, offset in offsets.items():
        shown = photograph(
            gone(first_state(resting_may_move=False), ANGLE * (index + offset)), Rig((footage.rig[name],))
        )
        noisy = shown.images[name] + rng.normal(0, NOISE, shown.images[name].shape)
        images[name], masks[name] = noisy.round().clip(0, 255).astype(np.uint8), shown.masks[name]
    return replace(frame, images=images, masks=masks)
