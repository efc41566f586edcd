"""Which pictures of a frame can be believed: a black frame is finite, and 100 iterations would paint the scene black.

Each camera is held against its own past and against the others of the frame, with figures that an update has anyway:
the mean brightness of its picture, and how well it was met when it was rendered first and last. One camera that fits
much worse than the others did is left out; what all of them say is believed as long as the frame as a whole can be met.
The thresholds were read off the captures: docs/stability.md has the distributions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import isfinite, log2, log10, nan
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

EXPOSURE = 1.05
"""Times brighter or darker, median over the cameras, from which a frame is exposed otherwise; clean captures: 1.04."""
ENOUGH = 8
"""Cameras that the exposure needs: an object that turns changes the brightness of one picture by a third."""
UNUSABLE = 2.0
"""Times brighter or darker, as above, from which the light is another and nothing is learnt from the frame."""
BLIND = 0.05
"""Share of its usual brightness, against the other cameras, below which a camera shows nothing."""

FIRST_DB = -9.0
"""Against its usual place among the cameras when first rendered: such a camera is left out at once; clean: -6.1."""
LAST_DB = -5.0
"""The same when last rendered: left out from the next frame on. Clean: -3.7; moved by one or two pixels: -6 to -15."""
FITS_DB = -3.0
"""From which a camera that was left out is believed again."""
NEW_DB = -4.0
"""More is allowed for in the first update, when a camera's place is known from frame 0 alone."""
DROP_DB = 6.0
"""Of the cameras' median below its usual, from which an update has not met its frame."""
DROPS_DB = (14.0, 9.0, 9.0)
"""The same in the first updates: what is usual is known from frame 0 alone, or from an update that took longer."""
HALVED_DB = 3.0
"""More is allowed for each halving of the iterations: 100 to 50 cost 1.7 dB on the captures, 50 to 25 3.2."""
BEHIND_DB = 1.5
"""The same, from which the first frames after held ones are sought longer: what moved on unseen is further away."""
CATCH_UP = 3
"""Frames that are, at most."""
MOST_OUT = 0.5
"""Share of the cameras that are left out at most; where more do not fit, it is the frame that changed."""

CLEAN_DB = 40.0
"""All that is met better counts as this: beyond, 5 dB are a thousandth of the range, and no sign of a fault."""

OTHER_EFFORT = 1.5
"""Times more or fewer iterations than the update before, from which the usual level begins anew."""

PLACE_RATE, LEVEL_RATE = 0.2, 0.3
"""How fast a camera's usual place and the usual level follow."""

DARKEST = 1e-3
"""Mean of a picture, 0…1, below which its brightness says nothing."""


@dataclass(frozen=True)
class CameraPast:
    """What is usual for one camera.

    Attributes:
        place: dB of its last rendering, less the level of its frame; NaN where not known.
        brightness: mean of its picture, 0…1, in the exposure of frame 0; NaN where not known.
        out: frames in a row that it has been left out, 0 when it is believed.
    """

    place: float = nan
    brightness: float = nan
    out: int = 0


@dataclass(frozen=True)
class Past:
    """What is usual for a scene; carried from commit to commit.

    Attributes:
        cameras: by name. level: dB at the end of an update, see ``level_of``; NaN where not known.
        updates: that went into it. held: frames in a row that were held although their pictures say something. fitted:
            seconds, time of the last frame that was learnt from. behind: frames since some were held or not moved, 0
            once they are met as usual again.
        iterations: of the last update. error: usual at the end of an update, by witness view.
        light: times that the last frame was brighter, ``Look.exposure``. lit: frames in a row that were brighter, or
            that were darker.
    """

    cameras: Mapping[str, CameraPast] = field(default_factory=dict)
    level: float = nan
    updates: int = 0
    held: int = 0
    fitted: float = nan
    behind: int = 0
    iterations: int = 0
    error: Mapping[str, float] = field(default_factory=dict)
    light: float = 1.0
    lit: int = 0

    @classmethod
    def of_first(cls, psnr: Mapping[str, float], bright: Mapping[str, float]) -> Past:
        """After frame 0: how well its fit met each camera, dB, and how bright the pictures are."""
        psnr = _capped(psnr)
        level = float(np.median(list(psnr.values()))) if psnr else nan
        cameras = {name: CameraPast(psnr.get(name, nan) - level, value) for name, value in bright.items()}
        return cls(cameras, level)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """As arrays, for a checkpoint."""
        rows = [(past.place, past.brightness, past.out) for past in self.cameras.values()]
        scene = [self.level, self.updates, self.held, self.fitted, self.behind, self.iterations, self.light, self.lit]
        return {
            "names": np.array(list(self.cameras), np.str_),
            "cameras": np.array(rows, np.float64).reshape(-1, 3),
            "scene": np.array(scene, np.float64),
            "witnesses": np.array(list(self.error), np.str_),
            "error": np.array(list(self.error.values()), np.float64),
        }

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Past:
        """From ``arrays``; from none, where nothing is known.

        Raises:
            KeyError, ValueError: some are missing, or do not fit.
        """
        if not arrays:
            return cls()
        rows = zip(arrays["names"].tolist(), arrays["cameras"].tolist(), strict=True)
        cameras = {name: CameraPast(place, bright, int(out)) for name, (place, bright, out) in rows}
        level, updates, held, fitted, behind, iterations, *light = arrays["scene"].tolist()
        light, lit = light or (1.0, 0)  # an older checkpoint knows nothing of the light
        error = dict(zip(arrays["witnesses"].tolist(), arrays["error"].tolist(), strict=True))
        return cls(
            cameras, level, int(updates), int(held), fitted, int(behind), int(iterations), error, light, int(lit)
        )

    def of(self, name: str) -> CameraPast:
        """What is usual for a camera; nothing for one that is new."""
        return self.cameras.get(name, CameraPast())


