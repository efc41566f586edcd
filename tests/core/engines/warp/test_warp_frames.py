"""Whole frames of a small scene on the Warp engine, beside the CPU engine: every effect, births and resuming."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("warp", reason="NVIDIA Warp is not installed: pip install warp-lang")

from box_scene import RIG, make_box, moved, take_frame
from warp_cases import Uploads, Waits

from scas4d_core.captures import open_capture
from scas4d_core.captures.frame import Frame
from scas4d_core.effects.evidence import FrameObservation
from scas4d_core.effects.presence import entering
from scas4d_core.engines.choose import WARP_DEVICE, Device
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.gaussians import UNBORN
from scas4d_core.metrics.image import psnr
from scas4d_core.preparation import Preparation
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import EFFECTS, Settings
from scas4d_core.storage.history import History
from scas4d_core.update.result import UpdateResult
from studies.wall import Size, known, rig, shown, wall
from tests.helpers.effect_cases import visited_room
from tests.helpers.effect_cases.visited_room import psnr as room_psnr
from tests.helpers.effect_cases.visited_room import scene, seen, visitor

SAMPLE = Path(__file__).parents[4] / "samples" / "robot"
DEVICES: tuple[Device, ...] = ("cpu", "gpu")
UPDATE = {"clusters": (2, 12), "iterations": 12, "stop_gain": 0, "skip_tolerance": 0}


@pytest.fixture(autouse=True)
def _kernels_of_the_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(WARP_DEVICE, os.environ.get(WARP_DEVICE, "cpu"))


def settings(device: Device, **more: object) -> Settings:
    given = {
        "scene": {"floor": (0, 1, 0, -2)},
        "static": {"iterations": 60, "max_gaussians": 600, "seconds": None},
        "update": UPDATE,
        **more,
    }
    return Settings.model_validate({"device": device, **given})


@cache
def frames() -> list[Frame]:
    """A box that moves twice."""
    first = make_box()
    states = [first, moved(first), moved(moved(first))]
    return [take_frame(index, index / 30, state, RIG) for index, state in enumerate(states)]


@cache
def first_fit(glossy: bool) -> StaticResult:
    """The fit of frame 0, which all scenes share."""
    effects = {"direction": "on"} if glossy else {}
    scene = Reconstruction.start(RIG, frames()[0], settings("cpu", effects=effects))
    assert scene.static is not None
    return scene.static


def error(scene: Reconstruction, frame: Frame) -> float:
    """Returns the mean PSNR on the training cameras in dB."""
    return float(np.mean([psnr(scene.render(camera).colour, frame.images[camera.name]) for camera in RIG.cameras]))


@pytest.mark.parametrize("effect", EFFECTS)
def test_an_effect_that_is_on_gives_the_state_of_the_cpu_engine(effect: str) -> None:
    scenes = {}
    for device in DEVICES:
        given = settings(device, effects={effect: "on"})
        scenes[device] = Reconstruction.start(RIG, frames()[0], given, static=first_fit(effect == "direction"))
        for frame in frames()[1:]:
            scenes[device].step(frame)
    mine, true = scenes["gpu"], scenes["cpu"]
    assert mine.history.report(2)["device"] == "gpu"
    assert error(mine, frames()[2]) == pytest.approx(error(true, frames()[2]), abs=0.05)
    assert len(mine.history.gaussians(2)) == len(true.history.gaussians(2))
    for index in (1, 2):
        losses = [scene.history.report(index)["loss"] for scene in (mine, true)]
        assert losses[0] == pytest.approx(losses[1], rel=0.01)
        assert mine.history.report(index)["candidate"] == true.history.report(index)["candidate"]


def test_the_host_waits_at_most_7_times_in_a_whole_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    capture, waits = open_capture(SAMPLE, image_scale=0.25), Waits(monkeypatch)
    effects = dict.fromkeys(("entering", "leaving", "uncovered"), "off")  # these look at images that fit badly
    given = settings("gpu", scene={}, update={"iterations": 30}, static={"iterations": 60}, effects=effects)
    scene = Reconstruction.start(capture.rig, capture.frame(0), given, points=capture.points)
    for index in range(1, 5):
        waits.count = 0
        assert scene.step(capture.frame(index)).outcome == "updated"
        if index >= 3:  # with colour steps, the timing of cameras, and the report
            assert 4 < waits.count <= 7


def test_the_host_waits_once_for_all_cameras(monkeypatch: pytest.MonkeyPatch) -> None:
    before = visited_room.known()
    frame = seen(scene(before), scene(before, visitor()), device="gpu")
    state, views, waits = frame.result.gaussians, frame.views, Waits(monkeypatch)
    cameras = [view.camera for view in views]
    calls = {
        "pictures": lambda: list(frame.renderer.render_each([(state, camera) for camera in cameras])),
        "comparisons": lambda: frame.renderer.compare(state, views),
        "blocks": lambda: frame.renderer.reached(state, cameras),
    }
    for call in calls.values():
        call()  # tile lists may have to be enlarged
    for name, call in calls.items():
        waits.count = 0
        assert len(call()) == len(views) > 3, name
        assert waits.count == 1, name


def test_frame_0_is_as_good_as_that_of_the_cpu_engine() -> None:
    ends = {}
    for device in DEVICES:
        given = settings(device, effects={"direction": "on"})
        scene = Reconstruction.start(RIG, frames()[0], given)
        ends[device] = error(scene, frames()[0])
    assert ends["gpu"] == pytest.approx(ends["cpu"], abs=0.3)


def test_what_enters_is_added_as_by_the_cpu_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scas4d_core.effects.presence.newborn_fit.ITERATIONS", 120)
    before, after = scene(visited_room.known()), scene(visited_room.known(), visitor())
    born, gained = {}, {}
    for device in DEVICES:
        frame = seen(before, after, device=device)
        result = entering.EFFECT.add_and_retire_gaussians(frame)
        born[device] = len(result.gaussians) - len(before)
        gained[device] = room_psnr(result.gaussians, frame) - room_psnr(before, frame)
    assert born["gpu"] == born["cpu"] > 50
    assert gained["gpu"] == pytest.approx(gained["cpu"], abs=0.3)
    assert gained["cpu"] > 8


def test_a_scene_is_resumed_on_the_other_device(tmp_path: Path) -> None:
    scene = Reconstruction.start(
        RIG, frames()[0], settings("gpu"), static=first_fit(False), history=History(tmp_path / "states")
    )
    scene.step(frames()[1])
    again = Reconstruction.resume(RIG, settings("cpu"), History.open(tmp_path / "states"))
    again.step(frames()[2])
    scene.step(frames()[2])
    assert error(again, frames()[2]) == pytest.approx(error(scene, frames()[2]), abs=0.05)
    assert [again.history.report(index)["device"] for index in (1, 2)] == ["gpu", "cpu"]


def with_births(preparation: Preparation, names: Sequence[str], seen: FrameObservation) -> UpdateResult:
    """Adds copies of the first Gaussians beside them, in place of the effects that add Gaussians."""
    state, parents = seen.result.gaussians, np.arange(100)
    born = state.rows(parents)
    born = born.replace(means=born.means + np.float32(0.01), ids=np.full(len(born), UNBORN))
    return replace(seen.result, gaussians=state.concatenate(born), parents=parents)


def test_a_frame_uploads_at_most_a_twentieth_beside_its_images(monkeypatch: pytest.MonkeyPatch) -> None:
    size = Size(gaussians=10_000, width=256, height=256, cameras=24, moving=1.0)  # as the captures `stage` and `lamps`
    state, cameras = wall(size), rig(size)
    given = Settings.model_validate(
        {
            "device": "gpu",
            "scene": {"metres_per_unit": 1.0, "background": (0.0, 0.0, 0.0)},
            "update": {"iterations": 3, "stop_gain": 0, "skip_tolerance": 0, "match_patches": False},
            "effects": {"prediction": "on"},  # uploads the motion of the previous frame
        }
    )
    shots = [replace(shown(state, 8 * index, cameras), index=index, time=index / 30) for index in range(5)]
    images = sum(array.nbytes for array in (*shots[-1].images.values(), *shots[-1].masks.values()))
    uploads = Uploads(monkeypatch)
    scene = Reconstruction.start(cameras, shots[0], given, static=known(state, cameras))
    for shot in shots[1:]:
        uploads.bytes.clear()
        if shot is shots[-2]:  # the next frame rebuilds the clusters
            monkeypatch.setattr(Preparation, "add_and_retire_gaussians", with_births)
        assert scene.step(shot).outcome == "updated"
        if shot in shots[-3:]:
            assert uploads.bytes.pop("uint8") == images  # each once, although some are probe views too
            assert 0 < sum(uploads.bytes.values()) <= 0.05 * images, uploads.bytes
