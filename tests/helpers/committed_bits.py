"""Run as a program: reconstruct three frames of the sample and print digests of all that is committed, as JSON.

Frame 0 once from the capture's cloud with masks, once from the pictures alone: every library that frame 0 uses has its
say. The number of threads is given by the environment, which libraries read when they are loaded.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from scas4d_core.captures import open_capture
from scas4d_core.first_frame import static_scene
from scas4d_core.kernels.jit import threads
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings, StaticSettings, UpdateSettings

SAMPLE = Path(__file__).parents[2] / "samples" / "robot"
SETTINGS = Settings(
    static=StaticSettings(iterations=40, max_gaussians=2500, seconds=None),
    update=UpdateSettings(iterations=8),
)
static_scene.DENSIFY_FROM = static_scene.DENSIFY_EVERY = 10  # densified, as short as it is


def digest(arrays: Iterable[np.ndarray]) -> str:
    """Of the bytes of arrays."""
    found = hashlib.sha256()
    for array in arrays:
        found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()[:16]


def committed(scale: float) -> dict[str, object]:
    """Digests by what was committed; and the threads that kernels had."""
    capture = open_capture(SAMPLE, image_scale=scale)
    found: dict[str, object] = {"threads": threads()}
    for name, points, masked in (("cloud", capture.points, True), ("pictures", None, False)):
        frames = [capture.frame(index) for index in range(3)]
        frames = [frame if masked else replace(frame, masks={}) for frame in frames]
        scene = Reconstruction.start(capture.rig, frames[0], SETTINGS, points=points)
        for frame in frames[1:]:
            scene.step(frame)
        for index in scene.history.indices:
            state = scene.history.gaussians(index)
            found[f"{name}, frame {index}"] = digest(state.arrays().values())
            report = scene.history.report(index)
            found[f"{name}, losses of frame {index}"] = digest([np.array(report["loss"])])
        found[f"{name}, parts"] = digest([scene.parts(4)])
    return found


if __name__ == "__main__":
    print(json.dumps(committed(float(sys.argv[1]))))
