"""Cases of faulty frames: the frames that each case sends, and the checks that its result must pass.

From a certain frame on, a case replaces the frames of undisturbed footage, first with faulty frames and then with good
ones. In every case, all values must be finite, and the report must explain what is wrong. The third good frame must be
as good as in the undisturbed run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from scas4d_core.captures.frame import Frame
from scas4d_core.frame_report import FrameReport
from studies.hard_frames.camera_faults import Picture

Pictures = Mapping[str, Picture]

AFTER = 3
"""Number of good frames after the faulty ones. The last good frame is compared with the undisturbed run."""
WITHIN_DB = 0.5
"""Largest allowed PSNR loss of the last good frame relative to the undisturbed run."""
NEAR_DB = 1.0
"""Largest allowed PSNR loss, relative to the undisturbed run, of a faulty frame that can still be tracked."""
JUMPED_DB = 3.0
"""Largest allowed PSNR loss three frames after a jump, which reveals other sides of the object and new shading."""


class Footage(Protocol):
    """An undisturbed sequence with held-out cameras."""

    def frame(self, index: int) -> Frame:
        """Returns a frame with the training images."""

    def truth(self, index: int) -> Pictures:
        """Returns the true images of the held-out cameras."""

    def jumped(self, index: int, sizes: float) -> tuple[Frame, Pictures] | None:
        """Returns the images with the object moved by a multiple of its size, or None if unavailable."""


@dataclass(frozen=True, eq=False)
class Sent:
    """A frame that a case sends.

    Attributes:
        frame: the frame; its index and time are set when it is sent.
        like: index of the footage frame that the result should resemble, which is looked up in the undisturbed run.
        truth: images of the held-out cameras at that moment.
        good: whether the frame is undisturbed.
    """

    frame: Frame
    like: int
    truth: Pictures
    good: bool


@dataclass(frozen=True, eq=False)
class FrameStep:
    """Outcome of one frame.

    Attributes:
        sent: the frame that was sent.
        report: the frame's report.
        kept: whether the state is bit-identical to the state before the frame.
        sound: whether the state is finite and its rotations have unit norm.
        psnr: PSNR of the held-out cameras in dB.
        usual: the same PSNR in the undisturbed run.
    """

    sent: Sent
    report: FrameReport
    kept: bool
    sound: bool
    psnr: float
    usual: float


Make = Callable[[Footage, int, Any], "list[Sent] | None"]
Holds = Callable[[Sequence[FrameStep], Any], list[str]]


@dataclass(frozen=True)
class FrameCase:
    """One entry of the catalogue of faulty frames.

    Attributes:
        name: case name.
        what: meaning of the size, and other details of the case.
        source: origin of the case in the literature or in users' reports.
        sizes: sizes at which the case is run.
        make: function that creates the frames to send, given a start frame and a size; returns None if the footage
            cannot show the case.
        holds: function that returns the checks violated by the faulty frames, besides the shared checks.
        alarms: function that returns whether the faulty frames of a given size must raise an alarm. Frames that
            resemble a resting or a faster scene cannot raise one.
    """

    name: str
    what: str
    source: str
    sizes: tuple[Any, ...]
    make: Make
    holds: Holds
    alarms: Callable[[Any], bool] = lambda size: True


def violations(case: FrameCase, steps: Sequence[FrameStep], size: Any) -> list[str]:
    """Returns the violated checks, one sentence each."""
    faults = [
        f"frame {step.report.index}: the state is not finite, or a rotation does not have unit norm"
        for step in steps
        if not step.sound
    ]
    faulty = [step for step in steps if not step.sent.good]
    faults += case.holds(faulty, size)
    if case.alarms(size) and not any(step.report.alarms for step in faulty):
        faults.append("no alarm")
    last = steps[-1]
    if last.sent.good:
        faults += [f"alarm {AFTER} good frames later: {alarm.evidence}" for alarm in last.report.alarms]
        if not last.psnr >= last.usual - WITHIN_DB:
            faults.append(
                f"{last.psnr - last.usual:+.2f} dB relative to the undisturbed run, {AFTER} good frames later"
            )
        if last.report.degraded is not None:
            faults.append(f"still degraded {AFTER} good frames later: {last.report.degraded}")
    return faults


# Checks of the faulty frames


def held(steps: Sequence[FrameStep], size: Any) -> list[str]:
    """Checks that every frame is rejected and leaves the state unchanged."""
    faults = [f"frame {step.report.index}: the state has changed" for step in steps if not step.kept]
    return faults + [f"frame {s.report.index}: not rejected" for s in steps if not s.report.outcome.rejected]


def left_out(names: Callable[[Any], Sequence[str]], first: int = 0, may: Sequence[str] = ()) -> Holds:
    """Returns a check that the right cameras are excluded, and that tracking is almost as good as usual.

    Args:
        names: function that returns the cameras that must be excluded, given the size of the case.
        first: number of the first faulty frame in which they must be excluded.
        may: other cameras that may be excluded.
    """

    def holds(steps: Sequence[FrameStep], size: Any) -> list[str]:
        faults = []
        for number, step in enumerate(steps):
            wanted, dropped = set(names(size)), set(step.report.dropped)
            missing, others = wanted - dropped, dropped - wanted - set(may)
            if missing and number >= first:
                faults.append(f"frame {step.report.index}: {', '.join(sorted(missing))} not excluded")
            if others:
                faults.append(f"frame {step.report.index}: {', '.join(sorted(others))} also excluded")
        return faults + near(steps, size)

    return holds


def near(steps: Sequence[FrameStep], size: Any) -> list[str]:
    """Checks that the frames are tracked almost as well as usual, with a PSNR loss of at most ``NEAR_DB``."""
    return [
        f"frame {step.report.index}: {step.psnr - step.usual:+.2f} dB relative to the undisturbed run"
        for step in steps
        if not step.psnr >= step.usual - NEAR_DB
    ]


def unchanged(steps: Sequence[FrameStep], size: Any) -> list[str]:
    """Checks that nothing moved and that the update ran no iterations."""
    faults = [f"frame {step.report.index}: the state has changed" for step in steps if not step.kept]
    return faults + [f"frame {s.report.index}: the update ran iterations" for s in steps if s.report.iterations]


def jumped(steps: Sequence[FrameStep], size: Any) -> list[str]:
    """Checks that the last frame loses at most ``JUMPED_DB``."""
    faults, last = [], steps[-1]
    if not last.psnr >= last.usual - JUMPED_DB:
        faults.append(f"not recovered: {last.psnr - last.usual:+.2f} dB after {len(steps)} frames")
    return faults


def explained(steps: Sequence[FrameStep], size: Any) -> list[str]:
    """Checks that each frame's report marks it as degraded or lists excluded cameras."""
    return [
        f"frame {s.report.index}: no explanation in the report"
        for s in steps
        if not (s.report.degraded or s.report.dropped)
    ]


