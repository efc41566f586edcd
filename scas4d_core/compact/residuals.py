"""Computes and applies quantized residuals of a state, one attribute at a time.

The quantization steps follow from the error bounds. This module requires only NumPy and zstandard.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.compact.bounds import Bounds
from scas4d_core.compact.columns import (
    LABELS,
    Columns,
    decorrelate_colours,
    label_of,
    levels_of,
    multiply_rows,
    products,
    relative_rotations,
    restore_colours,
    rotation_vectors,
    rotations_of_vectors,
)
from scas4d_core.compact.planes import Ints
from scas4d_core.gaussians import rotation_rows

Array = NDArray[np.float32]

SCALE_STEP = 0.08
"""Quantization step of log sizes. Other steps scale with the decoded sizes, which are within 4% of the true sizes."""
MARGIN = 0.95
"""Safety factor for steps that are relative to a size; it accounts for the quantization error of the size itself."""
LARGEST = 1 << 30
"""Limit on residuals, in quantization steps; centres and axes with larger or non-finite residuals are coded exactly."""
SHAPE = ("sizes", "rotations", "factors", "means")
"""Attributes that are coded first, in this order; each improves the prediction of the next."""


def appearance_attributes(state: Columns) -> tuple[str, ...]:
    """Returns the names of the attributes that are coded after the shape, independently of each other."""
    return ("colours", "foreground") if state.gloss is None else ("colours", "foreground", "gloss")


def coded_shape(state: Columns, name: str) -> tuple[int, int]:
    """Returns the number of components and the number of rows that are coded for an attribute."""
    if name == "gloss" and state.gloss is not None:
        return 3, state.gloss.shape[1]
    return {"sizes": 1, "factors": 9, "foreground": 1}.get(name, 3), len(state)


@dataclass(frozen=True, eq=False)
class DecodedState:
    """A partially decoded state, which starts as the clusters' prediction and is refined one attribute at a time.

    Earlier attributes refine the prediction of later ones: axes are rotated by the decoded rotation, and steps scale
    with the decoded size.
    """

    bounds: Bounds
    state: Columns
    sizes: Array
    """[N] sizes in metres, as decoded so far."""

    @classmethod
    def of(cls, bounds: Bounds, state: Columns) -> DecodedState:
        """Starts decoding from the clusters' prediction ``state``, with no residuals applied yet."""
        return cls(bounds, state, state.sizes())

    def _step(self, name: str) -> Array | np.float32:
        bounds = self.bounds
        if name in ("means", "factors"):
            part = bounds.position if name == "means" else bounds.axes
            return np.asarray(np.float32(2 * part * MARGIN) * self.sizes, np.float32)
        if name == "rotations":
            return np.float32(bounds.rotation_step)
        return np.float32(2 * (bounds.colour if name == "colours" else bounds.gloss))

    def residual(self, name: str, state: Columns) -> NDArray[Any]:
        """Returns an attribute's residual [P, N] relative to the prediction, in quantization steps."""
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            if name == "sizes":
                steps = np.rint(np.log(state.sizes() / self.sizes) / SCALE_STEP)
                return np.asarray(np.nan_to_num(steps, posinf=0, neginf=0))[None]
            if name == "foreground":
                return np.asarray(levels_of(state.foreground) - levels_of(self.state.foreground))[None]
            if name == "rotations":
                vectors = rotation_vectors(relative_rotations(state.rotations, self.state.rotations))
                return np.asarray(np.rint(vectors / self._step(name)))
            levels = np.rint((getattr(state, name) - getattr(self.state, name)) / self._step(name))
        return np.asarray(decorrelate_colours(levels) if name == "colours" else levels)

    def apply_residual(self, name: str, residual: Ints) -> DecodedState:
        """Returns the state with the residual of one attribute applied."""
        if not residual.any():
            return self
        if name == "sizes":
            scales = np.exp(np.float32(SCALE_STEP) * np.clip(residual[0], -500, 500).astype(np.float32))
            return replace(
                self, state=self.state.replace(factors=self.state.factors * scales), sizes=self.sizes * scales
            )
        if name == "foreground":
            levels = np.clip(levels_of(self.state.foreground) + residual[0], 0, LABELS - 1)
            return replace(self, state=self.state.replace(foreground=label_of(levels)))
        if name == "rotations":
            return self._turned(residual.astype(np.float32) * self._step(name))
        if name == "colours":
            residual = restore_colours(residual)
        changed = getattr(self.state, name) + residual.astype(np.float32) * self._step(name)
        return replace(self, state=self.state.replace(**{name: changed}))

    def _turned(self, vectors: Array) -> DecodedState:
        turns = rotations_of_vectors(vectors)
        factors = np.stack(multiply_rows(rotation_rows(turns), self.state.factors))
        rotations = products(turns, self.state.rotations)
        rotations /= np.sqrt(np.square(rotations).sum(axis=0))
        # Rows that do not rotate must stay bit-identical, whichever other rows are coded with them.
        rotations = np.where(vectors.any(axis=0), rotations, self.state.rotations)
        return replace(self, state=self.state.replace(rotations=rotations, factors=factors))


def whole_steps(found: NDArray[Any]) -> tuple[Ints, NDArray[np.bool_]]:
    """Converts residuals [P, N] to int32, and returns a mask [N] of rows with non-finite or too large values.

    In the int32 array, such values are replaced by 0.
    """
    outside = ~(np.abs(found) < LARGEST)
    return np.where(outside, 0, found).astype(np.int32), outside.any(axis=0)
