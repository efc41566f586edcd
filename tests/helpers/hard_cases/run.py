"""The catalogue of hard cases, and how a case is run on every available backend."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.util import find_spec
from typing import Any

import numpy as np

from hard_cases import cluster_map, geometry, scenes, steps
from hard_cases.case import CPU, REFERENCE, TORCH, HardCase

SECTIONS: dict[str, tuple[HardCase, ...]] = {
    "geometry": geometry.CASES,
    "cluster_map": cluster_map.CASES,
    "steps": steps.CASES,
    "scenes": scenes.CASES,
}
CASES = tuple(case for cases in SECTIONS.values() for case in cases)


def backends() -> list[str]:
    """Returns the available backends, starting with the float64 reference in PyTorch."""
    return [CPU] if find_spec("torch") is None else [REFERENCE, CPU, TORCH]


def violations(case: HardCase, size: Any, on: Iterable[str]) -> list[str]:
    """Runs one case at one size on the given backends and returns the violated checks; an exception is one of them."""
    try:
        with np.errstate(all="ignore"):
            problem = case.make(size)
            outcomes = {name: outcome for name in on if (outcome := problem.run(name)) is not None}
            return problem.violations(outcomes) + case.holds(problem, outcomes)
    except Exception as error:
        return [f"raised {type(error).__name__}: {error}"]
