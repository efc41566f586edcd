"""Alarms, which point out conditions that need attention after a frame. Only this module raises them.

Alarms are derived from values that an update computes anyway; only a search for dirt renders images. A camera is
compared with its own past and with the other cameras of the frame. A change that all cameras see is not attributed to a
single camera. Because a single frame may be noise, small deviations must persist for two or three frames. The
thresholds were chosen from measurements on the captures; docs/stability.md shows the distributions.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isnan, log, nan
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.views import TrainingView
from scas4d_core.frame_outcome import Alarm, AlarmKind, FrameOutcome, degraded_text
from scas4d_core.robust.lens_dirt import ShiftedRegion
from scas4d_core.robust.outliers import LAST_DB, MAX_OUT, Past, allowed, in_doubt, unless_most
from scas4d_core.update.result import CameraFit

TINT = (0.05, 0.1)
"""Maximum deviation of one colour channel from the other two, relative to the camera's past and the other cameras. The
first value applies to two consecutive frames, and the second to a single frame. Clean captures reach 0.03."""
GAIN = (0.15, 0.25)
"""Same as ``TINT``, but for the common deviation of all channels. Clean captures reach 0.09, when a sheet is seen
edge-on."""
JUMP = 0.12
"""Maximum change of a camera's estimated gain from one frame to the next, as a logarithm. Drifting gains change by at
most 0.05. If gains are estimated (effect ``camera_gain``), ``TINT`` and ``GAIN`` do not see a change of the camera."""
CAMERA_GAIN = "camera_gain"
"""Name of the effect that estimates gains."""
SPREAD = 4.0
"""``TINT``, ``GAIN`` and ``JUMP`` are raised to at least this multiple of the median deviation over the cameras of the
frame. If all cameras fit badly, as on small images, colours are unreliable."""
BRIGHTNESS = 0.005
"""Minimum deviation of an image's mean brightness, [0, 1], in ``DIRT_ROW`` consecutive frames, after which the image is
searched for dirt. Clean captures reach 0.004, and dirt that adds 20% white to a ninth of the image causes 0.005 to
0.02."""
DIRT_ROW = 3
"""Number of consecutive frames in which the brightness must deviate in the same direction."""
SHARPNESS = (0.12, 0.2)
"""Same as ``TINT``, but for the deviation of the log sharpness. Clean captures reach 0.07, and a blur of one pixel
causes 0.42."""
FOLLOWS = 0.2
"""Rate at which the usual colours, brightness and sharpness of a camera follow new values, unless these are suspect."""
ROW = 2
"""Number of consecutive suspect frames that raise an alarm."""
DARKEST = 0.02
"""Lower bound of a mean channel value, [0, 1], when computing relative differences."""
SMALLEST_GAIN = 0.02
"""Lower bound of a gain whose logarithm is computed."""
FLAT = 0.5
"""Minimum mean difference of neighbouring pixels, in 8-bit levels, for measuring sharpness."""
ROWS = 64
"""Approximate number of pixel rows used for measuring sharpness."""
COLOURS = ("red", "green", "blue")

Numbers = NDArray[np.float64]
Value = TypeVar("Value", float, Numbers)


@dataclass(frozen=True)
class CameraFigures:
    """Figures from which the alarms of one camera are derived.

    Attributes:
        colours: [3] usual value of ``colours_of`` minus the median over cameras; NaN if unknown.
        sharp: usual value of ``sharpness_of``; NaN if unknown.
        brightness: usual mean difference between the image and its rendering, minus the median over cameras; NaN if
            unknown.
        misfit, tint, gain, blur: numbers of consecutive suspect frames.
        dirt: number of consecutive images whose ``brightness`` deviates in the same direction; negative if they are
            darker.
        same: number of consecutive frames in which the image was repeated.
    """

    colours: tuple[float, float, float] = (nan, nan, nan)
    sharp: float = nan
    brightness: float = nan
    misfit: int = 0
    tint: int = 0
    gain: int = 0
    blur: int = 0
    dirt: int = 0
    same: int = 0

    @classmethod
    def of(cls, past: Past, name: str) -> CameraFigures:
        """Returns a camera's figures from a row created by ``row``, or the defaults if there is no row."""
        row = past.camera_figures.get(name)
        if row is None:
            return cls()
        red, green, blue, sharp, brightness = row[:5]
        return cls((red, green, blue), sharp, brightness, *map(int, row[5:]))

    def row(self) -> tuple[float, ...]:
        """Returns the figures as a row of ``Past.camera_figures``."""
        counts = self.misfit, self.tint, self.gain, self.blur, self.dirt, self.same
        return (*self.colours, self.sharp, self.brightness, *counts)


