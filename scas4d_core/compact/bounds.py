"""Error bounds of a compact file, by attribute."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields

from scas4d_core.errors import InputError


@dataclass(frozen=True)
class Bounds:
    """The largest error that a decoded state has in one component of an attribute.

    A Gaussian's size is the root mean square of the lengths of its three axes. Defaults: the coarsest at which the five
    objects lose less than 0.05 dB (docs/format.md has the figures).

    Attributes:
        position: of a centre, in parts of the Gaussian's size. axes: of an axis, in the same parts.
        rotation: of the material rotation, the angle in radians.
        colour: of a channel, where colours are 0…1. gloss: of a component. opacity: in 0…1.

    Raises:
        InputError: a bound that is not between 1e-6 (rotation: 0.002) and 1.

    >>> Bounds(position=0.1).position
    0.1
    >>> Bounds(colour=0)
    Traceback (most recent call last):
    scas4d_core.errors.InputError: bound colour=0 is out of its range; give a number from 1e-06 to 1
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
                raise InputError(f"bound {item.name}={value} is out of its range", f"give a number from {least} to 1")

    @property
    def rotation_step(self) -> float:
        """The step of each component of ``rotation_vectors``; the bound is of the angle that three of them make."""
        return 2 * self.rotation / 3**0.5

    def record(self) -> dict[str, float]:
        """The bounds by name, for the head of a file."""
        return asdict(self)

    @classmethod
    def of_record(cls, given: Mapping[str, float]) -> Bounds:
        """The bounds that a head holds; names of later versions are left out."""
        return cls(**{item.name: float(given[item.name]) for item in fields(cls) if item.name in given})


LEAST = 1e-6
"""Below it float32 has no digits left."""
MIN_ROTATION = 0.002
"""Below it the steps of a half turn are more than a plane holds."""
