"""Per-attribute error bounds of a compact file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields

from scas4d_core.errors import InputError


@dataclass(frozen=True)
class Bounds:
    """Maximum error of each attribute of a decoded state.

    All errors except that of the rotation are per component. A Gaussian's size is the root mean
    square of the lengths of its three axes. The defaults are the coarsest bounds at which the five
    test objects lose less than 0.05 dB (see docs/format.md).

    Attributes:
        position: error of the centre, as a fraction of the Gaussian's size.
        axes: error of each axis, as a fraction of the Gaussian's size.
        rotation: angular error of the material rotation, in radians.
        colour: error of each colour channel, whose range is [0, 1].
        gloss: error of each gloss component.
        opacity: error of the opacity, whose range is [0, 1].

    Raises:
        InputError: if a bound is not between 1e-6 (rotation: 0.002) and 1.

    >>> Bounds(position=0.1).position
    0.1
    >>> Bounds(colour=0)
    Traceback (most recent call last):
    scas4d_core.errors.InputError: bound colour=0 is out of range; use a number from 1e-06 to 1
    """

    position: float = 0.04
    axes: float = 0.055
    rotation: float = 0.05
    colour: float = 0.012
    gloss: float = 0.01
    opacity: float = 0.0005

    def __post_init__(self) -> None:
        for item in fields(self):
            value, least = getattr(self, item.name), MIN_ROTATION if item.name == "rotation" else LEAST
            if not least <= value <= 1:
                raise InputError(f"bound {item.name}={value} is out of range", f"use a number from {least} to 1")

    @property
    def rotation_step(self) -> float:
        """Quantization step per component of ``rotation_vectors``, derived from the bound on the total angle."""
        return 2 * self.rotation / 3**0.5

    def record(self) -> dict[str, float]:
        """Returns the bounds as a dict for the file header."""
        return asdict(self)

    @classmethod
    def of_record(cls, given: Mapping[str, float]) -> Bounds:
        """Creates bounds from the dict in a file header, ignoring names added by later versions."""
        return cls(**{item.name: float(given[item.name]) for item in fields(cls) if item.name in given})


LEAST = 1e-6
"""Smallest allowed bound; finer steps would exceed float32 precision."""
MIN_ROTATION = 0.002
"""Smallest allowed rotation bound; with a smaller one, a half turn would exceed the integer range of a plane."""
