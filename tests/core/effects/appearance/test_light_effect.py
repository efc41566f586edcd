"""Light over time: what faces alike changes together, and that switches the faster colours on; noise does not."""

from __future__ import annotations

import numpy as np
import pytest
from box_scene import MOVING, make_box, make_rig, take_frame
from effect_cases import builder, same, updated

from scas4d_core.effects.appearance.light import change_of_light, orientation_and_place
from scas4d_core.effects.switches import find_contradictions, first_switches, names_on, register_effects
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.gaussians import Gaussians
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings, UpdateSettings
from scas4d_core.update.rates import FASTER_IN_CHANGING_LIGHT, Rates

RIG = make_rig()
BOX = make_box().replace(colours=np.random.default_rng(1).uniform(0.2, 0.6, (448, 3)).astype(np.float32))
CENTRE = np.zeros(3)
ALL = np.arange(len(BOX))
FRAMES = 5


def under(lamp: np.ndarray) -> Gaussians:
    """The box with colours brighter on the sides that face a lamp, darker on the others."""
    normals = np.sign(BOX.means) * (np.abs(BOX.means) > 0.19)
    return BOX.replace(colours=(BOX.colours * (1 + normals @ lamp)[:, None]).clip(0.02, 1).astype(np.float32))


def test_normals_are_the_shortest_axes_on_the_side_of_the_cameras() -> None:
    terms = orientation_and_place(BOX, ALL, np.array([0.0, -9.0, 0.0]))
    np.testing.assert_allclose(np.linalg.norm(terms[:, 1:4], axis=1), 1, atol=1e-6)
    assert (terms[:, 2] <= 1e-6).all()  # the cameras are above, where y is negative
    assert np.allclose(terms[MOVING:, 2], -1)  # the plate
    np.testing.assert_allclose(terms[:, 4:].mean(axis=0), 0, atol=1e-6)


def test_what_changes_together_is_light_and_noise_is_not() -> None:
    rng = np.random.default_rng(3)
    dimmer = BOX.replace(colours=np.float32(0.95) * BOX.colours)
    noise = rng.normal(0, 0.05, BOX.colours.shape).astype(np.float32)
    assert change_of_light(BOX, BOX, CENTRE) == 0
    assert change_of_light(BOX, dimmer, CENTRE) == pytest.approx(0.05, rel=1e-3)
    assert change_of_light(BOX, BOX.replace(colours=BOX.colours + BOX.colours * noise), CENTRE) < 0.01
    hidden = BOX.replace(opacities=np.zeros(len(BOX), np.float32))
    assert change_of_light(hidden, dimmer, CENTRE) == 0


def test_colours_are_freer_while_the_light_changes() -> None:
    colours = register_effects(builder(), ["moving_colour", "static_colour", "light"]).plan.colours
    rates = Rates.of(UpdateSettings(rate_colour=0.002, rate_static_colour=0.01), 2, 4.0)
    assert colours is not None
    assert rates.colour_rates(colours) == (FASTER_IN_CHANGING_LIGHT * 0.01, FASTER_IN_CHANGING_LIGHT * 0.01)
    colours.changing_light = False
    assert rates.colour_rates(colours) == (0.002, 0.01)
    colours.moving = False
    assert rates.colour_rates(colours) == (0.0, 0.01)


def test_it_frees_no_colours_that_are_held() -> None:
    usual = [name for name in names_on(first_switches(Settings(), 0)) if "colour" not in name and name != "shading"]
    assert same(updated(usual), updated([*usual, "light"]))
    settings = Settings.model_validate({"update": {"rate_colour": 0}, "effects": {"light": "on"}})
    assert [name for name, *_ in find_contradictions(settings)] == ["light"]


def followed(mode: str, lamp: float) -> tuple[float, Reconstruction]:
    """Mean error of the box's colours after frames in which a lamp goes from one side of the box to the other."""
    # The judge keeps the state before the last frame with 1 of 5 seeds, by chance.
    update = {"clusters": (2, 12), "iterations": 40, "reject_outliers": False, "cold_start_iterations": 1.0}
    effects = {"light": mode, "shading": "off"}  # it follows what moves by itself
    settings = Settings.model_validate({"update": update, "effects": effects})
    scene = Reconstruction.start(RIG, take_frame(0, 0, BOX, RIG), settings, static=StaticResult(BOX, {}, []))
    for index in range(1, FRAMES):
        now = under(lamp * index * np.array([0.5, 0.0, 1.0]))
        scene.step(take_frame(index, index / 30, now, RIG))
    return float(np.abs(scene.history.newest.colours - now.colours)[:MOVING].mean()), scene


def test_a_lamp_that_moves_switches_it_on_and_is_followed() -> None:
    off, _ = followed("off", 0.08)
    error, scene = followed("auto", 0.08)
    switch = scene._prepared.carried.switches["light"]
    assert switch.on
    assert switch.text.startswith("the lighting changes by ")
    assert error < 0.8 * off


def test_a_light_that_stays_leaves_it_off() -> None:
    _, scene = followed("auto", 0.0)
    assert not scene._prepared.carried.switches["light"].on
