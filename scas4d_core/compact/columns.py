"""A state by component: [components, N] arrays, which small kernels of numpy go through fast."""

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
"""Levels of the learnt label; the threshold of moving Gaussians, 0.5, lies between two."""


@dataclass(frozen=True, eq=False)
class Columns:
    """N Gaussians, component by component; arrays are shared between states and must not be written to.

    Attributes:
        means: [3, N] metres. factors: [9, N], row by row of F. rotations: [4, N] (w, x, y, z). colours: [3, N].
        foreground: [N]. ids: [N]. opacities: [N], those of the retired too. retired: [N] bool.
        gloss: [3, M] or None. environment: what is mirrored, or None.

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
        """The columns of a state."""
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
        """The state."""
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
        """The same with some arrays exchanged."""
        return replace(self, **changes)

    def concatenate(self, born: Columns) -> Columns:
        """With Gaussians after its own, which keep their ids and are dull."""
        return self.replace(
            **{name: np.concatenate([getattr(self, name), getattr(born, name)], axis=-1) for name in BY_ROW}
        )

    def from_row(self, count: int) -> Columns:
        """The Gaussians from row ``count`` on, dull."""
        rows = {name: getattr(self, name)[..., count:] for name in BY_ROW}
        return self.replace(**rows, gloss=None, environment=None)

    def rows(self, rows: NDArray[np.intp]) -> Columns:
        """Some of the Gaussians, dull."""
        taken = {name: np.take(getattr(self, name), rows, axis=-1) for name in BY_ROW}
        return self.replace(**taken, gloss=None, environment=None)

    def replace_rows(self, rows: NDArray[np.intp], part: Columns) -> Columns:
        """The same with place and shape of some rows exchanged."""
        changed = {name: getattr(self, name).copy() for name in SHAPED}
        for name, array in changed.items():
            array[..., rows] = getattr(part, name) + np.float32(0)  # −0 to 0: whichever rows go through arithmetic
        return self.replace(**changed)

    @property
    def moving(self) -> NDArray[np.bool_]:
        """[N] bool: the Gaussians that move, by their label; none that is retired."""
        return np.asarray((self.foreground > 0.5) & ~self.retired)

    def sizes(self) -> Array:
        """[N] sizes, metres: the root mean square of the lengths of the axes.

        >>> Columns.of(Gaussians.of_points([[0, 0, 2]], radius=0.1)).sizes()
        array([0.1], dtype=float32)
        """
        return sizes_of(self.factors)

    def volumes(self) -> Float:
        """[N] determinants of F."""
        a, b, c, d, e, f, g, h, i = self.factors.astype(np.float64)
        return np.asarray(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g))


BY_ROW = ("means", "factors", "rotations", "colours", "foreground", "ids", "opacities", "retired")
"""Arrays with a column for each Gaussian."""
SHAPED = BY_ROW[:3]
"""Those of them that say where a Gaussian is and of which shape."""


def sizes_of(factors: Array) -> Array:
    """[N] sizes of factors [9, N], metres."""
    squares = np.zeros(factors.shape[1], np.float32)
    for plane in factors:
        squares += plane * plane
    return np.asarray(np.sqrt(squares / np.float32(3)))


def levels_of(labels: NDArray[Any]) -> NDArray[np.int32]:
    """Level of each learnt label, 0…63; those above 0.5 have 32 or more.

    >>> levels_of(np.array([0.0, 0.5, 0.501, 1.0]))
    array([ 0, 31, 32, 63], dtype=int32)
    """
    levels = np.clip(np.ceil(labels.astype(np.float64) * LABELS) - 1, 0, LABELS - 1)
    return np.asarray(levels, np.int32)


def label_of(levels: NDArray[Any]) -> Array:
    """Label in the middle of a level."""
    return ((levels + 0.5) / LABELS).astype(np.float32)


def products(a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
    """[4, N] a∘b of quaternions by component: first b, then a."""
    return np.stack(product_components(a, b))


def multiply_rows(rows: Sequence[Sequence[NDArray[Any]]], planes: NDArray[Any]) -> list[NDArray[Any]]:
    """The components, [N] each, of a matrix times vectors or matrices, one of each a Gaussian.

    Args:
        rows: of the matrices, three of three [N]. planes: [3, N] of vectors, or [9, N] of matrices row by row.

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
    """[3, N] green, and what red and blue have more of it: channels change alike.

    >>> decorrelate_colours(np.array([[5], [3], [2]])).ravel(), restore_colours(np.array([[3], [2], [-1]])).ravel()
    (array([ 3,  2, -1]), array([5, 3, 2]))
    """
    red, green, blue = colours
    return np.stack([green, red - green, blue - green])


def restore_colours(planes: NDArray[Any]) -> NDArray[Any]:
    """[3, N] red, green and blue of ``decorrelate_colours``."""
    green, red, blue = planes
    return np.stack([red + green, green, blue + green])


def relative_rotations(after: Array, before: Array) -> Float:
    """[4, N] what turns one rotation to another."""
    w, x, y, z = before.astype(np.float64)
    return np.asarray(products(after.astype(np.float64), np.stack([w, -x, -y, -z])))


def rotation_vectors(turns: NDArray[Any]) -> NDArray[Any]:
    """[3, N] 2 tan(θ/2) about the axis of each turn [4, N]; near θ where it is small."""
    w = turns[0]
    return np.asarray(turns[1:] * (2 * np.where(w < 0, -1, 1) / np.maximum(np.abs(w), 1e-6)))


def rotations_of_vectors(vectors: NDArray[Any]) -> NDArray[Any]:
    """[4, N] unit quaternions of ``rotation_vectors``."""
    squares = 1 + np.square(vectors).sum(axis=0) / 4
    return np.asarray(np.concatenate([np.ones_like(vectors[:1]), vectors / 2]) / np.sqrt(squares))


def _planes(rows: NDArray[Any]) -> Array:
    return np.ascontiguousarray(rows.T, np.float32)
