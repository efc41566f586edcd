"""Decodes the pictures of the frame log to a frame; cameras that cannot be decoded are left out with the reason."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Camera, Rig
from scas4d_core.captures import Frame
from scas4d_core.captures.images import ImageError, decode_image, decode_mask
from server.processes.messages import FrameReady
from server.storage.frame_store import FrameDamage, read_pictures
from server.storage.ledger import frame_identity

Picture = NDArray[np.uint8]

DECODERS = 8
"""Cameras that are decoded at a time at most: each holds its picture twice meanwhile."""


@dataclass(frozen=True)
class Encoded:
    """The files of a frame by camera, as they were sent. faults: a sentence for each record that could not be read."""

    images: dict[str, memoryview]
    masks: dict[str, memoryview]
    faults: list[str]


def read(folder: Path, message: FrameReady) -> Encoded:
    """Reads the files of a frame from the frame log.

    Raises:
        FrameDamage: the record that holds the whole frame cannot be used.
    """
    found = Encoded({}, {}, [])
    for name in message.files:
        try:
            pictures = read_pictures(folder, name)
        except FrameDamage as error:
            if len(message.files) == 1:
                raise
            found.faults.append(f"a record in the frame log is damaged: {error}")
            continue
        if len(message.files) == 1 and frame_identity(pictures.hashes, message.time) != message.identity:
            raise FrameDamage(f"{name}: it holds other pictures than were acknowledged")
        found.images.update(pictures.images)
        found.masks.update(pictures.masks)
    return found


def decode(rig: Rig, message: FrameReady, encoded: Encoded) -> tuple[Frame, dict[str, str]]:
    """Returns the frame, and the cameras left out of it with the reason; cameras are decoded side by side."""
    with ThreadPoolExecutor(max_workers=min(DECODERS, os.cpu_count() or 1)) as pool:
        found = list(pool.map(lambda camera: _pictures_of(camera, encoded), rig.cameras))
    images, masks, dropped = {}, {}, {}
    # In the order of the rig, whatever the order in which they came: the same pictures give the same bits.
    for camera, pictures in zip(rig.cameras, found, strict=True):
        if isinstance(pictures, str):
            dropped[camera.name] = pictures
            continue
        images[camera.name], mask = pictures
        if mask is not None:
            masks[camera.name] = mask
    return Frame(message.index, message.time, images, masks), dropped


def _pictures_of(camera: Camera, encoded: Encoded) -> tuple[Picture, Picture | None] | str:
    """Returns a camera's picture and its mask, if one was sent; or the reason to leave the camera out."""
    name, size = camera.name, (camera.width, camera.height)
    if name not in encoded.images:
        return "; ".join(encoded.faults) or f"camera {name!r} had sent nothing when the frame was closed"
    try:
        image = decode_image(bytes(encoded.images[name]), size=size, name=f"image of camera {name!r}")
        if name not in encoded.masks:
            return image, None
        return image, decode_mask(bytes(encoded.masks[name]), size=size, name=f"mask of camera {name!r}")
    except ImageError as error:
        return str(error)
