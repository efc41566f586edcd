"""Encodes a state as cluster motion and per-Gaussian residuals, relative to a reference known to the reader.

The reference is a decoded state, so errors do not accumulate: each frame corrects the errors of the previous one.
This module requires only NumPy and zstandard.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scas4d_core.compact.bounds import Bounds
from scas4d_core.compact.cluster_motion import ClusterMotion, Clusters
from scas4d_core.compact.columns import Columns, relative_rotations, rotation_vectors
from scas4d_core.compact.planes import Ints, PlaneError, pack, unpack
from scas4d_core.compact.residuals import LARGEST, SHAPE, DecodedState, appearance_attributes, coded_shape, whole_steps
from scas4d_core.compact.sections import (
    read_array,
    read_coded_rows,
    read_exact,
    read_mask,
    scattered,
    write_array,
    write_exact,
    write_mask,
    write_residuals,
)

Array = NDArray[np.float32]
Float = NDArray[np.float64]

MIN_VOLUME_RATIO = 0.1
"""Minimum ratio of decoded to true volume; its inverse is the maximum. Gaussians outside this range are coded exactly.

This concerns thin Gaussians whose axis error is as large as the axis itself; they would otherwise collapse or invert.
"""
SLACK = 1 + 1e-4
"""Factor by which bounds are relaxed to allow for float32 rounding."""
SHIFT_STEP = 0.5
"""Quantization step of a cluster's translation, relative to the median step of the moving Gaussians' centres."""
LARGEST_STEP = 1e90
"""Exclusive upper bound on valid steps; larger steps would produce non-finite states."""
COARSEST = 0.01
"""Maximum quantization step of A, the matrix of a cluster's affine map."""
_STEPS = struct.Struct("<dd")
"""Quantization steps of the matrix A and the translation t of a cluster's affine map."""


@dataclass(frozen=True)
class EncodedFrame:
    """An encoded state, and the state as decoded by a reader.

    Attributes:
        body: encoded bytes.
        decoded: state as decoded by a reader.
        errors: largest error of each attribute, in the units of ``Bounds``.
    """

    body: bytes
    decoded: Columns
    errors: Mapping[str, float]


