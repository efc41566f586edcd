"""Faults of a single camera: the faulty frames, and checks that an alarm names the camera.

Lenses lose focus or get dirty, gain or white balance jumps, or a frame grabber repeats its last image. Such faults may
hardly affect the update, but the operator must be alerted while the recording can still be saved.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from frame_cases.cases import Footage, FrameCase, FrameStep, Holds, Sent, near, replaced, two_cameras
from scas4d_core.captures.frame import Frame
from studies.hard_frames.camera_faults import FRAMES, Picture, blurred, dirty, noisy, scaled

SOON = 2
"""Number of faulty frames within which the alarm must be raised. A frozen image is recognized by its third frame."""
FIELD = "operators of rigs: lenses, gains and frame grabbers"

Fault = Callable[[Picture, Any], Picture]
"""Function that applies a fault of the given size to an image."""


def camera_faults(footage: Footage) -> tuple[FrameCase, ...]:
    """Returns the fault cases, all for the same camera."""
    name = two_cameras(footage)[0]

    def case(title: str, what: str, sizes: tuple[Any, ...], fault: Fault) -> FrameCase:
        return FrameCase(
            title,
            what,
            FIELD,
            sizes,
            lambda shown, at, size: _faulty(shown, at, name, size, fault),
            reports_alarm(name, SOON),
        )

    return (
        case("a camera out of focus", "blur in pixels", (1.5, 3.0), blurred),
        case("a camera's gain jumps", "factor on all its pixels", (0.7, 0.3), scaled),
        case(
            "a camera's white balance jumps", "factor on its red channel", (1.1, 1.25),
            lambda picture, size: scaled(picture, (size, 1.0, 1.0)),
        ),
        case("a camera is noisy", "standard deviation of the noise, in levels of 255", (10, 25), noisy),
        case(
            "a lens is dirty", "amount of white added to the middle ninth of the image, which is also blurred",
            (0.2, 0.35), dirty,
        ),
        FrameCase(
            "a camera's image freezes",
            "number of frames in which it repeats its previous image while the others continue", FIELD, (FRAMES,),
            lambda shown, at, size: _standing(shown, at, name, size), reports_alarm(name, FRAMES),
        ),
    )  # fmt: skip


def reports_alarm(name: str, soon: int) -> Holds:
    """Returns a check that only one camera raises an alarm, soon enough, and that tracking is almost as good as usual.

    Args:
        name: name of the faulty camera.
        soon: number of faulty frames within which the alarm must be raised.
    """

    def holds(steps: Sequence[FrameStep], size: Any) -> list[str]:
        faults = (
            [] if any(_names(step, name) for step in steps[:soon]) else [f"no alarm for {name} within {soon} frames"]
        )
        for step in steps:
            others = {alarm.camera for alarm in step.report.alarms} - {name}
            faults += [
                f"frame {step.report.index}: unexpected alarm for {other or 'the frame'}"
                for other in sorted(others, key=str)
            ]
        return faults + near(steps, size)

    return holds


def _names(step: FrameStep, name: str) -> bool:
    return any(alarm.camera == name for alarm in step.report.alarms)


def _faulty(footage: Footage, at: int, name: str, size: Any, fault: Fault) -> list[Sent]:
    def change(number: int, frame: Frame) -> Frame:
        images = {**frame.images, name: fault(np.asarray(frame.images[name]), size)}
        return Frame(frame.index, frame.time, images, frame.masks)

    return replaced(footage, at, FRAMES, change)


def _standing(footage: Footage, at: int, name: str, count: int) -> list[Sent]:
    before = footage.frame(at - 1)

    def change(number: int, frame: Frame) -> Frame:
        masks = {**frame.masks, name: before.masks[name]} if name in before.masks else frame.masks
        return Frame(frame.index, frame.time, {**frame.images, name: before.images[name]}, masks)

    return replaced(footage, at, count, change)
