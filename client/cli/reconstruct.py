"""A reconstruction in this process, for `scas4d reconstruct`."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from client.cli import pictures
from client.cli.progress import Bars, console
from client.importers.open_source import open_prepared
from scas4d_core.captures import open_capture


def reconstruct(folder: Path, out: Path, *, frames: int | None, preset: str, changes: Sequence[str]) -> None:
    """Runs every frame; `out` gets pictures beside the truth, `states/` and `last.ply`.

    Args:
        folder: of the capture.
        out: folder; made when missing.
        frames: how many; all where None.
        preset: named settings.
        changes: what differs, as ``update.iterations=200``.
    """
    given = open_prepared(folder)  # the reconstruction resizes what it is given

    from scas4d_core.query.ply import write_ply
    from scas4d_core.reconstruction import Reconstruction
    from scas4d_core.storage.history import History
    from scas4d_core.warm_up import warm_up_elsewhere
    from studies.quality.job import settings_of

    settings = settings_of(preset, overrides=changes)
    capture = open_capture(folder, image_scale=settings.scene.image_scale)
    count = min(frames or capture.frame_count, capture.frame_count)
    rig = capture.test_rig or capture.rig
    cameras = rig.cameras if capture.test_rig is not None else rig.cameras[:1]
    if (out / "states" / "fixed.npz").exists():  # of an earlier run, like the pictures beside it
        shutil.rmtree(out / "states")
    history = History(out / "states")
    if settings.device == "cpu":
        with console.status("compiling the kernels (once)"):
            warm_up_elsewhere()
    with Bars() as bars:

        def told(progress: Any) -> None:
            bars(progress.stage, progress.done, progress.total)

        reconstruction = Reconstruction.start(
            given.rig, given.frame(0), settings, points=given.points, progress=told, history=history
        )
        for index in range(count):
            if index:
                reconstruction.step(given.frame(index))
            bars("frames", index + 1, count)
            truth = capture.test_frame(index) if capture.test_rig is not None else capture.frame(index)
            scores = []
            for camera in cameras:
                colour = reconstruction.render(camera, index).colour
                render = np.rint(255 * np.clip(colour, 0, 1)).astype(np.uint8)
                true = truth.images[camera.name]
                scores.append(pictures.psnr(true, render))
                pictures.save(out / f"camera_{camera.name}" / f"{index:06d}.png", pictures.comparison(true, render))
            console.print(f"frame {index}: {np.mean(scores):.2f} dB")
    write_ply(out / "last.ply", history.gaussians(history.indices[-1]), reconstruction.world)
    console.print(f"pictures, states and last.ply: {out}")