def alarms_of(
    past: Past,
    after: Past,
    *,
    outcome: FrameOutcome,
    reason: str,
    exposure: float,
    offsets: Mapping[str, float],
    colours: Mapping[str, Numbers],
    gains: tuple[Mapping[str, Numbers], Mapping[str, Numbers]],
    differences: Mapping[str, float],
    region: Callable[[str], ShiftedRegion | None],
    sharp: Mapping[str, float],
    same: Collection[str],
    left_out: Collection[str] = (),
) -> tuple[list[Alarm], Past]:
    """Returns the alarms of an update, and the past for the next frame.

    An excluded camera has an alarm of ``left_out_alarms``, and here only that of a frozen image.

    Args:
        past, after: usual values before and after the frame.
        outcome: outcome of the frame.
        reason: reason for the outcome.
        exposure: ratio of the frame's brightness to the usual brightness.
        offsets: offset of each camera above (+) or below its usual fit, in dB.
        colours: ``colours_of`` for each rendered camera.
        gains: ``log_gains`` before and after the update; empty unless the previous update has estimated them.
        differences: ``mean_differences`` of the cameras used for the frame.
        region: function that searches a camera's image for dirt; see ``lens_dirt.shifted_region``.
        sharp: ``sharpness_of`` for each image of the frame.
        same: names of the cameras whose image is bit-identical to the previous one.
        left_out: names of the excluded cameras, for which ``left_out_alarms`` returns the alarms.
    """
    count = len(sharp)
    found = _frame_alarms(outcome, reason, exposure, same, count)
    if outcome.rejected or not offsets:
        return found, after  # there is nothing to compare the cameras with
    beside, watches = _minus_median(colours), {name: CameraFigures.of(past, name) for name in sharp}
    changes = {name: value - watches[name].sharp for name, value in sharp.items()}
    common = float(np.nanmedian(list(changes.values()))) if not np.isnan(list(changes.values())).all() else 0.0
    few_same = len(same) <= MAX_OUT * count
    shifts = colour_changes(
        {name: (watches[name].colours, colours) for name, colours in beside.items() if name in watches}
    )
    spread = (
        _upper_median(shift.odd_channel for shift in shifts.values()),
        _upper_median(shift.common for shift in shifts.values()),
    )
    figures, alarms = dict[str, CameraFigures](), dict[str, list[Alarm]]()
    for name, before in watches.items():
        figures[name], alarms[name] = _check_camera(
            name, before, past, offsets.get(name), shifts.get(name), sharp[name], changes[name] - common,
            few_same and name in same, spread,
        )  # fmt: skip
    _check_gains(alarms, *map(_minus_median, gains))
    _check_for_dirt(figures, alarms, _minus_median(differences), region)
    raised: dict[AlarmKind, dict[str, Alarm]] = {}
    for name in figures:
        for alarm in alarms[name]:
            if name in left_out and alarm.kind is not AlarmKind.CAMERA_FROZEN:
                continue  # only the images themselves show what is wrong with a camera that was not used
            raised.setdefault(alarm.kind, {})[name] = alarm
    found += [alarm for of_kind in raised.values() for alarm in unless_most(of_kind, count).values()]
    rows = {name: now.row() for name, now in figures.items()}
    return found, replace(after, camera_figures={**after.camera_figures, **rows})


