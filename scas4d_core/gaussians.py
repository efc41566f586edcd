"""Θ, the state of a scene: an ordered set of 3D Gaussians, which grows and never shrinks. Numpy only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float32]

WHOLE: Mapping[str, Any] = MappingProxyType({"whole": True})
"""Metadata of a field of ``Gaussians`` without a row per Gaussian; such a field may be None."""
ONCE: Mapping[str, Any] = MappingProxyType({"once": True})
"""Metadata of a field that a Gaussian keeps from the frame in which it was born."""
UNBORN = -1
"""Id of a Gaussian that no commit has given one yet."""


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N Gaussians at one moment. Row order is identity: row i is the same piece of matter in every frame.

    New ones are appended (``joined``); what has left the scene is retired and keeps its row, so that it can come back
    as itself. A retired Gaussian is not drawn, does not move, and does not count as moving.

    Attributes:
        means: [N, 3] float32, metres in the inside world.
        factors: [N, 3, 3] float32; Σ = F Fᵀ; the columns are the transported axes, metres.
        rotations: [N, 4] float32 unit quaternions (w, x, y, z): material rotation since frame 0, or since birth.
        opacities: [N] float32 in (0, 1), fixed after frame 0 or birth; as rendered: 0 for the retired.
        colours: [N, 3] float32 RGB, nominally 0…1.
        foreground: [N] float32 in 0…1: the learnt label; above 0.5 the Gaussian moves.
        ids: [N] int64, for ever; −1 until the frame of its birth is committed.
        retired: [N] bool; not given: none.
        own_opacities: [N] float32 in (0, 1), those of the retired too; follows from what is given as ``opacities``.
        gloss: [M, 3] float32, of the first M: normal, in the world's axes, times strength of what mirrors; those born
            later are dull. environment: float32, what is mirrored (``kernels.appearance.direction``). Both are None
            where colours do not depend on direction; else ``colours`` are those without the gloss.

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
        for name, array in (("retired", retired), ("own_opacities", own), ("opacities", shown)):
            object.__setattr__(self, name, array)

    @classmethod
    def of_points(cls, points: ArrayLike, radius: float, colours: ArrayLike = 0.5) -> Gaussians:
        """Round Gaussians that move, one for each point: for scenes made by hand.

        Args:
            points: [N, 3] metres in the inside world.
            radius: metres, the standard deviation along each axis.
            colours: [N, 3] RGB in 0…1, or one for all.
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
        """[N, 4] features as they are rendered: colours [N, 3], its own or as a camera sees them, and the label."""
        return np.concatenate([colours, self.foreground[:, None]], axis=1)

    def replace(self, **changes: Any) -> Gaussians:
        """A copy with some of the arrays exchanged; the others are shared. ``opacities`` are taken as its own.

        Where none is retired, all arrays may be exchanged for such of another number of Gaussians.
        """
        if "opacities" in changes:
            changes["own_opacities"] = changes["opacities"]
        if not self.retired.any():
            changes.setdefault("retired", None)
        return replace(self, **changes)

    @property
    def present(self) -> NDArray[np.bool_]:
        """[N] bool: the Gaussians that are there; the others are retired."""
        return ~self.retired

    @property
    def moving(self) -> NDArray[np.bool_]:
        """[N] bool: the Gaussians that move, by their label; none that is retired."""
        moving: NDArray[np.bool_] = (self.foreground > 0.5) & ~self.retired
        return moving

    def rows(self, which: ArrayLike) -> Gaussians:
        """The Gaussians of some rows, with their ids.

        Args:
            which: [N] bool, or rows in any order.
        """
        chosen = np.asarray(which)
        gloss = self.gloss
        if gloss is not None:
            gloss = np.concatenate([gloss, np.zeros((len(self) - len(gloss), 3), np.float32)])[chosen]
        return replace(self, gloss=gloss, **{name: array[chosen] for name, array in self._by_row().items()})

    def concatenate(self, born: Gaussians) -> Gaussians:
        """The state with new Gaussians after its own, in new rows; they get their ids when the frame is committed."""
        others = {**born._by_row(), "ids": np.full(len(born), UNBORN, np.int64)}
        return replace(self, **{name: np.concatenate([own, others[name]]) for name, own in self._by_row().items()})

    def retire(self, rows: ArrayLike) -> Gaussians:
        """The state with some rows ([N] bool, or indices) retired."""
        return self._with_retired(rows, True)

    def revive(self, rows: ArrayLike) -> Gaussians:
        """The state with some rows ([N] bool, or indices) there again, as they were when they were retired."""
        return self._with_retired(rows, False)

    def _with_retired(self, rows: ArrayLike, value: bool) -> Gaussians:
        given, retired = np.asarray(rows), self.retired.copy()
        retired[given if given.size else np.zeros(0, np.intp)] = value
        return self.replace(retired=retired)

    def _by_row(self) -> dict[str, NDArray[Any]]:
        """The arrays with a row per Gaussian, as the constructor takes them."""
        return {item.name: getattr(self, item.name) for item in fields(self) if not item.metadata.get("whole")}

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays by name, as the constructor takes them, for files and messages.

        ``opacities`` are those that the Gaussians have of their own. ``retired`` is left out where none is, and so is
        a field that is None.
        """
        arrays_by_name = {item.name: getattr(self, item.name) for item in fields(self)}
        arrays_by_name["opacities"] = arrays_by_name.pop("own_opacities")
        if not self.retired.any():
            del arrays_by_name["retired"]
        return {name: array for name, array in arrays_by_name.items() if array is not None}


FIXED = tuple(item.name for item in fields(Gaussians) if item.metadata.get("once"))
"""Arrays that a Gaussian keeps from its first frame."""
WHOLES = tuple(item.name for item in fields(Gaussians) if item.metadata.get("whole"))
"""Arrays without a row per Gaussian, which may be missing."""
PER_FRAME = tuple(
    item.name for item in fields(Gaussians) if item.name not in (*FIXED, *WHOLES, "retired", "own_opacities")
)
"""Arrays with a row per Gaussian that may differ from frame to frame."""


def quaternions_to_matrices(quaternions: NDArray[Any]) -> NDArray[Any]:
    """Unit quaternions [..., 4] (w, x, y, z) to rotation matrices [..., 3, 3].

    >>> quaternions_to_matrices(np.array([0.0, 0, 0, 1]))  # a half turn about z
    array([[-1.,  0.,  0.],
           [ 0., -1.,  0.],
           [ 0.,  0.,  1.]])
    """
    return np.stack([np.stack(row, axis=-1) for row in rotation_rows(np.moveaxis(quaternions, -1, 0))], axis=-2)


def rotation_rows(quaternion: NDArray[Any]) -> list[list[NDArray[Any]]]:
    """The rows of the rotation matrices of unit quaternions, by component: [4, ...] to three rows of three [...]."""
    w, x, y, z = quaternion
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def quaternion_products(a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
    """[M, 4] a∘b (w, x, y, z): first b, then a."""
    return np.stack(product_components(a.T, b.T), axis=1)


def product_components(a: NDArray[Any], b: NDArray[Any]) -> list[NDArray[Any]]:
    """The components (w, x, y, z) of a∘b, [M] each, of quaternions by component, [4, M]: first b, then a."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]


def moving_extent(gaussians: Gaussians) -> float:
    """Longest side, in metres, of the box that holds 98 % of the moving Gaussians on each axis.

    Where none moves it is that of those that are there, and where none is there, of all.

    It is the unit of tolerances and features that should not depend on the size of the scene; a few stray Gaussians do
    not change it.

    >>> points = np.linspace(0, 1, 101)[:, None] * [2, 1, 0]
    >>> round(moving_extent(Gaussians.of_points(points, 0.01)), 3)
    1.96
    """
    chosen = next((rows for rows in (gaussians.moving, gaussians.present) if rows.any()), slice(None))
    low, high = np.percentile(gaussians.means[chosen], (1, 99), axis=0)
    return float(np.max(high - low))
