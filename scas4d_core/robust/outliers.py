"""Outlying cameras and frames, detected by comparing each camera with its own past and with the other cameras.

The comparison uses values that an update computes anyway: the fit of each camera when it was first and last rendered,
and the mean brightness of its image (``checks``). A camera that fits much worse than the others is excluded. A change
that all cameras show is accepted if the frame can be fitted as a whole. The thresholds were chosen from measurements on
the captures; docs/stability.md shows the distributions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import isfinite, log2, log10, nan
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

FIRST_DB = -9.0
"""Offset from a camera's usual level, when first rendered, below which it is compared with the others again, in one
state. If the offset is still below this value, the camera is excluded at once. First renderings of clean captures reach
-7.7, because some cameras are rendered before the update has followed the motion."""
LAST_DB = -5.0
"""Offset when last rendered, without errors that other cameras confirm (``confirmed_errors``), below which a camera is
excluded starting with the next frame. Cameras that moved by one or two pixels reach -6 to -15."""
NEAR_DB = -3.5
"""Offset below which a camera is suspect. Its usual level is then not updated, so a lasting fault remains visible. Two
consecutive suspect frames raise an alarm. Without confirmed errors, clean captures reach -4.0
in single frames."""
FITS_DB = -4.5
"""Offset above which an excluded camera is accepted again. Until then, colours follow only the other cameras."""
NEW_DB = (-4.0, -2.0, -2.0)
"""Additional tolerance in the first updates, in which a camera's level is known only from frame 0 or one update."""
DROP_DB = 6.0
"""Drop of the cameras' median PSNR below its usual value at which an update counts as not fitting its frame."""
DROPS_DB = (14.0, 9.0, 9.0)
"""Same as ``DROP_DB``, but for the first updates, when the usual value is known only from frame 0 or a longer
update."""
HALVED_DB = 3.0
"""Additional tolerance per halving of the iterations. On the captures, 50 iterations instead of 100 cost 1.7 dB, and
25 instead of 50 cost 3.2 dB."""
BEHIND_DB = 1.5
"""Drop above which updates after rejected or skipped frames are continued, because objects have moved on."""
RESTS_DB = 3.0
"""Drop up to which a scene without visible motion counts as static. If frame 0 was fitted to noise, the drop is
1 to 2 dB."""
CATCH_UP = 3
"""Maximum number of consecutive frames after a rejected or skipped frame that count as lagging."""
MAX_OUT = 0.5
"""Maximum share of excluded cameras. If more cameras do not fit, the frame itself has changed."""

CLEAN_DB = 40.0
"""Upper limit of PSNR values. Above it, 5 dB correspond to a thousandth of the value range and do not indicate a
fault."""

ERROR_RISE = 1.02
"""Maximum factor by which the usual error of a probe view rises per update."""
OTHER_EFFORT = 1.5
"""Ratio of iterations between updates above which the usual level is reset."""

PLACE_RATE, LEVEL_RATE = 0.2, 0.3
"""Rates at which a camera's usual level and the overall level follow new values."""

CAMERA_FIGURES, TIMING_FIGURES = 11, 6
"""Numbers of values per camera in ``alarms.CameraFigures`` and ``timing.CameraTimingSums``."""

Fault = TypeVar("Fault")