# Frames that are sent


def good(footage: Footage, index: int) -> Sent:
    """Returns an undisturbed frame."""
    return Sent(footage.frame(index), index, footage.truth(index), True)


def replaced(footage: Footage, at: int, count: int, change: Callable[[int, Frame], Frame]) -> list[Sent]:
    """Returns ``count`` changed frames from ``at`` on, followed by good frames, while the scene continues to move."""
    faulty = [
        Sent(change(number, footage.frame(at + number)), at + number, footage.truth(at + number), False)
        for number in range(count)
    ]
    return faulty + [good(footage, at + count + number) for number in range(AFTER)]


def each(frame: Frame, change: Callable[[str, Picture], Picture]) -> Frame:
    """Returns the frame with every image changed and the masks unchanged."""
    images = {name: change(name, np.asarray(frame.images[name])) for name in frame.images}
    return Frame(frame.index, frame.time, images, frame.masks)


def filled(value: int) -> Make:
    """Returns a function that sends ``size`` frames of constant images."""
    return lambda footage, at, size: replaced(
        footage, at, size, lambda number, frame: each(frame, lambda name, picture: np.full_like(picture, value))
    )


def noise(footage: Footage, at: int, size: Any) -> list[Sent]:
    """Sends ``size`` frames in which every pixel is randomly 0 or 255."""
    rng = np.random.default_rng(0)

    def saturated(name: str, picture: Picture) -> Picture:
        return (255 * rng.integers(0, 2, picture.shape)).astype(np.uint8)

    return replaced(footage, at, size, lambda number, frame: each(frame, saturated))


