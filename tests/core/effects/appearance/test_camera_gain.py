"""Gains of cameras: those put in are found and followed, what all cameras share is light, and off is off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from box_scene import make_box, make_rig, moved, take_frame
from scipy.spatial.transform import Rotation

from scas4d_core.captures.frame import Frame
from scas4d_core.effects.appearance.camera_gain import NAME, POWER, current_exposures
from scas4d_core.effects.switches import register_effects
from scas4d_core.engines.cpu.engine import CpuEngine
from scas4d_core.engines.exposure import FOOT, gain_to_exposure, measured_gain
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.preparation import SMALLEST_CLUSTER
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import SceneSettings, Settings, UpdateSettings
from scas4d_core.structure.hierarchy import build_hierarchy
from scas4d_core.update.frame_update import FrameUpdate
from scas4d_core.update.parts import PlanBuilder
from scas4d_core.update.view_factory import ViewFactory

RIG = make_rig()
BOX = make_box().replace(colours=np.random.default_rng(1).uniform(0.2, 0.7, (448, 3)).astype(np.float32))
RNG = np.random.default_rng(2)
GAINS = np.exp(RNG.uniform(np.log(0.85), np.log(1.18), (6, 3)))
GAINS /= np.exp(np.log(GAINS).mean(axis=0))
DRIFT = np.exp(RNG.normal(0, 0.01, (6, 3)))
DRIFT /= np.exp(np.log(DRIFT).mean(axis=0))
FRAMES = 6
WITHIN = 0.02


def srgb(light: np.ndarray) -> np.ndarray:
    light = light.clip(0, 1)
    return np.where(light < 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def linear(value: np.ndarray) -> np.ndarray:
    return np.where(value < 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def shot(index: int, gains: np.ndarray, masks: bool = True) -> Frame:
    """The box, which turns a little, as cameras with these gains of light see it."""
    box = moved(BOX, Rotation.from_rotvec([0, 0.02 * index, 0]), np.array([0.004 * index, 0, 0]))
    frame = take_frame(index, index / 30, box, RIG, masks)
    images = {
        name: (255 * srgb(gain * linear(image / 255.0))).round().astype(np.uint8)
        for (name, image), gain in zip(frame.images.items(), gains, strict=True)
    }
    return replace(frame, images=images)


def started(mode: str, gains: np.ndarray = GAINS, told: bool = False) -> Reconstruction:
    """The box before any update; ``told``: frame 0 has found the gains, about."""
    settings = Settings.model_validate({"update": {"clusters": (2, 12), "iterations": 40}, "effects": {NAME: mode}})
    about = np.round(gains ** (1 / POWER), 1).astype(np.float32) + np.float32(0.01)
    exposures = {name: gain_to_exposure(gain) for name, gain in zip(RIG.names, about, strict=True)} if told else {}
    return Reconstruction.start(RIG, shot(0, gains), settings, static=StaticResult(BOX, exposures, []))


def found(scene: Reconstruction) -> np.ndarray:
    """Gains of light [6, 3] as the newest frame left them."""
    gains: np.ndarray = scene._prepared.carried.effects[NAME]["gains"] ** POWER
    return gains


def test_gains_that_stay_and_gains_that_drift_are_found() -> None:
    scene = started("on")
    for index in range(1, FRAMES):
        gains = GAINS * DRIFT**index
        scene.step(shot(index, gains))
        wrong = np.abs(found(scene) / gains - 1)
        assert np.median(wrong) < WITHIN
        assert np.abs(np.log(found(scene)).mean(axis=0)).max() < 1e-3  # per channel the product is 1
    assert wrong.max() < 2.5 * WITHIN


def test_a_light_that_all_cameras_share_is_no_gain() -> None:
    scene = started("on")
    for index, light in enumerate((0.97, 0.94, 0.92), start=1):
        scene.step(shot(index, light * GAINS))
    assert np.median(np.abs(found(scene) / GAINS - 1)) < WITHIN
    assert scene.history.newest.colours.mean() < 0.99 * BOX.colours.mean()  # it went into the colours


def test_cameras_that_are_alike_leave_it_off_and_others_switch_it_on() -> None:
    alike, other = started("auto", np.ones((6, 3))), started("auto", told=True)
    for scene, gains in ((alike, np.ones((6, 3))), (other, GAINS)):
        for index in (1, 2):
            scene.step(shot(index, gains))
    assert not alike._prepared.carried.switches[NAME].on
    assert NAME not in alike._prepared.carried.effects
    assert other._prepared.carried.switches[NAME].on
    assert found(other).std(axis=0).min() > 0.05
    assert other._prepared.carried.switches[NAME].text.startswith("colour gains differ by ")


def test_off_changes_no_bit() -> None:
    states = []
    for mode in ("off", "auto"):
        scene = started(mode, np.ones((6, 3)))
        scene.step(shot(1, np.ones((6, 3))))
        scene.step(shot(2, np.ones((6, 3))))
        states.append(scene.history.newest.arrays())
    assert all(np.array_equal(states[0][name], states[1][name]) for name in states[0])


def test_gains_that_were_found_are_those_of_the_pictures() -> None:
    given = {"c0": np.array([[1.1, 0.0]] * 3, np.float32)}
    assert current_exposures(given, {}, RIG.names) is given
    exposures = current_exposures(given, {NAME: {"gains": np.full((6, 3), 1.05, np.float32)}}, RIG.names)
    assert exposures["c3"] == pytest.approx(np.array([[1.05, 0.05 * FOOT]] * 3), abs=1e-6)


def test_a_picture_that_is_dark_tells_no_gain() -> None:
    shown = np.full((3, 20, 20), 0.5, np.float32)
    picture = 1.1 * shown + 0.1 * FOOT
    picture[2] = 0.01
    picture[:, :3] = 1.0  # saturated pixels have no say
    assert measured_gain(picture, shown) == pytest.approx(np.array([1.1, 1.1, np.nan]), abs=1e-4, nan_ok=True)


def test_an_attempt_starts_from_the_exposures_of_the_frame_and_not_from_those_of_another() -> None:
    settings = UpdateSettings(clusters=(2, 12), iterations=24)
    factory = ViewFactory(RIG)
    hierarchy = build_hierarchy(BOX.means, BOX.moving, settings.clusters, SMALLEST_CLUSTER)
    built = register_effects(PlanBuilder(SceneSettings(), settings, factory, hierarchy, BOX), [NAME])
    updater = FrameUpdate(CpuEngine(), built, None)
    views = factory.views(shot(1, GAINS), {})
    first, second = (updater.run(BOX, views, None, 1 / 30, seed=1) for _ in range(2))
    assert all((view.exposure[:3] == [1, 0]).all() for view in views)
    np.testing.assert_array_equal(first.carried[NAME]["gains"], second.carried[NAME]["gains"])
    for view, gain in zip(first.views, first.carried[NAME]["gains"], strict=True):
        np.testing.assert_array_equal(view.exposure[:3], gain_to_exposure(gain))
        assert not (view.exposure[:3] == [1, 0]).all()