@dataclass(frozen=True)
class Past:
    """The usual values of a scene and its cameras; carried from commit to commit.

    Attributes:
        camera_levels: usual PSNR of each camera when last rendered, minus the level of its frame, in dB; NaN if
            unknown.
        brightness: usual mean of each camera's image, [0, 1], at the exposure of frame 0; NaN if unknown.
        frames_left_out: number of consecutive frames for which each camera has been excluded; 0 if it is used.
        level: usual PSNR at the end of an update, in dB (see ``level_of``), or NaN if unknown.
        updates: number of updates included in the usual values.
        rejected: number of consecutive rejected frames with usable images.
        fitted: time of the last learnt frame, in seconds.
        lagging_frames: number of frames since a rejected or skipped frame; 0 once the PSNR is back to normal.
        iterations: number of iterations of the last update.
        error: usual error at the end of an update, keyed by probe view.
        light: brightness ratio of the last frame; see ``checks.check_brightness``.
        light_frames: number of consecutive frames that were all brighter, or all darker, than usual.
        last_brightness: mean of each camera's latest image, [0, 1], in any lighting.
        brightness_ratio: brightness of the last frame relative to the frame before it.
        camera_figures: figures of each camera for alarms; see ``alarms.CameraFigures``.
        timing: figures of each camera for its timing; see ``timing.CameraTimingSums``.
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
        """Returns the past after frame 0, from the PSNR in dB and the mean image brightness of each camera."""
        psnr = _capped(psnr)
        level = float(np.median(list(psnr.values()))) if psnr else nan
        places = {name: psnr.get(name, nan) - level for name in bright}
        return cls(places, dict(bright), dict.fromkeys(bright, 0), level, last_brightness=dict(bright))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Returns the values as arrays, for a checkpoint."""
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
        """Creates a past from ``arrays``.

        Raises:
            KeyError, ValueError: if arrays are missing or do not match.
        """
        rows = list(zip(arrays["names"].tolist(), arrays["cameras"].tolist(), strict=True))
        places = {name: place for name, (place, _, _) in rows}
        bright = {name: value for name, (_, value, _) in rows}
        outs = {name: int(out) for name, (_, _, out) in rows}
        level, updates, rejected, fitted, behind, iterations, light, light_frames, step = arrays["scene"].tolist()
        error = dict(zip(arrays["probe_views"].tolist(), arrays["error"].tolist(), strict=True))
        last = dict(zip(arrays["last_brightness.names"].tolist(), arrays["last_brightness"].tolist(), strict=True))
        watch, timing = _rows(arrays, "camera_figures.names", "camera_figures"), _rows(arrays, "timing.names", "timing")
        watch = {name: row for name, row in watch.items() if len(row) == CAMERA_FIGURES}  # else of an earlier version
        return cls(
            places, bright, outs, level,
            int(updates), int(rejected), fitted, int(behind), int(iterations), error, light, int(light_frames),
            last, step, watch, timing,
        )  # fmt: skip

    def camera_level(self, name: str) -> float:
        """Returns the usual level of a camera in dB, or NaN if unknown."""
        return self.camera_levels.get(name, nan)

    def is_left_out(self, name: str) -> bool:
        """Returns whether a camera is excluded."""
        return self.frames_left_out.get(name, 0) > 0


def _rows(arrays: Mapping[str, NDArray[Any]], names: str, rows: str) -> dict[str, tuple[float, ...]]:
    """Returns the figures of each camera from an array of names and an array of rows."""
    return {name: tuple(row) for name, row in zip(arrays[names].tolist(), arrays[rows].tolist(), strict=True)}


def past_in_light(past: Past, gain: float) -> Past:
    """Returns the past adapted to lighting that is ``gain`` times as bright. Brighter light causes larger errors."""
    brightness = {name: gain * value for name, value in past.brightness.items()}
    level = past.level - max(0.0, 20 * log10(gain))
    return replace(past, brightness=brightness, level=level, error={}, light=1.0, light_frames=0)


def offsets(past: Past, psnr: Mapping[str, float]) -> dict[str, float]:
    """Returns the offset of each known camera above (+) or below its usual level among the cameras, in dB."""
    known = {name: value for name, value in _capped(psnr).items() if past.camera_level(name) == past.camera_level(name)}
    if not known:
        return {}
    believed = [name for name in known if not past.is_left_out(name)] or list(known)
    shift = float(np.median([known[name] - past.camera_level(name) for name in believed]))
    return {name: value - past.camera_level(name) - shift for name, value in known.items()}


def misfits(past: Past, psnr: Mapping[str, float], limit: float) -> dict[str, str]:
    """Returns the cameras that fit much worse than usual, mapped to the reason, or none if most cameras do.

    Args:
        past: usual values of the cameras.
        psnr: PSNR of each camera, in dB.
        limit: ``FIRST_DB`` or ``LAST_DB``.
    """
    limit += allowed(past)
    outlying = {
        name: f"its image fits {-off:.1f} dB worse than usual relative to the other cameras"
        for name, off in offsets(past, psnr).items()
        if off < limit
    }
    return unless_most(outlying, len(psnr))


def allowed(past: Past) -> float:
    """Returns the additional tolerance in dB: ``NEW_DB`` in the first updates, then 0."""
    return NEW_DB[past.updates] if past.updates < len(NEW_DB) else 0.0


