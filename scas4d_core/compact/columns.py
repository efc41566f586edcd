"""A state stored by component as [components, N] arrays, a layout on which numpy is fast."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.gaussians import Gaussians, product_components

Array = NDArray[np.float32]
Float = NDArray[np.float64]

LABELS = 64
"""Number of levels of the learnt label; the threshold of moving Gaussians, 0.5, is between two levels."""


@dataclass(frozen=True, eq=False)
class Columns:
    """N Gaussians stored component by component. Arrays are shared between states and must not be modified.

    Attributes:
        means: [3, N] in metres.
        factors: [9, N], entries of F in row-major order.
        rotations: [4, N] quaternions (w, x, y, z).
        colours: [3, N].
        foreground: [N] learnt labels.
        ids: [N].
        opacities: [N], including those of retired Gaussians.
        retired: [N] bool.
        gloss: [3, M] for the first M Gaussians, or None.
        environment: environment map for reflections, or None.

    >>> state = Gaussians.of_points([[0, 0, 2], [1, 0, 2]], radius=0.1)
    >>> Columns.of(state).means
    array([[0., 1.],
           [0., 0.],
           [2., 2.]], dtype=float32)
    >>> bool((Columns.of(state).gaussians().factors == state.factors).all())
    True
    """

    means: Array
    factors: Array
    rotations: Array
    colours: Array
    foreground: Array
    ids: NDArray[np.int64]
    opacities: Array
    retired: NDArray[np.bool_]
    gloss: Array | None = None
    environment: Array | None = None

    @classmethod
    def of(cls, state: Gaussians) -> Columns:
        """Converts a state to columns."""
        return cls(
            means=_planes(state.means),
            factors=_planes(state.factors.reshape(len(state), 9)),
            rotations=_planes(state.rotations),
            colours=_planes(state.colours),
            foreground=state.foreground,
            ids=state.ids,
            opacities=state.own_opacities,
            retired=state.retired,
            gloss=None if state.gloss is None else _planes(state.gloss),
            environment=state.environment,
        )

    def __len__(self) -> int:
        return int(self.means.shape[1])

    def gaussians(self) -> Gaussians:
        """Converts the columns to a state."""
        return Gaussians(
            means=np.ascontiguousarray(self.means.T),
            factors=np.ascontiguousarray(self.factors.T).reshape(-1, 3, 3),
            rotations=np.ascontiguousarray(self.rotations.T),
            opacities=self.opacities,
            colours=np.ascontiguousarray(self.colours.T),
            foreground=self.foreground,
            ids=self.ids,
            retired=self.retired,
            gloss=None if self.gloss is None else np.ascontiguousarray(self.gloss.T),
            environment=self.environment,
        )

    def replace(self, **changes: Any) -> Columns:
        """Returns a copy with some arrays replaced."""
        return replace(self, **changes)

    def concatenate(self, born: Columns) -> Columns:
        """Appends newborn Gaussians, which keep their ids and have no gloss."""
        return self.replace(
            **{name: np.concatenate([getattr(self, name), getattr(born, name)], axis=-1) for name in BY_ROW}
        )

    def from_row(self, count: int) -> Columns:
        """Returns the Gaussians from row ``count`` on, without gloss."""
        rows = {name: getattr(self, name)[..., count:] for name in BY_ROW}
        return self.replace(**rows, gloss=None, environment=None)

    def rows(self, rows: NDArray[np.intp]) -> Columns:
        """Returns the Gaussians at the given rows, without gloss."""
        taken = {name: np.take(getattr(self, name), rows, axis=-1) for name in BY_ROW}
        return self.replace(**taken, gloss=None, environment=None)

    def replace_rows(self, rows: NDArray[np.intp], part: Columns) -> Columns:
        """Returns a copy with the positions and shapes of the given rows replaced."""
        changed = {name: getattr(self, name).copy() for name in SHAPED}
        for name, array in changed.items():
            array[..., rows] = getattr(part, name) + np.float32(0)  # −0 becomes 0, as in computed rows
        return self.replace(**changed)

    @property
    def moving(self) -> NDArray[np.bool_]:
        """[N] bool: Gaussians that move according to their label and are not retired."""
        return np.asarray((self.foreground > 0.5) & ~self.retired)

    def sizes(self) -> Array:
        """Returns the sizes [N] in metres: the root mean square of the lengths of the axes.

        >>> Columns.of(Gaussians.of_points([[0, 0, 2]], radius=0.1)).sizes()
        array([0.1], dtype=float32)
        """
        return sizes_of(self.factors)

    def volumes(self) -> Float:
        """Returns the determinants of F, [N]."""
        a, b, c, d, e, f, g, h, i = self.factors.astype(np.float64)
        return np.asarray(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g))


BY_ROW = ("means", "factors", "rotations", "colours", "foreground", "ids", "opacities", "retired")
"""Names of the arrays with one column per Gaussian."""
SHAPED = BY_ROW[:3]
"""Those arrays of `BY_ROW` that define position and shape."""


def sizes_of(factors: Array) -> Array:
    """Returns the sizes [N] in metres of factors [9, N]."""
    squares = np.zeros(factors.shape[1], np.float32)
    for plane in factors:
        squares += plane * plane
    return np.asarray(np.sqrt(squares / np.float32(3)))


def levels_of(labels: NDArray[Any]) -> NDArray[np.int32]:
    """Returns the level 0…63 of each learnt label; labels above 0.5 have levels of 32 or more.

    >>> levels_of(np.array([0.0, 0.5, 0.501, 1.0]))
    array([ 0, 31, 32, 63], dtype=int32)
    """
    levels = np.clip(np.ceil(labels.astype(np.float64) * LABELS) - 1, 0, LABELS - 1)
    return np.asarray(levels, np.int32)


def label_of(levels: NDArray[Any]) -> Array:
    """Returns the label at the centre of each level."""
    return ((levels + 0.5) / LABELS).astype(np.float32)


def products(a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
    """Returns the products a∘b of quaternions [4, N] by component; b is applied first."""
    return np.stack(product_components(a, b))


def multiply_rows(rows: Sequence[Sequence[NDArray[Any]]], planes: NDArray[Any]) -> list[NDArray[Any]]:
    """Multiplies one matrix per Gaussian with vectors or matrices; returns the components, each [N].

    Args:
        rows: rows of the left matrices, three by three arrays [N].
        planes: [3, N] vectors, or [9, N] matrices in row-major order.

    >>> one, zero = np.ones(1), np.zeros(1)
    >>> multiply_rows([[zero, one, zero], [one, zero, zero], [zero, zero, one]], np.array([[5.0], [6], [7]]))
    [array([6.]), array([5.]), array([7.])]
    """
    width = len(planes) // 3
    return [
        row[0] * planes[column] + row[1] * planes[width + column] + row[2] * planes[2 * width + column]
        for row in rows
        for column in range(width)
    ]


def decorrelate_colours(colours: NDArray[Any]) -> NDArray[Any]:
    """Returns green, red − green and blue − green, [3, N], since the channels are correlated.

    >>> decorrelate_colours(np.array([[5], [3], [2]])).ravel(), restore_colours(np.array([[3], [2], [-1]])).ravel()
    (array([ 3,  2, -1]), array([5, 3, 2]))
    """
    red, green, blue = colours
    return np.stack([green, red - green, blue - green])


def restore_colours(planes: NDArray[Any]) -> NDArray[Any]:
    """Inverts ``decorrelate_colours``; returns red, green and blue, [3, N]."""
    green, red, blue = planes
    return np.stack([red + green, green, blue + green])


def relative_rotations(after: Array, before: Array) -> Float:
    """Returns the rotations [4, N] that take ``before`` to ``after``."""
    w, x, y, z = before.astype(np.float64)
    return np.asarray(products(after.astype(np.float64), np.stack([w, -x, -y, -z])))


def rotation_vectors(turns: NDArray[Any]) -> NDArray[Any]:
    """Returns 2 tan(θ/2) times the axis of each rotation [4, N], as [3, N]; the length is close to θ for small θ."""
    w = turns[0]
    return np.asarray(turns[1:] * (2 * np.where(w < 0, -1, 1) / np.maximum(np.abs(w), 1e-6)))


def rotations_of_vectors(vectors: NDArray[Any]) -> NDArray[Any]:
    """Inverts ``rotation_vectors``; returns unit quaternions [4, N]."""
    squares = 1 + np.square(vectors).sum(axis=0) / 4
    return np.asarray(np.concatenate([np.ones_like(vectors[:1]), vectors / 2]) / np.sqrt(squares))


def _planes(rows: NDArray[Any]) -> Array:
    return np.ascontiguousarray(rows.T, np.float32)
