"""Θ, the state of a scene: an ordered, append-only set of 3D Gaussians. Requires only NumPy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float32]

WHOLE: Mapping[str, Any] = MappingProxyType({"whole": True})
"""Metadata of a ``Gaussians`` field without a row per Gaussian; the field may be None."""
ONCE: Mapping[str, Any] = MappingProxyType({"once": True})
"""Metadata of a field whose values do not change after a Gaussian is added."""
UNBORN = -1
"""Id of a Gaussian that has not been committed yet."""


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N Gaussians at one point in time.

    A Gaussian is identified by its row: row i is the same piece of matter in every frame. New
    Gaussians are appended (``concatenate``). A Gaussian that leaves the scene is retired but keeps
    its row, so it can return with the same identity. A retired Gaussian is not rendered, does not
    move and does not count as moving.

    Attributes:
        means: [N, 3] float32 centres in metres, in the internal world.
        factors: [N, 3, 3] float32 factors F of the covariances Σ = F Fᵀ. The columns of F are axes
            in metres, which the motion transforms.
        rotations: [N, 4] float32 unit quaternions (w, x, y, z) of the rotation of the material
            since frame 0, or since the Gaussian was added.
        opacities: [N] float32 opacities as rendered: 0 for retired Gaussians, otherwise in (0, 1).
        colours: [N, 3] float32 RGB colours, nominally [0, 1], without any gloss.
        foreground: [N] float32 learnt labels in [0, 1]. A Gaussian moves if its label is above 0.5.
        ids: [N] int64 permanent ids, or −1 for Gaussians that have not been committed yet.
        retired: [N] bool, true for retired Gaussians; defaults to all false.
        own_opacities: [N] float32 opacities in (0, 1), also of retired Gaussians; defaults to
            ``opacities``. They do not change after the first frame of a Gaussian.
        gloss: [M, 3] float32 normals of the first M Gaussians in the internal world, scaled by the
            strength of the reflection. Gaussians in later rows have no gloss. None if colours do
            not depend on the viewing direction.
        environment: [ROWS, 3] float32 reflected environment (``kernels.appearance.direction``).
            None if colours do not depend on the viewing direction.

    >>> state = Gaussians.of_points([[0, 0, 2], [0.5, 0, 2]], radius=0.1, colours=[1, 0, 0])
    >>> len(state), state.moving
    (2, array([ True,  True]))
    >>> state.replace(foreground=np.float32([1, 0])).moving
    array([ True, False])
    >>> gone = state.retire([0])
    >>> gone.opacities, gone.present, gone.revive([0]).opacities
    (array([0. , 0.9], dtype=float32), array([False,  True]), array([0.9, 0.9], dtype=float32))
    >>> state.concatenate(Gaussians.of_points([[0, 1, 2]], radius=0.1)).ids
    array([ 0,  1, -1])
    """

    means: Array
    factors: Array
    rotations: Array
    opacities: Array = field(metadata=ONCE)
    colours: Array
    foreground: Array
    ids: NDArray[np.int64] = field(metadata=ONCE)
    retired: NDArray[np.bool_] = None  # type: ignore[assignment]
    own_opacities: Array = None  # type: ignore[assignment]
    gloss: Array | None = field(default=None, metadata=WHOLE)
    environment: Array | None = field(default=None, metadata=WHOLE)

    def __post_init__(self) -> None:
        retired = np.zeros(len(self.means), np.bool_) if self.retired is None else self.retired
        own = self.opacities if self.own_opacities is None else self.own_opacities
        shown = np.where(retired, np.float32(0), own) if retired.any() else own
        if shown is not own and np.array_equal(shown, self.opacities):
            shown = self.opacities  # the same array object, so that its copy on a GPU stays valid
        for name, array in (("retired", retired), ("own_opacities", own), ("opacities", shown)):
            object.__setattr__(self, name, array)

    @classmethod
    def of_points(cls, points: ArrayLike, radius: float, colours: ArrayLike = 0.5) -> Gaussians:
        """Returns one isotropic moving Gaussian per point, for hand-made scenes.

        Args:
            points: [N, 3] centres in metres, in the internal world.
            radius: standard deviation along each axis, in metres.
            colours: [N, 3] RGB colours in [0, 1], or one colour for all points.
        """
        means = np.array(points, np.float32).reshape(-1, 3)
        count = len(means)
        return cls(
            means=means,
            factors=np.tile(np.float32(radius) * np.eye(3, dtype=np.float32), (count, 1, 1)),
            rotations=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
            opacities=np.full(count, 0.9, np.float32),
            colours=np.broadcast_to(np.asarray(colours, np.float32), (count, 3)).copy(),
            foreground=np.ones(count, np.float32),
            ids=np.arange(count, dtype=np.int64),
        )

    def __len__(self) -> int:
        return len(self.means)

    def features(self, colours: Array) -> Array:
        """Returns the [N, 4] features for rendering: the given colours [N, 3] and the foreground label."""
        return np.concatenate([colours, self.foreground[:, None]], axis=1)

    def replace(self, **changes: Any) -> Gaussians:
        """Returns a copy with some arrays replaced. The copy shares the other arrays.

        A value for ``opacities`` also replaces ``own_opacities``. If no Gaussian is retired, all
        arrays may be replaced by arrays with a different number of rows.
        """
        if "opacities" in changes:
            changes["own_opacities"] = changes["opacities"]
        if not self.retired.any():
            changes.setdefault("retired", None)
        return replace(self, **changes)

    @property
    def present(self) -> NDArray[np.bool_]:
        """[N] bool, true for Gaussians that are not retired."""
        return ~self.retired

    @property
    def moving(self) -> NDArray[np.bool_]:
        """[N] bool, true for Gaussians that are not retired and whose label is above 0.5."""
        moving: NDArray[np.bool_] = (self.foreground > 0.5) & ~self.retired
        return moving

    def rows(self, which: ArrayLike) -> Gaussians:
        """Returns the Gaussians of the selected rows, with their ids.

        Args:
            which: [N] bool mask, or row indices in any order.
        """
        chosen = np.asarray(which)
        gloss = self.gloss
        if gloss is not None:
            gloss = np.concatenate([gloss, np.zeros((len(self) - len(gloss), 3), np.float32)])[chosen]
        return replace(self, gloss=gloss, **{name: array[chosen] for name, array in self._by_row().items()})

    def concatenate(self, born: Gaussians) -> Gaussians:
        """Returns the state with new Gaussians appended.

        The new Gaussians get their ids when the frame is committed.

        Args:
            born: new Gaussians; their ids, gloss and environment are ignored.
        """
        others = {**born._by_row(), "ids": np.full(len(born), UNBORN, np.int64)}
        return replace(self, **{name: np.concatenate([own, others[name]]) for name, own in self._by_row().items()})

    def retire(self, rows: ArrayLike) -> Gaussians:
        """Returns the state in which the given rows ([N] bool mask, or indices) are retired."""
        return self._with_retired(rows, True)

    def revive(self, rows: ArrayLike) -> Gaussians:
        """Returns the state in which the given rows ([N] bool mask, or indices) are not retired.

        The other values of these rows do not change.
        """
        return self._with_retired(rows, False)

    def _with_retired(self, rows: ArrayLike, value: bool) -> Gaussians:
        given, retired = np.asarray(rows), self.retired.copy()
        retired[given if given.size else np.zeros(0, np.intp)] = value
        return self.replace(retired=retired)

    def _by_row(self) -> dict[str, NDArray[Any]]:
        """Returns the arrays with one row per Gaussian, keyed by field name."""
        return {item.name: getattr(self, item.name) for item in fields(self) if not item.metadata.get("whole")}

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Returns the arrays for files and messages, keyed by field name.

        ``opacities`` contains ``own_opacities``, which also has values for retired Gaussians.
        ``retired`` is omitted if no Gaussian is retired. Fields that are None are omitted.
        """
        arrays_by_name = {item.name: getattr(self, item.name) for item in fields(self)}
        arrays_by_name["opacities"] = arrays_by_name.pop("own_opacities")
        if not self.retired.any():
            del arrays_by_name["retired"]
        return {name: array for name, array in arrays_by_name.items() if array is not None}


FIXED = tuple(item.name for item in fields(Gaussians) if item.metadata.get("once"))
"""Names of the arrays whose values do not change after a Gaussian's first frame."""
WHOLES = tuple(item.name for item in fields(Gaussians) if item.metadata.get("whole"))
"""Names of the arrays without a row per Gaussian, which may be None."""
PER_FRAME = tuple(
    item.name for item in fields(Gaussians) if item.name not in (*FIXED, *WHOLES, "retired", "own_opacities")
)
"""Names of the arrays with one row per Gaussian that can change from frame to frame."""


