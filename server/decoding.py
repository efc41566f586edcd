"""Pictures of the frame log to a frame: what can be used of them, and what is left out and why."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from scas4d_core.cameras import Rig
from scas4d_core.captures import Frame
from scas4d_core.captures.images import ImageError, decode_image, decode_mask
from server.frame_store import FrameDamage, read_pictures
from server.ledger import frame_identity
from server.messages import FrameReady


@dataclass(frozen=True)
class Encoded:
    """Files of a frame by camera, as they were sent. faults: records that could not be read, a sentence each."""

    images: dict[str, memoryview]
    masks: dict[str, memoryview]
    faults: list[str]


def read(folder: Path, message: FrameReady) -> Encoded:
    """The files of a frame, from the frame log.

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
    """The frame, and the cameras left out of it with the reason."""
    images, masks, dropped = {}, {}, {}
    # In the order of the rig, whatever the order in which they came: the same pictures give the same bits.
    for camera in rig.cameras:
        name, size = camera.name, (camera.width, camera.height)
        if name not in encoded.images:
            dropped[name] = "; ".join(encoded.faults) or f"camera {name!r} had sent nothing when the frame was closed"
            continue
        try:
            image = decode_image(bytes(encoded.images[name]), size=size, name=f"image of camera {name!r}")
            if name in encoded.masks:
                mask = bytes(encoded.masks[name])
                masks[name] = decode_mask(mask, size=size, name=f"mask of camera {name!r}")
            images[name] = image
        except ImageError as error:
            dropped[name] = str(error)
    return Frame(message.index, message.time, images, masks), dropped