def _check_camera(
    name: str,
    before: CameraFigures,
    past: Past,
    offset: float | None,
    shift: ColourChange | None,
    sharp: float,
    sharper: float,
    same: bool,
    spread: tuple[float, float],
) -> tuple[CameraFigures, list[Alarm]]:
    """Returns a camera's figures for the next frame, and its alarms.

    Args:
        name: name of the camera.
        before: previous figures of the camera.
        past: usual values of all cameras.
        offset: offset of the camera from its usual fit, in dB, or None if it was not rendered.
        shift: change of the camera's colours relative to the other cameras, or None if unknown.
        sharp: sharpness of the image.
        sharper: change from the usual sharpness, relative to the other cameras.
        same: whether the image is unchanged while those of other cameras have changed.
        spread: median tint and gain deviations over the cameras.
    """
    # With one copy of the dataclass per figure, the copies would take longer than the checks.
    colours, usual_sharp, misfit, tint_frames, gain_frames, blur = (
        before.colours, before.sharp, before.misfit, before.tint, before.gain, before.blur
    )  # fmt: skip
    repeats, alarms = before.same + 1 if same else 0, list[Alarm]()
    if repeats >= ROW:
        text = f"its image has been identical for {repeats + 1} frames, while those of other cameras have changed"
        alarms.append(Alarm(AlarmKind.CAMERA_FROZEN, name, text))
    if offset is not None:
        misfit = before.misfit + 1 if in_doubt(past, offset) else 0
        if offset < LAST_DB + allowed(past) or misfit >= ROW:
            text = (
                f"its image fits {-offset:.1f} dB worse than usual relative to the other cameras; check whether the "
                "camera has moved, is dirty or lags"
            )
            alarms.append(Alarm(AlarmKind.CAMERA_MISFIT, name, text))
    if shift is not None:
        change, tint, gain = shift.change, shift.odd_channel, shift.common
        tints, gains = (
            [max(size, SPREAD * spread[0]) for size in TINT],
            [max(size, SPREAD * spread[1]) for size in GAIN],
        )
        tint_frames = before.tint + 1 if tint > tints[0] else 0
        gain_frames = before.gain + 1 if abs(gain) > gains[0] else 0
        if tint > tints[1] or tint_frames >= ROW:
            parts = ", ".join(f"{colour} {100 * part:+.0f}%" for colour, part in zip(COLOURS, change, strict=True))
            text = (
                f"its colours differ from its earlier images and the other cameras ({parts}); check the white balance"
            )
            alarms.append(Alarm(AlarmKind.CAMERA_COLOURS, name, text))
        elif abs(gain) > gains[1] or gain_frames >= ROW:
            size = f"{100 * abs(gain):.0f}% {'brighter' if gain > 0 else 'darker'}"
            text = (
                f"its image is {size} than expected from its earlier images and the other cameras; check the exposure"
            )
            alarms.append(Alarm(AlarmKind.CAMERA_COLOURS, name, text))
        if not tint_frames and not gain_frames:
            red, green, blue = (shift.usual + FOLLOWS * change).tolist()
            colours = (red, green, blue)
    if not isnan(sharper):
        blur = before.blur + 1 if abs(sharper) > SHARPNESS[0] else 0
        if abs(sharper) > SHARPNESS[1] or blur >= ROW:
            how, why = ("sharper", "check for noise") if sharper > 0 else ("less sharp", "check the focus")
            text = (
                f"its image is {100 * abs(np.expm1(sharper)):.0f}% {how} than usual relative to the other cameras; "
                f"{why}"
            )
            alarms.append(Alarm(AlarmKind.CAMERA_SHARPNESS, name, text))
    if isnan(before.sharp):
        usual_sharp = sharp
    elif not blur and not isnan(sharp):
        usual_sharp = before.sharp + FOLLOWS * (sharp - before.sharp)
    counts = misfit, tint_frames, gain_frames, blur, before.dirt, repeats
    return CameraFigures(colours, usual_sharp, before.brightness, *counts), alarms


def _check_gains(
    alarms: Mapping[str, list[Alarm]], before: Mapping[str, Numbers], after: Mapping[str, Numbers]
) -> None:
    """Compares each camera's gains with those of the previous frame.

    A jump raises an alarm in one frame, because the estimated gain then compensates for it.

    Args:
        alarms: alarms of each camera, to which alarms are added.
        before, after: log gains before and after the update, minus the median over cameras.
    """
    changes = {name: after[name] - before[name] for name in alarms if name in before and name in after}
    largest = {name: float(np.abs(change).max()) for name, change in changes.items()}
    limit = max(JUMP, SPREAD * _upper_median(largest.values()))
    for name, change in changes.items():
        if largest[name] > limit:
            parts = ", ".join(
                f"{colour} {100 * part:+.0f}%" for colour, part in zip(COLOURS, np.expm1(change), strict=True)
            )
            text = (
                f"its gain has jumped relative to the other cameras ({parts}); check the exposure and the white balance"
            )
            alarms[name].append(Alarm(AlarmKind.CAMERA_COLOURS, name, text))


