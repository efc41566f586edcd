"""Record of images that cannot be used, shared by the commands that read captures."""

from __future__ import annotations

from collections.abc import Mapping

from scas4d_core.cameras import Rig, minimum_cameras


class LeftOut:
    """Images that cannot be used, and frames that have too few others.

    Args:
        rig: cameras of a frame.
        minimum: minimum number of cameras per frame; None for half of the rig, rounded up.

    Attributes:
        minimum: minimum number of usable images per frame.
        images: number of images that cannot be used.
        frames: indices of the frames that are left out, because too few images can be used.

    >>> from client.importers.open_source import open_source
    >>> left_out = LeftOut(open_source(folder).rig)
    >>> left_out.record(3, {"0": "0/000003.png: no such file"})
    ['frame 3, without camera 0: 0/000003.png: no such file']
    >>> left_out.record(4, {"0": "0/000004.png: no such file", "1": "1/000004.png: no such file"})[-1]
    'frame 4 is left out: 0 of 2 images can be used, and at least 1 is required'
    >>> left_out.images, left_out.frames
    (3, [4])
    """

    def __init__(self, rig: Rig, minimum: int | None = None) -> None:
        self._cameras = len(rig)
        self.minimum = minimum_cameras(len(rig), minimum)
        self._before: Mapping[str, str] = {}
        self._last = -1
        self.images = 0
        self.frames: list[int] = []

    def is_too_much(self, reasons: Mapping[str, str]) -> bool:
        """Returns whether a frame is left out, given the reason for each camera without a usable image."""
        return self._cameras - len(reasons) < self.minimum

    def record(self, index: int, reasons: Mapping[str, str]) -> list[str]:
        """Records the cameras without a usable image of the next frame, and returns messages for the user.

        A reason that has not changed since the frame before, such as the end of a video, is not repeated. A frame that
        is sent again is not recorded again.
        """
        if index <= self._last:
            return []
        self._last = index
        self.images += len(reasons)
        messages = [
            f"frame {index}, without camera {name}: {reason}"
            for name, reason in reasons.items()
            if self._before.get(name) != reason
        ]
        if self.is_too_much(reasons):
            if messages:
                are = "is" if self.minimum == 1 else "are"
                messages.append(
                    f"frame {index} is left out: {self._cameras - len(reasons)} of {self._cameras} images can be used, "
                    f"and at least {self.minimum} {are} required"
                )
            self.frames.append(index)
        self._before = dict(reasons)
        return messages

    @property
    def summary(self) -> str | None:
        """One sentence for the user, or None if all images could be used."""
        if not self.images:
            return None
        some = f"{self.images} image{'' if self.images == 1 else 's'} could not be used"
        if not self.frames:
            return f"{some}; no frame was left out"
        return (
            f"{some}; {len(self.frames)} frame{'' if len(self.frames) == 1 else 's'} left out, because fewer than "
            f"{self.minimum} of {self._cameras} cameras had a usable image"
        )
