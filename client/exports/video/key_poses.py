"""Key poses of a camera path, read from a JSON file (docs/videos.md)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, FiniteFloat, ValidationError, model_validator

from client.wire.base import Model, Row3, Row4
from scas4d_core.cameras import CameraError
from scas4d_core.errors import InputError


class KeyPose(Model):
    """Camera pose at a point in time, in the user's world and units with OpenCV axes.

    Attributes:
        time: time of the pose, in seconds since the start of the video.
        frame: scene frame that sets the time of the pose, as an alternative to `time`.
        position: camera centre.
        look_at: point that appears at the image centre.
        world_to_camera: 4×4 pose matrix, as an alternative to `position` and `look_at`.
        field_of_view: vertical field of view in degrees.
    """

    time: Annotated[FiniteFloat, Field(ge=0)] | None = None
    frame: Annotated[int, Field(ge=0)] | None = None
    position: Row3 | None = None
    look_at: Row3 | None = None
    world_to_camera: Annotated[list[Row4], Field(min_length=4, max_length=4)] | None = None
    field_of_view: Annotated[FiniteFloat, Field(ge=1, le=170)] | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.time is None) == (self.frame is None):
            raise ValueError("set either time (seconds in the video) or frame (of the scene)")
        placed = self.position is not None or self.look_at is not None
        if placed == (self.world_to_camera is not None):
            raise ValueError("set either position and look_at, or world_to_camera")
        if placed and (self.position is None or self.look_at is None):
            raise ValueError("position and look_at must be set together")
        if placed and self.position == self.look_at:
            raise ValueError("position and look_at are the same point; set look_at to a point in front of the camera")
        return self


class KeyPoses(Model):
    """Camera path defined by key poses.

    Attributes:
        keys: key poses in chronological order.
        up: up direction for poses with `look_at`; None for the rig's up direction.
    """

    keys: Annotated[list[KeyPose], Field(min_length=1, max_length=10_000)]
    up: Row3 | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.up is not None and not any(self.up):
            raise ValueError("up is the zero vector; set it to a direction")
        return self


def read_key_poses(path: Path) -> KeyPoses:
    """Reads key poses from a JSON file.

    Raises:
        InputError: if the file does not exist or is invalid. The message names the field.

    >>> out.mkdir()
    >>> file = out / "keys.json"
    >>> _ = file.write_text('{"keys": [{"time": 0, "position": [0, 0, -3], "look_at": [0, 0, 0]}]}')
    >>> read_key_poses(file).keys[0].position
    [0.0, 0.0, -3.0]
    """
    if not path.is_file():
        raise InputError(f"path {str(path)!r} is not a file", "use orbit, camera, or a JSON file of key poses")
    try:
        return KeyPoses.model_validate_json(path.read_bytes())
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"]).lstrip(".")
        value = first["input"]
        given = f" {value!r}" if isinstance(value, str | int | float) and field else ""
        fault = first["msg"].removeprefix("Value error, ")
        raise InputError(
            f"{path.name}: {field + given + ': ' if field else ''}{fault[0].lower()}{fault[1:]}",
            "see docs/videos.md for the format",
        ) from None


def pose_error(path: Path, place: int, error: CameraError) -> InputError:
    """Returns the error for a `world_to_camera` matrix that is not a valid camera pose."""
    return InputError(f"{path.name}: keys[{place}].world_to_camera: {error.fault}", error.remedy)
