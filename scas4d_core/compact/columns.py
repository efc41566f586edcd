"""A state stored as one [components, N] array per attribute, a layout that NumPy processes quickly."""

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
"""Number of quantization levels of the learnt label; the moving threshold, 0.5, lies between two levels."""


@dataclass(frozen=True, eq=False)
class Columns:
    """N Gaussians stored component by component. Arrays are shared between states and must not be modified.

    Attributes:
        means: [3, N] centres in metres.
        factors: [9, N] entries of F in row-major order.
        rotations: [4, N] material rotations as quaternions (w, x, y, z).
        colours: [3, N] RGB colours.
        foreground: [N] learnt labels; a Gaussian moves if its label is above 0.5.
        ids: [N] Gaussian ids.
        opacities: [N] opacities; retired Gaussians keep their opacity.
        retired: [N] bool, whether each Gaussian is retired.
        gloss: [3, M] gloss of the first M Gaussians, or None.
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
        """Returns the Gaussians from row ``count`` onwards, without gloss."""
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
        """[N] bool: whether each Gaussian moves according to its label and is not retired."""
        return np.asarray((self.foreground > 0.5) & ~self.retired)

    def sizes(self) -> Array:
        """Returns the size of each Gaussian in metres, [N]: the root mean square of the lengths of its axes.

        >>> Columns.of(Gaussians.of_points([[0, 0, 2]], radius=0.1)).sizes()
        array([0.1], dtype=float32)
        """
        return sizes_of(self.factors)

    def volumes(self) -> Float:
        """Returns the determinant of each factor F, [N]."""
        a, b, c, d, e, f, g, h, i = self.factors.astype(np.float64)
        return np.asarray(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g))


BY_ROW = ("means", "factors", "rotations", "colours", "foreground", "ids", "opacities", "retired")
"""Names of the arrays with one column per Gaussian."""
SHAPED = BY_ROW[:3]
"""Arrays of `BY_ROW` that define position and shape."""


def sizes_of(factors: Array) -> Array:
    """Returns the sizes in metres, [N], of Gaussians with the given factors [9, N]."""
    squares = np.zeros(factors.shape[1], np.float32)
    for plane in factors:
        squares += plane * plane
    return np.asarray(np.sqrt(squares / np.float32(3)))


def levels_of(labels: NDArray[Any]) -> NDArray[np.int32]:
    """Quantizes learnt labels to levels 0…63; labels above 0.5 get level 32 or higher.

    >>> levels_of(np.array([0.0, 0.5, 0.501, 1.0]))
    array([ 0, 31, 32, 63], dtype=int32)
    """
    levels = np.clip(np.ceil(labels.astype(np.float64) * LABELS) - 1, 0, LABELS - 1)
    return np.asarray(levels, np.int32)


def label_of(levels: NDArray[Any]) -> Array:
    """Returns the label at the centre of each level."""
    return ((levels + 0.5) / LABELS).astype(np.float32)


def products(a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
    """Returns the quaternion products a∘b, [4, N], which apply the rotation b first."""
    return np.stack(product_components(a, b))


def multiply_rows(rows: Sequence[Sequence[NDArray[Any]]], planes: NDArray[Any]) -> list[NDArray[Any]]:
    """Multiplies one 3×3 matrix per Gaussian by a vector or matrix; returns the components, each [N].

    Args:
        rows: left matrices, as three rows of three arrays [N].
        planes: [3, N] right vectors, or [9, N] right matrices in row-major order.

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
    """Converts RGB to green, red − green and blue − green, [3, N], because the channels are correlated.

    >>> decorrelate_colours(np.array([[5], [3], [2]])).ravel(), restore_colours(np.array([[3], [2], [-1]])).ravel()
    (array([ 3,  2, -1]), array([5, 3, 2]))
    """
    red, green, blue = colours
    return np.stack([green, red - green, blue - green])


def restore_colours(planes: NDArray[Any]) -> NDArray[Any]:
    """Converts the output of ``decorrelate_colours`` back to RGB, [3, N]."""
    green, red, blue = planes
    return np.stack([red + green, green, blue + green])


def relative_rotations(after: Array, before: Array) -> Float:
    """Returns the rotations [4, N] that take ``before`` to ``after``."""
    w, x, y, z = before.astype(np.float64)
    return np.asarray(products(after.astype(np.float64), np.stack([w, -x, -y, -z])))


def rotation_vectors(turns: NDArray[Any]) -> NDArray[Any]:
    """Converts rotations [4, N] to vectors [3, N]: the axis times 2 tan(θ/2), which is close to θ for small angles."""
    w = turns[0]
    return np.asarray(turns[1:] * (2 * np.where(w < 0, -1, 1) / np.maximum(np.abs(w), 1e-6)))


def rotations_of_vectors(vectors: NDArray[Any]) -> NDArray[Any]:
    """Converts the output of ``rotation_vectors`` back to unit quaternions [4, N]."""
    squares = 1 + np.square(vectors).sum(axis=0) / 4
    return np.asarray(np.concatenate([np.ones_like(vectors[:1]), vectors / 2]) / np.sqrt(squares))


def _planes(rows: NDArray[Any]) -> Array:
    return np.ascontiguousarray(rows.T, np.float32)
