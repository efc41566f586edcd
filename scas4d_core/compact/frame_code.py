"""One state as bytes, told by a reference that the reader has: cluster motion, and what each Gaussian has of its own.

The reference is a decoded state, so errors do not add up: what one frame leaves wrong, the next one sees. Numpy only.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.compact.bounds import Bounds
from scas4d_core.compact.cluster_motion import ClusterMotion, Clusters
from scas4d_core.compact.columns import (
    LABELS,
    Columns,
    by_green,
    label_of,
    levels_of,
    mapped,
    of_green,
    products,
    turns_between,
    turns_of,
    vectors_of,
)
from scas4d_core.compact.planes import Ints, PlaneError, pack, unpack
from scas4d_core.compact.sections import (
    read_array,
    read_exact,
    read_mask,
    read_residuals,
    write_array,
    write_exact,
    write_mask,
    write_residuals,
)
from scas4d_core.gaussians import rotation_rows

Array = NDArray[np.float32]
Float = NDArray[np.float64]

FLAT = 0.1
"""A decoded Gaussian whose volume is not between this part of the true one and its inverse is told exactly: thin ones,
whose error in an axis is as large as the axis, would lose their volume or turn inside out."""
SCALE_STEP = 0.08
"""Step of the logarithm of a size; so the size that steps are parts of is within four percent of the true one."""
MARGIN = 0.95
"""Of steps that are parts of a size, for that."""
SLACK = 1 + 1e-4
"""On bounds, for the rounding of float32."""
LARGEST = 1 << 30
"""Residuals from here on, in steps, are told exactly, as are numbers that are not finite."""
SHIFT_STEP = 0.5
"""Step of a cluster's motion in parts of the middle step of a centre."""
COARSEST = 0.01
"""Step of A at most."""
_STEPS = struct.Struct("<dd")
"""Steps of A and t."""


@dataclass(frozen=True)
class Coded:
    """A state as bytes, and as a reader will have it.

    Attributes:
        errors: the largest error of each attribute, in the units of ``Bounds``.
    """

    body: bytes
    decoded: Columns
    errors: Mapping[str, float]


def encode(reference: Columns, state: Columns, clusters: Clusters, bounds: Bounds) -> Coded:
    """Codes a state of the same Gaussians as the reference.

    Args:
        reference: [N] as the reader has it. state: [N] exact. clusters: of the N.

    >>> from scas4d_core.gaussians import Gaussians
    >>> before = Gaussians.of_points(np.random.default_rng(0).normal(size=(300, 3)), radius=0.1)
    >>> after = before.replace(means=before.means + np.float32([0.2, 0, 0]))
    >>> clusters = Clusters.of(before)
    >>> coded = encode(Columns.of(before), Columns.of(after), clusters, Bounds())
    >>> len(coded.body) < 200, bool(np.allclose(coded.decoded.means.T, after.means, atol=0.006))
    (True, True)
    >>> again = decode(Columns.of(before), clusters, Bounds(), coded.body)
    >>> bool((again.means == coded.decoded.means).all())
    True
    """
    motion = ClusterMotion.between(clusters, reference, state)
    steps = _steps(clusters, reference, bounds)
    planes = np.rint(np.concatenate([motion.matrices.reshape(-1, 9) / steps[0], motion.shifts / steps[1]], axis=1).T)
    planes = np.clip(planes, -LARGEST, LARGEST).astype(np.int64)
    told = _Told.of(bounds, _moved(reference, clusters, planes, steps))
    exact = np.zeros(len(state), np.bool_)
    sections = [_STEPS.pack(*steps), *(pack(plane) for plane in planes)]
    for name in told.names:
        residual, beyond = whole_steps(told.residual(name, state))
        exact[: len(beyond)] |= beyond
        sections.append(write_residuals(residual))
        told = told.having(name, residual)
    exact |= _beyond(told.state, state, bounds)
    rows = np.flatnonzero(exact)
    values = np.concatenate([state.means[:, rows], state.factors[:, rows]])
    sections.append(write_exact(rows, values))
    retired, environment = state.retired, state.environment
    sections.append(write_mask(None if np.array_equal(reference.retired, retired) else retired))
    if environment is not None and reference.environment is not None:
        environment = None if np.array_equal(environment, reference.environment) else environment
    sections.append(write_array(environment))
    decoded = completed(told.state, rows, values, retired, environment)
    return Coded(b"".join(sections), decoded, errors_of(decoded, state))