def quaternions_to_matrices(quaternions: NDArray[Any]) -> NDArray[Any]:
    """Converts unit quaternions [..., 4] (w, x, y, z) to rotation matrices [..., 3, 3].

    >>> quaternions_to_matrices(np.array([0.0, 0, 0, 1]))  # a half turn about z
    array([[-1.,  0.,  0.],
           [ 0., -1.,  0.],
           [ 0.,  0.,  1.]])
    """
    return np.stack([np.stack(row, axis=-1) for row in rotation_rows(np.moveaxis(quaternions, -1, 0))], axis=-2)


def rotation_rows(quaternion: NDArray[Any]) -> list[list[NDArray[Any]]]:
    """Converts unit quaternions to rotation matrices, component by component.

    Args:
        quaternion: [4, ...] components w, x, y and z.

    Returns:
        3 rows of 3 arrays [...], the entries of the matrices.
    """
    w, x, y, z = quaternion
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def quaternion_products(a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
    """Returns the quaternion products a∘b, [M, 4] (w, x, y, z), which apply rotation b first."""
    return np.stack(product_components(a.T, b.T), axis=1)


def turned_rotations(rotations: NDArray[Any], rows: NDArray[np.int64], turns: NDArray[Any]) -> NDArray[Any]:
    """Returns a copy of unit quaternions in which some rows are rotated further.

    Args:
        rotations: [N, 4] unit quaternions (w, x, y, z).
        rows: [M] rows to rotate.
        turns: [M, 4] quaternions (w, x, y, z), which are applied after ``rotations``.
    """
    made = rotations.copy()
    turned = quaternion_products(turns, rotations[rows])
    made[rows] = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    return made


def product_components(a: NDArray[Any], b: NDArray[Any]) -> list[NDArray[Any]]:
    """Returns the quaternion products a∘b, component by component.

    The products apply the rotation b first.

    Args:
        a, b: [4, M] components w, x, y and z.

    Returns:
        The components w, x, y and z of the products, [M] each.
    """
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]


def moving_extent(gaussians: Gaussians) -> float:
    """Returns the extent of the moving Gaussians in metres.

    The extent is the longest side of a box that contains the central 98% of the centres along each
    axis. A few stray Gaussians therefore hardly affect the result. If no Gaussian moves, all Gaussians
    that are not retired are used. If all Gaussians are retired, all of them are used.

    Tolerances and features use the extent as their unit, so that they do not depend on the size of
    the scene.

    >>> points = np.linspace(0, 1, 101)[:, None] * [2, 1, 0]
    >>> round(moving_extent(Gaussians.of_points(points, 0.01)), 3)
    1.96
    """
    chosen = next((rows for rows in (gaussians.moving, gaussians.present) if rows.any()), slice(None))
    low, high = np.percentile(gaussians.means[chosen], (1, 99), axis=0)
    return float(np.max(high - low))
