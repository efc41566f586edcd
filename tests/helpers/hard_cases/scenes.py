"""Hard cases for whole scenes: frame 0 and two updates with unusual rigs and units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
from ball import ball_on_a_floor, moved, rig

from hard_cases.case import CPU, BackendResult, HardCase
from scas4d_core.cameras import Camera, Rig, WorldFrame
from scas4d_core.captures.frame import Frame
from scas4d_core.gaussians import Gaussians
from scas4d_core.settings import Settings
from studies.wall import photograph

SIZE, BALL = 32, 400
"""Width and height of the images in pixels, and number of Gaussians in the ball."""


@dataclass(frozen=True, eq=False)
class HardScene:
    """Scene of a ball that moves over a floor, with two updates that start from the true frame 0.

    Attributes:
        rig: rig for which the images are rendered, in the world in which the ball has a radius of 0.25 m.
        user: conversion between that world and the user's coordinates.
        metres_per_unit: setting ``scene.metres_per_unit`` as given by the user.
        least: minimum PSNR in dB of the last update on its own views, close to that of the same scene in metres.
    """

    rig: Rig
    user: WorldFrame = field(default_factory=lambda: WorldFrame(np.zeros(3)))
    metres_per_unit: float | str = 1.0
    least: float = 0.0

    def run(self, backend: str) -> BackendResult | None:
        """Reconstructs the scene on the CPU, or returns None for other backends."""
        if backend != CPU:
            return None
        from scas4d_core.first_frame.static_result import StaticResult
        from scas4d_core.reconstruction import Reconstruction

        states = [ball_on_a_floor(BALL, np.random.default_rng(0))]
        for _ in range(2):
            states.append(moved(states[-1]))
        frames = [Frame(k, float(k), f.images, f.masks) for k, f in enumerate(photograph(s, self.rig) for s in states)]
        cameras = Rig(tuple(_in_users_world(camera, self.user) for camera in self.rig.cameras))
        world = cameras.world_frame(self.metres_per_unit)
        settings = Settings.model_validate(
            {
                "scene": {"metres_per_unit": self.metres_per_unit, "background": (0, 0, 0)},  # as in the renders
                "update": {"iterations": 60, "clusters": [4, 16]},
            }
        )
        first = _inside(states[0], self.user, world)
        static = StaticResult(gaussians=first, exposures={}, losses=[])
        made = Reconstruction.start(cameras, frames[0], settings, static=static)
        for frame in frames[1:]:
            report = made.step(frame)
        last = made.history.gaussians(made.history.indices[-1])
        values: dict[str, Any] = {name: array for name, array in last.arrays().items() if array.dtype.kind == "f"}
        values["psnr"] = np.array([report.psnr])
        truth = _inside(states[-1], self.user, world)
        rows = first.moving
        extent = np.ptp(truth.means[rows], axis=0).max()
        values["error"] = np.linalg.norm(last.means[rows] - truth.means[rows], axis=1) / extent
        values["standing"] = np.abs(last.means[~rows] - first.means[~rows])
        return BackendResult(values)

    def violations(self, outcomes: Mapping[str, BackendResult]) -> list[str]:
        """Returns a line for each violated check.

        The checks cover finite values, unit rotations, unchanged static Gaussians, position errors and PSNR.
        """
        values = outcomes[CPU].values
        faults = [f"{name} is not finite" for name, array in values.items() if not np.isfinite(array).all()]
        lengths = np.linalg.norm(values["rotations"], axis=1)
        faults += [] if np.abs(lengths - 1).max() < 1e-4 else [f"a rotation has length {lengths.max():.4g}"]
        faults += [] if values["standing"].max() == 0 else ["a static Gaussian has moved"]
        far = float(values["error"].max())
        faults += [] if far < 1 else [f"a Gaussian is off by {far:.2g} times the extent"]
        psnr = float(values["psnr"][0])
        faults += [] if psnr >= self.least else [f"{psnr:.1f} dB; at least {self.least:.1f} dB expected"]
        return faults


def _in_users_world(camera: Camera, user: WorldFrame) -> Camera:
    pose = camera.world_to_camera.copy()
    centre = user.to_user(camera.centre)
    pose[:3, 3] = -pose[:3, :3] @ centre
    return Camera(camera.name, camera.intrinsics, pose, camera.width, camera.height)


def _inside(gaussians: Gaussians, user: WorldFrame, world: WorldFrame) -> Gaussians:
    scale = np.float32(world.metres_per_unit / user.metres_per_unit)
    means = world.to_inside(user.to_user(gaussians.means)).astype(np.float32)
    return gaussians.replace(means=means, factors=gaussians.factors * scale)


@cache
def _six() -> Rig:
    return rig(SIZE)


def _with(changes: Mapping[int, Any]) -> Rig:
    """Returns the rig of six cameras, some of them with different intrinsics."""
    cameras = list(_six().cameras)
    for k, intrinsics in changes.items():
        cameras[k] = replace(cameras[k], intrinsics=np.array(intrinsics))
    return Rig(tuple(cameras))


def _lens(focal: float, cx: float = SIZE / 2, cy: float = SIZE / 2) -> list[list[float]]:
    return [[focal, 0, cx], [0, focal, cy], [0, 0, 1]]


def _scaled(scale: float) -> HardScene:
    """Creates a scene whose unit is 1/scale metres, with metres_per_unit "auto"."""
    return HardScene(_six(), WorldFrame(np.zeros(3), 1 / scale), "auto", least=37.5)


def _unsaid(scale: float) -> HardScene:
    """Creates a scene whose unit is 1/scale metres but is not declared, so that rates and bounds in metres differ."""
    return HardScene(_six(), WorldFrame(np.zeros(3), 1 / scale), 1.0)


def _shifted(metres: float) -> HardScene:
    return HardScene(_six(), WorldFrame(np.array([-metres, metres, 0.3 * metres])), 1.0, least=39.5)


def _cameras(names: tuple[int, ...]) -> HardScene:
    least = 30 if len(names) > 1 else 26  # one camera does not determine the depth of moving Gaussians
    return HardScene(Rig(tuple(_six().cameras[k] for k in names)), least=least)


CASES = (
    HardCase(
        "six cameras",
        "unit; the same ball over a floor as in the cases below",
        "reference for the other cases",
        ("metres",),
        lambda s: HardScene(_six(), least=39.5),
    ),
    HardCase(
        "declared units",
        "scale factor of all lengths, with metres_per_unit auto",
        "users' units",
        (1e-3, 1e-2, 1e2, 1e3),
        _scaled,
    ),
    HardCase(
        "undeclared units",
        "scale factor of all lengths, with metres_per_unit 1; the result stays finite and bounded",
        "users' units",
        (1e-3, 1e-1, 10.0, 1e3),
        _unsaid,
    ),
    HardCase(
        "distant origin",
        "distance of the origin from the rig in metres; inputs are recentred in float64",
        "survey coordinates; float32",
        (1e3, 1e4, 1e6),
        _shifted,
    ),
    HardCase(
        "few cameras",
        "indices of the cameras used: one, two that face each other, or three",
        "rigs of one or two",
        ((0,), (0, 3), (0, 2, 4)),
        _cameras,
    ),
    HardCase(
        "mixed focal lengths",
        "factor on the focal length of one of the six cameras; another has half the focal length",
        "rigs of mixed lenses",
        (2.0, 8.0),
        lambda k: HardScene(_with({1: _lens(20.0), 2: _lens(40.0 * k)}), least=39.5),
    ),
    HardCase(
        "principal points outside",
        "offset from the centre in image sizes, for two of the six cameras",
        "cropped rigs",
        (0.6, 2.0),
        lambda k: HardScene(
            _with({1: _lens(40.0, SIZE / 2 + k * SIZE), 4: _lens(40.0, SIZE / 2, SIZE / 2 - k * SIZE)}), least=40
        ),
    ),
)