def decode(reference: Columns, clusters: Clusters, bounds: Bounds, body: bytes) -> Columns:
    """The state that was coded.

    Args:
        reference, clusters, bounds: as they were given to ``encode``.

    Raises:
        PlaneError: the bytes are no such state.
    """
    if len(body) < _STEPS.size:
        raise PlaneError(f"{len(body)} bytes are no state")
    steps = _STEPS.unpack_from(body)
    if not np.isfinite(steps).all():
        raise PlaneError(f"steps {steps} cannot be")
    offset, planes = _STEPS.size, np.zeros((12, clusters.count), np.int64)
    for plane in planes:
        plane[:], offset = unpack(body, clusters.count, offset)
    told = _Told.of(bounds, _moved(reference, clusters, planes, steps))
    for name in told.names:
        residual, offset = read_residuals(body, offset, *told.shape(name))
        told = told.having(name, residual)
    rows, values, offset = read_exact(body, offset, len(reference), 12)
    retired, offset = read_mask(body, offset, len(reference))
    environment, offset = read_array(body, offset)
    if offset != len(body):
        raise PlaneError(f"{len(body) - offset} bytes follow the state")
    return completed(told.state, rows, values, retired, environment)


def errors_of(decoded: Columns, state: Columns) -> dict[str, float]:
    """The largest error of each attribute of a decoded state, in the units of ``Bounds``."""
    sizes = np.maximum(state.sizes(), 1e-12)

    def largest(found: Array, true: Array, unit: Array | float = 1.0) -> float:
        return float((np.abs(found - true) / unit).max(initial=0))

    turns = vectors_of(turns_between(state.rotations, decoded.rotations))
    found = {
        "position": largest(decoded.means, state.means, sizes),
        "axes": largest(decoded.factors, state.factors, sizes),
        "rotation": float(np.sqrt(np.square(turns).sum(axis=0)).max(initial=0)),
        "colour": largest(decoded.colours, state.colours),
        "opacity": largest(decoded.opacities, state.opacities),
    }
    if state.gloss is not None and decoded.gloss is not None:
        found["gloss"] = largest(decoded.gloss, state.gloss)
    return found


@dataclass(frozen=True, eq=False)
class _Told:
    """A state as far as it is told: what clusters foretell, and attributes one after the other.

    What comes first helps the next: axes turn with the rotation, and steps are parts of the told size.
    """

    bounds: Bounds
    state: Columns
    sizes: Array
    """[N] metres, as they are told so far."""

    @classmethod
    def of(cls, bounds: Bounds, state: Columns) -> _Told:
        return cls(bounds, state, state.sizes())

    @property
    def names(self) -> tuple[str, ...]:
        names = ("sizes", "rotations", "factors", "means", "colours", "foreground")
        return names if self.state.gloss is None else (*names, "gloss")

    def shape(self, name: str) -> tuple[int, int]:
        """Components and rows."""
        if name == "gloss" and self.state.gloss is not None:
            return 3, self.state.gloss.shape[1]
        return {"sizes": 1, "factors": 9, "foreground": 1}.get(name, 3), len(self.state)

    def _step(self, name: str) -> Array | np.float32:
        bounds = self.bounds
        if name in ("means", "factors"):
            part = bounds.position if name == "means" else bounds.axes
            return np.asarray(np.float32(2 * part * MARGIN) * self.sizes, np.float32)
        if name == "rotations":
            return np.float32(bounds.rotation_step)
        return np.float32(2 * (bounds.colour if name == "colours" else bounds.gloss))

    def residual(self, name: str, state: Columns) -> NDArray[Any]:
        """[P, N] what a state has beside, in whole steps."""
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            if name == "sizes":
                steps = np.rint(np.log(state.sizes() / self.sizes) / SCALE_STEP)
                return np.asarray(np.nan_to_num(steps, posinf=0, neginf=0))[None]
            if name == "foreground":
                return np.asarray(levels_of(state.foreground) - levels_of(self.state.foreground))[None]
            if name == "rotations":
                vectors = vectors_of(turns_between(state.rotations, self.state.rotations))
                return np.asarray(np.rint(vectors / self._step(name)))
            found = np.rint((getattr(state, name) - getattr(self.state, name)) / self._step(name))
        return np.asarray(by_green(found) if name == "colours" else found)

    def having(self, name: str, residual: Ints) -> _Told:
        """The same with another attribute."""
        if not residual.any():
            return self
        if name == "sizes":
            scales = np.exp(np.float32(SCALE_STEP) * np.clip(residual[0], -500, 500).astype(np.float32))
            return replace(
                self, state=self.state.having(factors=self.state.factors * scales), sizes=self.sizes * scales
            )
        if name == "foreground":
            levels = np.clip(levels_of(self.state.foreground) + residual[0], 0, LABELS - 1)
            return replace(self, state=self.state.having(foreground=label_of(levels)))
        if name == "rotations":
            return self._turned(residual.astype(np.float32) * self._step(name))
        if name == "colours":
            residual = of_green(residual)
        changed = getattr(self.state, name) + residual.astype(np.float32) * self._step(name)
        return replace(self, state=self.state.having(**{name: changed}))

    def _turned(self, vectors: Array) -> _Told:
        turns = turns_of(vectors)
        factors = np.stack(mapped(rotation_rows(turns), self.state.factors))
        rotations = products(turns, self.state.rotations)
        rotations /= np.sqrt(np.square(rotations).sum(axis=0))
        return replace(self, state=self.state.having(rotations=rotations, factors=factors))