@dataclass(frozen=True)
class Look:
    """What the pictures themselves say, before anything is rendered.

    Attributes:
        exposure: times that the frame is brighter than the one before; 1 where it is not seen to differ.
        left_out: by camera, why. held: why nothing can be learnt from the frame, or None.
    """

    exposure: float = 1.0
    left_out: Mapping[str, str] = field(default_factory=dict)
    held: str | None = None


def brightness_of(picture: NDArray[np.uint8]) -> float:
    """Mean of every fourth pixel of every fourth row of a picture [H, W, 3], 0…1."""
    return float(picture[::4, ::4].mean()) / 255


def brightness(pictures: Mapping[str, NDArray[np.uint8]]) -> dict[str, float]:
    """Of each camera's picture."""
    return {name: brightness_of(picture) for name, picture in pictures.items()}


def look(past: Past, bright: Mapping[str, float]) -> Look:
    """Judge the pictures of a frame by their brightness; cameras that were left out before stay so (``settle``)."""
    left_out = {
        name: "it has not fitted the other cameras since it was left out" for name in bright if past.of(name).out
    }
    ratios = {
        name: value / past.of(name).brightness for name, value in bright.items() if past.of(name).brightness > DARKEST
    }
    if not ratios:
        return Look(left_out=_few(left_out, len(bright)))
    common = float(np.median(list(ratios.values())))
    enough = len(ratios) >= ENOUGH
    if not 1 / UNUSABLE <= common <= UNUSABLE and (enough or common < BLIND or common > 1 / BLIND):
        return Look(common, left_out, f"the pictures are {common:.2g} times as bright as they were")
    for name, ratio in ratios.items():
        if ratio < BLIND * common:
            left_out[name] = f"it shows nothing: {ratio:.2g} times as bright as it was"
    if not enough or 1 / EXPOSURE <= common <= EXPOSURE:
        common = 1.0
    return Look(common, _few(left_out, len(bright)))


def lit(past: Past, seen: Look) -> Past:
    """The past with the light of a frame: how long it has been brighter, or darker; darkness is none."""
    light = seen.exposure
    if light == 1.0 or not BLIND <= light <= 1 / BLIND:
        return replace(past, light=1.0, lit=0)
    same = past.lit > 0 and (light > 1) == (past.light > 1)
    return replace(past, light=light, lit=past.lit + 1 if same else 1)


def relit(past: Past, gain: float) -> Past:
    """What is usual once a light is the usual one: a brighter one makes what is not met brighter, too."""
    cameras = {name: replace(one, brightness=gain * one.brightness) for name, one in past.cameras.items()}
    level = past.level - max(0.0, 20 * log10(gain))
    return replace(past, cameras=cameras, level=level, error={}, light=1.0, lit=0)


def place(past: Past, psnr: Mapping[str, float]) -> dict[str, float]:
    """DB by camera, above (+) or below where it usually is among the cameras."""
    known = {name: value for name, value in _capped(psnr).items() if past.of(name).place == past.of(name).place}
    if not known:
        return {}
    believed = [name for name in known if not past.of(name).out] or list(known)
    shift = float(np.median([known[name] - past.of(name).place for name in believed]))
    return {name: value - past.of(name).place - shift for name, value in known.items()}


