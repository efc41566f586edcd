"""The numbers of a first cloud that a user can set."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class InitialPointsSettings(BaseModel):
    """How a first cloud is made from the pictures of frame 0. Lengths are relative: no unit is assumed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    max_points: int = Field(
        default=60_000, ge=100, le=1_000_000, description="points kept at most; where there are more, the spacing grows"
    )
    min_views: int = Field(
        default=3,
        ge=2,
        le=32,
        description="cameras that must agree on a point: two always meet somewhere on an epipolar line",
    )
    spacing: float = Field(
        default=1.5,
        ge=0.5,
        le=32,
        description="distance of neighbouring points, pixels at the middle of the stage; twice that on the background",
    )
    max_features: int = Field(
        default=4096, ge=64, le=32768, description="SIFT features a picture; matching costs their product for each pair"
    )
    epipolar_error: float = Field(
        default=2.0,
        gt=0,
        le=20,
        description="pixels a match may lie off its epipolar line; calibration residuals are near 0.5",
    )
    hull_voxel: float = Field(
        default=1.5, ge=0.25, le=16, description="edge of the smallest hull voxel in pixels at the middle of the stage"
    )
    hull_misses: float = Field(
        default=0.05,
        ge=0,
        lt=0.5,
        description="share of the cameras whose given mask may miss a voxel: automatic masks are ragged. "
        "Silhouettes read off a plain background are exact and get none",
    )
    plain_border: float = Field(
        default=0.95,
        gt=0.5,
        le=1,
        description="share of the border of every picture in one colour that counts as plain",
    )
    surfaces: int = Field(
        default=3, ge=0, le=8, description="planes and spheres fitted to the triangulated points, at most; 0 fits none"
    )
    surface_tolerance: float = Field(
        default=0.012, gt=0, le=0.1, description="distance of an inlier from a fitted surface, in radii of the rig"
    )
    stereo: bool = Field(default=True, description="dense stereo where the pictures have texture")
    stereo_width: int = Field(
        default=320, ge=64, le=4096, description="pictures wider than this are halved for stereo until they are not"
    )
    stereo_neighbours: int = Field(default=4, ge=2, le=16, description="other cameras each picture is compared with")
    stereo_iterations: int = Field(default=4, ge=1, le=20, description="rounds of propagation and refinement")
    seed: int = Field(default=0, ge=0, description="of every random choice; the same seed gives the same points")
