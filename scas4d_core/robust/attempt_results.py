"""Results of attempts at a frame: joined, told as one, and the errors that are usual after them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from scas4d_core.frame_outcome import Candidate
from scas4d_core.update.result import UpdateResult

ERROR_RISE = 1.02
"""Times that the usual error of a probe view rises at most in an update."""


def met(result: UpdateResult) -> dict[str, float]:
    """DB of the cameras that were learnt from to the end."""
    return {name: psnr for name, psnr in result.trace.fits.items() if name not in result.trace.left_out}


def joined(result: UpdateResult, first: UpdateResult) -> UpdateResult:
    """An update that went on from where another ended: its motion is that of both."""
    if result.motion is None or first.motion is None:
        return result
    return replace(result, motion=result.motion.after(first.motion))


def retold(result: UpdateResult, first: UpdateResult) -> UpdateResult:
    """A later attempt with the errors of the frame before and of the warm start as the first one found them."""
    errors: dict[Candidate, dict[str, float]] = {**first.trace.errors}
    errors.pop(Candidate.END, None)
    if result.trace.errors:
        errors[Candidate.END] = result.trace.errors[result.trace.kept]
    shown = result.trace.shown if result.trace.kept is Candidate.END else {}
    return replace(result, trace=replace(result.trace, errors=errors, kept=Candidate.END, shown=shown))


def usual_errors(before: Mapping[str, float], now: Mapping[str, float]) -> dict[str, float]:
    """The errors by view that are usual: they fall at once and rise slowly.

    A noisy frame's error would else be enough for the next good one, which moved.
    """
    return {name: min(value, ERROR_RISE * before.get(name, value)) for name, value in now.items()}
