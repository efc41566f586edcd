"""Alarms point a person to what needs a look after a frame. They are made here alone, and only shown everywhere else.

They are derived from the figures that an update has anyway. A camera is compared with its own past and with the other
cameras of the frame, so what all see together is no camera's fault. One frame may be noise: what is not far off has to
stay so for two. The thresholds were read off the captures: docs/stability.md has the distributions.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import log, nan

import numpy as np
from numpy.typing import NDArray

from scas4d_core.frame_outcome import Alarm, AlarmKind, FrameOutcome, degraded_text
from scas4d_core.robust.outliers import LAST_DB, MAX_OUT, Past, allowed, in_doubt, unless_most
from scas4d_core.update.result import CameraFit

TINT = (0.05, 0.1)
"""By how much more than its past and the others a camera's red, green or blue may differ from what is rendered, beside
its two other colours: two frames in a row, and one. Clean: 0.03."""
GAIN = (0.15, 0.25)
"""The same of all its colours together. Clean: 0.09, where a sheet is seen from its edge."""
SPREAD = 4.0
"""Times what half of the cameras differ by in this frame, up to which ``TINT`` and ``GAIN`` are widened: where all are
met badly, as in a few pixels, colours say little."""
SHARPNESS = (0.12, 0.2)
"""The same of the logarithm of a picture's sharpness. Clean: 0.07; blurred by a pixel: 0.42."""
FOLLOWS = 0.2
"""How fast the usual colours and sharpness of a camera follow, as its usual place does; not while they are in doubt."""
ROW = 2
"""Frames in a row with a doubt, from which it is an alarm."""
DARKEST = 0.02
"""Mean of a colour, 0…1, below which it is not held against itself."""
FLAT = 0.5
"""Levels of 255, mean difference of neighbouring pixels, below which a picture has no sharpness."""
ROWS = 64
"""Pixels of a picture, about, from which its sharpness is measured."""
COLOURS = ("red", "green", "blue")

Numbers = NDArray[np.float64]


@dataclass(frozen=True)
class CameraFigures:
    """Figures from which the alarms of one camera are derived.

    Attributes:
        colours: [3] usual ``colours_of``, less the median over the cameras; NaN where not known. sharp: usual
            ``sharpness_of``, NaN where not known.
        misfit, tint, gain, blur, same: frames in a row with a doubt, or with the same picture.
    """

    colours: tuple[float, float, float] = (nan, nan, nan)
    sharp: float = nan
    misfit: int = 0
    tint: int = 0
    gain: int = 0
    blur: int = 0
    same: int = 0

    @classmethod
    def of(cls, past: Past, name: str) -> CameraFigures:
        """Of a camera, as ``row`` left it."""
        row = past.camera_figures.get(name)
        if row is None:
            return cls()
        red, green, blue, sharp, *counts = row
        return cls((red, green, blue), sharp, *(int(count) for count in counts))

    def row(self) -> tuple[float, ...]:
        """As ``Past.camera_figures`` has it."""
        return (*self.colours, self.sharp, self.misfit, self.tint, self.gain, self.blur, self.same)


def alarms_of(
    past: Past,
    after: Past,
    *,
    outcome: FrameOutcome,
    reason: str,
    exposure: float,
    offsets: Mapping[str, float],
    colours: Mapping[str, Numbers],
    sharp: Mapping[str, float],
    same: Collection[str],
    left_out: Collection[str] = (),
) -> tuple[list[Alarm], Past]:
    """The alarms of an update, but for the cameras that were left out; and the past with the figures of the next ones.

    Args:
        past, after: the usual figures before and after it. outcome, reason, exposure: of the frame.
        offsets: dB by camera above (+) or below its usual place. colours: ``colours_of`` each that was rendered.
        sharp: ``sharpness_of`` each picture of the frame. same: cameras whose picture is that of the frame before, bit
            by bit. left_out: cameras that were not believed; that is their alarm.
    """
    count = len(sharp)
    found = _frame_alarms(outcome, reason, exposure, same, count)
    if outcome.rejected or not offsets:
        return found, after  # nothing that a camera could be held against
    watch, raised = dict(after.camera_figures), dict[AlarmKind, dict[str, Alarm]]()
    beside, watches = _minus_median(colours), {name: CameraFigures.of(past, name) for name in sharp}
    changes = {name: value - watches[name].sharp for name, value in sharp.items()}
    common = float(np.nanmedian(list(changes.values()))) if not np.isnan(list(changes.values())).all() else 0.0
    few_same = len(same) <= MAX_OUT * count
    moved = {name: colour - _known(watches[name].colours, colour) for name, colour in beside.items() if name in watches}
    spread = (
        _upper_median(odd_channel_change(change) for change in moved.values()),
        _upper_median(common_change(change) for change in moved.values()),
    )
    for name, before in watches.items():
        now, alarms = _check_camera(
            name, before, past, offsets.get(name), beside.get(name), sharp[name], changes[name] - common,
            few_same and name in same, spread,
        )  # fmt: skip
        watch[name] = now.row()
        if name not in left_out:
            for alarm in alarms:
                raised.setdefault(alarm.what, {})[name] = alarm
    found += [alarm for of_kind in raised.values() for alarm in unless_most(of_kind, count).values()]
    return found, replace(after, camera_figures=watch)