def misfits(past: Past, psnr: Mapping[str, float], limit: float) -> dict[str, str]:
    """Cameras whose rendering fits so much worse than usual, of all that were rendered, with the reason.

    Args:
        psnr: dB by camera. limit: ``FIRST_DB`` or ``LAST_DB``.
    """
    if past.updates == 0:
        limit += NEW_DB
    found = {
        name: f"its picture fits {-off:.1f} dB worse than usual beside the others"
        for name, off in place(past, psnr).items()
        if off < limit
    }
    return _few(found, len(psnr))


def unmet(past: Past, psnr: Mapping[str, float], iterations: int = 0) -> str | None:
    """Why an update has not met its frame, or None.

    Args:
        psnr: dB by camera when last rendered. iterations: of the update; one that was told to take fewer than the one
            before may meet its frame less well. 0: as many.
    """
    if not psnr or past.level != past.level:
        return None
    level = level_of(past, psnr)
    drop = DROPS_DB[past.updates] if past.updates < len(DROPS_DB) else DROP_DB
    if level > past.level - drop - _shorter(past, iterations):
        return None
    return f"the pictures are met at {level:.1f} dB, {past.level - level:.1f} dB less than usual"


def behind(past: Past, psnr: Mapping[str, float], iterations: int = 0) -> str | None:
    """Why an update after frames that were held or not moved should be sought longer, or None. See ``unmet``."""
    if not (past.held or past.behind) or not psnr or past.level != past.level:
        return None
    off = past.level - level_of(past, psnr)
    return f"{off:.1f} dB less than before" if off > BEHIND_DB + _shorter(past, iterations) else None


def _shorter(past: Past, iterations: int) -> float:
    """DB that an update of so many iterations may be worse by, as it was told to take fewer than the one before."""
    return HALVED_DB * log2(past.iterations / iterations) if 0 < iterations < past.iterations else 0.0


def level_of(past: Past, psnr: Mapping[str, float]) -> float:
    """DB, median over the cameras, each less its usual place: a short update renders a few of them; NaN of none."""
    places = {name: past.of(name).place for name in psnr}
    values = [value - (places[name] if isfinite(places[name]) else 0.0) for name, value in _capped(psnr).items()]
    return float(np.median(values)) if values else nan


def health(off: float | None) -> float:
    """0…1: 1 where a camera fits as usual or better, 0 from ``LAST_DB`` on. ``off``: see ``place``; None: not known."""
    return 1.0 if off is None else float(np.clip(1 - off / LAST_DB, 0, 1))


def settle(
    past: Past, psnr: Mapping[str, float], bright: Mapping[str, float], exposure: float, iterations: int = 0
) -> Past:
    """What is usual after an update was committed.

    Args:
        psnr: dB by camera, of those learnt from when last rendered, of those left out as the update ended.
        bright: of every picture of the frame. exposure: of the frame. iterations: of the update, 0: as many as before.
    """
    psnr = _capped(psnr)
    off = place(past, psnr)
    out = misfits(past, psnr, LAST_DB)
    believed = {n: v for n, v in psnr.items() if n not in out and not past.of(n).out}
    level = level_of(past, believed) if believed else past.level
    cameras = dict(past.cameras)
    for name, value in bright.items():
        before = past.of(name)
        now = before  # of a camera that was not learnt from: what it showed is no sign of what is usual
        if before.out:
            fits = off.get(name, -np.inf) > FITS_DB
            now = replace(before, out=0) if fits else replace(before, out=before.out + 1)
        elif name in out:
            now = replace(before, out=1)
        elif name in psnr:
            here = psnr[name] - level
            known = before.place == before.place and past.updates > 0
            here = before.place + PLACE_RATE * (here - before.place) if known else here
            now = replace(before, place=here, brightness=value / exposure)
        cameras[name] = now
    known = past.updates > 0
    later = past.behind + 1 if behind(past, believed, iterations) and past.behind < CATCH_UP else 0
    follows = LEVEL_RATE if later == 0 else 0.0
    if later == 0 and iterations and not 1 / OTHER_EFFORT < iterations / max(1, past.iterations) < OTHER_EFFORT:
        follows = 1.0
    return replace(
        past,
        cameras=cameras,
        level=past.level + follows * (level - past.level) if known else level,
        updates=past.updates + 1,
        held=0,
        behind=later,
        iterations=iterations or past.iterations,
    )


def _capped(psnr: Mapping[str, float]) -> dict[str, float]:
    """No more than ``CLEAN_DB`` each; what is not a number stays none."""
    return {name: CLEAN_DB if value > CLEAN_DB else value for name, value in psnr.items()}


def _few(found: dict[str, str], count: int) -> dict[str, str]:
    """What was found against cameras, unless it is found against most of them."""
    return found if len(found) <= MOST_OUT * count else {}
