"""Decoding of a frame's images from the frame log, in advance while the previous frame is being updated."""

from __future__ import annotations

import os
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Camera, Rig
from scas4d_core.captures import Frame
from scas4d_core.captures.images import decode_image, decode_mask
from scas4d_core.captures.picture_file import ImageError
from server.messages import FrameReady
from server.storage.frame_store import FrameDamage, read_pictures
from server.storage.ledger import frame_identity

DECODERS = 8
"""Maximum number of cameras to decode in parallel; each needs memory for two copies of its image meanwhile."""

Picture = NDArray[np.uint8]
Decoded = tuple[Frame, dict[str, str]]
"""A decoded frame, and the reason for each camera that was left out."""


class FrameDecoder:
    """Decoder of a scene's frames, which decodes at most one frame in advance.

    The next frame may be announced before the worker takes the one decoded before, so two frames may be in memory.

    Args:
        rig: cameras of the scene.
        folder: folder of the frame log.
    """

    def __init__(self, rig: Rig, folder: Path) -> None:
        self._rig = rig
        self._folder = folder
        self._cameras = ThreadPoolExecutor(min(DECODERS, os.cpu_count() or 1), thread_name_prefix="decode")
        self._frames = ThreadPoolExecutor(1, thread_name_prefix="decode-ahead")
        self._ahead: dict[tuple[int, tuple[str, ...], str], Future[Decoded]] = {}
        self._lock = threading.Lock()

    def begin(self, message: FrameReady) -> None:
        """Starts to decode a frame in advance. Of the frames before it, only the last one is kept."""
        with self._lock:
            for old in list(self._ahead)[:-1]:
                self._ahead.pop(old).cancel()
            self._ahead[_key(message)] = self._frames.submit(self._decode, message)

    def decode(self, message: FrameReady) -> Decoded:
        """Decodes a frame, or returns it if it was decoded in advance.

        Raises:
            FrameDamage: the single record that contains the whole frame is damaged.
        """
        with self._lock:
            ahead = self._ahead.pop(_key(message), None)
        return self._decode(message) if ahead is None else ahead.result()

    def _decode(self, message: FrameReady) -> Decoded:
        return self.decode_images(message, read(self._folder, message))

    def decode_images(self, message: FrameReady, encoded: Encoded) -> Decoded:
        """Decodes the images of a frame that were read from the frame log, several cameras in parallel."""
        decoded = list(self._cameras.map(lambda camera: _pictures_of(camera, encoded), self._rig.cameras))
        images, masks, dropped = {}, {}, {}
        # In the order of the rig, not of arrival, so that equal images give bit-identical results.
        for camera, pictures in zip(self._rig.cameras, decoded, strict=True):
            if isinstance(pictures, str):
                dropped[camera.name] = pictures
                continue
            images[camera.name], mask = pictures
            if mask is not None:
                masks[camera.name] = mask
        files = {name: encoded.images[name] for name in images}
        return Frame(message.index, message.time, images, masks, files), dropped


def _key(message: FrameReady) -> tuple[int, tuple[str, ...], str]:
    return message.index, message.files, message.identity


@dataclass(frozen=True)
class Encoded:
    """Encoded images and masks of a frame, keyed by camera; `faults` has a sentence for each unreadable record."""

    images: dict[str, memoryview]
    masks: dict[str, memoryview]
    faults: list[str]


def read(folder: Path, message: FrameReady) -> Encoded:
    """Reads the files of a frame from the frame log.

    Raises:
        FrameDamage: the single record that contains the whole frame is damaged.
    """
    contents = Encoded({}, {}, [])
    for name in message.files:
        try:
            pictures = read_pictures(folder, name)
        except FrameDamage as error:
            if len(message.files) == 1:
                raise
            contents.faults.append(f"a record in the frame log is damaged: {error}")
            continue
        if len(message.files) == 1 and frame_identity(pictures.hashes, message.time) != message.identity:
            raise FrameDamage(f"{name}: its images differ from the acknowledged ones")
        contents.images.update(pictures.images)
        contents.masks.update(pictures.masks)
    return contents


def _pictures_of(camera: Camera, encoded: Encoded) -> tuple[Picture, Picture | None] | str:
    """Returns a camera's image and mask, if any, or the reason for leaving the camera out."""
    name, size = camera.name, (camera.width, camera.height)
    if name not in encoded.images:
        return "; ".join(encoded.faults) or f"camera {name!r} had not sent an image when the frame was closed"
    try:
        image = decode_image(encoded.images[name], size=size, name=f"image of camera {name!r}")
        if name not in encoded.masks:
            return image, None
        return image, decode_mask(encoded.masks[name], size=size, name=f"mask of camera {name!r}")
    except ImageError as error:
        return str(error)
