"""Every number a user can set, with its unit, range and the reason for its default. Pydantic only."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from scas4d_core.errors import InputError

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]


class Model(BaseModel):
    """Settings do not change once read, and an unknown name is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class SceneSettings(Model):
    """How the outside world enters."""

    metres_per_unit: Positive | Literal["auto"] = Field(
        1.0,
        description="Metres in one unit of the calibration; 'auto' takes the rig's radius for 3 m. A single "
        "camera tells no size: give a number such that what it sees is about 3 m away.",
    )
    image_scale: float = Field(1.0, gt=0, le=1, description="Pictures are resized by this before anything else.")
    background: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description="RGB in 0…1 behind everything; black, as in the captures of the field."
    )
    near: Positive | Literal["auto"] = Field(
        default="auto",
        description="Metres; nothing nearer to a camera is drawn. 'auto': a tenth of the rig's radius. Nothing in the "
        "pictures tells how it looks right before a camera that is not there, and one stray Gaussian hides all.",
    )
    floor: tuple[float, float, float, float] | None = Field(
        None,
        description="Plane (a, b, c, d) of the floor in the user's world; a·x + b·y + c·z + d > 0 lies below it, and "
        "what moves is kept above. None: the scene has no floor term.",
    )

    @field_validator("floor")
    @classmethod
    def _points_somewhere(cls, floor: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if floor is not None and not any(floor[:3]):
            raise InputError(f"floor {floor} has no direction", "give (a, b, c, d) with (a, b, c) pointing down")
        return floor


class StaticSettings(Model):
    """Frame 0: 3D Gaussian Splatting with adaptive density control."""

    iterations: int = Field(3000, ge=1, description="Iterations of frame 0, one training view each.")
    stop_gain: float = Field(
        0.0,
        ge=0,
        lt=1,
        description="Stop rule: frame 0 ends before its iterations are through, once none are added any more and five "
        "rounds over all views lower the mean training loss by less than this share. 0: never; 0.01 saves a simple "
        "scene a part of its wait.",
    )
    max_gaussians: int | None = Field(
        None,
        ge=1,
        description="Budget of Gaussians; densification stops there. None: 0.34 for each pixel of a training picture "
        "and 0.27 more for each that is not background, at most 100,000: 25,000 for an object at 256x256, 40,000 for "
        "a room.",
    )
    initial_share: float = Field(
        0.6, gt=0, le=1, description="Share of the budget that the first cloud may take; of a larger one a random part."
    )
    densify_from: int = Field(200, ge=0, description="First iteration that densifies; before, gradients are noise.")
    densify_every: int = Field(100, ge=1, description="Iterations between densifications.")
    densify_until: float = Field(0.6, ge=0, le=1, description="Fraction of the iterations after which none is added.")
    densify_gradient: Positive = Field(
        1e-6,
        description="Mean screen gradient (per half picture, as in 3DGS) above which a Gaussian may be refined; the "
        "budget decides how many are, hardest pulled first.",
    )
    prune_opacity: NotNegative = Field(0.01, description="Less opaque Gaussians are removed while densifying.")
    min_views: int = Field(2, ge=0, description="What fewer training cameras than this see is removed.")
    seen_pixels: NotNegative = Field(
        0.05, description="Pixels' worth of blending weight from which a camera counts as seeing a Gaussian."
    )
    exposure: bool | Literal["auto"] = Field(
        default="auto",
        description="Learn a colour gain and offset per training camera (held-out cameras are scored raw). 'auto': "
        "give it up after 30 % of the iterations where the cameras turn out alike: then it only fits noise.",
    )
    rate_position: Positive = Field(1.6e-4, description="Adam rate of means at the start, per metre of scene radius.")
    rate_position_end: Positive = Field(1.6e-6, description="The same at the end; the decay is exponential.")
    rate_colour: Positive = Field(2.5e-3, description="Adam rate of colours.")
    rate_opacity: Positive = Field(5e-2, description="Adam rate of opacity logits.")
    rate_scale: Positive = Field(5e-3, description="Adam rate of log scales.")
    rate_rotation: Positive = Field(2e-3, description="Adam rate of quaternions.")
    rate_exposure: Positive = Field(1e-3, description="Adam rate of gain and offset.")
    weight_mask: NotNegative = Field(
        3.0, description="Weight of the mask loss where masks are given; in frame 0 it teaches the labels only."
    )
    seed: int = Field(0, ge=0, description="Seed of the order of views and of the split of Gaussians.")


class LayerRates(Model):
    """Adam rates of one layer of clusters."""

    rotation: Positive = Field(description="Per iteration, in units of tan(angle/2).")
    translation: Positive = Field(description="Metres per iteration, for a scene radius of 4 m.")
    scaling: Positive = Field(description="Of c (1/m) and s.")


class Weights(Model):
    """Weights of the terms. A term with weight 0 is not computed."""

    image: Positive = Field(1.0, description="0.8 L1 + 0.2 (1 − SSIM).")
    mask: NotNegative = Field(
        1.0,
        description="The same form on the rendered label, where masks are given and at least a tenth of the Gaussians "
        "stands: it tells what moves from what does not.",
    )
    mask_alone: NotNegative = Field(
        0.3,
        description="The same where all but a few move: the picture has the silhouette already, and the masks' hard "
        "edges pull it off.",
    )
    rigidity: NotNegative = Field(4.0, description="Dynamic3DGaussians; with image 1, the paper's 0.19 to 0.05.")
    isometry: NotNegative = Field(
        6.0, description="Three times the authors': it ties distances and lets bend, and only helps."
    )
    rotation: NotNegative = Field(4.0, description="Likewise.")
    scale: NotNegative = Field(10.0, description="Likewise, the paper's 0.48 to 0.05.")
    floor: NotNegative = Field(2.0, description="Dynamic3DGaussians; only where the scene names a floor.")
    soft_colour: NotNegative = Field(0.01, description="Dynamic3DGaussians; the paper does not give it.")


class UpdateSettings(Model):
    """One update: from Θ_{t−1} and the pictures of frame t to Θ_t."""

    iterations: int = Field(100, ge=1, description="Iterations a frame, each a step down the gradient.")
    views: int = Field(
        1,
        ge=1,
        le=8,
        description="Training views that an iteration renders forward and backward; losses and gradients are their "
        "mean. The paper does not say how many; its code base, Dynamic3DGaussians, takes one.",
    )
    budget_ms: Positive | None = Field(
        None,
        description="Milliseconds that a frame may take, decoding and commit included; then there are as many "
        "iterations as fit, whatever `iterations` says. None: no limit.",
    )
    stop_gain: float = Field(
        0.0,
        ge=0,
        lt=1,
        description="An update cools down and ends once ten iterations lower its error on four training views by less "
        "than this share, after all layers have begun. 0: never.",
    )
    still: float = Field(
        0.0,
        ge=-1,
        description="A frame needs no iteration where the state before shows it, on four training views, with at most "
        "1 + this times the error that the last update ended with. -1: every frame is updated.",
    )
    judge: bool = Field(
        True,
        description="Leave out cameras and hold frames that do not fit what was before, commit no state that is worse "
        "than not moving, and say so in the frame's report.",
    )
    patience: int = Field(
        10,
        ge=1,
        description="Frames in a row that are held because they cannot be met, before the scene is another; dark ones "
        "do not count. A light that stays for so many is the scene's own.",
    )
    clusters: tuple[int, ...] = Field(
        (64, 320, 1280), description="Clusters per layer, coarse to fine (the paper's); empty: each Gaussian alone."
    )
    smallest_cluster: int = Field(8, ge=1, description="Layers are capped so that clusters hold this many on average.")
    cluster_map: Literal["centred", "published"] = Field(
        "centred", description="Scaling about the pivot (translation-equivariant) or about the world origin (paper)."
    )
    covariance: Literal["entangled", "separate"] = Field(
        "entangled",
        description="A Gaussian's covariance follows the Jacobian of the map that moves it (paper), or is learnt apart "
        "from the positions, by its own ΔR and Δs alone (the paper's ablation).",
    )
    layer_rates: tuple[LayerRates, ...] = Field(
        (
            LayerRates(rotation=0.04, translation=0.008, scaling=0.002),
            LayerRates(rotation=0.01, translation=0.002, scaling=0.002),
            LayerRates(rotation=0.002, translation=0.0004, scaling=0.002),
        ),
        min_length=1,
        description="One per layer, coarse to fine; with more layers the last is repeated.",
    )
    layer_starts: tuple[Annotated[float, Field(ge=0, lt=1)], ...] = Field(
        (0.0, 0.2, 0.4),
        min_length=1,
        description="Share of the iterations after which a layer begins to learn, one per layer, coarse to fine; with "
        "more layers the last is repeated. The coarse motion is found first: all at once, the finer layers take a part "
        "of it, each cluster another.",
    )
    own_start: float = Field(
        0.4, ge=0, lt=1, description="The same for what each Gaussian adds to its clusters: Δp, ΔR, Δs."
    )
    cold_longer: float = Field(
        1.0, gt=0, description="Factor on the iterations where there is no motion to start from."
    )
    cold_start: float = Field(
        2.0, ge=1, description="Factor on the layers' rates where there is no motion to start from: further to go."
    )
    rate_position: Positive = Field(1.6e-4, description="Δp, per metre of scene radius.")
    rate_rotation: Positive = Field(0.002, description="ΔR, in units of tan(angle/2).")
    rate_scale: NotNegative = Field(0.001, description="Δs, log.")
    rate_colour: NotNegative = Field(0.0025, description="RGB of what moves.")
    rate_colour_standing: NotNegative = Field(
        0.01,
        description="RGB of what stands: light and shadows wander over it, and no motion can be mistaken for them.",
    )
    coarse_until: float = Field(
        0.0, ge=0, le=1, description="Share of the iterations, at the start, that render coarser pictures."
    )
    coarse_scale: float = Field(0.5, gt=0, le=1, description="Their size: less to render, and a wider basin.")
    rate_end: float = Field(
        0.05, gt=0, le=1, description="All rates decay to this fraction over the frame (cosine); 1: constant."
    )
    beta1: float = Field(0.8, ge=0, lt=1, description="Adam's first decay.")
    beta2: float = Field(
        0.95, ge=0, lt=1, description="Adam's second decay; 100 iterations are too few for the usual 0.999."
    )
    warm_start: float = Field(1.0, ge=0, le=1, description="Share of the previous deformation that starts the next.")
    momentum: float = Field(
        0.0, ge=0, le=1, description="Share of what the layers leave of the previous motion that Δp starts from."
    )
    neighbours: int = Field(20, ge=1, description="Neighbours of a Gaussian in the rigidity terms.")
    neighbour_falloff: Positive = Field(2000.0, description="1/m²: weight exp(−falloff d²) of a neighbour at d.")
    neighbour_sample: int = Field(4000, ge=1, description="Gaussians whose neighbours are looked at an iteration.")
    max_scale: Positive = Field(0.02, description="Metres; longer axes are held at their length of frame 0.")
    weights: Weights = Field(default_factory=Weights)
    use_masks: bool = Field(True, description="Use the frame's masks where it has any.")
    seed: int = Field(0, ge=0, description="Seed of the order of views and of the sampled neighbours.")

    @field_validator("clusters")
    @classmethod
    def _ascend(cls, clusters: tuple[int, ...]) -> tuple[int, ...]:
        if any(size < 1 for size in clusters) or list(clusters) != sorted(set(clusters)):
            raise InputError(
                f"clusters {clusters} do not ascend",
                "give numbers from 1, the coarsest layer's first, the finest's last",
            )
        return clusters


class Settings(Model):
    """All settings of one scene."""

    scene: SceneSettings = Field(default_factory=SceneSettings)
    static: StaticSettings = Field(default_factory=StaticSettings)
    update: UpdateSettings = Field(default_factory=UpdateSettings)
    device: Literal["cpu", "cuda"] = Field("cpu", description="Where the update runs.")