def brighter(factors: Callable[[Any, int], float], count: Callable[[Any], int]) -> Make:
    """Returns a function that sends images multiplied by a factor, saturating at 255.

    Args:
        factors: function that returns the factor, given the size of the case and the number of the faulty frame.
        count: function that returns the number of faulty frames, given the size of the case.
    """

    def make(footage: Footage, at: int, size: Any) -> list[Sent]:
        def changed(number: int, frame: Frame) -> Frame:
            factor = factors(size, number)
            return each(frame, lambda name, picture: (factor * picture).round().clip(0, 255).astype(np.uint8))

        return replaced(footage, at, count(size), changed)

    return make


def swapped(footage: Footage, at: int, size: Any) -> list[Sent]:
    """Swaps the images of two cameras in ``size`` frames."""
    one, two = two_cameras(footage)

    def change(number: int, frame: Frame) -> Frame:
        images, masks = dict(frame.images), dict(frame.masks)
        images[one], images[two] = images[two], images[one]
        if masks:
            masks[one], masks[two] = masks[two], masks[one]
        return Frame(frame.index, frame.time, images, masks)

    return replaced(footage, at, size, change)


def bumped(footage: Footage, at: int, size: Any) -> list[Sent]:
    """Shifts the images of one camera by ``size`` pixels in four frames, without good frames after them."""
    name = two_cameras(footage)[0]

    def change(number: int, frame: Frame) -> Frame:
        images = {**frame.images, name: np.roll(np.asarray(frame.images[name]), size, axis=1)}
        masks = {**frame.masks, name: np.roll(np.asarray(frame.masks[name]), size, axis=1)} if frame.masks else {}
        return Frame(frame.index, frame.time, images, masks)

    return replaced(footage, at, 4, change)[:4]


def capped(footage: Footage, at: int, size: Any) -> list[Sent]:
    """Blackens the images of ``size`` cameras in two frames."""
    names = capped_names(footage, size)
    return replaced(
        footage, at, 2,
        lambda number, frame: each(frame, lambda name, picture: 0 * picture if name in names else picture),
    )  # fmt: skip


def capped_names(footage: Footage, size: int) -> list[str]:
    """Returns the names of the first ``size`` cameras of the rig."""
    return sorted(footage.frame(0).images)[:size]


def still(footage: Footage, at: int, size: Any) -> list[Sent]:
    """Repeats the previous frame ``size`` times, then continues."""
    return _again(footage, at, size, lambda frame: frame)


def stuck(footage: Footage, at: int, size: Any) -> list[Sent]:
    """Repeats the images of the previous frame in ``size`` frames while the scene continues to move."""
    before = footage.frame(at - 1)
    return replaced(footage, at, size, lambda number, frame: before)


def still_noisy(footage: Footage, at: int, size: Any) -> list[Sent]:
    """Repeats the previous frame twice, with noise of standard deviation ``size`` in 8-bit levels."""
    rng = np.random.default_rng(0)

    def change(name: str, picture: Picture) -> Picture:
        return (picture + rng.normal(0, size, picture.shape)).round().clip(0, 255).astype(np.uint8)

    return _again(footage, at, 2, lambda frame: each(frame, change))


def _again(footage: Footage, at: int, count: int, change: Callable[[Frame], Frame]) -> list[Sent]:
    sent = [Sent(change(footage.frame(at - 1)), at - 1, footage.truth(at - 1), False) for _ in range(count)]
    return sent + [good(footage, at + number) for number in range(AFTER)]


def dropping(footage: Footage, at: int, size: Any) -> list[Sent]:
    """Removes more cameras in each frame until ``size`` cameras remain. Then all of them return."""
    names = sorted(footage.frame(0).images)
    count = min(len(names) - size, 7)
    steps = np.linspace(1, len(names) - size, count).round().astype(int)

    def change(number: int, frame: Frame) -> Frame:
        kept = names[steps[number] :]
        return Frame(
            frame.index,
            frame.time,
            {name: frame.images[name] for name in kept},
            {name: frame.masks[name] for name in kept if name in frame.masks},
        )

    return replaced(footage, at, count, change)


