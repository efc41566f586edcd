"""Interface between the update loop and the device that computes it, and the values that cross it.

The loop (``update.frame_update``) decides, an engine computes. The calls of one attempt at a frame, in order::

    engine.bind(plan, structure)            # once per hierarchy: allocate, compile, capture graphs
    engine.load_views(views, probes)        # images of the frame
    engine.load_state(previous)             # Θ_{t−1} without motion
    engine.set_tables(tables)               # initial motion: none, or the motion of the previous frame
    engine.probe(...)                       # image losses of the candidates on a few views
    engine.begin(start)                     # reset the Adam moments to zero
    engine.iterate(views, step)             # deform, render, compare, backward, Adam: once per iteration
    engine.log(), engine.leave_out(views)   # after every camera was rendered: exclude outlier cameras
    engine.probe(...)                       # for the stopping rule, and at the end
    engine.state(learnt=True)               # Θ_t

Only ``probe``, ``log``, ``tables``, ``state``, ``exposures`` and ``gains`` make the host wait for the device. That is
about ten synchronizations per frame, and none during an iteration.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.plan import Structure, UpdatePlan
from scas4d_core.engines.renderer import Renderer
from scas4d_core.engines.views import TrainingView
from scas4d_core.gaussians import Gaussians
from scas4d_core.structure.hierarchy import Hierarchy

Array = NDArray[np.float32]

REPORT = "report"
"""Name of the stage in which an update prepares its own report: timers, colour shifts, writing and publishing."""
KEPT_PICTURES = 8
"""Number of recent views whose renderings the log keeps, as evidence for effects."""
KEPT_ROWS = 128
"""Approximate number of rows of a kept rendering; larger ones are subsampled."""


class EngineError(ValueError):
    """The engine does not support what a plan requires.

    Raised only by ``UpdateEngine.bind`` and ``FitEngine.load_table``.

    Args:
        engine: name of the engine. asked: the unsupported fields of the plan.

    >>> print(EngineError("torch", ["gloss"]))
    engine torch cannot compute: gloss; switch the effect off, or choose another device
    """

    def __init__(self, engine: str, asked: Sequence[str]) -> None:
        super().__init__(
            f"engine {engine} cannot compute: {', '.join(asked)}; switch the effect off, or choose another device"
        )
        self.engine, self.asked = engine, tuple(asked)


@dataclass(eq=False)
class Tables:
    """The parameters of a deformation, on the host. All zeros means no motion.

    Attributes:
        clusters: one table per layer, coarse to fine: [K, 10] float32, columns r, t, c, s of equation (6).
        deltas: [M, 9] float32, columns Δp, ΔR, Δs of equation (7).
    """

    clusters: list[Array]
    deltas: Array

    @classmethod
    def identity(cls, hierarchy: Hierarchy) -> Tables:
        """Returns tables without motion."""
        clusters = [np.zeros((count, 10), np.float32) for count in hierarchy.sizes]
        return cls(clusters, np.zeros((len(hierarchy.rows), 9), np.float32))

    def copy(self) -> Tables:
        """Returns a copy with its own arrays."""
        return Tables([values.copy() for values in self.clusters], self.deltas.copy())


@dataclass(frozen=True, eq=False)
class AttemptStart:
    """Constants of the iterations of one attempt. A parameter with learning rate 0 is not updated.

    Attributes:
        layers: Adam learning rates of each layer (r, t in metres, c and s), coarse to fine.
        position, rotation, scale: learning rates of Δp (metres), ΔR, Δs.
        colour, static_colour: learning rates of the RGB colours of moving and of static Gaussians.
        beta1, beta2: Adam's decay rates.
        samples: samples of entries in the hierarchy's order, [S] int64 each; ``StepScalars.sample`` selects one.
        gains: [cameras, 3] initial camera gains, in the plan's order; None: gains are not estimated.
        curve: whether to compute terms that only affect the reported loss, not the state.
        lap: callback that receives the name of each finished stage, from engines that synchronize after each stage.
    """

    layers: tuple[tuple[float, float, float], ...]
    position: float
    rotation: float
    scale: float
    colour: float
    static_colour: float
    beta1: float
    beta2: float
    samples: Sequence[NDArray[np.int64]]
    gains: Array | None = None
    curve: bool = True
    lap: Callable[[str], None] = lambda stage: None

    @property
    def cluster_columns(self) -> list[list[float]]:
        """Learning rates of the ten columns r, t, c, s of each layer's table."""
        return [[r] * 3 + [t] * 3 + [scaling] * 4 for r, t, scaling in self.layers]

    @property
    def delta_columns(self) -> list[float]:
        """Learning rates of the nine columns Δp, Δr, Δs of the deltas."""
        return [self.position] * 3 + [self.rotation] * 3 + [self.scale] * 3


@dataclass(frozen=True)
class StepScalars:
    """The scalars that change between iterations.

    Attributes:
        frozen: number of frozen layers, starting with the coarsest.
        layers: factor on the learning rates of each layer; 0: the layer is not updated.
        own: factor on the learning rates of Δp, ΔR, Δs. colour, gloss: factors on those of colours and gloss.
        smooth_gloss: whether the updates of the gloss are averaged over neighbours after this step.
        rigidity: weight of the rigidity loss in this iteration.
        sample: index of the attempt's sample whose neighbours are compared.
        keep_pictures: whether the log keeps the rendering of this iteration.
    """

    frozen: int
    layers: tuple[float, ...]
    own: float
    colour: float
    gloss: float
    smooth_gloss: bool
    rigidity: float
    sample: int
    keep_pictures: bool


