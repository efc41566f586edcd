"""Interface between the update loop and the engine that runs it, with the data they exchange.

The loop (``update.frame_update``) makes the decisions, and the engine does the computation. One attempt to update a
frame makes these calls, in order::

    engine.bind(plan, structure)            # once per hierarchy: allocate, compile, capture graphs
    engine.load_views(views, probes)        # images of the frame
    engine.load_state(previous)             # Θ_{t−1} without motion
    engine.set_tables(tables)               # initial motion: none, or the motion of the previous frame
    engine.probe(...)                       # image losses of the candidate states on a few views
    engine.begin(start)                     # reset the Adam moments to zero
    engine.iterate(views, step)             # once per iteration: deform, render, compare, backward, Adam
    engine.log(), engine.leave_out(views)   # once all cameras have been rendered: exclude outlier cameras
    engine.probe(...)                       # for the stopping criterion, and at the end
    engine.log()                            # losses, kept renderings and guards; read with the last probe
    engine.state(learnt=True)               # Θ_t

Results are read by ``probe``, ``log``, ``tables``, ``state``, ``exposures`` and ``gains``, never during an iteration.
``wait`` only limits how far the host runs ahead of the device.
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

GAINS_MISSING = "begin was called without gains; enable UpdatePlan.camera_gains to estimate them"
"""Error message of ``UpdateEngine.gains`` if gains are not estimated."""
REPORT = "report"
"""Name of the stage in which an update compiles its report. This stage covers timings, colour shifts, I/O and
publishing."""
KEPT_PICTURES = 8
"""Maximum number of views with a rendering in the log. Effects evaluate these renderings."""
KEPT_ROWS = 128
"""Approximate length in pixels of the shorter side of a rendering in the log. Larger renderings are subsampled."""


class EngineError(ValueError):
    """Raised if an engine does not support a feature that a plan or a fit requires.

    Only ``UpdateEngine.bind`` and ``FitEngine.load_table`` raise this error.

    Args:
        engine: name of the engine.
        asked: names of the unsupported features.

    >>> print(EngineError("torch", ["gloss"]))
    engine torch does not support: gloss; disable the effect or choose another device
    """

    def __init__(self, engine: str, asked: Sequence[str]) -> None:
        super().__init__(
            f"engine {engine} does not support: {', '.join(asked)}; disable the effect or choose another device"
        )
        self.engine, self.asked = engine, tuple(asked)


@dataclass(eq=False)
class Tables:
    """Deformation parameters in host memory. If all values are zero, nothing moves.

    Attributes:
        clusters: [K, 10] float32 table per layer, coarse to fine, with columns r, t, c, s of equation (6).
        deltas: [M, 9] float32 table with columns Δp, ΔR, Δs of equation (7).
    """

    clusters: list[Array]
    deltas: Array

    @classmethod
    def identity(cls, hierarchy: Hierarchy) -> Tables:
        """Returns all-zero tables, which represent no motion."""
        clusters = [np.zeros((count, 10), np.float32) for count in hierarchy.sizes]
        return cls(clusters, np.zeros((len(hierarchy.rows), 9), np.float32))

    def copy(self) -> Tables:
        """Returns a deep copy."""
        return Tables([values.copy() for values in self.clusters], self.deltas.copy())


@dataclass(frozen=True, eq=False)
class AttemptStart:
    """Optimizer settings that stay constant during one attempt. A parameter with learning rate 0 is not updated.

    Attributes:
        layers: Adam learning rates of each layer (r, t in metres, c and s), coarse to fine.
        position, rotation, scale: learning rates of Δp (metres), ΔR and Δs.
        colour, static_colour: learning rates of the RGB colours of moving and static Gaussians, respectively.
        beta1, beta2: Adam's decay rates.
        samples: samples of the moving Gaussians, each with [S] int64 indices in hierarchy order.
            ``StepScalars.sample`` selects one of them.
        gains: [cameras, 3] initial camera gains, in the plan's camera order, or None if gains are not estimated.
        lap: callback that receives the name of each stage when the stage ends. The stages depend on the engine.
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
    lap: Callable[[str], None] = lambda stage: None

    @property
    def cluster_columns(self) -> list[list[float]]:
        """Learning rates of the ten columns (r, t, c, s) of each layer's table."""
        return [[r] * 3 + [t] * 3 + [scaling] * 4 for r, t, scaling in self.layers]

    @property
    def delta_columns(self) -> list[float]:
        """Learning rates of the nine columns (Δp, Δr, Δs) of the deltas."""
        return [self.position] * 3 + [self.rotation] * 3 + [self.scale] * 3