def elsewhen(footage: Footage, at: int, size: Any) -> list[Sent]:
    """Sends one frame that shows the scene ``size`` frames later."""
    wrong = footage.frame(at + size)
    faulty = Sent(Frame(at, 0.0, wrong.images, wrong.masks), at + size, footage.truth(at + size), False)
    return [faulty, *(good(footage, at + 1 + number) for number in range(AFTER))]


def teleported(footage: Footage, at: int, size: Any) -> list[Sent] | None:
    """Sends four frames in which the object has moved by ``size`` times its own size and continues from there.

    Returns None if the footage cannot show this.
    """
    sent = []
    for number in range(4):
        jump = footage.jumped(at + number, size)
        if jump is None:
            return None
        sent.append(Sent(jump[0], at + number, jump[1], False))
    return sent


def two_cameras(footage: Footage) -> tuple[str, str]:
    """Returns the names of two cameras that see the object from different directions."""
    names = sorted(footage.frame(0).images)
    return names[1], names[len(names) // 2 + 1]


FIELD = "users' reports of capture systems: caps, triggers, cables and light"
CASES = (
    FrameCase(
        "all black", "number of frames with lens caps or a lost trigger; learning them would paint the scene black",
        FIELD, (1, 3, 5), filled(0), held,
    ),
    FrameCase("all white", "number of overexposed frames", FIELD, (1, 3), filled(255), held),
    FrameCase("saturated noise", "number of frames whose pixels are randomly 0 or 255", FIELD, (1, 3), noise, held),
    FrameCase(
        "lights off and on", "number of frames with 2% of the light, followed by full light", FIELD, (1, 5),
        brighter(lambda size, number: 0.02, lambda size: int(size)), held,
    ),
    FrameCase(
        "exposure flickers", "factor; images are multiplied alternately by it and its inverse for four frames", FIELD,
        (1.1, 1.3, 1.6),
        brighter(lambda size, number: size if number % 2 == 0 else 1 / size, lambda size: 4), near,
    ),
)  # fmt: skip


def named(footage: Footage) -> tuple[FrameCase, ...]:
    """Returns all cases for some footage, including those that refer to particular cameras."""
    one, two = two_cameras(footage)
    return (
        *CASES,
        FrameCase(
            "two cameras swapped", "number of frames with swapped cables", FIELD, (1, 3), swapped,
            left_out(lambda size: (one, two)),
        ),
        FrameCase(
            "a camera is bumped", "permanent shift in pixels; a shift of one may go unnoticed", FIELD,
            (1, 2, 4, 8), bumped,
            left_out(lambda size: (one,) if size > 1 else (), first=1, may=(one,)), lambda size: bool(size > 1),
        ),
        FrameCase(
            "cameras go black", "number of cameras that are black for two frames", FIELD, (1, 3), capped,
            left_out(lambda size: capped_names(footage, size)),
        ),
        FrameCase("nothing moves", "number of times the same images are repeated", FIELD, (1, 5), still, unchanged),
        FrameCase(
            "repeated frame", "number of frames with repeated images while the scene continues", FIELD, (1, 2), stuck,
            unchanged,
        ),
        FrameCase(
            "repeated frame with noise",
            "standard deviation of the noise in levels of 255; the last images are sent twice more", FIELD,
            (1, 3), still_noisy, near, lambda size: False,
        ),
        FrameCase(
            "cameras drop out one by one", "number of cameras that remain before all return", FIELD, (4, 2), dropping,
            lambda steps, size: [],
        ),
        FrameCase(
            "frame from another time", "number of frames by which one frame is ahead", FIELD, (2, 4), elsewhen,
            lambda steps, size: [], lambda size: False,
        ),
        FrameCase(
            "the object jumps", "length of the jump as a multiple of the object's size; it continues from there", FIELD,
            (1.0, 2.0), teleported, jumped, lambda size: size > 1,  # patch matches find a shorter jump
        ),
    )  # fmt: skip
