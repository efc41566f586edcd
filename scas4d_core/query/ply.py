"""Writes and reads a frame as a standard 3D Gaussian Splatting ``.ply`` (Kerbl et al. 2023), for any splat viewer.

The format is binary little-endian with one float32 row per Gaussian. The columns are x y z, nx ny nz (zero), f_dc_0…2
(degree 0 of the spherical harmonics), opacity (logit), scale_0…2 (log), rot_0…3 (w, x, y, z). If colours depend on the
viewing direction, f_rest_0…44 (degrees 1 to 3, channel by channel) follow. Positions and lengths are in the user's
world and units.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement, PlyParseError
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import WorldFrame
from scas4d_core.errors import InputError
from scas4d_core.gaussians import Gaussians
from scas4d_core.query.harmonics import harmonics

Float = NDArray[np.float64]

SH_DEGREE_0 = 0.28209479177387814
"""The constant spherical harmonic 1/(2√π): colour = 0.5 + SH_DEGREE_0 · f_dc."""
OPACITY_MARGIN = 1e-6
"""Minimum distance of opacities from 0 and 1, where the logit is infinite."""
JACOBI_SWEEPS = 12
"""Number of one-sided Jacobi sweeps. A 3×3 matrix requires about five, because convergence is quadratic."""
ORTHOGONAL = 1e-6
"""Cosine below which two axes are considered orthogonal, given the precision of float32 factors."""

_FIELDS = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)


class PlyError(InputError):
    """Raised if Gaussians cannot be exported, or a file is invalid. The message names the affected rows or the file."""


@dataclass(frozen=True, eq=False)
class Splats:
    """The Gaussians of a splat file, in the user's world.

    Attributes:
        means: [N, 3] float64 centres.
        scales: [N, 3] float64 standard deviations along the axes.
        rotations: [N, 4] float64 unit quaternions (w, x, y, z); the axes are the columns of the rotation matrix.
        opacities: [N] float64 opacities in (0, 1).
        colours: [N, 3] float64 RGB colours.
    """

    means: Float
    scales: Float
    rotations: Float
    opacities: Float
    colours: Float

    def __len__(self) -> int:
        return len(self.means)

    def covariances(self) -> Float:
        """Returns the covariances Σ, [N, 3, 3], in squared user units."""
        axes = Rotation.from_quat(np.roll(self.rotations, -1, axis=1)).as_matrix() * self.scales[:, None, :]
        result: Float = axes @ axes.transpose(0, 2, 1)
        return result


def write_ply(path: Path | str, gaussians: Gaussians, world: WorldFrame) -> None:
    """Writes a state to a splat file atomically, without its retired Gaussians.

    Args:
        path: path of the file.
        gaussians: state in the internal world.
        world: transform from the user's world to the internal world.

    Raises:
        PlyError: if some Gaussians have non-finite values or no volume; the message lists their rows and ids.

    >>> from tempfile import TemporaryDirectory
    >>> state = Gaussians.of_points([[0, 0, 2]], radius=0.1)
    >>> with TemporaryDirectory() as folder:
    ...     write_ply(f"{folder}/a.ply", state, WorldFrame(np.zeros(3), metres_per_unit=0.5))
    ...     read_ply(f"{folder}/a.ply").means
    array([[0., 0., 4.]])
    """
    gaussians = gaussians.rows(gaussians.present) if gaussians.retired.any() else gaussians
    columns = _columns(splats(gaussians, world))
    if gaussians.gloss is not None:
        sums = harmonics(gaussians)
        columns |= {f"f_dc_{channel}": sums[:, 0, channel] for channel in range(3)}
        rest = sums[:, 1:].transpose(0, 2, 1).reshape(len(gaussians), 3 * (sums.shape[1] - 1))
        columns |= {f"f_rest_{k}": column for k, column in enumerate(rest.T)}
    fields = (*_FIELDS, *(name for name in columns if name not in _FIELDS))
    data = np.zeros(len(gaussians), dtype=[(name, "<f4") for name in fields])
    for name, column in columns.items():
        data[name] = column
    target = Path(path)
    beside = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        PlyData([PlyElement.describe(data, "vertex")], byte_order="<").write(str(beside))
        beside.replace(target)
    finally:
        beside.unlink(missing_ok=True)


def read_ply(source: Path | str | BinaryIO, name: str | None = None) -> Splats:
    """Reads a splat file, ignoring spherical harmonics above degree 0.

    Args:
        source: path or open file.
        name: name of the file for error messages, or None to use the path.

    Raises:
        PlyError: if the file is not a splat file, a property is missing, or a row has a non-finite value or a
            rotation of length 0.

    >>> read_ply("README.md")
    Traceback (most recent call last):
    scas4d_core.query.ply.PlyError: README.md is not a 3D Gaussian Splatting .ply file (...)
    """
    try:
        vertex = PlyData.read(str(source) if isinstance(source, Path) else source)["vertex"]
        table = {name: np.asarray(vertex[name], dtype=np.float64) for name in _FIELDS if name[0] != "n"}
    except (OSError, KeyError, ValueError, PlyParseError) as error:
        raise PlyError(f"{name or source} is not a 3D Gaussian Splatting .ply file ({error})") from error

    def columns(*names: str) -> Float:
        return np.stack([table[name] for name in names], axis=-1)

    rotations = columns("rot_0", "rot_1", "rot_2", "rot_3")
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        read = Splats(
            means=columns("x", "y", "z"),
            scales=np.exp(columns("scale_0", "scale_1", "scale_2")),
            rotations=rotations / np.linalg.norm(rotations, axis=1, keepdims=True),
            opacities=1 / (1 + np.exp(-table["opacity"])),
            colours=0.5 + SH_DEGREE_0 * columns("f_dc_0", "f_dc_1", "f_dc_2"),
        )
    values = np.column_stack([read.means, read.scales, read.rotations, read.opacities, read.colours])
    rows = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if rows.size:
        raise PlyError(
            f"{name or source} has {rows.size} Gaussians with non-finite values or rotations of length 0: "
            f"rows {rows[:5].tolist()}{' …' if rows.size > 5 else ''}",
            "export the file again, or remove these rows",
        )
    return read


def splats(gaussians: Gaussians, world: WorldFrame) -> Splats:
    """Returns the centres, scales, rotations, opacities and colours of a state in the user's world.

    Raises:
        PlyError: if some Gaussians have non-finite values or no volume.
    """
    _refuse(gaussians)
    axes, scales = split_factors(gaussians.factors)
    return Splats(
        means=world.to_user(gaussians.means),
        scales=scales / world.metres_per_unit,
        rotations=np.roll(Rotation.from_matrix(axes).as_quat(canonical=True), 1, axis=1),
        opacities=gaussians.opacities.astype(np.float64),
        colours=gaussians.colours.astype(np.float64),
    )


def split_factors(factors: NDArray[Any]) -> tuple[Float, Float]:
    """Splits factors into rotations Q [N, 3, 3] and lengths s [N, 3] with Q diag(s²) Qᵀ = F Fᵀ.

    The one-sided Jacobi method rotates columns of F pairwise, by at most 45°, until they are orthogonal. Columns that
    are already orthogonal do not change, even if their lengths are equal and eigenvectors would be arbitrary. The axes
    can be ordered and signed in 24 ways to form a right-handed frame. The frame closest to the columns of F is used.

    Args:
        factors: [N, 3, 3] factors F of full rank.

    >>> axes, lengths = split_factors(np.diag([3.0, 1.0, 2.0])[None])
    >>> lengths, bool(np.allclose(axes, np.eye(3)))
    (array([[3., 1., 2.]]), True)
    """
    start = np.asarray(factors, dtype=np.float64)
    columns = start.copy()
    for _ in range(JACOBI_SWEEPS):
        for i, j in ((0, 1), (0, 2), (1, 2)):
            a, b = columns[:, :, i].copy(), columns[:, :, j].copy()
            off = np.einsum("ni,ni->n", a, b)
            difference = np.einsum("ni,ni->n", b, b) - np.einsum("ni,ni->n", a, a)
            # Tangent of the angle: the smaller root of t² + 2 t (difference / 2 off) − 1 = 0 (Golub & Van Loan, 8.5).
            sign = np.where(difference < 0, -1.0, 1.0)
            size = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
            off[np.abs(off) <= ORTHOGONAL * size] = 0
            bottom = np.abs(difference) + np.hypot(difference, 2 * off)
            t = 2 * off * sign / np.where(bottom > 0, bottom, 1)
            cos = (1 / np.hypot(1, t))[:, None]
            sin = cos * t[:, None]
            columns[:, :, i], columns[:, :, j] = cos * a - sin * b, sin * a + cos * b
    scales = np.linalg.norm(columns, axis=1)
    axes = columns / scales[:, None, :]
    return _nearest_naming(axes, scales, start / np.linalg.norm(start, axis=1)[:, None, :])


def _nearest_naming(axes: Float, scales: Float, wanted: Float) -> tuple[Float, Float]:
    """Returns axes and scales, permuted and flipped to the right-handed frame with the largest trace(axesᵀ wanted)."""
    rows = np.arange(len(axes))
    dots = np.einsum("nki,nkj->nij", axes, wanted)  # axis i with wanted column j
    handed = np.linalg.det(axes)
    best = np.full(len(axes), -np.inf)
    order = np.zeros((len(axes), 3), dtype=np.intp)
    flips = np.ones((len(axes), 3))
    for chosen in permutations(range(3)):
        parity = float(np.linalg.det(np.eye(3)[list(chosen)]))
        dot = dots[:, list(chosen), range(3)]
        sign = np.where(dot < 0, -1.0, 1.0)
        weakest = np.abs(dot).argmin(axis=1)
        wrong = handed * parity * sign.prod(axis=1) < 0
        sign[rows[wrong], weakest[wrong]] *= -1
        trace = (sign * dot).sum(axis=1)
        better = trace > best + 1e-12
        best[better], order[better], flips[better] = trace[better], chosen, sign[better]
    named = np.take_along_axis(axes, order[:, None, :], axis=2) * flips[:, None, :]
    return named, np.take_along_axis(scales, order, axis=1)


def _columns(of: Splats) -> dict[str, Float]:
    opacity = np.clip(of.opacities, OPACITY_MARGIN, 1 - OPACITY_MARGIN)
    result = {"opacity": np.log(opacity / (1 - opacity))}
    for names, values in (
        (("x", "y", "z"), of.means),
        (("f_dc_0", "f_dc_1", "f_dc_2"), (of.colours - 0.5) / SH_DEGREE_0),
        (("scale_0", "scale_1", "scale_2"), np.log(of.scales)),
        (("rot_0", "rot_1", "rot_2", "rot_3"), of.rotations),
    ):
        result.update(zip(names, values.T, strict=True))
    return result


def _refuse(gaussians: Gaussians) -> None:
    for name in ("means", "factors", "opacities", "colours"):
        finite = np.isfinite(getattr(gaussians, name))
        _name_rows(gaussians, ~finite.all(axis=tuple(range(1, finite.ndim))), f"non-finite {name}")
    volume = np.abs(np.linalg.det(gaussians.factors.astype(np.float64)))
    _name_rows(gaussians, ~(volume > 0), "no volume (an axis of length 0)")


def _name_rows(gaussians: Gaussians, bad: NDArray[np.bool_], fault: str) -> None:
    rows = np.flatnonzero(bad)
    if rows.size:
        raise PlyError(
            f"{rows.size} Gaussians have {fault}: rows {rows[:5].tolist()}, ids {gaussians.ids[rows[:5]].tolist()}"
            f"{' …' if rows.size > 5 else ''}",
            "export an earlier frame, or fix these Gaussians",
        )