def _check_for_dirt(
    figures: dict[str, CameraFigures],
    alarms: Mapping[str, list[Alarm]],
    brightness: Mapping[str, float],
    region: Callable[[str], ShiftedRegion | None],
) -> None:
    """Searches images for dirt whose brightness has deviated for ``DIRT_ROW`` frames, unless most images deviate.

    Args:
        figures: figures of the cameras, which are updated.
        alarms: alarms of each camera, to which alarms are added. Cameras that have one are not searched.
        brightness: mean difference between each camera's image and its rendering, minus the median over cameras.
        region: see ``alarms_of``.
    """
    suspects = []
    for name in figures.keys() & brightness.keys():
        usual, dirt = figures[name].brightness, figures[name].dirt
        change = 0.0 if isnan(usual) else brightness[name] - usual
        sign = 1 if change > 0 else -1
        if abs(change) > BRIGHTNESS:
            dirt = sign * (max(sign * dirt, 0) + 1)
        else:
            usual, dirt = brightness[name] if isnan(usual) else usual + FOLLOWS * change, 0
        figures[name] = replace(figures[name], brightness=usual, dirt=dirt)
        if abs(dirt) >= DIRT_ROW and not alarms[name]:
            suspects.append(name)
    for name in sorted(suspects) if len(suspects) <= MAX_OUT * len(figures) else ():
        found, sign = region(name), 1 if figures[name].dirt > 0 else -1
        if found is not None and found.is_dirt and sign * found.level > 0:
            text = (
                f"a region of {100 * found.share:.0f}% of its image is {'brighter' if sign > 0 else 'darker'} than the "
                f"other cameras suggest, by {100 * abs(found.level):.0f}% of the full range; check the lens for dirt"
            )
            alarms[name].append(Alarm(AlarmKind.CAMERA_MISFIT, name, text))
        elif found is not None:  # something else has changed, and the image becomes the usual one
            figures[name] = replace(figures[name], brightness=brightness[name], dirt=0)


class ColourChange(NamedTuple):
    """Change of a camera's colours.

    Attributes:
        usual: [3] usual colours, or the current ones if the usual colours are unknown.
        change: [3] current minus usual colours.
        odd_channel: largest change of one channel relative to the median of the channels.
        common: change that the channels share, which is their median change.
    """

    usual: Numbers
    change: Numbers
    odd_channel: float
    common: float


def colour_changes(
    colours: Mapping[str, tuple[tuple[float, float, float], Numbers]],
) -> dict[str, ColourChange]:
    """Returns the change of each camera's colours, given its usual (NaN if unknown) and its current colours."""
    if not colours:
        return {}
    known, now = (np.array(values) for values in zip(*colours.values(), strict=True))
    usual = np.where(np.isnan(known), now, known)
    changes = now - usual
    common = np.median(changes, axis=1)
    odd = np.abs(changes - common[:, None]).max(axis=1)
    rows = zip(usual, changes, odd.tolist(), common.tolist(), strict=True)
    return {name: ColourChange(*row) for name, row in zip(colours, rows, strict=True)}