@dataclass(frozen=True)
class StepScalars:
    """Scalars that may change from one iteration to the next.

    Attributes:
        frozen: number of frozen layers, counted from the coarsest.
        layers: learning rate factor of each layer. A layer with factor 0 is not updated.
        own: learning rate factor of Δp, ΔR and Δs.
        colour, gloss: learning rate factors of the colours and the gloss.
        smooth_gloss: whether to average the gloss updates over neighbours after this step.
        rigidity: weight of the rigidity loss in this iteration.
        sample: index of the sample in ``AttemptStart.samples`` for which the neighbour terms are evaluated.
        keep_pictures: whether to keep the renderings of this iteration in the log.
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


def kept_step(height: int, width: int) -> int:
    """Returns the subsampling factor for a rendering that is kept in the log.

    >>> kept_step(720, 1280)
    5
    """
    return max(1, min(height, width) // KEPT_ROWS)


class Thinned(NamedTuple):
    """A subsampled rendering.

    Attributes:
        every: subsampling factor along rows and columns.
        planes: [5, h, w] float32 channels: RGB before the camera's exposure, label, and remaining transmittance.
    """

    every: int
    planes: Array

    @classmethod
    def of(cls, features: Array, transmittance: Array) -> Thinned:
        """Subsamples a rendering, given its features [4, H, W] and remaining transmittance [H, W]."""
        every = kept_step(*transmittance.shape)
        return cls(every, np.concatenate([features[:, ::every, ::every], transmittance[None, ::every, ::every]]))


class ViewRecord(NamedTuple):
    """Log entry for one rendering of a training view.

    Attributes:
        view: index of the view.
        psnr: PSNR of the rendering, in dB.
        colour_shift: [3] mean of the training image minus mean of the rendering, RGB in [0, 1], with the camera's
            exposure applied.
    """

    view: int
    psnr: float
    colour_shift: tuple[float, float, float]


@dataclass(eq=False)
class IterationLog:
    """Log of all iterations since ``begin``.

    Attributes:
        losses: total weighted loss of each iteration.
        rendered: records of all renderings, in chronological order.
        pictures: maps view indices to their most recent subsampled renderings, oldest first.
        guards: maps the name of each guard (see ``guards.GUARDS``) to the number of times it was triggered.
    """

    losses: list[float] = field(default_factory=list)
    rendered: list[ViewRecord] = field(default_factory=list)
    pictures: dict[int, Thinned] = field(default_factory=dict)
    guards: dict[str, int] = field(default_factory=dict)

    def keep(self, view: int, picture: Thinned) -> None:
        """Adds a rendering and drops all but the ``KEPT_PICTURES`` most recent ones."""
        self.pictures.pop(view, None)
        self.pictures[view] = picture
        for old in list(self.pictures)[:-KEPT_PICTURES]:
            del self.pictures[old]


class Probe(NamedTuple):
    """Request to compare a state with probe views; see ``UpdateEngine.probe``.

    Attributes:
        views: indices of the probe views.
        moved: whether to deform Θ_{t−1} with the current tables.
        learnt: whether to use the learned colours, gloss and environment instead of those of Θ_{t−1}.
    """

    views: Sequence[int]
    moved: bool
    learnt: bool


class UpdateEngine(Protocol):
    """Interface of an engine that runs the updates of one scene on one device.

    Attributes:
        name: name of the engine, used in messages.
    """

    name: str

    @property
    def renderer(self) -> Renderer:
        """Renderer for states, with the background and limits of the plan."""

    def bind(self, plan: UpdatePlan, structure: Structure) -> None:
        """Allocates buffers and compiles kernels for a plan and a structure.

        Raises:
            EngineError: if the engine does not support a feature that the plan requires.
        """

    def load_views(self, views: Sequence[TrainingView], probes: Sequence[TrainingView]) -> None:
        """Loads the images of a frame. Views that are already loaded are reused.

        Args:
            views: training views. ``iterate`` refers to them by index.
            probes: views of the same cameras that are used to compare states. ``probe`` refers to them by index.
        """

    def load_state(self, previous: Gaussians) -> None:
        """Loads Θ_{t−1} and discards learned colours and gloss. The next call must be ``set_tables``."""

    def set_tables(self, tables: Tables) -> None:
        """Sets the parameters of the deformation. The arrays may become read-only."""

    def begin(self, start: AttemptStart) -> None:
        """Starts an attempt, with zero Adam moments and an empty log."""

    def iterate(self, views: Sequence[int], step: StepScalars) -> None:
        """Runs one iteration: deform, render, compare, backward, Adam step.

        Args:
            views: indices of the views to render. Image and mask losses are averaged over them.
            step: scalars of this iteration.
        """

    def leave_out(self, views: Sequence[int]) -> None:
        """Freezes the camera gains of the views with the given indices, which the attempt no longer renders."""

    def wait(self, iteration: int) -> None:
        """Waits until only a few iterations are pending, so that host timings reflect the work on the device."""

    def probe(self, *probes: Probe, state_next: bool = False) -> list[list[float]]:
        """Returns the image losses of each probe, one per view. A GPU engine waits once for all probes.

        Args:
            probes: one or more states to render, and the probe views to compare them with. In total, at most two
                renderings per loaded probe view.
            state_next: whether ``state(learnt=True)`` will be called next. A GPU engine then downloads the state with
                the losses.
        """

    def tables(self) -> Tables:
        """Returns the current deformation parameters."""

    def log(self) -> IterationLog:
        """Returns the log of the iterations so far."""

    def state(self, learnt: bool) -> Gaussians:
        """Returns Θ_{t−1} deformed by the current tables, with accumulated material rotations.

        Args:
            learnt: whether to use the learned colours, gloss and environment instead of those of Θ_{t−1}.
        """

    def gradients(self) -> dict[str, Array]:
        """Returns the gradients of the last iteration's loss, for tests. Call it before rendering anything else.

        The keys are "cluster 0" … [K, 10] and "deltas" [M, 9], with the columns of ``Tables``. "colours" [N, 3],
        "gloss" [M, 3] and "environment" are included if they are learned.
        """

    def exposures(self) -> Mapping[str, Array]:
        """Returns the current exposures ([C, 2] gain and offset) of all cameras with views, keyed by camera name."""

    def gains(self) -> Array:
        """Returns the camera gains [cameras, 3], including measurements since the last complete round.

        Raises:
            ValueError: if gains are not estimated.
        """
