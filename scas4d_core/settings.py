"""Settings of a scene: all values that users can change, with their units, ranges and defaults.

Values that only developers of the method would change are constants in the modules that use them.
"""

from __future__ import annotations

import difflib
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from scas4d_core.effect_names import EFFECTS, Mode
from scas4d_core.errors import InputError

Positive = Annotated[float, Field(gt=0)]
Unit = Annotated[float, Field(ge=0, le=1)]
Share = Annotated[float, Field(ge=0, lt=1)]
NotNegative = Annotated[float, Field(ge=0)]
Count = Annotated[int, Field(ge=1, le=1_000_000)]


class SettingsModel(BaseModel):
    """Base class of all settings; instances are immutable, and unknown names are rejected."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class SceneSettings(SettingsModel):
    """Settings of the scene: unit, images, background, near plane and floor.

    >>> SceneSettings(metres_per_unit="auto").image_scale
    1.0
    >>> SceneSettings(image_scale=2)
    Traceback (most recent call last):
    pydantic_core._pydantic_core.ValidationError: 1 validation error for SceneSettings...
    """

    metres_per_unit: Positive | Literal["auto"] = Field(
        1.0,
        description="Metres per unit of the calibration. 'auto' scales the rig radius to 3 m. A single camera does not "
        "determine the scale; set a value that places the subject about 3 m away.",
    )
    image_scale: float = Field(1.0, gt=0, le=1, description="Scale factor applied to all images before any other step.")
    background: tuple[Unit, Unit, Unit] | Literal["auto"] = Field(
        "auto",
        description="Background colour as RGB values in [0, 1]. 'auto' uses the colour of a plain backdrop or, without "
        "one, the mean colour of frame 0.",
    )
    near: Positive | Literal["auto"] = Field(
        default="auto",
        description="Distance of the near plane from the camera in metres. 'auto' uses a tenth of the rig radius.",
    )
    floor: tuple[float, float, float, float] | None = Field(
        None,
        description="Floor plane (a, b, c, d) in world coordinates: points with a·x + b·y + c·z + d > 0 are below "
        "the floor. None disables the floor term.",
    )

    @property
    def background_rgb(self) -> tuple[float, float, float]:
        """Background colour as RGB; black until 'auto' is resolved (``fit_first_frame.with_background``)."""
        return (0.0, 0.0, 0.0) if self.background == "auto" else self.background

    @field_validator("floor")
    @classmethod
    def _points_somewhere(cls, floor: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if floor is not None and not any(floor[:3]):
            raise InputError(f"floor {floor} has a zero normal", "use (a, b, c, d) with (a, b, c) pointing down")
        return floor


class StaticSettings(SettingsModel):
    """Settings of frame 0: 3D Gaussian Splatting with adaptive density control.

    >>> StaticSettings(seed=3).detail
    1.0
    """

    iterations: int = Field(3000, ge=1, le=1_000_000, description="Number of iterations for frame 0, one view each.")
    seconds: Annotated[float, Field(gt=0, le=1_000_000)] | None = Field(
        110.0,
        description="Time limit for frame 0 in seconds, for the point search and the fit. A tight limit makes the "
        "search coarser and the fit shorter (at least 500 iterations), so the result depends on the machine. None "
        "means no limit.",
    )
    stop_gain: Share = Field(
        0.0,
        description="After densification, the fit of frame 0 stops once five passes over all views reduce the "
        "training loss by less than this fraction. 0 disables early stopping; 0.01 saves time on simple scenes.",
    )
    max_gaussians: Annotated[int, Field(ge=1, le=10_000_000)] | None = Field(
        None,
        description="Maximum number of Gaussians, at which densification stops. None means 0.34 per pixel of a "
        "training image plus 0.27 per foreground pixel, up to 100,000 (25,000 for an object at 256x256).",
    )
    detail: float = Field(
        1.0, gt=0, le=1, description="Factor applied to the default max_gaussians; ignored if max_gaussians is set."
    )
    exposure: bool | Literal["auto"] = Field(
        default="auto",
        description="Whether to learn a colour gain and offset for each training camera. Held-out cameras are "
        "evaluated without them. 'auto' stops learning after 30% of the iterations if the cameras agree, to avoid "
        "fitting noise.",
    )
    refine_calibration: bool = Field(
        default=False,
        description="Whether to refine the camera poses using image features of frame 0. Refined poses are used only "
        "if they reduce the error of held-out features.",
    )
    seed: int = Field(0, ge=0, description="Random seed for the order of views and the splitting of Gaussians.")


class LayerRates(SettingsModel):
    """Adam learning rates of one layer of clusters."""

    rotation: Positive = Field(description="Rotation rate per iteration, in units of tan(angle/2).")
    translation: Positive = Field(description="Translation rate in metres per iteration, for a scene radius of 4 m.")


class Weights(SettingsModel):
    """Weights of the loss terms; the image loss has weight 1. A term with weight 0 is not computed."""

    mask: NotNegative = Field(
        1.0,
        description="Weight of the image loss between rendered labels and masks, which separates moving from static "
        "Gaussians. Used if masks are given and at least a tenth of the Gaussians are static.",
    )
    mask_alone: NotNegative = Field(
        0.3,
        description="Weight of the mask loss if nearly all Gaussians move. It is lower, because hard mask edges would "
        "distort the silhouette.",
    )
    rigidity: NotNegative = Field(
        4.0,
        description="Weight of the rigidity loss, as in Dynamic3DGaussians. In the paper, its ratio to the image loss "
        "is 0.19 to 0.05.",
    )
    isometry: NotNegative = Field(
        6.0,
        description="Weight of the isometry loss, which preserves distances but allows bending; three times the weight "
        "in Dynamic3DGaussians.",
    )
    rotation: NotNegative = Field(4.0, description="Weight of the rotation loss, as in Dynamic3DGaussians.")
    scale: NotNegative = Field(
        10.0, description="Weight of the axis-length loss. In the paper, its ratio to the image loss is 0.48 to 0.05."
    )


class UpdateSettings(SettingsModel):
    """Settings of an update from Θ_{t−1} and the images of frame t to Θ_t.

    >>> UpdateSettings(iterations=50, budget_ms=400).clusters
    (64, 320, 1280)
    """

    iterations: int = Field(100, ge=1, le=100_000, description="Number of iterations per frame.")
    views: int = Field(
        1,
        ge=1,
        le=8,
        description="Number of training views per iteration; losses and gradients are averaged over them. The paper "
        "does not state the number; its code base, Dynamic3DGaussians, uses one view.",
    )
    budget_ms: Annotated[float, Field(gt=0, le=3_600_000)] | None = Field(
        None,
        description="Time budget per frame in milliseconds, until the new state is in memory. It determines the number "
        "of iterations and overrides `iterations`. None means no limit.",
    )
    stop_gain: Share = Field(
        0.0,
        description="Once all layers have started, an update stops early if ten iterations reduce its error on the "
        "probe views by less than this fraction. 0 disables early stopping.",
    )
    match_patches: bool = Field(
        True,
        description="Whether updates start from matches of image patches if the extrapolated motion does not fit. This "
        "finds faster motion. Without `reject_outliers` and `stop_gain`, states are not compared, and nothing is "
        "matched.",
    )
    skip_tolerance: float = Field(
        0.0,
        ge=-1,
        description="An update is skipped if the error of the previous state on the probe views is at most "
        "(1 + skip_tolerance) times the error after the last update. -1 disables skipping.",
    )
    reject_outliers: bool = Field(
        True,
        description="Whether to exclude outlier cameras, reject frames that do not fit, and discard states that fit "
        "worse than the previous state. The frame report states the reasons.",
    )
    max_rejected_frames: int = Field(
        10,
        ge=1,
        le=1_000_000,
        description="If this many consecutive frames do not fit, the last is accepted, because the scene has changed. "
        "Dark frames do not count. A lighting change of this length is accepted as the scene's normal lighting.",
    )
    clusters: tuple[Count, ...] = Field(
        (64, 320, 1280),
        max_length=16,
        description="Number of clusters per layer, from coarse to fine; the default is the paper's. If empty, each "
        "Gaussian moves independently.",
    )
    cluster_map: Literal["centred", "published"] = Field(
        "centred",
        description="Whether clusters scale about their pivot ('centred', translation-equivariant) or the world origin "
        "('published', as in the paper).",
    )
    covariance: Literal["entangled", "separate"] = Field(
        "entangled",
        description="Whether a Gaussian's covariance follows the Jacobian of its map ('entangled', as in the paper) or "
        "only its own ΔR and Δs ('separate', the paper's ablation).",
    )
    layer_rates: tuple[LayerRates, ...] = Field(
        (
            LayerRates(rotation=0.04, translation=0.008),
            LayerRates(rotation=0.01, translation=0.002),
            LayerRates(rotation=0.002, translation=0.0004),
        ),
        min_length=1,
        description="Learning rates of each layer, from coarse to fine; further layers use the last entry.",
    )
    deltas_start: Share = Field(
        0.4,
        description="Fraction of the iterations after which the optimization of each Gaussian's own Δp, ΔR and Δs "
        "starts. The cluster layers start earlier, one after another.",
    )
    cold_start_iterations: Positive = Field(
        3.0, description="Factor applied to the number of iterations if there is no previous motion."
    )
    cold_start_rates: float = Field(
        2.0, ge=1, description="Factor applied to the layers' learning rates if there is no previous motion."
    )
    rate_position: Positive = Field(1.6e-4, description="Learning rate of Δp, per metre of scene radius.")
    rate_rotation: Positive = Field(0.002, description="Learning rate of ΔR, in units of tan(angle/2).")
    rate_scale: NotNegative = Field(0.001, description="Learning rate of Δs, on a logarithmic scale.")
    rate_colour: NotNegative = Field(0.0025, description="Learning rate of the colours of moving Gaussians.")
    rate_static_colour: NotNegative = Field(
        0.01,
        description="Learning rate of the colours of static Gaussians while the effect static_colour is on. 0 fixes "
        "these colours.",
    )
    final_rate: float = Field(
        0.05,
        gt=0,
        le=1,
        description="Fraction of its initial value to which each learning rate decays along a half-cosine, until its "
        "layer is frozen. 1 keeps the rates constant.",
    )
    beta1: float = Field(0.8, ge=0, lt=1, description="Decay rate of Adam's first moment.")
    beta2: Share = Field(
        0.95, description="Decay rate of Adam's second moment; 100 iterations are too few for the usual 0.999."
    )
    momentum: Unit = Field(
        0.0,
        description="Fraction of a Gaussian's own previous motion, relative to the layers, from which Δp and ΔR start.",
    )
    weights: Weights = Field(default_factory=Weights)
    use_masks: bool = Field(True, description="Whether to use masks, if available.")
    seed: int = Field(0, ge=0, description="Random seed for the order of views and the sampling of neighbours.")

    @field_validator("clusters")
    @classmethod
    def _ascend(cls, clusters: tuple[int, ...]) -> tuple[int, ...]:
        if list(clusters) != sorted(set(clusters)):
            raise InputError(
                f"clusters must be in ascending order; got {clusters}",
                "list the coarsest layer first and the finest last",
            )
        return clusters


class Settings(SettingsModel):
    """All settings of one scene.

    >>> settings = Settings.model_validate({"scene": {"metres_per_unit": 0.01}, "update": {"iterations": 50}})
    >>> settings.update.iterations, settings.static.iterations
    (50, 3000)
    >>> Settings.model_validate_json(settings.model_dump_json()) == settings
    True
    >>> Settings(effects={"flour": "off"})
    Traceback (most recent call last):
    pydantic_core._pydantic_core.ValidationError: 1 validation error for Settings...
    """

    scene: SceneSettings = Field(default_factory=SceneSettings)
    static: StaticSettings = Field(default_factory=StaticSettings)
    update: UpdateSettings = Field(default_factory=UpdateSettings)
    effects: dict[str, Mode] = Field(
        default_factory=dict,
        description='Effects (docs/effects.md) pinned to "on" or "off", keyed by name; all others are "auto" and are '
        "switched on if the scene needs them.",
    )
    device: Literal["auto", "cpu", "gpu"] = Field(
        "auto",
        description="Device that fits and updates the scene (docs/gpu.md). `auto` uses an NVIDIA GPU if there is one.",
    )

    @field_validator("device", mode="before")
    @classmethod
    def _has_an_engine(cls, device: object) -> object:
        if device not in ("auto", "cpu", "gpu"):
            raise InputError(f"device {device!r} is not supported", "choose 'auto', 'cpu' or 'gpu'")
        return device

    @field_validator("effects")
    @classmethod
    def _are_known(cls, effects: dict[str, Mode]) -> dict[str, Mode]:
        for name in effects:
            if name not in EFFECTS:
                near = difflib.get_close_matches(name, EFFECTS, 1)
                remedy = f"did you mean {near[0]}? " if near else ""
                raise InputError(f"unknown effect {name!r}", f"{remedy}docs/effects.md lists all effects")
        return effects