def whole_steps(found: NDArray[Any]) -> tuple[Ints, NDArray[np.bool_]]:
    """[P, N] as whole numbers, 0 for those that are none or too large, and [N] whether a row has any of these."""
    outside = ~(np.abs(found) < LARGEST)
    return np.where(outside, 0, found).astype(np.int32), outside.any(axis=0)


def _moved(reference: Columns, clusters: Clusters, planes: NDArray[np.int64], steps: tuple[float, float]) -> Columns:
    """The reference, moved with its clusters."""
    table = planes.T.astype(np.float64)
    motion = ClusterMotion(table[:, :9].reshape(-1, 3, 3) * steps[0], table[:, 9:] * steps[1])
    return motion.carried(clusters, reference)


def _steps(clusters: Clusters, reference: Columns, bounds: Bounds) -> tuple[float, float]:
    """Steps of A and t, such that both move a Gaussian by a part of its own step."""
    moving = clusters.labels > 0
    if not moving.any():
        return 1.0, 1.0
    shift = SHIFT_STEP * 2 * bounds.position * max(float(np.median(reference.sizes()[moving])), 1e-9)
    squares = clusters.means(np.square(reference.means.astype(np.float64))) - np.square(clusters.means(reference.means))
    radius = float(np.sqrt(max(float(squares.sum(axis=0).mean()), 1e-18)))
    return min(shift / radius, COARSEST), shift


def _beyond(found: Columns, true: Columns, bounds: Bounds) -> NDArray[np.bool_]:
    """[N] bool: the Gaussians whose centre or axes are further off than the bounds, or whose volume is lost."""
    sizes = true.sizes()
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(found.factors - true.factors).max(axis=0) <= SLACK * bounds.axes * sizes
        moved = np.abs(found.means - true.means).max(axis=0) <= SLACK * bounds.position * sizes
    return np.asarray(~(off & moved)) | lost_volume(found, true)


def lost_volume(found: Columns, true: Columns) -> NDArray[np.bool_]:
    """[N] bool: the Gaussians whose decoded volume is another than the true one, where that has any."""
    with np.errstate(over="ignore", invalid="ignore"):
        volumes, told = true.volumes(), found.volumes()
        low, high = np.minimum(FLAT * volumes, volumes / FLAT), np.maximum(FLAT * volumes, volumes / FLAT)
        return np.asarray(~((told >= low) & (told <= high)) & (volumes != 0))


def completed(
    state: Columns, rows: NDArray[np.intp], values: Array, retired: NDArray[np.bool_] | None, environment: Array | None
) -> Columns:
    """A state with what is told exactly: centres and axes [12, E] of some rows, who is retired, what is mirrored.

    Args:
        retired, environment: None where the state's own hold.
    """
    if len(rows):
        means, factors = state.means.copy(), state.factors.copy()
        means[:, rows], factors[:, rows] = values[:3], values[3:]
        state = state.having(means=means, factors=factors)
    if environment is not None:
        state = state.having(environment=environment)
    return state if retired is None else state.having(retired=retired)
