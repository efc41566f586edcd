"""Data model of hard cases, and checks that all of them share."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Values = dict[str, NDArray[Any]]

REFERENCE = "float64"
"""Backend with which the others are compared: the PyTorch reference in float64."""
CPU, TORCH = "cpu", "torch float32"


@dataclass(frozen=True, eq=False)
class BackendResult:
    """Result of one backend for one case.

    Attributes:
        values: output arrays, keyed by name.
        gradients: gradient arrays, keyed by name.
        guards: number of times each guard was triggered, keyed by name.
    """

    values: Values
    gradients: Values = field(default_factory=dict)
    guards: Mapping[str, int] = field(default_factory=dict)


class SizedCase(Protocol):
    """Protocol of a case at one size."""

    def run(self, backend: str) -> BackendResult | None:
        """Runs the computation on a backend, or returns None if the backend does not support it."""

    def violations(self, outcomes: Mapping[str, BackendResult]) -> list[str]:
        """Returns descriptions of the violated checks."""


def _nothing_more(problem: Any, outcomes: Mapping[str, BackendResult]) -> list[str]:
    return []


@dataclass(frozen=True, eq=False)
class HardCase:
    """One entry of the catalogue of hard cases.

    Attributes:
        name: case name.
        what: description of the difficulty, the meaning of the size, and requirements besides the shared checks.
        source: origin of the case: the literature, users' reports (repository#thread), or the equations.
        sizes: sizes at which the case is run.
        make: function that creates the problem at a given size.
        holds: function that returns violations of the requirements specific to this case.
        slow: whether the case is skipped when only fast cases are run.
    """

    name: str
    what: str
    source: str
    sizes: tuple[Any, ...]
    make: Callable[[Any], SizedCase]
    holds: Callable[[Any, Mapping[str, BackendResult]], list[str]] = _nothing_more
    slow: bool = False


def not_finite(outcome: BackendResult, backend: str) -> list[str]:
    """Returns a line for each array that contains NaN or infinity."""
    arrays = [*outcome.values.items(), *((f"gradient of {name}", a) for name, a in outcome.gradients.items())]
    return [
        f"{backend}: {name} contains {np.count_nonzero(~np.isfinite(array))} non-finite values"
        for name, array in arrays
        if not np.isfinite(array).all()
    ]


def beyond(outcome: BackendResult, backend: str, bound: float) -> list[str]:
    """Returns a line for each gradient that exceeds a bound."""
    return [
        f"{backend}: gradient of {name} reaches {np.abs(array).max():.3g}; the bound is {bound:.3g}"
        for name, array in outcome.gradients.items()
        if array.size and float(np.abs(array).max()) > bound
    ]


def apart(found: NDArray[Any], truth: NDArray[Any], least: float = 1e-30) -> float:
    """Returns the norm of the difference divided by the norm of the reference, or by ``least`` if that is larger."""
    difference = np.linalg.norm((found - truth).astype(np.float64))
    return float(difference / max(float(np.linalg.norm(truth.astype(np.float64))), least)) if difference > 0 else 0.0


def unexpected_counts(
    outcome: BackendResult, expected: Mapping[str, int] | None, silent: Sequence[str] = ()
) -> list[str]:
    """Returns a line if the CPU guard counts are not as expected.

    Args:
        outcome: result on the CPU.
        expected: expected count of each guard; None accepts any counts.
        silent: guards to ignore.
    """
    if expected is None:
        return []
    counts = {name: count for name, count in outcome.guards.items() if count and name not in silent}
    wanted = {name: count for name, count in expected.items() if count}
    return [] if counts == wanted else [f"guard counts are {counts}; expected {wanted}"]
