"""On a torch device: hooks that its update calls are called, effects that need others are off or refused by name."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from types import ModuleType

import numpy as np
import pytest
from box_scene import moved, take_frame
from effect_cases import BEFORE, RIG, UPDATE, builder
from scas4d_core.effects.appearance.colours import Colours
from scas4d_core.engines.torch.device_update import DeviceUpdate

from scas4d_core.cameras import WorldFrame
from scas4d_core.checkpoint import CarryOver
from scas4d_core.effect_names import EFFECTS
from scas4d_core.effects import effect as effect_module
from scas4d_core.effects.effect import Effect, Group
from scas4d_core.effects.presence.catching import Catching
from scas4d_core.effects.switches import Switches, contradictions, first_switches, joined
from scas4d_core.engines.cpu.renderer import CpuRenderer
from scas4d_core.gaussians import Gaussians
from scas4d_core.preparation import Preparation
from scas4d_core.presets import SettingError, preset
from scas4d_core.settings import Settings
from scas4d_core.structure.neighbours import build_neighbours
from scas4d_core.update.parts import Part, PartsBuilder, Work, not_on_devices

NAME = "drag"


class DragPart(Part):
    """Has a term, and no twin of it."""

    def loss(self, work: Work) -> float:
        return 0.0

    def step(self, work: Work, iteration: int, planned: int) -> None:
        """Steps nothing."""


class Drag(Effect):
    """As the example of docs/effects.md, always on."""

    def join(self, builder: PartsBuilder) -> None:
        builder.parts.append(DragPart())


@pytest.fixture
def drag(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    module = ModuleType("made_up_drag")
    module.EFFECT, module.DragPart = Drag(NAME, Group.MOTION, "says", "gauge", "cost"), DragPart  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "made_up_drag", module)
    monkeypatch.setitem(EFFECTS, NAME, "made_up_drag")
    effect_module.effect.cache_clear()
    yield
    effect_module.effect.cache_clear()


@pytest.mark.usefixtures("drag")
def test_a_pinned_effect_with_hooks_that_no_device_calls_is_refused_by_name() -> None:
    pinned = {"effects": {NAME: "on"}, "device": "cuda"}
    with pytest.raises(SettingError) as caught:
        preset("scas4d", pinned)
    assert caught.value.setting == f"effects.{NAME}"
    assert "device is 'cuda', and no update there calls loss and step of DragPart" in caught.value.fault
    assert "set device to 'cpu'" in caught.value.remedy
    assert preset("scas4d", pinned | {"device": "cpu"}).effects == {NAME: "on"}


@pytest.mark.usefixtures("drag")
def test_left_auto_it_stays_off_and_says_why() -> None:
    on_gpu, on_cpu = (first_switches(Settings(device=device), 0) for device in ("cuda", "cpu"))
    assert (on_gpu[NAME].on, on_cpu[NAME].on) == (False, True)
    assert on_gpu[NAME].text.startswith("device is 'cuda'")
    assert on_gpu["camera_gain"].text == "device is 'cuda'"
    assert on_gpu["floor"].text == on_cpu["camera_gain"].text == ""


def test_what_works_on_a_device_is_not_refused() -> None:
    names = ("entering", "uncovered", "leaving", "rigidity", "moving_colour", "standing_colour", "light", "mask_term")
    assert list(contradictions(Settings(device="cuda", effects=dict.fromkeys(names, "on")))) == []
    assert not_on_devices(Catching) == not_on_devices(Colours) == []


def test_presets_that_a_gpu_knows() -> None:
    for name in ("scas4d", "rigid", "articulated", "cloth"):
        assert preset(name, {"device": "cuda"}).device == "cuda"
    for name in ("people", "lights"):
        with pytest.raises(SettingError) as caught:
            preset(name, {"device": "cuda"})
        assert caught.value.setting == "effects.shadows"


def test_a_scene_that_goes_on_on_another_device_leaves_what_is_not_known_there(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = Settings(device="cuda")
    parts = builder()
    made = Preparation(parts.factory, settings, WorldFrame(np.zeros(3)), CpuRenderer(parts.factory, (0, 0, 0), 1, 0))
    seen: list[Switches] = []
    monkeypatch.setattr(Preparation, "updater", lambda self, first, switches: (seen.append(switches), 0))
    on_cpu = first_switches(Settings(effects={"camera_gain": "on", "entering": "on"}), 0)
    _, carried = made.again(BEFORE, CarryOver(switches=on_cpu))
    assert (seen[0]["camera_gain"].on, seen[0]["entering"].on) == (False, True)
    assert carried.switches == seen[0]


def update(parts: PartsBuilder) -> DeviceUpdate:
    hierarchy = parts.hierarchy
    neighbours = build_neighbours(BEFORE.means[hierarchy.rows], 20, 200.0)
    settings = UPDATE.model_copy(update={"iterations": 1})
    return DeviceUpdate(parts.factory, parts.scene, settings, hierarchy, neighbours, BEFORE, parts, device="cpu")


class Moves(Part):
    """Starts the coarsest clusters with a shift, and leaves an array."""

    def start(self, work: Work) -> None:
        work.deformation.clusters[0][:, 3:6] = [0.5, 0, 0]

    def end(self, work: Work, state: Gaussians) -> Gaussians:
        work.carried["moves"] = {"kept": np.array(str(work.kept))}
        return state.replace(colours=state.colours + 1)


def test_starts_and_ends_are_called_there() -> None:
    parts = joined(builder(), ["cluster_translation", "rigidity", "moving_colour"])
    views = parts.factory.views(take_frame(1, 1.0, moved(BEFORE), RIG, True), {})
    without = update(parts).run(BEFORE, views, None, 1.0, seed=3)
    parts.parts.append(Moves())
    found = update(parts).run(BEFORE, views, None, 1.0, seed=3)
    rows = parts.hierarchy.rows
    went = (found.gaussians.means - without.gaussians.means)[rows]
    np.testing.assert_allclose(np.median(went, axis=0), [0.5, 0, 0], atol=0.1)
    assert found.gaussians.colours.min() > 0.9
    assert found.carried["moves"]["kept"] == "end"
    assert without.carried == {}


def test_an_update_on_a_device_leaves_no_hook_out_silently() -> None:
    parts = builder()
    parts.parts.append(DragPart())
    with pytest.raises(ValueError, match="DragPart: an update on a device calls no loss, step"):
        update(parts)