def _upper_median(sizes: Iterable[float]) -> float:
    """Returns the median absolute value (the lower of two middle values), or 0 if there are no values."""
    ordered = sorted(abs(size) for size in sizes)
    return ordered[(len(ordered) - 1) // 2] if ordered else 0.0


def left_out_alarms(names: Sequence[str], shown: Collection[str], dropped: Mapping[str, str]) -> list[Alarm]:
    """Returns the alarms of cameras that were not used for a frame.

    Args:
        names: names of the rig's cameras.
        shown: names of the cameras with an image.
        dropped: maps each excluded camera to the reason for its exclusion.
    """
    reasons = {name: "no image was received" for name in names if name not in shown} | dict(dropped)
    return [
        Alarm(AlarmKind.CAMERA_LEFT_OUT, name, f"not used in this frame: {why}")
        for name, why in sorted(reasons.items())
    ]


def colours_of(shift: Sequence[float], mean: Sequence[float] | Numbers) -> Numbers:
    """Returns the [3] relative brightness difference between a camera's channels and their rendering.

    Args:
        shift: [3] colour shift of the camera; see ``CameraFit.colour_shift``.
        mean: [3] mean colour of the camera's image, [0, 1].

    >>> colours_of((0.05, 0.0, -0.02), (0.3, 0.2, 0.18)).round(3).tolist()
    [0.2, 0.0, -0.1]
    """
    shifts = np.array(shift, np.float64)
    rendered: Numbers = np.maximum(np.array(mean, np.float64) - shifts, DARKEST)
    return shifts / rendered


def log_gains(views: Iterable[TrainingView]) -> dict[str, Numbers]:
    """Returns the log gain [3] of the sRGB channels of each view."""
    return {view.name: np.log(np.maximum(view.exposure[:3, 0].astype(np.float64), SMALLEST_GAIN)) for view in views}


def mean_differences(fits: Mapping[str, CameraFit]) -> dict[str, float]:
    """Returns the mean difference between each camera's image and its rendering: that of the median channel, [-1, 1].

    >>> mean_differences({"north": {"psnr": 30.0, "colour_shift": (0.1, 0.02, 0.01), "health": 1.0}})
    {'north': 0.02}
    """
    shifts = {name: fit["colour_shift"] for name, fit in fits.items()}
    return {name: sorted(shift)[1] for name, shift in shifts.items() if shift is not None}


def colours_by_camera(fits: Mapping[str, CameraFit], means: Mapping[str, Numbers]) -> dict[str, Numbers]:
    """Returns ``colours_of`` for each camera with a measured shift and a given image mean."""
    shifts = {name: (fit["colour_shift"], means[name]) for name, fit in fits.items() if name in means}
    return {name: colours_of(shift, mean) for name, (shift, mean) in shifts.items() if shift is not None}


def sharpness_of(picture: NDArray[np.uint8]) -> float:
    """Returns the log ratio of second to first differences along the rows of an image [H, W, 3].

    The ratio cancels the amount of texture, so objects that move through the image do not affect it. Returns NaN for an
    image without texture.
    """
    every = max(1, len(picture) // ROWS)
    first = np.diff(picture[::every].astype(np.int16), axis=1)
    slope, bend = (float(np.abs(steps).mean()) if steps.size else 0.0 for steps in (first, np.diff(first, axis=1)))
    return log(bend / slope) if slope > FLAT and bend > 0 else nan


def sharpness(pictures: Mapping[str, NDArray[np.uint8]]) -> dict[str, float]:
    """Returns the sharpness of each camera's image."""
    return {name: sharpness_of(picture) for name, picture in pictures.items()}


def with_first_figures(past: Past, pictures: Mapping[str, NDArray[np.uint8]]) -> Past:
    """Returns the past after frame 0, extended by the alarm figures of its images."""
    return replace(
        past, camera_figures={name: CameraFigures(sharp=value).row() for name, value in sharpness(pictures).items()}
    )


def _minus_median(values: Mapping[str, Value]) -> dict[str, Value]:
    """Returns values minus their median over cameras, which removes a lighting change that all cameras see."""
    if not values:
        return {}
    common: Any = np.median(list(values.values()), axis=0)
    return {name: value - common for name, value in values.items()}


def _frame_alarms(
    outcome: FrameOutcome, reason: str, exposure: float, same: Collection[str], count: int
) -> list[Alarm]:
    """Returns the alarms that do not concern a single camera."""
    text = degraded_text(outcome, reason)
    if text is not None:
        return [Alarm(AlarmKind.FRAME_REJECTED if outcome.rejected else AlarmKind.FRAME_IN_PART, None, text)]
    if count and len(same) == count:
        return [Alarm(AlarmKind.FRAME_REPEATED, None, f"all {count} cameras repeated bit-identical images")]
    if exposure != 1.0:
        return [Alarm(AlarmKind.LIGHT, None, f"the images are {exposure:.2g} times as bright as before")]
    return []
