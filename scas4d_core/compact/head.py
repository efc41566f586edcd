"""The header of a compact file: JSON metadata that defines how its numbers are interpreted."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from scas4d_core.cameras import Camera, Rig, WorldFrame
from scas4d_core.compact.bounds import Bounds
from scas4d_core.compact.records import FileError, FormatError

VERSION = 1
"""Format version (docs/format.md); files with other versions are rejected."""


@dataclass(frozen=True)
class FileHeader:
    """Metadata that applies to a whole file.

    Attributes:
        world: transform from the user's world to the world of the states.
        bounds: error bounds of all states.
        background: background colour, RGB in [0, 1].
        rig: cameras in the user's world, or None if unknown.
        frames_per_second: nominal frame rate, or None if unknown; each frame has its own time.
        metadata: additional JSON values about the file.

    >>> head = FileHeader(WorldFrame(np.zeros(3)))
    >>> FileHeader.read(head.text(), "a file").bounds == head.bounds
    True
    """

    world: WorldFrame
    bounds: Bounds = field(default_factory=Bounds)
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rig: Rig | None = None
    frames_per_second: float | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def text(self) -> bytes:
        """Returns the header serialized as JSON."""
        cameras = None if self.rig is None else [_camera_record(camera) for camera in self.rig.cameras]
        record = {
            "format": "scas4d",
            "version": VERSION,
            "axes": "opencv: x right, y down, z forward",
            "colour": "sRGB values 0..1, plain RGB a Gaussian",
            "world": {"origin": np.asarray(self.world.origin).tolist(), "metres_per_unit": self.world.metres_per_unit},
            "bounds": self.bounds.record(),
            "background": list(self.background),
            "cameras": cameras,
            "frames_per_second": self.frames_per_second,
            "metadata": dict(self.metadata),
        }
        return json.dumps(record, allow_nan=False).encode()

    @classmethod
    def read(cls, text: bytes, name: str) -> FileHeader:
        """Parses the header of a file.

        Args:
            text: serialized header.
            name: name of the file, used in error messages.

        Raises:
            FileError: if the text is not a valid header.
            FormatError: if the file has an unsupported format version.
        """
        try:
            record = json.loads(text)
            version = record["version"]
            if record["format"] != "scas4d" or not isinstance(version, int):
                raise ValueError(f"format {record['format']!r}, version {version!r}")
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise FileError(f"{name} is not a compact 4D file: invalid header ({error})") from None
        if version != VERSION:
            raise FormatError(
                f"{name} has compact 4D format version {version}, but this version of scas4d reads version {VERSION}; "
                "use the version that wrote the file"
            )
        try:
            origin = np.array(record["world"]["origin"], np.float64).reshape(3)
            metres = float(record["world"]["metres_per_unit"])
            if not (np.isfinite(origin).all() and np.isfinite(metres) and metres > 0):
                raise ValueError(f"invalid world {record['world']}")
            red, green, blue = (float(value) for value in record["background"])
            cameras, rate = record["cameras"], record["frames_per_second"]
            return cls(
                WorldFrame(origin, metres),
                Bounds.of_record(record["bounds"]),
                (red, green, blue),
                Rig(tuple(map(_camera, cameras))) if cameras else None,
                None if rate is None else float(rate),
                dict(record["metadata"]),
            )
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
            raise FileError(f"{name}: the header is incomplete or invalid ({error})") from None


def _camera_record(camera: Camera) -> dict[str, Any]:
    return {
        "name": camera.name,
        "intrinsics": camera.intrinsics.tolist(),
        "world_to_camera": camera.world_to_camera.tolist(),
        "width": camera.width,
        "height": camera.height,
    }


def _camera(record: Mapping[str, Any]) -> Camera:
    return Camera(
        str(record["name"]),
        record["intrinsics"],
        np.array(record["world_to_camera"], np.float64),
        int(record["width"]),
        int(record["height"]),
    )
