"""The interface between the loop of an update and the device that computes it, and the values that cross it.

The loop (``update.frame_update``) decides; an engine computes. The calls of one attempt at a frame, in order::

    engine.bind(plan, structure)            # once per hierarchy: allocate, compile, capture graphs
    engine.load_views(views, probes)        # images of the frame
    engine.load_state(previous)             # Θ_{t−1}, no motion
    engine.set_tables(tables)               # initial motion: none, or that of the previous frame
    engine.probe(...)                       # image losses of the candidates on a few views
    engine.begin(start)                     # zero moments
    engine.iterate(views, step)             # deform, render, compare, backward, Adam: once per iteration
    engine.log(), engine.leave_out(views)   # once every camera was rendered: exclude outlying cameras
    engine.probe(...)                       # for the stopping rule, and at the end
    engine.state(learnt=True)               # Θ_t

Only ``probe``, ``log``, ``tables``, ``state``, ``exposures`` and ``gains`` make the host wait for the device: about ten
calls per frame, and none during an iteration.
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

    Only ``UpdateEngine.bind`` and ``FitEngine.load_table`` raise it.

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
    """The parameters of a deformation, on the host.

    Attributes:
        clusters: for each layer, coarse to fine, [K, 10] float32, columns r, t, c, s of equation (6).
        deltas: [M, 9] float32, columns Δp, ΔR, Δs of equation (7).

    All zeros is no motion.
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
    """Constants of the iterations of one attempt. A parameter with rate 0 is not updated.

    Attributes:
        layers: Adam's rates (r, t in metres, c and s) of each layer, coarse to fine.
        position, rotation, scale: rates of Δp (metres), ΔR, Δs.
        colour, static_colour: rates of RGB of moving and of static Gaussians.
        beta1, beta2: Adam's decays.
        samples: samples of entries in the hierarchy's order, [S] int64 each; ``StepScalars.sample`` selects one.
        gains: [cameras, 3] initial gains of the cameras, in the plan's order; None: gains are not estimated.
        curve: whether to compute terms that only the reported loss needs; they do not change the state.
        lap: called with the name of each finished stage, by engines that wait for each stage.
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


@dataclass(frozen=True)
class StepScalars:
    """The scalars that change between iterations.

    Attributes:
        frozen: number of frozen layers, starting with the coarsest.
        layers: factor on the rates of each layer; 0: the layer is not updated.
        own: factor on the rates of Δp, ΔR, Δs. colour: on those of the colours. gloss: on those of the gloss.
        smooth_gloss: whether the changes of the gloss are averaged over neighbours after this step.
        rigidity: weight of rigidity in this iteration.
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
            0…1, the camera's exposure included.
    """

    view: int
    psnr: float
    colour_shift: tuple[float, float, float]


@dataclass(eq=False)
class IterationLog:
    """The log of the iterations since ``begin``.

    Attributes:
        losses: weighted sum of the terms of each iteration. rendered: all renderings, in order.
        pictures: the kept renderings by index of the view, oldest first.
        guards: number of times that each guard acted (``guards.GUARDS``).
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
    """Computes the updates of one scene on one device, and owns their memory.

    Attributes:
        name: name of the engine, for messages.
    """

    name: str

    @property
    def renderer(self) -> Renderer:
        """The renderer of states, with the background and limits of the plan."""

    def bind(self, plan: UpdatePlan, structure: Structure) -> None:
        """Prepares for the updates of a plan: allocates and compiles.

        Raises:
            EngineError: the engine does not support what the plan requires.
        """

    def load_views(self, views: Sequence[TrainingView], probes: Sequence[TrainingView]) -> None:
        """Loads the images of a frame; views that are already loaded are reused.

        Args:
            views: training views; ``iterate`` refers to them by index.
            probes: views for comparing states, of the same cameras; ``probe`` refers to them by index.
        """

    def load_state(self, previous: Gaussians) -> None:
        """Loads Θ_{t−1}, without motion or learnt colours."""

    def set_tables(self, tables: Tables) -> None:
        """Sets the parameters of the deformation."""

    def begin(self, start: AttemptStart) -> None:
        """Starts the iterations of an attempt, with zero moments and an empty log."""

    def iterate(self, views: Sequence[int], step: StepScalars) -> None:
        """Runs one iteration: deform, render, compare, backward, step.

        Args:
            views: indices of the views; the image and mask losses are their mean.
        """

    def leave_out(self, views: Sequence[int]) -> None:
        """Excludes views, by index, from the rest of the attempt; their cameras' gains stay unchanged."""

    def wait(self, iteration: int) -> None:
        """Waits until the device is close to an iteration, so that the host's clock measures its work."""

    def probe(self, which: Sequence[int], *, moved: bool, learnt: bool) -> list[float]:
        """Returns the image losses of a state on some of the probe views.

        Args:
            which: indices of the views. moved: whether Θ_{t−1} is deformed by the tables.
            learnt: whether to use the learnt colours, gloss and environment instead of those of Θ_{t−1}.
        """

    def tables(self) -> Tables:
        """Returns the current parameters of the deformation."""

    def log(self) -> IterationLog:
        """Returns the log of the iterations so far."""

    def state(self, learnt: bool) -> Gaussians:
        """Returns Θ_{t−1} deformed by the tables, with accumulated material rotations.

        Args:
            learnt: whether to use the learnt colours, gloss and environment instead of those of Θ_{t−1}.
        """

    def gradients(self) -> dict[str, Array]:
        """Returns the gradients of the last iteration's loss, for tests, before anything else is rendered.

        Keys are "cluster 0" … [K, 10] and "deltas" [M, 9], with the columns of ``Tables``; if they are learnt, also
        "colours" [N, 3], "gloss" [M, 3] and "environment".
        """

    def exposures(self) -> Mapping[str, Array]:
        """Returns the current [C, 2] gain and offset of each camera with views, by name."""

    def gains(self) -> Array:
        """Returns the [cameras, 3] gains, updated with the renderings since the last round."""
