"""What is behind everything: found from the pictures of frame 0, and the same from then on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scas4d_core.cameras import Camera, WorldFrame
from scas4d_core.first_frame.fit_first_frame import with_background, with_recorded_background
from scas4d_core.gaussians import Gaussians
from scas4d_core.query.committed import CommittedScene
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings
from scas4d_core.storage.history import History
from tests.helpers.box_scene import make_box, make_rig, moved, take_frame

FEW = {"iterations": 30, "max_gaussians": 300}
FAR_AWAY = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -100], [0, 0, 0, 1]])
"""A pose that has everything behind the camera."""


def found(*pictures: np.ndarray) -> tuple[float, float, float]:
    images = {f"c{number}": picture for number, picture in enumerate(pictures)}
    background = with_background(Settings(), images).scene.background
    assert background != "auto"
    return background


def noise(low: int, high: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(low, high, (96, 128, 3)).astype(np.uint8)


def test_a_plain_backdrop_is_the_background_noise_and_all() -> None:
    thing = noise(0, 256)
    for colour in ((0, 0, 0), (250, 252, 249), (20, 180, 40)):
        picture = np.clip(noise(-2, 3).astype(np.int8) + np.array(colour), 0, 255).astype(np.uint8)
        picture[20:70, 30:90] = thing[20:70, 30:90]
        np.testing.assert_allclose(found(picture, picture), np.array(colour) / 255, atol=2 / 255)


def test_black_is_exactly_black_beside_a_thing() -> None:
    picture = np.zeros((96, 128, 3), np.uint8)
    picture[30:60, 40:90] = noise(20, 256)[30:60, 40:90]
    assert found(picture) == (0.0, 0.0, 0.0)


def test_a_room_has_the_mean_of_its_pictures() -> None:
    one, other = noise(30, 250), noise(0, 100, seed=1)
    np.testing.assert_allclose(found(one, other), np.concatenate([one, other]).mean(axis=(0, 1)) / 255, atol=0.02)


def test_what_one_camera_sees_is_no_backdrop() -> None:
    wall, room = np.full((96, 128, 3), 240, np.uint8), noise(0, 120)
    assert max(found(wall, room, room)) < 0.6


def test_pictures_may_differ_in_size() -> None:
    assert found(np.zeros((40, 40, 3), np.uint8), np.zeros((64, 20, 3), np.uint8)) == (0.0, 0.0, 0.0)


def test_a_given_background_stays() -> None:
    given = Settings.model_validate({"scene": {"background": [0.2, 0.3, 0.4]}})
    assert with_background(given, {"c0": noise(0, 256)}) is given


@pytest.mark.parametrize("background", [[0.2, 0.3, 0.4], "auto"])
def test_it_is_committed_and_goes_on(tmp_path: Path, background: list[float] | str) -> None:
    settings = Settings.model_validate({"scene": {"background": background}, "static": FEW})
    rig, box = make_rig(), make_box()
    first = take_frame(0, 0.0, box, rig)
    grey = {name: np.where(first.masks[name][..., None] > 0, image, 77) for name, image in first.images.items()}
    first.images.clear()
    first.images.update({name: image.astype(np.uint8) for name, image in grey.items()})
    scene = Reconstruction.start(rig, first, settings, history=History(tmp_path / "states"))
    expected = scene.settings.scene.background
    assert expected == (tuple(background) if background != "auto" else (0.302, 0.302, 0.302))

    outside = Camera("away", [[100, 0, 4], [0, 100, 4], [0, 0, 1]], FAR_AWAY, 8, 8)
    read = CommittedScene(History.open(tmp_path / "states"), scene.world)
    np.testing.assert_allclose(read.render(outside).colour, np.broadcast_to(expected, (8, 8, 3)), atol=1e-6)
    assert with_recorded_background(settings, read.history).scene.background == expected
    again = Reconstruction.resume(rig, settings, History.open(tmp_path / "states"))
    assert again.settings.scene.background == expected
    assert Reconstruction.fork(rig, settings, again.history, 0).settings.scene.background == expected
    again.step(take_frame(1, 1 / 30, moved(box), rig))
    np.testing.assert_allclose(again.render(outside).colour, np.broadcast_to(expected, (8, 8, 3)), atol=1e-6)


def test_a_history_that_says_nothing_has_black() -> None:
    history = History()
    history.append(0, 0.0, Gaussians.of_points([[0, 0, 2]], radius=0.1, colours=[1, 0, 0]))
    away = Camera("away", [[100, 0, 8], [0, 100, 8], [0, 0, 1]], FAR_AWAY, 16, 16)
    assert not CommittedScene(history, WorldFrame(np.zeros(3))).render(away).colour.any()
    assert with_recorded_background(Settings(), history).scene.background_rgb == (0.0, 0.0, 0.0)


def test_a_thing_that_fills_the_pictures_has_the_colour_painted_behind_it() -> None:
    picture = noise(0, 256)
    picture[:10] = (0, 0, 0)  # a tenth
    assert found(picture, picture) == (0.0, 0.0, 0.0)


def test_pictures_that_are_refused_later_are_not_looked_at() -> None:
    for images in ({}, {"c0": np.zeros((48, 64), np.uint8)}, {"c0": np.zeros((1, 2, 3), np.uint8)}):
        assert with_background(Settings(), images).scene.background_rgb == (0.0, 0.0, 0.0)


def test_a_colour_beyond_1_is_refused() -> None:
    with pytest.raises(ValueError, match="less than or equal to 1"):
        Settings.model_validate({"scene": {"background": [255, 255, 255]}})
