"""Outlying cameras and frames: each camera is compared with its own past and with the others of the frame.

The figures are those that an update has anyway: how well each camera was met when it was rendered first and last, and
the mean brightness of its picture (``checks``). One camera that fits much worse than the others is left out; a
frame that all cameras agree on is believed as long as it can be met as a whole. The thresholds were read off the
captures: docs/stability.md has the distributions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import isfinite, log2, log10, nan
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

FIRST_DB = -9.0
"""Against its usual place among the cameras when first rendered: such a camera is left out at once; clean: -6.1."""
LAST_DB = -5.0
"""The same when last rendered: left out from the next frame on. Clean: -3.7; moved by one or two pixels: -6 to -15."""
NEAR_DB = -4.0
"""The same, from which a camera is in doubt: its usual place does not follow, so that what lasts is seen to last; two
frames in a row are an alarm. Clean: -3.7."""
FITS_DB = -4.0
"""From which a camera that was left out is believed again: colours that follow the others do not follow it."""
NEW_DB = (-4.0, -2.0, -2.0)
"""More is allowed for in the first updates: a camera's place is known from frame 0 alone, or from one update."""
DROP_DB = 6.0
"""Of the cameras' median below its usual, from which an update has not met its frame."""
DROPS_DB = (14.0, 9.0, 9.0)
"""The same in the first updates: what is usual is known from frame 0 alone, or from an update that took longer."""
HALVED_DB = 3.0
"""More is allowed for each halving of the iterations: 100 to 50 cost 1.7 dB on the captures, 50 to 25 3.2."""
BEHIND_DB = 1.5
"""The same, from which the first frames after held ones are sought longer: what moved on unseen is further away."""
RESTS_DB = 3.0
"""The same, up to which a scene in which nothing is seen to move may stand: noise that frame 0 fits costs 1 to 2 dB."""
CATCH_UP = 3
"""Frames that are, at most."""
MAX_OUT = 0.5
"""Share of the cameras that are left out at most; where more do not fit, it is the frame that changed."""

CLEAN_DB = 40.0
"""All that is met better counts as this: beyond, 5 dB are a thousandth of the range, and no sign of a fault."""

ERROR_RISE = 1.02
"""Times that the usual error of a probe view rises at most in an update."""
OTHER_EFFORT = 1.5
"""Times more or fewer iterations than the update before, from which the usual level begins anew."""

PLACE_RATE, LEVEL_RATE = 0.2, 0.3
"""How fast a camera's usual place and the usual level follow."""

CAMERA_FIGURES, TIMING_FIGURES = 9, 6
"""Figures of ``alarms.CameraFigures`` and of ``timing.CameraTimingSums`` by camera."""

Fault = TypeVar("Fault")