def encode(reference: Columns, state: Columns, clusters: Clusters, bounds: Bounds) -> EncodedFrame:
    """Encodes a state that consists of the same Gaussians as the reference.

    Args:
        reference: reference state of N Gaussians, as decoded by the reader.
        state: exact state of the same Gaussians.
        clusters: clusters of these Gaussians.
        bounds: error bounds.

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
    rows, still = _changing(reference, state, clusters, bounds)
    before, true, own = reference, state, clusters
    if rows is not None:
        before, true, own = reference.rows(rows), state.rows(rows), clusters.rows(rows)
    motion = ClusterMotion.fit(own, before, true)
    steps = _steps(own, before, bounds)
    planes = np.rint(np.concatenate([motion.matrices.reshape(-1, 9) / steps[0], motion.shifts / steps[1]], axis=1).T)
    planes = np.clip(planes, -LARGEST, LARGEST).astype(np.int64)
    partial = DecodedState.of(bounds, _predict(before, own, planes, steps))
    exact = np.zeros(len(true), np.bool_)
    sections = [_STEPS.pack(*steps), *(pack(plane) for plane in planes)]
    for name in SHAPE:
        residual, beyond = whole_steps(partial.residual(name, true))
        exact |= beyond
        sections.append(write_residuals(residual, rows, len(state)))
        partial = partial.apply_residual(name, residual)
    exact |= _out_of_bounds(partial.state, true, bounds)
    exactly, values = np.flatnonzero(exact), np.concatenate([true.means[:, exact], true.factors[:, exact]])
    shaped = apply_exact(partial.state, exactly, values)
    errors = {
        name: max(float(each.max(initial=0)), still.get(name, 0)) for name, each in _shape_errors(shaped, true).items()
    }
    partial = replace(partial, state=shaped if rows is None else reference.replace_rows(rows, shaped))
    for name in appearance_attributes(state):
        residual, _ = whole_steps(partial.residual(name, state))
        sections.append(write_residuals(residual))
        partial = partial.apply_residual(name, residual)
    sections.append(write_exact(exactly if rows is None else rows[exactly], values))
    retired, environment = state.retired, state.environment
    sections.append(write_mask(None if np.array_equal(reference.retired, retired) else retired))
    if environment is not None and reference.environment is not None:
        environment = None if np.array_equal(environment, reference.environment) else environment
    sections.append(write_array(environment))
    decoded = apply_exact(partial.state, retired=retired, environment=environment)
    return EncodedFrame(b"".join(sections), decoded, errors | _appearance_errors(decoded, state))


@dataclass(frozen=True, eq=False)
class FrameDelta:
    """The changes encoded in the body of a state record.

    Attributes:
        steps: quantization steps of A and t.
        motion: [12, clusters] A and t of each cluster, in quantization steps.
        residuals: maps each attribute to its coded rows [R] and their quantized residuals [P, R].
        rows, values: indices [E] of the exactly coded rows, and the values [12, E] in these rows.
        retired, environment: new retired mask and environment map, each None if unchanged.
    """

    steps: tuple[float, float]
    motion: NDArray[np.int64]
    residuals: Mapping[str, tuple[NDArray[np.intp], Ints]]
    rows: NDArray[np.intp]
    values: Array
    retired: NDArray[np.bool_] | None
    environment: Array | None

    @classmethod
    def read(cls, body: bytes, reference: Columns, clusters: Clusters) -> FrameDelta:
        """Parses the body of a state record.

        Args:
            body: encoded bytes.
            reference, clusters: reference state, and clusters of its Gaussians.

        Raises:
            PlaneError: if the bytes are not a valid state of these Gaussians.
        """
        if len(body) < _STEPS.size:
            raise PlaneError(f"truncated state of {len(body)} bytes")
        steps = _STEPS.unpack_from(body)
        if not (np.abs(steps) < LARGEST_STEP).all():
            raise PlaneError(f"quantization steps {steps} are out of range")
        offset, motion = _STEPS.size, np.zeros((12, clusters.count), np.int64)
        for plane in motion:
            plane[:], offset = unpack(body, clusters.count, offset)
        residuals = {}
        for name in (*SHAPE, *appearance_attributes(reference)):
            rows, planes, offset = read_coded_rows(body, offset, *coded_shape(reference, name))
            residuals[name] = rows, planes
        rows, values, offset = read_exact(body, offset, len(reference), 12)
        retired, offset = read_mask(body, offset, len(reference))
        environment, offset = read_array(body, offset)
        if offset != len(body):
            raise PlaneError(f"{len(body) - offset} unexpected bytes after the state")
        return cls(steps, motion, residuals, rows, values, retired, environment)

    def apply_shape(
        self, state: Columns, clusters: Clusters, bounds: Bounds, places: NDArray[np.intp] | None
    ) -> Columns:
        """Applies the changes to centres, axes and rotations; gloss rotates with its cluster.

        Args:
            state: reference Gaussians, or a subset of them.
            clusters: clusters of these Gaussians.
            bounds: error bounds.
            places: maps each reference row to its column in ``state``, or None if ``state`` contains all rows.
        """
        partial = DecodedState.of(bounds, _predict(state, clusters, self.motion, self.steps))
        for name in SHAPE:
            rows, planes = self.residuals[name]
            own = rows if places is None else places[rows]
            partial = partial.apply_residual(name, scattered(own, planes, coded_shape(state, name)[1]))
        return apply_exact(partial.state, self.rows if places is None else places[self.rows], self.values)

    def apply_appearance(self, state: Columns, bounds: Bounds) -> Columns:
        """Applies the remaining changes: appearance, retirement and environment."""
        partial = DecodedState(bounds, state, np.zeros(0, np.float32))
        for name in appearance_attributes(state):
            partial = partial.apply_residual(name, scattered(*self.residuals[name], coded_shape(state, name)[1]))
        return apply_exact(partial.state, retired=self.retired, environment=self.environment)


def decode(reference: Columns, clusters: Clusters, bounds: Bounds, body: bytes) -> Columns:
    """Decodes a state encoded by ``encode``.

    Args:
        reference, clusters, bounds: the same values as passed to ``encode``.
        body: encoded bytes.

    Raises:
        PlaneError: if the bytes are not a valid state of these Gaussians.
    """
    return apply_deltas(reference, clusters, bounds, [FrameDelta.read(body, reference, clusters)])


def apply_deltas(reference: Columns, clusters: Clusters, bounds: Bounds, changes: Sequence[FrameDelta]) -> Columns:
    """Applies successive changes to the same Gaussians.

    Shapes are computed only for Gaussians that belong to a cluster or have coded shape changes.
    """
    if _codes_all_rows(reference, clusters):
        for change in changes:
            reference = change.apply_appearance(change.apply_shape(reference, clusters, bounds, None), bounds)
        return reference
    chosen = clusters.labels > 0
    for change in changes:
        for coded in (change.rows, *(change.residuals[name][0] for name in SHAPE)):
            chosen[coded] = True
    rows, places = np.flatnonzero(chosen), np.cumsum(chosen) - 1
    state, own = reference.rows(rows), clusters.rows(rows)
    for change in changes:
        state = change.apply_shape(state, own, bounds, places)
    state = reference.replace_rows(rows, state)
    for change in changes:
        state = change.apply_appearance(state, bounds)
    return state


def errors_of(decoded: Columns, state: Columns) -> dict[str, float]:
    """Returns the largest error of each attribute of a decoded state, in the units of ``Bounds``."""
    apart = {name: float(errors.max(initial=0)) for name, errors in _shape_errors(decoded, state).items()}
    return apart | _appearance_errors(decoded, state)


def _shape_errors(decoded: Columns, state: Columns) -> dict[str, Array]:
    """Returns the errors of each Gaussian's centre, axes and rotation, each [N]."""
    sizes = np.maximum(state.sizes(), np.float32(1e-12))
    turns = rotation_vectors(relative_rotations(state.rotations, decoded.rotations))
    return {
        "position": np.abs(decoded.means - state.means).max(axis=0) / sizes,
        "axes": np.abs(decoded.factors - state.factors).max(axis=0) / sizes,
        "rotation": np.sqrt(np.square(turns).sum(axis=0)),
    }


