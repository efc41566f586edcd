"""Writes a frame as ``.glb`` with KHR_gaussian_splatting, as ratified by Khronos (see its README in KhronosGroup/glTF).

The extension stores a linear, nonnegative scale, a linear opacity in [0, 1], and the rotation as a
unit quaternion (x, y, z, w), all in float32. Harmonics have the same signs and order as in 3DGS.
Drafts of the extension stored the logarithm of the scale.

In glTF, y points up and z towards the viewer, and lengths are in metres. The half turn about x and
the conversion to metres are applied to the stored *values*, and the node's transform is the
identity. A rotation in the node would be less portable: the extension says only that a reader
SHOULD rotate harmonics with the node. The half turn is lossless, because it only changes signs and
the order of quaternion components. ``asset.extras`` stores ``metres_per_unit`` for the inverse
conversion.

Readers without the extension show points coloured by ``COLOR_0`` (linear light, 16 bits). The
attribute ``_ID`` stores the ids as float32, which represents integers below 2²⁴ exactly. The
attribute is omitted if any id is 2²⁴ or more.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from scas4d_core.cameras import WorldFrame
from scas4d_core.exports.cloud import Cloud, cloud_of, linear_light
from scas4d_core.exports.glb import Binary
from scas4d_core.gaussians import Gaussians

EXTENSION = "KHR_gaussian_splatting"
POINTS = 0
"""Primitive mode of points."""
EXACT_IDS = 2**24
"""Limit below which float32 represents all integers; glTF does not allow 32-bit integers as vertex attributes."""
DEGREES = ((0,), (1, 2, 3), (4, 5, 6, 7, 8), (9, 10, 11, 12, 13, 14, 15))
"""Indices of the harmonics of each degree."""


def write_glb(path: Path | str, gaussians: Gaussians, world: WorldFrame) -> None:
    """Writes one frame atomically, without its retired Gaussians.

    Args:
        path: path of the file.
        gaussians: state in the internal world.
        world: transform from the user's world to the internal world.

    Raises:
        InputError: if some Gaussians have non-finite values or no volume, or if the file would
            exceed 4 GiB or cannot be written.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     write_glb(f"{folder}/a.glb", Gaussians.of_points([[0, 0, 2]], radius=0.1), WorldFrame(np.zeros(3)))
    ...     b"KHR_gaussian_splatting:ROTATION" in Path(f"{folder}/a.glb").read_bytes()
    True
    """
    cloud = cloud_of(gaussians, world).scaled(world.metres_per_unit).half_turned()
    binary = Binary()
    document: dict[str, Any] = {"scene": 0, "scenes": [{}], "asset_extras": asset_extras(world)}
    if len(cloud):  # glTF does not allow empty accessors
        document |= {
            "scenes": [{"nodes": [0]}],
            "nodes": [{"name": "gaussians", "mesh": 0}],
            "meshes": [{"primitives": [splat_primitive(binary, cloud)]}],
            "extensionsUsed": [EXTENSION],
        }
    binary.write(path, document)


def splat_primitive(binary: Binary, cloud: Cloud) -> dict[str, Any]:
    """Adds the attributes of a cloud to a file, and returns the primitive that refers to them.

    Args:
        binary: arrays of the file.
        cloud: at least one Gaussian, in glTF's axes and unit.

    >>> cloud = cloud_of(Gaussians.of_points([[0, 0, 2]], radius=0.1), WorldFrame(np.zeros(3)))
    >>> sorted(splat_primitive(Binary(), cloud)["attributes"])[:3]
    ['COLOR_0', 'KHR_gaussian_splatting:OPACITY', 'KHR_gaussian_splatting:ROTATION']
    """
    of = cloud.splats
    opacities = np.clip(of.opacities, 0, 1)
    fallback = np.concatenate([linear_light(of.colours), opacities[:, None]], axis=1)

    def added(values: Any, **about: bool) -> int:
        return binary.add(np.asarray(values, "<f4"), vertices=True, **about)

    attributes = {
        "POSITION": added(of.means, bounds=True),
        "COLOR_0": binary.add(np.rint(fallback * 65535).astype("<u2"), vertices=True, normalized=True),
        f"{EXTENSION}:ROTATION": added(np.roll(of.rotations, -1, axis=1)),
        f"{EXTENSION}:SCALE": added(of.scales),
        f"{EXTENSION}:OPACITY": added(opacities),
    }
    for degree, rows in enumerate(DEGREES):
        if rows[-1] < cloud.harmonics.shape[1]:
            for place, row in enumerate(rows):
                attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{place}"] = added(cloud.harmonics[:, row])
    if cloud.ids.max() < EXACT_IDS:
        attributes["_ID"] = added(cloud.ids)
    about = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    return {"attributes": attributes, "mode": POINTS, "extensions": {EXTENSION: about}}


def asset_extras(world: WorldFrame) -> dict[str, Any]:
    """Returns asset extras for converting to the user's world: position · (1, −1, −1) / ``metres_per_unit``.

    >>> asset_extras(WorldFrame(np.zeros(3), metres_per_unit=0.01))["metres_per_unit"]
    0.01
    """
    return {
        "metres_per_unit": float(world.metres_per_unit),
        "axes": "the user's world (OpenCV: x right, y down, z forward), turned by 180 degrees about x",
    }