def in_doubt(past: Past, offset: float) -> bool:
    """Returns whether a camera's offset, in dB, is so low that a second such frame raises an alarm."""
    return offset < NEAR_DB + allowed(past)


def misfit_reason(past: Past, psnr: Mapping[str, float], iterations: int = 0) -> str | None:
    """Returns the reason why an update has not fitted its frame, or None.

    Args:
        past: usual values before the update.
        psnr: PSNR of each camera when last rendered, in dB.
        iterations: number of iterations. If there were fewer than in the previous update, a lower PSNR is accepted. 0
            means as many as in the previous update.
    """
    if not psnr or past.level != past.level:
        return None
    level = level_of(past, psnr)
    drop = DROPS_DB[past.updates] if past.updates < len(DROPS_DB) else DROP_DB
    if level > past.level - drop - _shorter(past, iterations):
        return None
    return f"the state fits the images with {level:.1f} dB PSNR, {past.level - level:.1f} dB less than usual"


def lag_reason(past: Past, psnr: Mapping[str, float], iterations: int = 0) -> str | None:
    """Returns the reason why an update after rejected or skipped frames should be continued, or None.

    The arguments are the same as for ``misfit_reason``.
    """
    if not (past.rejected or past.lagging_frames) or not psnr or past.level != past.level:
        return None
    off = past.level - level_of(past, psnr)
    return f"{off:.1f} dB less than before" if off > BEHIND_DB + _shorter(past, iterations) else None


def _shorter(past: Past, iterations: int) -> float:
    """Returns the additional tolerance in dB for an update with fewer iterations than the previous one."""
    return HALVED_DB * log2(past.iterations / iterations) if 0 < iterations < past.iterations else 0.0


def level_of(past: Past, psnr: Mapping[str, float]) -> float:
    """Returns the median PSNR in dB over cameras, each relative to its usual level, or NaN if there are none."""
    places = {name: past.camera_level(name) for name in psnr}
    values = [value - (places[name] if isfinite(places[name]) else 0.0) for name, value in _capped(psnr).items()]
    return float(np.median(values)) if values else nan


def health(past: Past, off: float) -> float:
    """Returns a camera's health for its offset ``off`` in dB: 1 at or above its usual fit, 0 at the exclusion limit."""
    return float(np.clip(1 - off / (LAST_DB + allowed(past)), 0, 1))


def past_after_update(
    past: Past,
    psnr: Mapping[str, float],
    bright: Mapping[str, float],
    exposure: float,
    iterations: int = 0,
    moved: bool = True,
) -> Past:
    """Returns the past after a committed update.

    Args:
        past: usual values before the update.
        psnr: PSNR of each camera in dB: when last rendered for used cameras, at the end of the update for excluded
            cameras.
        bright: mean of each camera's image, [0, 1].
        exposure: brightness ratio of the frame.
        iterations: number of iterations of the update; 0 means as in the previous update.
        moved: whether this or an earlier update changed the state. Otherwise, the usual values of updates are unknown.
    """
    psnr = _capped(psnr)
    off = offsets(past, psnr)
    out = misfits(past, psnr, LAST_DB)
    believed = {n: v for n, v in psnr.items() if n not in out and not past.is_left_out(n)}
    level = level_of(past, believed) if believed else past.level
    places, brightness, outs = dict(past.camera_levels), dict(past.brightness), dict(past.frames_left_out)
    for name, value in bright.items():
        # Figures of cameras that were not used do not change, because their images are not representative.
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
    """Returns the usual error of each view, which falls immediately but rises slowly.

    If the usual error rose immediately, the frame after a noisy frame could be skipped even though objects have moved.
    """
    return {name: min(value, ERROR_RISE * before.get(name, value)) for name, value in now.items()}


def _capped(psnr: Mapping[str, float]) -> dict[str, float]:
    """Returns each value limited to ``CLEAN_DB``; NaN is preserved."""
    return {name: CLEAN_DB if value > CLEAN_DB else value for name, value in psnr.items()}


def unless_most(found: dict[str, Fault], count: int) -> dict[str, Fault]:
    """Returns the problems of the cameras, or none if more than ``MAX_OUT`` of the ``count`` cameras have one."""
    return found if len(found) <= MAX_OUT * count else {}
