"""Settings of a scene: every value that a user can change, with its unit, range and the reason for its default.

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
    """Base of all settings: instances are immutable, and an unknown name is an error."""

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
        description="Metres per unit of the calibration. 'auto' scales the rig's radius to 3 m. A single camera does "
        "not determine a size: give a number that puts the subject about 3 m away.",
    )
    image_scale: float = Field(1.0, gt=0, le=1, description="Pictures are resized by this before anything else.")
    background: tuple[Unit, Unit, Unit] | Literal["auto"] = Field(
        "auto",
        description="RGB in 0…1 behind the scene. 'auto': the colour of a plain backdrop, else the mean of frame 0's "
        "pictures.",
    )
    near: Positive | Literal["auto"] = Field(
        default="auto",
        description="Near plane in metres: nothing closer to a camera is drawn. 'auto': a tenth of the rig's radius.",
    )
    floor: tuple[float, float, float, float] | None = Field(
        None,
        description="Plane (a, b, c, d) in the user's world: a·x + b·y + c·z + d > 0 lies below the floor. None: no "
        "floor term.",
    )

    @property
    def background_rgb(self) -> tuple[float, float, float]:
        """The background as RGB; black until 'auto' is resolved (``fit_first_frame.with_background``)."""
        return (0.0, 0.0, 0.0) if self.background == "auto" else self.background

    @field_validator("floor")
    @classmethod
    def _points_somewhere(cls, floor: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if floor is not None and not any(floor[:3]):
            raise InputError(f"floor {floor} has no direction", "give (a, b, c, d) with (a, b, c) pointing down")
        return floor


class StaticSettings(SettingsModel):
    """Settings of frame 0: 3D Gaussian Splatting with adaptive density control.

    >>> StaticSettings(seed=3).detail
    1.0
    """

    iterations: int = Field(3000, ge=1, le=1_000_000, description="Iterations of frame 0, one training view each.")
    seconds: Annotated[float, Field(gt=0, le=1_000_000)] | None = Field(
        110.0,
        description="Time limit for frame 0 in seconds, covering the initial points and the fit. With too few seconds, "
        "points are searched coarsely and the fit has fewer iterations (at least 500), so the result depends on the "
        "machine. None: no limit.",
    )
    stop_gain: Share = Field(
        0.0,
        description="Frame 0 stops early when no Gaussians are added any more and five rounds over all views lower the "
        "mean training loss by less than this share. 0: never; 0.01 saves a simple scene part of its wait.",
    )
    max_gaussians: Annotated[int, Field(ge=1, le=10_000_000)] | None = Field(
        None,
        description="Budget of Gaussians; densification stops there. None: 0.34 per pixel of a training picture and "
        "0.27 more per foreground pixel, at most 100,000 (25,000 for an object at 256x256).",
    )
    detail: float = Field(
        1.0, gt=0, le=1, description="Factor on that number of Gaussians where max_gaussians is None."
    )
    exposure: bool | Literal["auto"] = Field(
        default="auto",
        description="Learn a colour gain and offset per training camera; held-out cameras are scored without. 'auto': "
        "stop learning them after 30 % of the iterations where the cameras agree, because then they only "
        "fit noise.",
    )
    refine_calibration: bool = Field(
        default=False,
        description="Refine the cameras' poses on features of frame 0. The result is used only where it lowers the "
        "error of held-out features.",
    )
    seed: int = Field(0, ge=0, description="Seed of the order of views and of the split of Gaussians.")


class LayerRates(SettingsModel):
    """Adam learning rates of one layer of clusters."""

    rotation: Positive = Field(description="Per iteration, in units of tan(angle/2).")
    translation: Positive = Field(description="Metres per iteration, for a scene radius of 4 m.")


class Weights(SettingsModel):
    """Weights of the loss terms; the image loss has weight 1. A term with weight 0 is not computed."""

    mask: NotNegative = Field(
        1.0,
        description="Weight of the same loss on the rendered label, where masks are given and at least a tenth of the "
        "Gaussians is static. It separates moving from static Gaussians.",
    )
    mask_alone: NotNegative = Field(
        0.3,
        description="The same where nearly all Gaussians move: the pictures show the silhouette already, and hard mask "
        "edges pull it off.",
    )
    rigidity: NotNegative = Field(4.0, description="Dynamic3DGaussians; with image 1, the paper's 0.19 to 0.05.")
    isometry: NotNegative = Field(
        6.0, description="Three times the authors' weight: it ties distances, allows bending, and only helps."
    )
    rotation: NotNegative = Field(4.0, description="Likewise.")
    scale: NotNegative = Field(10.0, description="Likewise, the paper's 0.48 to 0.05.")


class UpdateSettings(SettingsModel):
    """Settings of an update from Θ_{t−1} and the images of frame t to Θ_t.

    >>> UpdateSettings(iterations=50, budget_ms=400).clusters
    (64, 320, 1280)
    """

    iterations: int = Field(100, ge=1, le=100_000, description="Iterations per frame.")
    views: int = Field(
        1,
        ge=1,
        le=8,
        description="Training views per iteration; losses and gradients are their mean. The paper does not give a "
        "number; its code base, Dynamic3DGaussians, uses one.",
    )
    budget_ms: Annotated[float, Field(gt=0, le=3_600_000)] | None = Field(
        None,
        description="Milliseconds that a frame may take, with decoding and commit. The number of iterations follows "
        "from it, whatever `iterations` says. None: no limit.",
    )
    stop_gain: Share = Field(
        0.0,
        description="An update decays its rates and ends once ten iterations lower its error on probe views by less "
        "than this share, after all layers have started. 0: never.",
    )
    skip_tolerance: float = Field(
        0.0,
        ge=-1,
        description="Skip the update when the previous state's error on probe views is at most (1 + skip_tolerance) "
        "times the error after the last update. -1: never skip.",
    )
    reject_outliers: bool = Field(
        True,
        description="Exclude outlying cameras, reject frames that do not fit, and never commit a state that is worse "
        "than not moving. The frame's report gives the reasons.",
    )
    max_rejected_frames: int = Field(
        10,
        ge=1,
        le=1_000_000,
        description="After this many consecutive rejected frames, accept the next one as a new scene. Dark frames do "
        "not count. A light that lasts this long is learnt as the scene's own.",
    )
    clusters: tuple[Count, ...] = Field(
        (64, 320, 1280),
        max_length=16,
        description="Clusters per layer, coarse to fine (the paper's). Empty: each Gaussian moves alone.",
    )
    cluster_map: Literal["centred", "published"] = Field(
        "centred", description="Scaling about the pivot (translation-equivariant) or about the world origin (paper)."
    )
    covariance: Literal["entangled", "separate"] = Field(
        "entangled",
        description="A Gaussian's covariance follows the Jacobian of its map (paper), or is learnt separately by its "
        "own ΔR and Δs (the paper's ablation).",
    )
    layer_rates: tuple[LayerRates, ...] = Field(
        (
            LayerRates(rotation=0.04, translation=0.008),
            LayerRates(rotation=0.01, translation=0.002),
            LayerRates(rotation=0.002, translation=0.0004),
        ),
        min_length=1,
        description="One per layer, coarse to fine; with more layers the last is repeated.",
    )
    deltas_start: Share = Field(
        0.4,
        description="Share of the iterations after which each Gaussian's own Δp, ΔR and Δs start to learn. The cluster "
        "layers start one after the other before.",
    )
    cold_start_iterations: Positive = Field(
        3.0, description="Factor on the iterations of an update without a previous motion."
    )
    cold_start_rates: float = Field(
        2.0, ge=1, description="Factor on the layers' rates in an update without a previous motion."
    )
    rate_position: Positive = Field(1.6e-4, description="Δp, per metre of scene radius.")
    rate_rotation: Positive = Field(0.002, description="ΔR, in units of tan(angle/2).")
    rate_scale: NotNegative = Field(0.001, description="Δs, log.")
    rate_colour: NotNegative = Field(0.0025, description="Learning rate of the RGB of moving Gaussians.")
    rate_static_colour: NotNegative = Field(
        0.01,
        description="Learning rate of the RGB of static Gaussians, where static_colour is on. 0: they keep their "
        "colours.",
    )
    final_rate: float = Field(
        0.05,
        gt=0,
        le=1,
        description="Each learning rate decays to this share on a half-cosine and ends when its layer is frozen. 1: "
        "constant.",
    )
    beta1: float = Field(0.8, ge=0, lt=1, description="Adam's first decay.")
    beta2: Share = Field(0.95, description="Adam's second decay; 100 iterations are too few for the usual 0.999.")
    momentum: Unit = Field(
        0.0, description="Share of the previous residual motion, beyond the layers', from which Δp starts."
    )
    weights: Weights = Field(default_factory=Weights)
    use_masks: bool = Field(True, description="Use the frame's masks where it has any.")
    seed: int = Field(0, ge=0, description="Seed of the order of views and of the sampled neighbours.")

    @field_validator("clusters")
    @classmethod
    def _ascend(cls, clusters: tuple[int, ...]) -> tuple[int, ...]:
        if list(clusters) != sorted(set(clusters)):
            raise InputError(f"clusters {clusters} do not ascend", "give the coarsest layer's first, the finest's last")
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
        description='Effects (docs/effects.md) that are pinned "on" or "off", by name; the others are "auto": on where '
        "the scene calls for them.",
    )
    device: Literal["cpu"] = Field("cpu", description="Where the update runs: the CPU; it is the only engine so far.")

    @field_validator("device", mode="before")
    @classmethod
    def _has_an_engine(cls, device: object) -> object:
        if device != "cpu":
            raise InputError(f"device {device!r} has no engine; updates run on the CPU so far", "give 'cpu'")
        return device

    @field_validator("effects")
    @classmethod
    def _are_known(cls, effects: dict[str, Mode]) -> dict[str, Mode]:
        for name in effects:
            if name not in EFFECTS:
                near = difflib.get_close_matches(name, EFFECTS, 1)
                remedy = f"did you mean {near[0]}? " if near else ""
                raise InputError(f"{name} is not an effect", f"{remedy}docs/effects.md lists all effects")
        return effects
