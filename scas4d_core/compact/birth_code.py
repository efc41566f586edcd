"""Encodes Gaussians without a reference: those of the first frame, and newborn ones later.

Later frames are coded relative to these Gaussians, so even thin axes must keep their direction.
Each axis is therefore quantized relative to its own length.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scas4d_core.compact.bounds import Bounds
from scas4d_core.compact.cluster_motion import MAX_CLUSTERS, Clusters
from scas4d_core.compact.columns import (
    LABELS,
    Columns,
    decorrelate_colours,
    label_of,
    levels_of,
    restore_colours,
    rotation_vectors,
    rotations_of_vectors,
    sizes_of,
)
from scas4d_core.compact.frame_code import apply_exact, lost_volume
from scas4d_core.compact.planes import Ints, PlaneError, pack, unpack
from scas4d_core.compact.residuals import MARGIN, whole_steps
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

Float = NDArray[np.float64]

OCTAVE = 8
"""Number of quantization steps per octave (factor of two) of axis length."""
FINER = 4
"""Divisor that tightens the bounds on centres, axes and colours, because static Gaussians keep their initial errors."""
COARSEST = 0.02
"""Maximum error of an axis relative to its own length."""
SHORTEST = 1e-30
"""Minimum axis length, in metres."""
TINIEST, LARGEST_SIZE = 1e-18, 1e18
"""Range of quantizable sizes, in metres; Gaussians outside it are coded exactly."""
OPAQUE = 1e-4
"""Minimum margin between a decoded opacity and the limits 0 and 1."""
COMPONENTS = {"lengths": 3, "axes": 9, "means": 3, "rotations": 3, "colours": 3, "labels": 1, "opacities": 1}


def encode_born(state: Columns, clusters: Clusters, bounds: Bounds) -> tuple[bytes, Columns]:
    """Encodes Gaussians, their ids and their clusters; returns the bytes, and the Gaussians as decoded by a reader.

    >>> from scas4d_core.gaussians import Gaussians
    >>> state = Columns.of(Gaussians.of_points([[0, 0, 2], [1, 0, 2]], radius=0.1))
    >>> body, decoded = encode_born(state, Clusters(np.array([1, 1])), Bounds())
    >>> again, clusters = decode_born(body, 2, Bounds())
    >>> again.ids, clusters.labels, bool((again.means == decoded.means).all())
    (array([0, 1]), array([1, 1]), True)
    """
    coded: dict[str, Ints] = {}
    exact = np.zeros(len(state), np.bool_)
    for name, planes in _planes(state, bounds).items():
        coded[name], beyond = whole_steps(planes)
        exact |= beyond
    exact |= lost_volume(_columns(coded, state.ids, bounds), state)
    rows = np.flatnonzero(exact)
    gloss, retired = state.gloss, state.retired
    body = b"".join(
        [
            pack(np.diff(state.ids, prepend=0)),
            pack(clusters.labels),
            *(write_residuals(planes) for planes in coded.values()),
            write_exact(rows, np.concatenate([state.means[:, rows], state.factors[:, rows]])),
            write_mask(retired if retired.any() else None),
            pack(np.array([0 if gloss is None else 1 + gloss.shape[1]])),
            b"" if gloss is None else write_residuals(np.rint(gloss / (2 * bounds.gloss)).astype(np.int32)),
            write_array(state.environment),
        ]
    )
    return body, decode_born(body, len(state), bounds)[0]


def decode_born(body: bytes, count: int, bounds: Bounds) -> tuple[Columns, Clusters]:
    """Decodes Gaussians and their clusters.

    Raises:
        PlaneError: if the bytes do not encode ``count`` Gaussians.
    """
    steps, offset = unpack(body, count)
    labels, offset = unpack(body, count, offset)
    if labels.min(initial=0) < 0 or labels.max(initial=0) > MAX_CLUSTERS:
        raise PlaneError(f"cluster labels {labels.min(initial=0)} to {labels.max(initial=0)} are out of range")
    coded = {}
    for name, components in COMPONENTS.items():
        coded[name], offset = read_residuals(body, offset, components, count)
    rows, values, offset = read_exact(body, offset, count, 12)
    retired, offset = read_mask(body, offset, count)
    (with_gloss,), offset = unpack(body, 1, offset)
    state = _columns(coded, np.cumsum(steps.astype(np.int64)), bounds)
    if with_gloss:
        if not 1 <= with_gloss <= count + 1:
            raise PlaneError(f"invalid number of Gaussians with gloss: {with_gloss - 1} of {count}")
        planes, offset = read_residuals(body, offset, 3, int(with_gloss) - 1)
        state = state.replace(gloss=planes * np.float32(2 * bounds.gloss))
    environment, offset = read_array(body, offset)
    if offset != len(body):
        raise PlaneError(f"{len(body) - offset} unexpected bytes after the Gaussians")
    values += np.float32(0)  # −0 becomes 0, as in `Columns.replace_rows`
    return apply_exact(state, rows, values, retired, environment), Clusters(labels.astype(np.int64))


def _axis_step(bounds: Bounds) -> float:
    return 2 * min(COARSEST, bounds.axes / FINER)


def _planes(state: Columns, bounds: Bounds) -> dict[str, Float]:
    """Returns each attribute [P, N] in quantization steps, including non-finite and too large values."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        factors = state.factors.astype(np.float64).reshape(3, 3, -1)
        lengths = np.rint(OCTAVE * np.log2(np.maximum(np.sqrt(np.square(factors).sum(axis=0)), SHORTEST)))
        coded = np.exp2(lengths / OCTAVE)
        axes = np.rint(factors / coded / _axis_step(bounds))
        sizes = sizes_of((axes * _axis_step(bounds) * coded).reshape(9, -1)).astype(np.float64)
        usable = (sizes > TINIEST) & (sizes < LARGEST_SIZE)
        means = np.rint(state.means / (2 * bounds.position / FINER * MARGIN * np.where(usable, sizes, 0)))
        return {
            "lengths": np.nan_to_num(lengths),
            "axes": axes.reshape(9, -1),
            "means": means,
            "rotations": np.rint(rotation_vectors(state.rotations.astype(np.float64)) / bounds.rotation_step),
            "colours": decorrelate_colours(np.rint(state.colours.astype(np.float64) / (2 * bounds.colour / FINER))),
            "labels": levels_of(state.foreground)[None].astype(np.float64),
            "opacities": np.rint(state.opacities.astype(np.float64) / (2 * bounds.opacity))[None],
        }


