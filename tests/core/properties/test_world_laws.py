"""Laws of the whole way of frames on the CPU: the user's world, frame 0, updates, what is committed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from box_scene import RIG, make_box, moved, take_frame
from hypothesis import example, given
from hypothesis import strategies as st
from law_cases import law, some_rotation

from scas4d_core.cameras import Camera, Rig
from scas4d_core.captures import Capture, InitialPoints, open_capture
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.gaussians import Gaussians
from scas4d_core.metrics.image import psnr
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import SceneSettings, Settings, StaticSettings, UpdateSettings
from studies.constants import varied

pytestmark = pytest.mark.slow

BOX = make_box()
FRAMES = [take_frame(index, index / 30, moved(BOX) if index else BOX, RIG) for index in range(2)]
POINTS = InitialPoints(BOX.means.astype(np.float64), BOX.colours, BOX.foreground)
FLOOR = (0.0, 1.0, 0.0, -0.375)
QUICK = Settings(
    static=StaticSettings(iterations=12, max_gaussians=500),
    update=UpdateSettings(iterations=8, clusters=(2, 12, 48)),
)
SAMPLE = Path(__file__).parents[3] / "samples" / "robot"
SAME_DB = 0.4
"""Within this the pictures of a rotated world, or of one in other units, are as good: less than seeds differ by."""


@contextmanager
def densified_early() -> Iterator[None]:
    """Frame 0 in a few iterations."""
    static_scene = "scas4d_core.first_frame.static_scene"
    with varied(f"{static_scene}.DENSIFY_FROM", 4), varied(f"{static_scene}.DENSIFY_EVERY", 4):
        yield


def placed(camera: Camera, turn: np.ndarray, shift: np.ndarray, factor: float) -> Camera:
    """The camera in a world where x is factor · turn x + shift."""
    pose = camera.world_to_camera.copy()
    pose[:3, :3] = camera.rotation @ turn.T
    pose[:3, 3] = factor * camera.translation - pose[:3, :3] @ shift
    return replace(camera, world_to_camera=pose)


def placed_rig(rig: Rig, turn: np.ndarray, shift: np.ndarray, factor: float) -> Rig:
    return Rig(tuple(placed(camera, turn, shift, factor) for camera in rig.cameras))


def states(shift: np.ndarray, factor: float, pointless: bool = False) -> list[Gaussians]:
    """Θ_0 and Θ_1 of the box in units of 1/factor metres, all lengths of the settings told by ``metres_per_unit``."""
    a, b, c, d = FLOOR
    scene = SceneSettings(floor=(a, b, c, factor * d - float(np.dot((a, b, c), shift))), metres_per_unit=1 / factor)
    points = replace(POINTS, positions=factor * POINTS.positions + shift)
    settings = QUICK.model_copy(update={"scene": scene})
    rig = placed_rig(RIG, np.eye(3), shift, factor)
    with densified_early():
        made = Reconstruction.start(rig, FRAMES[0], settings, points=None if pointless else points)
    made.step(FRAMES[1])
    return [made.history.gaussians(index) for index in made.history.indices]


@pytest.fixture(scope="module")
def plain() -> dict[bool, list[Gaussians]]:
    return {pointless: states(np.zeros(3), 1.0, pointless) for pointless in (False, True)}


shifts = st.tuples(*[st.integers(-(2**30), 2**30)] * 3).map(lambda whole: np.array(whole) / 2**10)
"""Up to 1,000 km in steps of 1/1024 m."""


@law(6)
@given(shifts, st.integers(-10, 10), st.booleans())
@example(np.array([10_000.0, 0, 0]), 0, True)
@example(np.zeros(3), 10, False)
@example(np.zeros(3), -10, False)
def test_a_shift_and_a_power_of_two_as_the_unit_change_no_bit(
    plain: dict[bool, list[Gaussians]], shift: np.ndarray, power: int, pointless: bool
) -> None:
    for state, expected in zip(states(shift, 2.0**power, pointless), plain[pointless], strict=True):
        for name, array in expected.arrays().items():
            np.testing.assert_array_equal(getattr(state, name), array, err_msg=name)


def test_a_shift_of_the_rig_alone_is_seen(plain: dict[bool, list[Gaussians]]) -> None:
    """What the law above could miss if nothing depended on where the points are."""
    points = replace(POINTS, positions=POINTS.positions + 2.0**-10)
    with densified_early():
        other = Reconstruction.start(RIG, FRAMES[0], QUICK, points=points)
    assert np.any(other.history.gaussians(0).means != plain[False][0].means)


class Robot:
    """The sample at half size: a quick frame 0, and updates from it in a world that is placed otherwise."""

    def __init__(self, capture: Capture) -> None:
        self.capture = capture
        self.settings = Settings(static=StaticSettings(iterations=300, max_gaussians=3000))
        first = Reconstruction.start(capture.rig, capture.frame(0), self.settings, points=capture.points)
        self.state = first.history.gaussians(0)
        self.exposures = first.static.exposures

    def psnr_of_test_cameras(self, turn: np.ndarray, factor: float, last: int = 2) -> float:
        """Mean dB over the updates and the cameras held out."""
        state = self.state.replace(
            means=(self.state.means @ turn.T).astype(np.float32),
            factors=(turn @ self.state.factors).astype(np.float32),
        )
        scene = SceneSettings(metres_per_unit=1 / factor)
        made = Reconstruction.start(
            placed_rig(self.capture.rig, turn, np.zeros(3), factor), self.capture.frame(0),
            self.settings.model_copy(update={"scene": scene}), static=StaticResult(state, self.exposures, []),
        )  # fmt: skip
        scores = []
        for index in range(1, last + 1):
            made.step(self.capture.frame(index))
            truth = self.capture.test_frame(index).images
            for camera in self.capture.test_rig.cameras:
                seen = made.render(placed(camera, turn, np.zeros(3), factor)).colour
                scores.append(psnr(seen, truth[camera.name] / 255))
        return float(np.mean(scores))


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot(open_capture(SAMPLE, image_scale=0.5))


def test_a_rotation_or_another_unit_leaves_the_pictures_as_good(robot: Robot) -> None:
    """A seed of the order of views alone moves the same figure by some 0.5 dB."""
    wanted = robot.psnr_of_test_cameras(np.eye(3), 1.0)
    for turn, factor in ((some_rotation(0), 1.0), (some_rotation(1), 0.3048)):
        assert robot.psnr_of_test_cameras(turn, factor) == pytest.approx(wanted, abs=SAME_DB)