class Thinned(NamedTuple):
    """A subsampled rendering.

    Attributes:
        every: step between the kept rows and columns.
        planes: [5, h, w] float32: RGB before the camera's exposure, label, remaining transmittance.
    """

    every: int
    planes: Array

    @classmethod
    def of(cls, features: Array, transmittance: Array) -> Thinned:
        """Subsamples a rendering: features [4, H, W] and remaining transmittance [H, W]."""
        every = max(1, min(transmittance.shape) // KEPT_ROWS)
        return cls(every, np.concatenate([features[:, ::every, ::every], transmittance[None, ::every, ::every]]))


class ViewRecord(NamedTuple):
    """The log entry of one rendering of a training view.

    Attributes:
        view: index of the view. psnr: dB. colour_shift: [3] mean of the picture minus mean of the rendering, RGB in
            0…1, with the camera's exposure applied.
    """

    view: int
    psnr: float
    colour_shift: tuple[float, float, float]


@dataclass(eq=False)
class IterationLog:
    """The log of the iterations since ``begin``.

    Attributes:
        losses: weighted sum of the loss terms, per iteration. rendered: records of all renderings, in order.
        pictures: the kept renderings by view index, oldest first.
        guards: number of times that each guard was triggered (``guards.GUARDS``).
    """

    losses: list[float] = field(default_factory=list)
    rendered: list[ViewRecord] = field(default_factory=list)
    pictures: dict[int, Thinned] = field(default_factory=dict)
    guards: dict[str, int] = field(default_factory=dict)

    def keep(self, view: int, picture: Thinned) -> None:
        """Adds a rendering and drops all but the newest ``KEPT_PICTURES``."""
        self.pictures.pop(view, None)
        self.pictures[view] = picture
        for old in list(self.pictures)[:-KEPT_PICTURES]:
            del self.pictures[old]


class UpdateEngine(Protocol):
    """Computes the updates of one scene on one device and owns the memory that they use.

    Attributes:
        name: name of the engine, for messages.
    """

    name: str

    @property
    def renderer(self) -> Renderer:
        """Returns the renderer of states, with the background and limits of the plan."""

    def bind(self, plan: UpdatePlan, structure: Structure) -> None:
        """Allocates buffers and compiles kernels for the updates of a plan.

        Raises:
            EngineError: if the engine does not support what the plan requires.
        """

    def load_views(self, views: Sequence[TrainingView], probes: Sequence[TrainingView]) -> None:
        """Loads the images of a frame; views that are already loaded are reused.

        Args:
            views: training views; ``iterate`` refers to them by index.
            probes: views for comparing states, of the same cameras; ``probe`` refers to them by index.
        """

    def load_state(self, previous: Gaussians) -> None:
        """Loads Θ_{t−1} without motion or learned colours."""

    def set_tables(self, tables: Tables) -> None:
        """Sets the parameters of the deformation."""

    def begin(self, start: AttemptStart) -> None:
        """Starts the iterations of an attempt, with zero Adam moments and an empty log."""

    def iterate(self, views: Sequence[int], step: StepScalars) -> None:
        """Runs one iteration: deform, render, compare, backward, Adam step.

        Args:
            views: indices of the views; the image and mask losses are averaged over them.
        """

    def leave_out(self, views: Sequence[int]) -> None:
        """Excludes views, by index, from the rest of the attempt; the gains of their cameras stay unchanged."""

    def wait(self, iteration: int) -> None:
        """Waits until the device is close to an iteration, so that host timings reflect the device's work."""

    def probe(self, which: Sequence[int], *, moved: bool, learnt: bool) -> list[float]:
        """Returns the image losses of a state on some of the probe views.

        Args:
            which: indices of the views. moved: whether Θ_{t−1} is deformed by the tables.
            learnt: whether to use the learned colours, gloss and environment instead of those of Θ_{t−1}.
        """

    def tables(self) -> Tables:
        """Returns the current parameters of the deformation."""

    def log(self) -> IterationLog:
        """Returns the log of the iterations so far."""

    def state(self, learnt: bool) -> Gaussians:
        """Returns Θ_{t−1} deformed by the tables, with accumulated material rotations.

        Args:
            learnt: whether to use the learned colours, gloss and environment instead of those of Θ_{t−1}.
        """

    def gradients(self) -> dict[str, Array]:
        """Returns the gradients of the last iteration's loss, for tests; call it before anything else is rendered.

        The keys are "cluster 0" … [K, 10] and "deltas" [M, 9], with the columns of ``Tables``. If they are learned,
        "colours" [N, 3], "gloss" [M, 3] and "environment" are included.
        """

    def exposures(self) -> Mapping[str, Array]:
        """Returns the current [C, 2] gain and offset of each camera with views, by camera name."""

    def gains(self) -> Array:
        """Returns the [cameras, 3] gains, updated with the renderings since the last round."""
