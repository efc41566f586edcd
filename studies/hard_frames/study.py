"""Runs the frame cases, each from the same committed state, and compares them with an undisturbed run."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from client.cli.reconstruct import FRAME_ALARMS
from scas4d_core.gaussians import Gaussians
from scas4d_core.metrics import psnr
from scas4d_core.reconstruction import Reconstruction
from studies.constants import all_varied
from studies.hard_frames.camera_faults import camera_faults
from studies.hard_frames.footage import AnyFootage
from studies.hard_frames.frames import FrameCase, FrameStep, Pictures, Sent, named, violations
from studies.quality.first_frame import continued

AT = 5
"""Index of the frame at which each case begins. By then, the checks have learned the usual values."""
UNIT = 1e-5
"""Largest deviation of a rotation's norm from 1."""


@dataclass
class FrameCaseResult:
    """Result of a case at one size.

    Attributes:
        case: the case.
        size: size at which the case was run.
        said: summaries of the reports on the faulty frames.
        against: PSNR of each frame minus that of the undisturbed run, in dB; the good frames come last.
        violations: violated checks.
    """

    case: FrameCase
    size: Any
    said: list[str] = field(default_factory=list)
    against: list[float] = field(default_factory=list)
    violations: list[str] = field(default_factory=list)


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

    def run(self, case: FrameCase, size: Any) -> FrameCaseResult | None:
        """Runs a case at one size, or returns None if the footage cannot show it or is too short."""
        try:
            sent = case.make(self.footage, AT, size)
        except IndexError:
            return None
        if sent is None:
            return None
        line = FrameCaseResult(case, size)
        steps = self._steps(sent)
        line.against = [step.psnr - step.usual for step in steps]
        line.said = list(dict.fromkeys(_said(step) for step in steps if not step.sent.good))
        line.violations = violations(case, steps, size)
        return line

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


def study(
    footage: AnyFootage,
    folder: Path,
    names: Sequence[str] = (),
    echo: Callable[[str], None] = print,
) -> list[FrameCaseResult]:
    """Runs frame cases at all sizes, reports each result immediately, and returns the results.

    Args:
        footage: footage on which the cases are run.
        folder: folder for committed states; its contents are deleted.
        names: only cases whose name contains one of these texts are run; all cases if empty.
        echo: callback that prints progress messages.
    """
    of, lines = FrameStudy(footage, folder), []
    echo(f"{footage.name}, undisturbed: {', '.join(f'{of.undisturbed(index):.1f}' for index in range(1, AT + 4))} dB")
    for case in of.cases:
        if names and not any(name in case.name for name in names):
            continue
        for size in case.sizes:
            line = of.run(case, size)
            if line is None:
                echo(f"-      {case.name}, {size}: not possible with {footage.name}")
                continue
            lines.append(line)
            echo(f"{'passed' if not line.violations else 'FAILED'}  {case.name}, {size}  {_decibels(line.against)} dB")
            for sentence in [*line.said, *(f"! {violation}" for violation in line.violations)]:
                echo(f"       {sentence}")
    failed = sum(bool(line.violations) for line in lines)
    echo(
        f"{len({line.case.name for line in lines})} frame cases ({len(lines)} counting each size separately), {failed} "
        "failures"
    )
    return lines


def table(lines: Sequence[FrameCaseResult]) -> str:
    """Formats the results as a Markdown table, with one row per case and size."""
    rows = [
        "| case | size | description of the size | reports | dB relative to undisturbed | passes |",
        "|" + "---|" * 6,
    ]
    for line in lines:
        verdict = "yes" if not line.violations else f"**no**: {'; '.join(line.violations)}"
        said = "; ".join(line.said)
        rows.append(
            f"| {line.case.name} | {line.size} | {line.case.what} | {said} | {_decibels(line.against)} | {verdict} |"
        )
    return "\n".join(rows)


def _decibels(values: Sequence[float]) -> str:
    return " ".join(f"{value:+.1f}" for value in values)


def _said(step: FrameStep) -> str:
    """Formats a frame's report as one line."""
    report = step.report
    words = [] if report.degraded is None else [report.degraded]
    if report.dropped:
        words.append("without " + ", ".join(f"{name} ({why})" for name, why in report.dropped.items()))
    alarms = [alarm for alarm in report.alarms if alarm.kind not in FRAME_ALARMS and alarm.camera not in report.dropped]
    words += [alarm.evidence if alarm.camera is None else f"{alarm.camera}: {alarm.evidence}" for alarm in alarms]
    return "; ".join(words or report.attempts)


def _same(before: Gaussians, after: Gaussians) -> bool:
    there = after.arrays()
    return all(np.array_equal(array, there[name]) for name, array in before.arrays().items())


def sound(state: Gaussians) -> bool:
    """Returns whether a state is finite and its rotations have unit length."""
    finite = all(bool(np.isfinite(array).all()) for array in state.arrays().values())
    norms = np.linalg.norm(state.rotations.astype(np.float64), axis=1)
    return finite and bool(np.abs(norms - 1).max() <= UNIT)
