"""Reads a frame from a ``.glb`` with KHR_gaussian_splatting, as written by ``exports.gltf``."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.errors import InputError
from scas4d_core.exports.cloud import Cloud
from scas4d_core.exports.gltf import DEGREES, EXTENSION
from scas4d_core.query.ply import SH_DEGREE_0, Splats

WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
FLOAT = 5126
REMEDY = "use a .glb file written by scas4d export --format glb"


class GltfFrame:
    """The JSON document and binary data of one ``.glb`` file.

    Args:
        data: contents of the file.
        name: name of the file, used in error messages.

    Raises:
        InputError: if the file is not a .glb, or contains an animation of parts.
    """

    def __init__(self, data: bytes, name: str) -> None:
        self._name = name
        try:
            self._document, self._bytes = _chunks(data)
            self._meshes: list[Any] = self._document.get("meshes", [])
        except (ValueError, KeyError, TypeError, AttributeError, struct.error) as error:
            raise InputError(f"{name} is not a .glb file ({error})", REMEDY) from None
        if self._document.get("animations"):
            raise InputError(
                f"{name} contains the motion of parts (glb-parts) instead of one state per frame",
                "use files written by scas4d export --format glb, usd or s4d",
            )

    @property
    def metres_per_unit(self) -> float:
        """Metres per unit of the user's world."""
        unit = self._document.get("asset", {}).get("extras", {}).get("metres_per_unit", 1.0)
        if not isinstance(unit, int | float) or not 0 < unit < float("inf"):
            raise InputError(f"{self._name}: invalid metres_per_unit {unit!r}", REMEDY)
        return float(unit)

    def cloud(self) -> Cloud:
        """Returns the Gaussians with all harmonics, in the user's world and units with OpenCV axes.

        Raises:
            InputError: if attributes or ids are missing, or the file does not contain exactly one set of splats.
        """
        if not self._meshes:
            none = np.zeros((0, 3))
            empty = Splats(none, none, np.zeros((0, 4)), np.zeros(0), none)
            return Cloud(empty, np.zeros((0, 1, 3)), np.zeros(0, np.int64))
        try:
            (mesh,) = self._meshes
            (primitive,) = mesh["primitives"]
            attributes = primitive["attributes"]
            if "_ID" not in attributes:
                raise InputError(
                    f"{self._name} has no ids (_ID), so Gaussians cannot be matched between frames",
                    "export it as usd or s4d; a .glb cannot store ids of 2^24 or more",
                )
            means, scales, rotations = (
                self._values(attributes[key]) for key in ("POSITION", f"{EXTENSION}:SCALE", f"{EXTENSION}:ROTATION")
            )
            names = [
                [f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{place}" for place in range(len(rows))]
                for degree, rows in enumerate(DEGREES)
            ]
            held = [name for each in names for name in each if name in attributes]
            harmonics = np.stack([self._values(attributes[name]) for name in held], axis=1)
            ids = np.rint(self._values(attributes["_ID"])[:, 0]).astype(np.int64)
            opacities = self._values(attributes[f"{EXTENSION}:OPACITY"])[:, 0]
            splats = Splats(
                means, scales, np.roll(rotations, 1, axis=1), opacities, 0.5 + SH_DEGREE_0 * harmonics[:, 0]
            )
            if {len(each) for each in (means, scales, rotations, harmonics, ids, opacities)} != {len(means)}:
                raise ValueError("attributes have different counts")
            if not np.linalg.norm(rotations, axis=1).all():
                raise ValueError("a rotation has length 0")
            cloud = Cloud(splats, harmonics, ids)
        except (ValueError, KeyError, IndexError, TypeError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{self._name} contains no readable splats ({error})", REMEDY) from None
        return cloud.half_turned().scaled(1 / self.metres_per_unit)

    def _values(self, number: int) -> NDArray[np.float64]:
        """Returns the values [N, width] of an accessor."""
        accessor = self._document["accessors"][number]
        view = self._document["bufferViews"][accessor["bufferView"]]
        width, count = WIDTHS[accessor["type"]], accessor["count"]
        if accessor["componentType"] != FLOAT or "byteStride" in view or "sparse" in accessor:
            raise ValueError("values are not contiguous float32")
        begin = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        return np.frombuffer(self._bytes, "<f4", count * width, begin).reshape(count, width).astype(np.float64)


def _chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Returns the JSON document and the binary chunk (glTF 2.0, section 4.4)."""
    magic, version, _ = struct.unpack_from("<4sII", data)
    if magic != b"glTF" or version != 2:
        raise ValueError("no glTF 2.0 header")
    length, kind = struct.unpack_from("<I4s", data, 12)
    if kind != b"JSON":
        raise ValueError("the first chunk is not JSON")
    document = json.loads(data[20 : 20 + length])
    begin = 20 + length
    if begin + 8 > len(data):
        return document, b""
    length, _ = struct.unpack_from("<I4s", data, begin)
    return document, data[begin + 8 : begin + 8 + length]
