"""The ``.glb`` container (glTF 2.0, section 4): a JSON chunk, and a binary chunk referenced by accessors.

This module does not use pygltflib. With it, the files of the exporter would be about 20 lines shorter. But it takes
five times the CPU time, copies all arrays twice in memory, and requires six further packages (76 MiB of arrays, 22
accessors, pygltflib 1.16.5, 2026-12-01).
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.errors import InputError
from scas4d_core.exports.atomic_files import atomic_path

COMPONENTS = {np.dtype("<f4"): 5126, np.dtype("<u2"): 5123, np.dtype("u1"): 5121}
"""glTF component types by dtype."""
SHAPES = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4"}
"""glTF element types by the shape of an element."""
ARRAY_BUFFER = 34962
"""Target of buffer views with vertex attributes."""
LONGEST = 2**32 - 1
"""Maximum file size in bytes; the header stores it in 32 bits."""
GENERATOR = "SCas4D"


class Binary:
    """The arrays of one ``.glb`` file, collected in memory until ``write``.

    Attributes:
        accessors, views: accessors and buffer views of the JSON document.
        length: current size of the binary chunk in bytes.

    >>> binary = Binary()
    >>> binary.add(np.float32([[0, 0, 2], [1, 0, 2]]), vertices=True, bounds=True)
    0
    >>> binary.accessors[0]["type"], binary.accessors[0]["max"], binary.length
    ('VEC3', [1.0, 0.0, 2.0], 24)
    """

    def __init__(self) -> None:
        self.accessors: list[dict[str, Any]] = []
        self.views: list[dict[str, Any]] = []
        self.length = 0
        self._arrays: list[NDArray[Any]] = []

    def add(
        self, array: NDArray[Any], *, vertices: bool = False, bounds: bool = False, normalized: bool = False
    ) -> int:
        """Adds an array as an accessor with its own buffer view, and returns the accessor's index.

        Args:
            array: [N, …] array with N ≥ 1 and a dtype in ``COMPONENTS``. For vertex attributes, the row size must be a
                multiple of 4 bytes.
            vertices: whether the array is a vertex attribute.
            bounds: whether to write min and max, which glTF requires for positions and times.
            normalized: whether integers represent values in [0, 1].
        """
        given = np.ascontiguousarray(array)
        accessor: dict[str, Any] = {
            "bufferView": len(self.views),
            "componentType": COMPONENTS[given.dtype],
            "count": len(given),
            "type": SHAPES[given.shape[1:]],
        }
        if normalized:
            accessor["normalized"] = True
        if bounds:
            flat = given.reshape(len(given), -1)
            accessor |= {"min": flat.min(axis=0).tolist(), "max": flat.max(axis=0).tolist()}
        view = {"buffer": 0, "byteOffset": self.length, "byteLength": given.nbytes}
        self.accessors.append(accessor)
        self.views.append(view | {"target": ARRAY_BUFFER} if vertices else view)
        self._arrays.append(given)
        self.length += given.nbytes + -given.nbytes % 4
        return len(self.accessors) - 1

    def write(self, path: Path | str, document: Mapping[str, Any]) -> None:
        """Writes the document and the collected arrays to a file, atomically.

        Args:
            path: path of the file.
            document: JSON document without asset, buffers, buffer views and accessors; its ``asset_extras`` become the
                ``extras`` of the asset.

        Raises:
            InputError: if the file would exceed 4 GiB, or cannot be written.

        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     Binary().write(f"{folder}/a.glb", {"scenes": [{}], "scene": 0})
        ...     Path(f"{folder}/a.glb").read_bytes()[:4]
        b'glTF'
        """
        content = dict(document)
        asset: dict[str, Any] = {"version": "2.0", "generator": GENERATOR}
        if extras := content.pop("asset_extras", None):
            asset["extras"] = extras
        content = {"asset": asset, **content}
        if self._arrays:
            content["buffers"] = [{"byteLength": self.length}]
            content |= {"bufferViews": self.views, "accessors": self.accessors}
        text = json.dumps(content, allow_nan=False, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + (8 + self.length if self._arrays else 0)
        if total > LONGEST:
            raise InputError(
                f"out {str(path)!r} would have {total:,} bytes, but a .glb file can have at most 4 GiB", "export as ply"
            )
        with atomic_path(path) as beside, beside.open("wb") as file:
            file.write(struct.pack("<4sII", b"glTF", 2, total))
            file.write(struct.pack("<I4s", len(text), b"JSON") + text)
            if self._arrays:
                file.write(struct.pack("<I4s", self.length, b"BIN\0"))
            for array in self._arrays:
                file.write(array.data)
                file.write(b"\0" * (-array.nbytes % 4))
