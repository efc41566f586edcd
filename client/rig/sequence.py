"""Frames of a capture as encoded frames of a scene. The next frames are read ahead of time."""

from __future__ import annotations

import os
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

from client.left_out import LeftOut
from scas4d_core.captures import Capture, CaptureError, ImageError

FOREVER = 10**9
AHEAD = 2
"""Number of frames to read ahead. With one, reading would pause while the service syncs a frame to disk."""


@dataclass(frozen=True)
class EncodedFrame:
    """Encoded images and masks of a frame, keyed by camera name, with the frame time in seconds.

    `unusable` has the reason for each camera whose image or mask cannot be used.
    """

    time: float
    images: dict[str, bytes]
    masks: dict[str, bytes]
    unusable: dict[str, str]

    def without(self, camera: str, reason: str) -> EncodedFrame:
        """Returns the frame without the image and mask of a camera."""
        images, masks = (
            {name: file for name, file in of.items() if name != camera} for of in (self.images, self.masks)
        )
        return replace(self, images=images, masks=masks, unusable={**self.unusable, camera: reason})


def ping_pong(index: int, count: int) -> int:
    """Maps an increasing index to a position in 0…count − 1 that runs back and forth.

    >>> [ping_pong(index, 3) for index in range(6)]
    [0, 1, 2, 1, 0, 1]
    """
    if count == 1:
        return 0
    turn = index % (2 * count - 2)
    return min(turn, 2 * count - 2 - turn)


class Sequence:
    """The frames of a capture, from `start` on, as the frames of a scene.

    With `loop`, the frames run back and forth endlessly. Playback reverses at the ends, because a
    jump from the last frame to the first would not be plausible motion.
    """

    def __init__(self, source: Capture, *, start: int = 0, loop: bool = False) -> None:
        if not 0 <= start < source.frame_count:
            raise ValueError(f"start must be a frame of {source.name}, 0…{source.frame_count - 1}; got {start}")
        self.source = source
        self.start = start
        self.loop = loop
        self._last = source.frame_count - 1 - start
        self._pool = ThreadPoolExecutor(max_workers=min(8, os.cpu_count() or 1), thread_name_prefix="frames")
        self._ahead: dict[int, Future[EncodedFrame]] = {}
        self._reader = ThreadPoolExecutor(max_workers=1, thread_name_prefix="ahead")

    def __len__(self) -> int:
        return FOREVER if self.loop else self._last + 1

    def capture_index(self, index: int) -> int:
        """Returns the capture index that corresponds to frame `index` of the scene."""
        return self.start + ping_pong(index, self._last + 1)

    def time(self, index: int) -> float:
        """Returns the time of a frame in seconds, extrapolated at the frame rate beyond the end of the capture."""
        if index <= self._last:
            return self.source.time(self.start + index) - self.source.time(self.start)
        return self.time(self._last) + (index - self._last) / self.source.fps

    def files(self, index: int) -> EncodedFrame:
        """Returns the files of a frame, and starts to read the next frames in the background."""
        files = self.read_ahead(index)
        following = range(index + 1, min(index + 1 + AHEAD, len(self)))
        self._ahead = {
            other: self._ahead[other] if other in self._ahead else self._reader.submit(self._files, other)
            for other in following
        }
        return files

    def read_ahead(self, index: int) -> EncodedFrame:
        """Reads a frame and keeps it for the next call of `files`."""
        if index not in self._ahead:
            for other in self._ahead.values():
                other.cancel()
            self._ahead = {index: self._reader.submit(self._files, index)}
        return self._ahead[index].result()

    def first_usable(self, left_out: LeftOut) -> int:
        """Returns the index of the first frame with enough usable images, and keeps this frame for `files`.

        Raises:
            CaptureError: if there is no such frame. The message names an image and the reason.
        """
        reasons: dict[str, str] = {}
        for index in range(self._last + 1):
            unusable = self.read_ahead(index).unusable
            if not left_out.is_too_much(unusable):
                return index
            reasons = reasons or unusable
        camera, reason = next(iter(reasons.items()))
        raise CaptureError(
            f"{self.source.name} has no frame with usable images of {left_out.minimum} of {len(self.source.full_rig)} "
            f"cameras; the first fault, of camera {camera}: {reason}"
        )

    def _files(self, index: int) -> EncodedFrame:
        place, names = self.capture_index(index), self.source.full_rig.names
        images, masks, unusable = dict[str, bytes](), dict[str, bytes](), dict[str, str]()
        for name, files in zip(names, self._pool.map(lambda name: self._camera_files(place, name), names), strict=True):
            if isinstance(files, str):
                unusable[name] = files
                continue
            images[name], mask = files
            if mask is not None:
                masks[name] = mask
        # The service accepts masks for all cameras or for none.
        return EncodedFrame(self.time(index), images, masks if len(masks) == len(images) else {}, unusable)

    def _camera_files(self, place: int, name: str) -> tuple[bytes, bytes | None] | str:
        """Returns a camera's image and mask, or the reason why they cannot be used."""
        try:
            return self.source.encoded_image(place, name), self.source.encoded_mask(place, name)
        except (ImageError, CaptureError) as fault:
            return str(fault)

    def close(self) -> None:
        """Stops the threads."""
        self._reader.shutdown(wait=True, cancel_futures=True)
        self._pool.shutdown(wait=True)