@dataclass(frozen=True)
class Past:
    """The usual figures of a scene and its cameras; carried from commit to commit.

    Attributes:
        camera_levels: by camera, dB of its last rendering, less the level of its frame; NaN where not known.
        brightness: by camera, mean of its picture, 0…1, in the exposure of frame 0; NaN where not known.
        frames_left_out: by camera, frames in a row that it has been left out, 0 when it is believed.
        level: dB at the end of an update, see ``level_of``; NaN where not known.
        updates: that went into it. rejected: consecutive frames that were rejected with usable pictures.
            fitted: seconds, time of the last frame that was learnt from. lagging_frames: frames since some were
                rejected or
            skipped, 0 once the PSNR is as usual again.
        iterations: of the last update. error: usual at the end of an update, by probe view.
        light: times that the last frame was brighter, see ``checks.check_brightness``. light_frames: frames in a row
            that were brighter, or that were darker.
        last_brightness: by camera, mean of its picture in the last frame, in whatever light. brightness_ratio: times
            that the last frame was
            brighter than the one before it.
        camera_figures: by camera, what its alarms are derived from, see ``alarms.CameraFigures``.
        timing: by camera, the moments of its pictures, see ``timing.CameraTimingSums``.
    """

    camera_levels: Mapping[str, float] = field(default_factory=dict)
    brightness: Mapping[str, float] = field(default_factory=dict)
    frames_left_out: Mapping[str, int] = field(default_factory=dict)
    level: float = nan
    updates: int = 0
    rejected: int = 0
    fitted: float = nan
    lagging_frames: int = 0
    iterations: int = 0
    error: Mapping[str, float] = field(default_factory=dict)
    light: float = 1.0
    light_frames: int = 0
    last_brightness: Mapping[str, float] = field(default_factory=dict)
    brightness_ratio: float = 1.0
    camera_figures: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    timing: Mapping[str, tuple[float, ...]] = field(default_factory=dict)

    @classmethod
    def of_first(cls, psnr: Mapping[str, float], bright: Mapping[str, float]) -> Past:
        """After frame 0: how well its fit met each camera, dB, and how bright the pictures are."""
        psnr = _capped(psnr)
        level = float(np.median(list(psnr.values()))) if psnr else nan
        places = {name: psnr.get(name, nan) - level for name in bright}
        return cls(places, dict(bright), dict.fromkeys(bright, 0), level, last_brightness=dict(bright))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """As arrays, for a checkpoint."""
        rows = [
            (place, self.brightness[name], self.frames_left_out[name]) for name, place in self.camera_levels.items()
        ]
        scene = [
            self.level,
            self.updates,
            self.rejected,
            self.fitted,
            self.lagging_frames,
            self.iterations,
            self.light,
            self.light_frames,
        ]
        scene.append(self.brightness_ratio)
        return {
            "names": np.array(list(self.camera_levels), np.str_),
            "cameras": np.array(rows, np.float64).reshape(-1, 3),
            "scene": np.array(scene, np.float64),
            "probe_views": np.array(list(self.error), np.str_),
            "error": np.array(list(self.error.values()), np.float64),
            "last_brightness.names": np.array(list(self.last_brightness), np.str_),
            "last_brightness": np.array(list(self.last_brightness.values()), np.float64),
            "camera_figures.names": np.array(list(self.camera_figures), np.str_),
            "camera_figures": np.array(list(self.camera_figures.values()), np.float64).reshape(-1, CAMERA_FIGURES),
            "timing.names": np.array(list(self.timing), np.str_),
            "timing": np.array(list(self.timing.values()), np.float64).reshape(-1, TIMING_FIGURES),
        }

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Past:
        """From ``arrays``.

        Raises:
            KeyError, ValueError: some are missing, or do not fit.
        """
        rows = list(zip(arrays["names"].tolist(), arrays["cameras"].tolist(), strict=True))
        places = {name: place for name, (place, _, _) in rows}
        bright = {name: value for name, (_, value, _) in rows}
        outs = {name: int(out) for name, (_, _, out) in rows}
        level, updates, rejected, fitted, behind, iterations, light, light_frames, step = arrays["scene"].tolist()
        error = dict(zip(arrays["probe_views"].tolist(), arrays["error"].tolist(), strict=True))
        last = dict(zip(arrays["last_brightness.names"].tolist(), arrays["last_brightness"].tolist(), strict=True))
        watch, timing = _rows(arrays, "camera_figures.names", "camera_figures"), _rows(arrays, "timing.names", "timing")
        return cls(
            places, bright, outs, level,
            int(updates), int(rejected), fitted, int(behind), int(iterations), error, light, int(light_frames),
            last, step, watch, timing,
        )  # fmt: skip

    def camera_level(self, name: str) -> float:
        """Usual place of a camera, dB; NaN where not known."""
        return self.camera_levels.get(name, nan)

    def is_left_out(self, name: str) -> bool:
        """True for a camera that is left out."""
        return self.frames_left_out.get(name, 0) > 0


def _rows(arrays: Mapping[str, NDArray[Any]], names: str, rows: str) -> dict[str, tuple[float, ...]]:
    """Figures by camera."""
    return {name: tuple(row) for name, row in zip(arrays[names].tolist(), arrays[rows].tolist(), strict=True)}


def past_in_light(past: Past, gain: float) -> Past:
    """The past once another light is the usual one: in a brighter light, errors are brighter, too."""
    brightness = {name: gain * value for name, value in past.brightness.items()}
    level = past.level - max(0.0, 20 * log10(gain))
    return replace(past, brightness=brightness, level=level, error={}, light=1.0, light_frames=0)


def offsets(past: Past, psnr: Mapping[str, float]) -> dict[str, float]:
    """DB by camera, above (+) or below its usual place among the cameras; of those whose place is known."""
    known = {name: value for name, value in _capped(psnr).items() if past.camera_level(name) == past.camera_level(name)}
    if not known:
        return {}
    believed = [name for name in known if not past.is_left_out(name)] or list(known)
    shift = float(np.median([known[name] - past.camera_level(name) for name in believed]))
    return {name: value - past.camera_level(name) - shift for name, value in known.items()}


def misfits(past: Past, psnr: Mapping[str, float], limit: float) -> dict[str, str]:
    """Cameras whose rendering fits so much worse than usual, of all that were rendered, with the reason.

    Args:
        psnr: dB by camera. limit: ``FIRST_DB`` or ``LAST_DB``.
    """
    limit += allowed(past)
    outlying = {
        name: f"its picture fits {-off:.1f} dB worse than usual beside the others"
        for name, off in offsets(past, psnr).items()
        if off < limit
    }
    return unless_most(outlying, len(psnr))


def allowed(past: Past) -> float:
    """DB that are allowed for beside every limit, by how well the cameras' places are known: ``NEW_DB``, or 0."""
    return NEW_DB[past.updates] if past.updates < len(NEW_DB) else 0.0


def in_doubt(past: Past, offset: float) -> bool:
    """True where a camera is met so much worse than usual, dB, that one more such frame is an alarm."""
    return offset < NEAR_DB + allowed(past)