def _appearance_errors(decoded: Columns, state: Columns) -> dict[str, float]:
    """Returns the largest error of each appearance attribute."""

    def largest(found: Array, true: Array) -> float:
        return float(np.abs(found - true).max(initial=0))

    found = {
        "colour": largest(decoded.colours, state.colours),
        "opacity": largest(decoded.opacities, state.opacities),
    }
    if state.gloss is not None and decoded.gloss is not None:
        found["gloss"] = largest(decoded.gloss, state.gloss)
    return found


def _codes_all_rows(reference: Columns, clusters: Clusters) -> bool:
    """Returns whether to code all rows: no row is static, or the Gaussians have gloss."""
    return reference.gloss is not None or bool(clusters.labels.all())


def _changing(
    reference: Columns, state: Columns, clusters: Clusters, bounds: Bounds
) -> tuple[NDArray[np.intp] | None, dict[str, float]]:
    """Finds the Gaussians whose shape or position must be coded because they move or exceed the bounds.

    Returns:
        The rows [E] of these Gaussians, or None for all rows, and the largest error of each attribute over all
        other Gaussians.
    """
    if _codes_all_rows(reference, clusters):
        return None, {}
    errors = _shape_errors(reference, state)
    changing = lost_volume(reference, state) | (clusters.labels > 0)
    for name, error in errors.items():
        changing |= ~(error <= getattr(bounds, name))
    return np.flatnonzero(changing), {name: float(error[~changing].max(initial=0)) for name, error in errors.items()}


def _predict(reference: Columns, clusters: Clusters, planes: NDArray[np.int64], steps: tuple[float, float]) -> Columns:
    """Predicts a state by moving the reference with its clusters."""
    table = planes.T.astype(np.float64)
    motion = ClusterMotion(table[:, :9].reshape(-1, 3, 3) * steps[0], table[:, 9:] * steps[1])
    return motion.predict(clusters, reference)


def _steps(clusters: Clusters, reference: Columns, bounds: Bounds) -> tuple[float, float]:
    """Returns the quantization steps of A and t; one step moves a Gaussian by a fraction of its own position step."""
    moving = clusters.labels > 0
    if not moving.any():
        return 1.0, 1.0
    shift = SHIFT_STEP * 2 * bounds.position * max(float(np.median(reference.sizes()[moving])), 1e-9)
    squares = clusters.means(np.square(reference.means.astype(np.float64))) - np.square(clusters.means(reference.means))
    radius = float(np.sqrt(max(float(squares.sum(axis=0).mean()), 1e-18)))
    return min(shift / radius, COARSEST), shift


def _out_of_bounds(found: Columns, true: Columns, bounds: Bounds) -> NDArray[np.bool_]:
    """Returns [N] bool: whether each Gaussian exceeds the bounds on centre or axes, or loses its volume."""
    sizes = true.sizes()
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(found.factors - true.factors).max(axis=0) <= SLACK * bounds.axes * sizes
        moved = np.abs(found.means - true.means).max(axis=0) <= SLACK * bounds.position * sizes
    return np.asarray(~(off & moved)) | lost_volume(found, true)


def lost_volume(found: Columns, true: Columns) -> NDArray[np.bool_]:
    """Returns [N] bool: whether each Gaussian's decoded volume differs too much from a nonzero true volume."""
    with np.errstate(over="ignore", invalid="ignore"):
        volumes, volumes_decoded = true.volumes(), found.volumes()
        low, high = (
            np.minimum(MIN_VOLUME_RATIO * volumes, volumes / MIN_VOLUME_RATIO),
            np.maximum(MIN_VOLUME_RATIO * volumes, volumes / MIN_VOLUME_RATIO),
        )
        return np.asarray(~((volumes_decoded >= low) & (volumes_decoded <= high)) & (volumes != 0))


def apply_exact(
    state: Columns,
    rows: NDArray[np.intp] | None = None,
    values: Array | None = None,
    retired: NDArray[np.bool_] | None = None,
    environment: Array | None = None,
) -> Columns:
    """Applies exactly coded values: centres and axes of some rows, the retired mask and the environment.

    Args:
        state: state to change.
        rows, values: row indices [E], and the centres and axes [12, E] of these rows, or None for no rows.
        retired, environment: new values; None keeps the current ones.
    """
    if rows is not None and values is not None and len(rows):
        means, factors = state.means.copy(), state.factors.copy()
        means[:, rows], factors[:, rows] = values[:3], values[3:]
        state = state.replace(means=means, factors=factors)
    if environment is not None:
        state = state.replace(environment=environment)
    return state if retired is None else state.replace(retired=retired)
