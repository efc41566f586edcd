"""Runs the frame cases, each from the same committed state, and compares them with an undisturbed run."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from frame_cases.camera_faults import camera_faults
from frame_cases.cases import FrameCase, FrameStep, Pictures, Sent, named, violations
from frame_cases.footage import AnyFootage
from scas4d_core.gaussians import Gaussians
from scas4d_core.metrics import psnr
from scas4d_core.reconstruction import Reconstruction
from studies.constants import all_varied
from studies.quality.first_frame import continued

AT = 5
"""Index of the frame at which each case begins. By then, the checks have learned the usual values."""
UNIT = 1e-5
"""Largest deviation of a rotation's norm from 1."""


def cases_of(footage: AnyFootage) -> tuple[FrameCase, ...]:
    """Returns all cases: faults of frames and of one camera."""
    return (*named(footage), *camera_faults(footage))


class FrameStudy:
    """Runs cases on footage and compares them with an undisturbed run.

    Args:
        footage: footage on which the cases are run.
        folder: folder for committed states; its contents are deleted.
    """

    def __init__(self, footage: AnyFootage, folder: Path) -> None:
        self.footage, self.folder = footage, folder
        self.cases = cases_of(footage)
        shutil.rmtree(folder, ignore_errors=True)
        scene = footage.start(folder / "before")
        self._interval = footage.frame(1).time - footage.frame(0).time
        for index in range(1, AT):
            scene.step(footage.frame(index))
        self.usual = {index: self._measured(scene, index, footage.truth(index)) for index in range(1, AT)}
        self._scene = self._branch("undisturbed")

    def undisturbed(self, index: int) -> float:
        """Returns the PSNR in dB of the held-out cameras in a frame of the undisturbed run."""
        for at in range(max(self.usual) + 1, index + 1):
            self._scene.step(self.footage.frame(at))
            self.usual[at] = self._measured(self._scene, at, self.footage.truth(at))
        return self.usual[index]

    def run(self, case: FrameCase, size: Any) -> list[str] | None:
        """Runs a case at one size and returns the violated checks, or None if the footage cannot show it."""
        try:
            sent = case.make(self.footage, AT, size)
        except IndexError:  # the footage is too short
            return None
        return None if sent is None else violations(case, self._steps(sent), size)

    def _steps(self, sent: Sequence[Sent]) -> list[FrameStep]:
        scene, steps = self._branch("case"), []
        for number, one in enumerate(sent):
            index = AT + number
            before = scene.history.gaussians(index - 1)
            report = scene.step(replace(one.frame, index=index, time=index * self._interval))
            after = scene.history.gaussians(index)
            steps.append(
                FrameStep(
                    one, report, _same(before, after), sound(after), self._measured(scene, index, one.truth),
                    self.undisturbed(one.like),
                )
            )  # fmt: skip
        return steps

    def _branch(self, name: str) -> Reconstruction:
        """Returns a copy of the scene as it was before the case, which continues bit-identically."""
        with all_varied(self.footage.constants):
            return continued(self.folder / "before", self.folder / name, self.footage.rig, self.footage.settings)

    def _measured(self, scene: Reconstruction, index: int, truth: Pictures) -> float:
        return float(
            np.mean([psnr(scene.render(camera, index).colour, truth[camera.name]) for camera in self.footage.held_out])
        )


def _same(before: Gaussians, after: Gaussians) -> bool:
    there = after.arrays()
    return all(np.array_equal(array, there[name]) for name, array in before.arrays().items())


def sound(state: Gaussians) -> bool:
    """Returns whether a state is finite and its rotations have unit length."""
    finite = all(bool(np.isfinite(array).all()) for array in state.arrays().values())
    norms = np.linalg.norm(state.rotations.astype(np.float64), axis=1)
    return finite and bool(np.abs(norms - 1).max() <= UNIT)