def misfit_reason(past: Past, psnr: Mapping[str, float], iterations: int = 0) -> str | None:
    """Why an update has not met its frame, or None.

    Args:
        psnr: dB by camera when last rendered. iterations: of the update; one that took fewer than the one
            before may meet its frame less well. 0: as many.
    """
    if not psnr or past.level != past.level:
        return None
    level = level_of(past, psnr)
    drop = DROPS_DB[past.updates] if past.updates < len(DROPS_DB) else DROP_DB
    if level > past.level - drop - _shorter(past, iterations):
        return None
    return f"the pictures are met at {level:.1f} dB, {past.level - level:.1f} dB less than usual"


def lag_reason(past: Past, psnr: Mapping[str, float], iterations: int = 0) -> str | None:
    """Why an update after frames that were held or not moved should be sought longer, or None. See
    ``misfit_reason``.
    """
    if not (past.rejected or past.lagging_frames) or not psnr or past.level != past.level:
        return None
    off = past.level - level_of(past, psnr)
    return f"{off:.1f} dB less than before" if off > BEHIND_DB + _shorter(past, iterations) else None


def _shorter(past: Past, iterations: int) -> float:
    """DB that an update of so many iterations may be worse by, as it took fewer than the one before."""
    return HALVED_DB * log2(past.iterations / iterations) if 0 < iterations < past.iterations else 0.0


def level_of(past: Past, psnr: Mapping[str, float]) -> float:
    """DB, median over the cameras, each less its usual place: a short update renders a few of them; NaN of none."""
    places = {name: past.camera_level(name) for name in psnr}
    values = [value - (places[name] if isfinite(places[name]) else 0.0) for name, value in _capped(psnr).items()]
    return float(np.median(values)) if values else nan


def health(past: Past, off: float) -> float:
    """0…1: 1 where a camera fits as usual or better, 0 from where it will be left out; ``off`` is its offset, dB."""
    return float(np.clip(1 - off / (LAST_DB + allowed(past)), 0, 1))


def past_after_update(
    past: Past,
    psnr: Mapping[str, float],
    bright: Mapping[str, float],
    exposure: float,
    iterations: int = 0,
    moved: bool = True,
) -> Past:
    """The past after an update was committed.

    Args:
        psnr: dB by camera, of those learnt from when last rendered, of those left out as the update ended.
        bright: of every picture of the frame. exposure: of the frame. iterations: of the update, 0: as many as before.
        moved: whether it gave another state, or one before did: else no update's usual figures are known.
    """
    psnr = _capped(psnr)
    off = offsets(past, psnr)
    out = misfits(past, psnr, LAST_DB)
    believed = {n: v for n, v in psnr.items() if n not in out and not past.is_left_out(n)}
    level = level_of(past, believed) if believed else past.level
    places, brightness, outs = dict(past.camera_levels), dict(past.brightness), dict(past.frames_left_out)
    for name, value in bright.items():
        # Of a camera that was not learnt from the figures stay: its picture is no sign of what is usual.
        before = outs.setdefault(name, 0)
        place = places.setdefault(name, nan)
        brightness.setdefault(name, nan)
        if before:
            outs[name] = 0 if off.get(name, -np.inf) > FITS_DB else before + 1
        elif name in out:
            outs[name] = 1
        elif name in psnr:
            here = psnr[name] - level
            known = place == place and past.updates > 0
            if not known:
                places[name] = here
            elif not in_doubt(past, off[name]):
                places[name] = place + PLACE_RATE * (here - place)
            brightness[name] = value / exposure
    known = past.updates > 0
    later = past.lagging_frames + 1 if lag_reason(past, believed, iterations) and past.lagging_frames < CATCH_UP else 0
    follows = LEVEL_RATE if later == 0 else 0.0
    if later == 0 and iterations and not 1 / OTHER_EFFORT < iterations / max(1, past.iterations) < OTHER_EFFORT:
        follows = 1.0
    return replace(
        past,
        camera_levels=places,
        brightness=brightness,
        frames_left_out=outs,
        level=past.level + follows * (level - past.level) if known else level,
        updates=past.updates + moved,
        rejected=0,
        lagging_frames=later,
        iterations=iterations or past.iterations,
    )


def usual_errors(before: Mapping[str, float], now: Mapping[str, float]) -> dict[str, float]:
    """The errors by view that are usual: they fall at once and rise slowly.

    A noisy frame's error would else be enough for the next good one, which moved.
    """
    return {name: min(value, ERROR_RISE * before.get(name, value)) for name, value in now.items()}


def _capped(psnr: Mapping[str, float]) -> dict[str, float]:
    """No more than ``CLEAN_DB`` each; NaN stays NaN."""
    return {name: CLEAN_DB if value > CLEAN_DB else value for name, value in psnr.items()}


def unless_most(found: dict[str, Fault], count: int) -> dict[str, Fault]:
    """The faults found of cameras, by name; none where most of ``count`` cameras have one."""
    return found if len(found) <= MAX_OUT * count else {}
