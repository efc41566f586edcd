"""Time of an update versus the share of moving pixels, on synthetic footage.

A textured wall is seen by a row of cameras; a square in its middle slides, as large as the share asks for.
All variants have the same Gaussians, cameras and settings; they are updated in turns.
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
"""As many Gaussians as a captured object has, and as small pictures."""


@dataclass(frozen=True)
class MovingTime:
    """Times of a variant.

    Attributes:
        share: of the pixels that show something that moves, asked for. moving: Gaussians that move. seconds: median of
            an update. psnr: dB, mean over the cameras at the last update.
    """

    share: float
    moving: int
    seconds: float
    psnr: float


def measure(shares: Sequence[float], frames: int, settings: Settings | None = None) -> list[MovingTime]:
    """Updates all variants in alternation, frame by frame.

    Args:
        shares: 0…1. frames: updates of each; the first one, which looks for the motion, does not count.
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
    """Formats the results as Markdown, with ratios to the last one."""
    last = results[-1].seconds
    lines = ["| pixels that move | Gaussians that move | s an update | of the last | PSNR |", "|---|---|---|---|---|"]
    lines += [
        f"| {100 * one.share:.0f} % | {one.moving:,} | {one.seconds:.2f} | {one.seconds / last:.2f} | {one.psnr:.1f} |"
        for one in results
    ]
    return "\n".join(lines)
