"""Writes the SPZ format (Niantic, github.com/nianticlabs/spz) with the gsply package.

Versions 3 (gzip) and 4 (zstd) are written. As SPZ's README states, axes are RUB: x right, y up,
z backward, that is, the user's world rotated by 180° about x. gsply does not convert axes, so this
module does. Lengths are in metres, because the value ranges of the format are designed for metres.
The format quantizes as follows, according to gsply 0.4.6 and Niantic's ``load-spz.cc``:

- positions: 24-bit fixed point, ±2⁻ᶠ⁻¹ m, with the largest number of fractional bits f for which the frame fits;
- scales: the logarithm in one byte, 16 steps per factor of e: ±3.2%, clipped below 45 µm or above 379 m;
- rotations: the smallest three components in 10 bits each, ±0.0007 per component;
- opacity: one byte, linear, ±0.002; colour: one byte over −0.44…1.44, ±0.0037;
- harmonics of degree 1 to 3: one byte over −1…1, ±0.004, clipped outside this range.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scas4d_core.cameras import WorldFrame
from scas4d_core.errors import InputError
from scas4d_core.exports.atomic_files import atomic_path, import_optional
from scas4d_core.exports.cloud import Cloud, cloud_of
from scas4d_core.gaussians import Gaussians
from scas4d_core.query.ply import OPACITY_MARGIN

VERSIONS = (3, 4)
"""Versions that gsply can write: most viewers support 3, and recent ones also support 4."""
POSITION_BITS = 23
"""Number of bits of a position, excluding the sign."""
MAX_FRACTIONAL_BITS = 24
"""Maximum number of fractional bits that gsply accepts."""


def write_spz(path: Path | str, gaussians: Gaussians, world: WorldFrame, version: int = 3) -> None:
    """Writes one frame atomically, without its retired Gaussians.

    Args:
        path: path of the file.
        gaussians: state in the internal world.
        world: transform from the user's world to the internal world.
        version: SPZ version, 3 or 4.

    Raises:
        InputError: if the version is not supported; gsply (or zstandard for version 4) is missing; some Gaussians have
            non-finite values or no volume; a position exceeds 4,194 km; or the file cannot be written.

    >>> write_spz("a.spz", Gaussians.of_points([[0, 0, 2]], radius=0.1), WorldFrame(np.zeros(3)), version=2)
    Traceback (most recent call last):
    scas4d_core.errors.InputError: SPZ version 2 is not supported; use 3 or 4
    """
    if version not in VERSIONS:
        raise InputError(f"SPZ version {version} is not supported", "use 3 or 4")
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
    """Returns the largest number of fractional bits f for which all positions fit into 24 bits; a step is 2⁻ᶠ units.

    Raises:
        InputError: if a position is too far from the origin.

    >>> fractional_bits(cloud_of(Gaussians.of_points([[0, 0, 5]], radius=0.1), WorldFrame(np.zeros(3))))
    20
    """
    farthest = float(np.abs(cloud.splats.means).max(initial=0.0))
    for bits in range(MAX_FRACTIONAL_BITS, 0, -1):
        if round(farthest * 2**bits) < 2**POSITION_BITS:
            return bits
    raise InputError(
        f"a Gaussian is {farthest:.3g} m from the origin of the user's world, but SPZ allows at most {2**22:,} m",
        "move the origin of the calibration near the scene, or export as ply or glb",
    )
