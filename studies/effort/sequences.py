"""Frame sequences for testing updates: a capture played back and forth, with repeated frames, or slowed down."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from client.pictures import eight_bit
from client.rig.sequence import ping_pong
from scas4d_core.captures import Capture, Frame
from scas4d_core.gaussians import Gaussians
from studies.quality.first_frame import started
from studies.quality.settings import settings_of


@dataclass(frozen=True)
class Shown:
    """A frame of a sequence.

    Attributes:
        frame: the frame.
        truth: true images of the test cameras, from 0 to 1, keyed by camera name.
        repeats: whether the frame repeats the previous one.
    """

    frame: Frame
    truth: Mapping[str, NDArray[np.float32]]
    repeats: bool = False


def back_and_forth(capture: Capture, frames: int) -> Iterator[Frame]:
    """Yields ``frames`` frames after the first, played back and forth with increasing times."""
    count = capture.frame_count
    first, second = capture.frame(0), capture.frame(1)
    step = second.time - first.time
    for index in range(1, frames + 1):
        shown = capture.frame(ping_pong(index, count))
        yield Frame(index, first.time + index * step, shown.images, shown.masks)


def as_it_is(capture: Capture, updates: int) -> Iterator[Shown]:
    """Yields the first ``updates`` frames of a capture after frame 0, or fewer if the capture is shorter."""
    for index in range(1, min(updates + 1, capture.frame_count)):
        yield Shown(capture.frame(index), _truth(capture, index))


def repeated(capture: Capture, updates: int) -> Iterator[Shown]:
    """Yields every frame twice, as if recorded at half the frame rate, and frame 3 four times."""
    step = capture.frame(1).time - capture.frame(0).time
    number = 0
    for index in range(1, min(updates + 1, capture.frame_count)):
        shown = capture.frame(index)
        for turn in range(4 if index == 3 else 2):
            number += 1
            frame = Frame(number, capture.frame(0).time + number * step, shown.images, shown.masks)
            yield Shown(frame, _truth(capture, index), repeats=turn > 0)


def slowed(capture: Capture, updates: int, out: Path, factor: int = 3) -> Iterator[Shown]:
    """Yields the frames of a capture slowed down by ``factor``, rendered from interpolated states of a reconstruction.

    The training images and the ground truth are both rendered, so the results are comparable only with each other.
    """
    source = started(capture, settings_of("scas4d"), out)
    for index in range(1, min(updates + 1, capture.frame_count)):
        source.step(capture.frame(index))
    drawn = started(capture, settings_of("scas4d"), out)  # renders interpolated states
    step = capture.frame(1).time - capture.frame(0).time
    number = 0
    for index in range(1, min(updates + 1, capture.frame_count)):
        before, after = source.history.gaussians(index - 1), source.history.gaussians(index)
        for part in range(1, factor + 1):
            number += 1
            mixed = _between(before, after, part / factor)
            drawn.history.append(number, capture.frame(0).time + number * step, mixed)
            images = {c.name: eight_bit(drawn.render(c).colour) for c in capture.rig.cameras}
            cameras = capture.test_rig.cameras if capture.test_rig is not None else ()
            truth = {c.name: drawn.render(c).colour for c in cameras}
            yield Shown(Frame(number, capture.frame(0).time + number * step, images, {}), truth)


def _truth(capture: Capture, index: int) -> dict[str, NDArray[np.float32]]:
    return {key: image.astype(np.float32) / np.float32(255) for key, image in capture.test_frame(index).images.items()}


def _between(before: Gaussians, after: Gaussians, share: float) -> Gaussians:
    """Interpolates linearly between the states of two neighbouring frames."""
    mixed = {
        name: ((1 - share) * getattr(before, name) + share * getattr(after, name)).astype(np.float32)
        for name in ("means", "factors", "colours")
    }
    return after.replace(**mixed)