def _columns(coded: dict[str, Ints], ids: NDArray[np.int64], bounds: Bounds) -> Columns:
    lengths = np.exp2(np.clip(coded["lengths"], -1000, 1000) / OCTAVE)
    with np.errstate(over="ignore", invalid="ignore"):
        factors = (coded["axes"].reshape(3, 3, -1) * _axis_step(bounds) * lengths).reshape(9, -1)
        sizes = sizes_of(factors).astype(np.float64)
        means = (coded["means"] * (2 * bounds.position / FINER * MARGIN * sizes)).astype(np.float32)
    colours = (restore_colours(coded["colours"]) * (2 * bounds.colour / FINER)).astype(np.float32)
    rotations = rotations_of_vectors(coded["rotations"] * bounds.rotation_step).astype(np.float32)
    foreground = label_of(np.clip(coded["labels"][0], 0, LABELS - 1))
    opacities = np.clip(coded["opacities"][0] * (2 * bounds.opacity), OPAQUE, 1 - OPAQUE).astype(np.float32)
    return Columns(
        means=means,
        factors=factors.astype(np.float32),
        rotations=rotations,
        colours=colours,
        foreground=foreground,
        ids=ids,
        opacities=opacities,
        retired=np.zeros(len(ids), np.bool_),
    )