def _check_camera(
    name: str,
    before: CameraFigures,
    past: Past,
    offset: float | None,
    colours: Numbers | None,
    sharp: float,
    sharper: float,
    same: bool,
    spread: tuple[float, float],
) -> tuple[CameraFigures, list[Alarm]]:
    """A camera's figures for the next frame, and its alarms.

    Args:
        before: its figures. past: of all. offset: dB; None: not rendered. colours: beside the others'.
        sharp: of its picture; ``sharper``: than usual, beside the others. same: as in the frame before, and others not.
        spread: tint and gain that half of the cameras differ by.
    """
    now, alarms = replace(before, same=before.same + 1 if same else 0), list[Alarm]()
    if now.same >= ROW:
        text = f"its picture is the same, bit by bit, for {now.same + 1} frames, and those of the others are not"
        alarms.append(Alarm(AlarmKind.CAMERA_FROZEN, name, text))
    if offset is not None:
        now = replace(now, misfit=before.misfit + 1 if in_doubt(past, offset) else 0)
        if offset < LAST_DB + allowed(past) or now.misfit >= ROW:
            text = f"its picture fits {-offset:.1f} dB worse than usual beside the others: moved, dirty or late?"
            alarms.append(Alarm(AlarmKind.CAMERA_MISFIT, name, text))
    if colours is not None:
        usual = _known(before.colours, colours)
        change = colours - usual
        tint, gain = odd_channel_change(change), common_change(change)
        tints, gains = np.maximum(TINT, SPREAD * spread[0]), np.maximum(GAIN, SPREAD * spread[1])
        now = replace(now, tint=before.tint + 1 if tint > tints[0] else 0)
        now = replace(now, gain=before.gain + 1 if abs(gain) > gains[0] else 0)
        if tint > tints[1] or now.tint >= ROW:
            parts = ", ".join(f"{colour} {100 * part:+.0f} %" for colour, part in zip(COLOURS, change, strict=True))
            text = f"its colours are off, against its past and the others: {parts}; white balance?"
            alarms.append(Alarm(AlarmKind.CAMERA_COLOURS, name, text))
        elif abs(gain) > gains[1] or now.gain >= ROW:
            size = f"{100 * abs(gain):.0f} % {'brighter' if gain > 0 else 'darker'}"
            text = f"its picture is {size} than it should be, against its past and the others: exposure?"
            alarms.append(Alarm(AlarmKind.CAMERA_COLOURS, name, text))
        if not now.tint and not now.gain:
            red, green, blue = (usual + FOLLOWS * change).tolist()
            now = replace(now, colours=(red, green, blue))
    if not np.isnan(sharper):
        now = replace(now, blur=before.blur + 1 if abs(sharper) > SHARPNESS[0] else 0)
        if abs(sharper) > SHARPNESS[1] or now.blur >= ROW:
            how, why = ("sharper", "noise?") if sharper > 0 else ("less sharp", "out of focus?")
            text = f"its picture is {100 * abs(np.expm1(sharper)):.0f} % {how} than usual beside the others: {why}"
            alarms.append(Alarm(AlarmKind.CAMERA_SHARPNESS, name, text))
    if np.isnan(before.sharp):
        now = replace(now, sharp=sharp)
    elif not now.blur and not np.isnan(sharp):
        now = replace(now, sharp=before.sharp + FOLLOWS * (sharp - before.sharp))
    return now, alarms


def odd_channel_change(change: Numbers) -> float:
    """By how much one of three colours changed beside the two others."""
    return float(np.abs(change - np.median(change)).max())


