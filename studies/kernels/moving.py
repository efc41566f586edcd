"""Update time as a function of the share of moving pixels, measured on synthetic footage.

Cameras in a row see a textured wall. A square in the middle of the wall slides, and its size depends on the share. All
variants have the same Gaussians, cameras and settings, and are updated alternately.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings
from studies.synthetic.wall import Size, known, rig, shown, wall

SIZE = Size(gaussians=22_500)
"""A scene with as many Gaussians as a typical captured object, but with small images."""


@dataclass(frozen=True)
class MovingTime:
    """Measurements of one variant, that is, one share of moving pixels.

    Attributes:
        share: requested share of pixels that show moving content.
        moving: number of moving Gaussians.
        seconds: median seconds per update.
        psnr: PSNR of the last update, averaged over the cameras, in dB.
    """

    share: float
    moving: int
    seconds: float
    psnr: float


def measure(shares: Sequence[float], frames: int, settings: Settings | None = None) -> list[MovingTime]:
    """Updates all variants alternately, frame by frame, and returns the measurements of each.

    Args:
        shares: shares of moving pixels, from 0 to 1.
        frames: updates per share. The first one searches for the motion and is not counted.
        settings: reconstruction settings; the defaults, with metres as the unit, if None.
    """
    settings = settings or Settings.model_validate({"scene": {"metres_per_unit": 1.0}})
    cameras = rig(SIZE)
    scenes, states, seconds = [], [], [[] for _ in shares]  # type: ignore[var-annotated]
    for share in shares:
        state = wall(replace(SIZE, moving=share))
        scene = Reconstruction.start(cameras, shown(state, 0, cameras), settings, static=known(state, cameras))
        scenes.append(scene)
        states.append(state)
    for index in range(1, frames + 1):
        for number, (scene, state) in enumerate(zip(scenes, states, strict=True)):
            frame = shown(state, index, cameras)
            began = perf_counter()
            scene.step(frame)
            seconds[number].append(perf_counter() - began)
    results = []
    for number, (share, state) in enumerate(zip(shares, states, strict=True)):
        report = scenes[number].report
        assert report is not None
        psnr = float(np.mean([fit["psnr"] for fit in report.cameras.values()]))
        results.append(MovingTime(share, int(state.moving.sum()), float(np.median(seconds[number][1:])), psnr))
    return results


def table(results: Sequence[MovingTime]) -> str:
    """Formats the results as a Markdown table, with times also relative to the last variant."""
    last = results[-1].seconds
    lines = ["| moving pixels | moving Gaussians | s per update | of the last | PSNR |", "|---|---|---|---|---|"]
    lines += [
        f"| {100 * one.share:.0f}% | {one.moving:,} | {one.seconds:.2f} | {one.seconds / last:.2f} | {one.psnr:.1f} |"
        for one in results
    ]
    return "\n".join(lines)
