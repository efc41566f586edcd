"""Wire models of cameras and rigs."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from client.wire.base import MAX_CAMERAS, MAX_PIXELS_A_SIDE, CameraName, Model, Row3, Row4
from scas4d_core.cameras import Camera, Rig
from scas4d_core.errors import InputError


class CameraModel(Model):
    """A pinhole camera without distortion, with OpenCV axes and pixel centres at +0.5."""

    name: CameraName
    intrinsics: Annotated[list[Row3], Field(min_length=3, max_length=3)]
    """[[fx,0,cx],[0,fy,cy],[0,0,1]] in pixels; (0, 0) is the upper left corner of the image."""
    world_to_camera: Annotated[list[Row4], Field(min_length=4, max_length=4)]
    """Pose matrix [[R, t], [0, 1]] with X_cam = R X_world + t, in the user's units."""
    width: int = Field(ge=1, le=MAX_PIXELS_A_SIDE)
    """Width of the images in pixels."""
    height: int = Field(ge=1, le=MAX_PIXELS_A_SIDE)
    """Height of the images in pixels."""

    @model_validator(mode="after")
    def _check_camera(self) -> CameraModel:
        """Rejects names that are reserved for frame fields, and invalid cameras."""
        if self.name == "time" or self.name.startswith("mask."):
            raise InputError(f"camera name {self.name!r} is reserved for another field of a frame", "rename the camera")
        self.camera()  # raises CameraError, a ValueError, for an invalid camera
        return self

    def camera(self) -> Camera:
        """Converts the wire model to a core `Camera`."""
        return Camera(
            self.name, np.array(self.intrinsics), np.array(self.world_to_camera), width=self.width, height=self.height
        )

    @classmethod
    def of(cls, camera: Camera) -> CameraModel:
        """Converts a camera to the wire model."""
        return cls(
            name=camera.name,
            intrinsics=camera.intrinsics.tolist(),
            world_to_camera=camera.world_to_camera.tolist(),
            width=camera.width,
            height=camera.height,
        )


class RigModel(Model):
    """The cameras of a scene."""

    axes: Literal["opencv"]
    """Camera axes: x right, y down, z forward. The only supported convention, which must be stated explicitly."""
    cameras: Annotated[list[CameraModel], Field(min_length=1, max_length=MAX_CAMERAS)]

    @model_validator(mode="after")
    def _names_unique(self) -> RigModel:
        self.rig()
        return self

    def rig(self) -> Rig:
        """Converts the wire model to a core `Rig`."""
        return Rig(tuple(camera.camera() for camera in self.cameras))

    @classmethod
    def of(cls, rig: Rig) -> RigModel:
        """Converts a rig to the wire model."""
        return cls(axes="opencv", cameras=[CameraModel.of(camera) for camera in rig.cameras])