def common_change(change: Numbers) -> float:
    """By how much three colours changed together."""
    return float(np.median(change))


def _known(usual: tuple[float, float, float], now: Numbers) -> Numbers:
    """[3] the usual colours, where they are not known those of now."""
    known: Numbers = np.where(np.isnan(usual), now, usual)
    return known


def _upper_median(sizes: Iterable[float]) -> float:
    """The size that half of them, rounded up, do not exceed; 0 of none."""
    ordered = sorted(abs(size) for size in sizes)
    return ordered[(len(ordered) - 1) // 2] if ordered else 0.0


def left_out_alarms(names: Sequence[str], shown: Collection[str], dropped: Mapping[str, str]) -> list[Alarm]:
    """Alarms of the cameras that a frame was reconstructed without.

    Args:
        names: of the rig's cameras. shown: those with a picture. dropped: left out, with the reason.
    """
    reasons = {name: "no picture came" for name in names if name not in shown} | dict(dropped)
    return [
        Alarm(AlarmKind.CAMERA_LEFT_OUT, name, f"left out of this frame: {why}")
        for name, why in sorted(reasons.items())
    ]


def colours_of(shift: Sequence[float], mean: Sequence[float] | Numbers) -> Numbers:
    """[3] by how much brighter a camera's red, green and blue are than they are rendered, of 1.

    Args:
        shift: ``CameraFit.colour_shift``. mean: of the camera's picture, 0…1.

    >>> colours_of((0.05, 0.0, -0.02), (0.3, 0.2, 0.18)).round(3).tolist()
    [0.2, 0.0, -0.1]
    """
    shifts = np.array(shift, np.float64)
    rendered: Numbers = np.maximum(np.array(mean, np.float64) - shifts, DARKEST)
    return shifts / rendered


def colours_by_camera(fits: Mapping[str, CameraFit], means: Mapping[str, Numbers]) -> dict[str, Numbers]:
    """``colours_of`` each camera whose shift was measured and whose picture's mean is given."""
    shifts = {name: (fit["colour_shift"], means[name]) for name, fit in fits.items() if name in means}
    return {name: colours_of(shift, mean) for name, (shift, mean) in shifts.items() if shift is not None}


def sharpness_of(picture: NDArray[np.uint8]) -> float:
    """Logarithm of how large second differences along the rows of a picture [H, W, 3] are, of the first.

    How much there is to see in it cancels out, so what moves through it is no sign; NaN where there is nothing.
    """
    rows = picture[:: max(1, len(picture) // ROWS)].astype(np.int16)
    first = np.diff(rows, axis=1)
    slope, bend = (float(np.abs(part).mean()) if part.size else 0.0 for part in (first, np.diff(first, axis=1)))
    return log(bend / slope) if slope > FLAT and bend > 0 else nan


def sharpness(pictures: Mapping[str, NDArray[np.uint8]]) -> dict[str, float]:
    """Of each camera's picture."""
    return {name: sharpness_of(picture) for name, picture in pictures.items()}


def with_first_figures(past: Past, pictures: Mapping[str, NDArray[np.uint8]]) -> Past:
    """The past after frame 0, with the figures of its pictures for the alarms."""
    return replace(
        past, camera_figures={name: CameraFigures(sharp=value).row() for name, value in sharpness(pictures).items()}
    )


def _minus_median(colours: Mapping[str, Numbers]) -> dict[str, Numbers]:
    """Colours less the median over the cameras: a light that all see is no camera's."""
    if not colours:
        return {}
    common = np.median(list(colours.values()), axis=0)
    return {name: colour - common for name, colour in colours.items()}


def _frame_alarms(
    outcome: FrameOutcome, reason: str, exposure: float, same: Collection[str], count: int
) -> list[Alarm]:
    """Alarms of no camera."""
    text = degraded_text(outcome, reason)
    if text is not None:
        return [Alarm(AlarmKind.FRAME_REJECTED if outcome.rejected else AlarmKind.FRAME_IN_PART, None, text)]
    if count and len(same) == count:
        return [Alarm(AlarmKind.FRAME_REPEATED, None, f"all {count} cameras send the same pictures again, bit by bit")]
    if exposure != 1.0:
        return [Alarm(AlarmKind.LIGHT, None, f"the pictures are {exposure:.2g} times as bright as before")]
    return []
