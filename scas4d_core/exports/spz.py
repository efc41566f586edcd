"""Writes and reads SPZ (Niantic, github.com/nianticlabs/spz), versions 3 (gzip) and 4 (zstd), by the package gsply.

Axes are RUB, as SPZ's README states: x right, y up, z backward, the user's world turned by 180° about x. gsply turns
nothing, so this file does. Lengths are metres, for which the format's ranges are made. Rounding, from gsply 0.4.6 and
Niantic's ``load-spz.cc``:

- positions: 24-bit fixed point, ±2⁻ᶠ⁻¹ m; f, the fractional bits, is the largest that holds the frame;
- scales: a byte a logarithm, 16 steps to a factor of e: ±3.2 %; below 45 µm or above 379 m they are clipped;
- rotations: the smallest three components in 10 bits each, ±0.0007 a component;
- opacity: a byte, linear, ±0.002; colour: a byte over −0.44…1.44, ±0.0037;
- harmonics of degree 1 to 3: a byte over −1…1, ±0.004, clipped beyond.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scas4d_core.cameras import WorldFrame
from scas4d_core.errors import InputError
from scas4d_core.exports.atomic_files import atomic_path, import_optional
from scas4d_core.exports.cloud import Cloud, cloud_of
from scas4d_core.gaussians import Gaussians
from scas4d_core.query.ply import OPACITY_MARGIN, SH_DEGREE_0, Splats

VERSIONS = (3, 4)
"""Containers that gsply writes: 3 is read by most viewers, 4 by recent ones."""
POSITION_BITS = 23
"""Bits of a position beside its sign."""
MAX_FRACTIONAL_BITS = 24
"""The most that gsply takes."""


def write_spz(path: Path | str, gaussians: Gaussians, world: WorldFrame, version: int = 3) -> None:
    """Writes one frame, whole or not at all, without the Gaussians that are retired in it.

    Args:
        path: of the file. gaussians: in the inside world. world: user's world to inside.
        version: 3 or 4.

    Raises:
        InputError: another version, gsply (for 4 also zstandard) is missing, rows that are not finite or have no
            volume, a position beyond 4,194 km, or the file cannot be written.

    >>> write_spz("a.spz", Gaussians.of_points([[0, 0, 2]], radius=0.1), WorldFrame(np.zeros(3)), version=2)
    Traceback (most recent call last):
    scas4d_core.errors.InputError: version 2 of SPZ is not written; give 3 or 4
    """
    if version not in VERSIONS:
        raise InputError(f"version {version} of SPZ is not written", "give 3 or 4")
    gsply = import_optional("gsply", "spz")
    if version == 4:
        import_optional("zstandard", "spz4")
    cloud = cloud_of(gaussians, world).scaled(world.metres_per_unit).half_turned()
    of = cloud.splats
    opacities = np.clip(of.opacities, OPACITY_MARGIN, 1 - OPACITY_MARGIN)
    rest = cloud.harmonics[:, 1:]
    data = gsply.GSData.from_arrays(
        means=np.float32(of.means),
        scales=np.float32(np.log(of.scales)),
        quats=np.float32(of.rotations),
        opacities=np.float32(np.log(opacities / (1 - opacities))),
        sh0=np.float32(cloud.harmonics[:, 0]),
        shN=np.float32(rest) if rest.size else None,
        format="ply",
    )
    bits = fractional_bits(cloud)
    with atomic_path(path) as beside:
        gsply.write_spz(beside, data, version=version, fractional_bits=bits)


def fractional_bits(cloud: Cloud) -> int:
    """The most bits after the point with which all positions fit into 24: a step is 2⁻ᶠ of their unit.

    Raises:
        InputError: a position is too far away.

    >>> fractional_bits(cloud_of(Gaussians.of_points([[0, 0, 5]], radius=0.1), WorldFrame(np.zeros(3))))
    20
    """
    farthest = float(np.abs(cloud.splats.means).max(initial=0.0))
    for bits in range(MAX_FRACTIONAL_BITS, 0, -1):
        if round(farthest * 2**bits) < 2**POSITION_BITS:
            return bits
    raise InputError(
        f"a Gaussian is {farthest:.3g} m from the origin of the user's world, and SPZ ends at {2**22:,} m",
        "move the origin of the calibration near the scene, or export as ply or glb",
    )


def read_spz(path: Path | str, metres_per_unit: float = 1.0) -> Splats:
    """Reads a file of version 1 to 4; of the harmonics only degree 0. Axes are turned back to OpenCV's.

    Args:
        path: of the file. metres_per_unit: metres in one of the units that are wanted.

    Raises:
        InputError: gsply is missing, or it cannot read the file.

    >>> read_spz("README.md")
    Traceback (most recent call last):
    scas4d_core.errors.InputError: README.md: not an SPZ file (...); ...
    """
    gsply = import_optional("gsply", "spz")
    try:
        data = gsply.read_spz(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not an SPZ file ({error})", "give a whole .spz file of version 1 to 4") from error
    means, logs, quaternions, logits, base = (
        np.asarray(column, np.float64)
        for column in (data.means, data.scales, data.quats, data.opacities.reshape(-1), data.sh0)
    )
    given = Splats(
        means=means,
        scales=np.exp(logs),
        rotations=quaternions,
        opacities=1 / (1 + np.exp(-logits)),
        colours=0.5 + SH_DEGREE_0 * base,
    )
    return Cloud(given, base[:, None], np.arange(len(given))).half_turned().scaled(1 / metres_per_unit).splats
