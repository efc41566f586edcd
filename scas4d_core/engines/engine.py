"""The interface between the loop of an update and the device that computes it, and the values that cross it.

The loop (``update.frame_update``) decides; an engine computes. The calls of one attempt at a frame, in order::

    engine.bind(plan, structure)            # once for a hierarchy: allocate, compile, capture graphs
    engine.load_views(views, probes)        # pictures of the frame
    engine.load_state(previous)             # Θ_{t−1}, no motion
    engine.set_tables(tables)               # the start: no motion, or that of the frame before
    engine.probe(...)                       # image losses of the candidates on a few views
    engine.begin(start)                     # fresh moments
    engine.iterate(views, step)             # deform, render, compare, backward, Adam: once an iteration
    engine.log(), engine.leave_out(views)   # at the gate, once each camera was rendered
    engine.probe(...)                       # where a stopping rule looks, and at the end
    engine.state(learnt=True)               # Θ_t

Only ``probe``, ``log``, ``tables``, ``state``, ``exposures`` and ``gains`` make the host wait for the device: about ten
calls a frame, none in an iteration.
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
"""Stage of the time that an update spends on its own report: timers, colour shifts, writing and publishing it."""
KEPT_PICTURES = 8
"""Views of the last iterations whose renderings the log keeps: evidence for effects is taken from them."""
KEPT_ROWS = 128
"""Rows of a kept rendering, about: of larger pictures every so many rows and columns are kept."""


class EngineError(ValueError):
    """An engine cannot do what a plan asks for.

    ``UpdateEngine.bind`` and ``FitEngine.load_table`` raise it; nothing later does.

    Args:
        engine: name of the engine. asked: what it cannot do, one item a field of the plan.

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
        """No motion."""
        clusters = [np.zeros((count, 10), np.float32) for count in hierarchy.sizes]
        return cls(clusters, np.zeros((len(hierarchy.rows), 9), np.float32))

    def copy(self) -> Tables:
        """The same parameters in arrays of their own."""
        return Tables([values.copy() for values in self.clusters], self.deltas.copy())


@dataclass(frozen=True, eq=False)
class AttemptStart:
    """What stays the same through the iterations of one attempt. A parameter whose rate is 0 is not stepped.

    Attributes:
        layers: Adam's rates (r, t in metres, c and s) of each layer, coarse to fine.
        position, rotation, scale: rates of Δp (metres), ΔR, Δs.
        colour, static_colour: rates of RGB of moving and of static Gaussians.
        beta1, beta2: Adam's decays.
        samples: of entries of the hierarchy's order, [S] int64 each; ``StepScalars.sample`` picks one.
        gains: [cameras, 3] the gains that the cameras start with, in the plan's order; None: not followed.
        curve: whether terms that only the reported loss needs are computed; the state is the same without.
        lap: called with the name of a stage when it is done, on engines that wait for each stage.
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
    """What changes from iteration to iteration: a few numbers.

    Attributes:
        frozen: number of layers, from the coarsest, that do not learn any more.
        layers: factor on the rates of each layer in this iteration; 0: it is not stepped.
        own: factor on the rates of Δp, ΔR, Δs. colour: factor on those of the colours. gloss: on those of the gloss.
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
    """A rendering of which every so many rows and columns are kept.

    Attributes:
        every: so many. planes: [5, h, w] float32, RGB before the camera's exposure, label, transmittance left.
    """

    every: int
    planes: Array

    @classmethod
    def of(cls, features: Array, transmittance: Array) -> Thinned:
        """Of a rendering: features [4, H, W] and transmittance left [H, W]."""
        every = max(1, min(transmittance.shape) // KEPT_ROWS)
        return cls(every, np.concatenate([features[:, ::every, ::every], transmittance[None, ::every, ::every]]))


class ViewRecord(NamedTuple):
    """One rendering of a training view, as the log has it.

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
        losses: weighted sum of the terms of each iteration. rendered: each rendering, in order.
        pictures: the last renderings that were kept, by index of the view, oldest first.
        guards: the guards that acted, and how often (``guards.GUARDS``).
    """

    losses: list[float] = field(default_factory=list)
    rendered: list[ViewRecord] = field(default_factory=list)
    pictures: dict[int, Thinned] = field(default_factory=dict)
    guards: dict[str, int] = field(default_factory=dict)

    def keep(self, view: int, picture: Thinned) -> None:
        """Keep a rendering, and of earlier ones the newest ``KEPT_PICTURES``."""
        self.pictures.pop(view, None)
        self.pictures[view] = picture
        for old in list(self.pictures)[:-KEPT_PICTURES]:
            del self.pictures[old]


class UpdateEngine(Protocol):
    """Computes the updates of one scene on one device, and owns the memory that they take.

    Attributes:
        name: of the engine, as messages name it.
    """

    name: str

    @property
    def renderer(self) -> Renderer:
        """Draws states with the background and limits of the plan."""

    def bind(self, plan: UpdatePlan, structure: Structure) -> None:
        """Prepare for the updates of a plan: allocate, compile.

        Raises:
            EngineError: the engine cannot do what the plan asks for.
        """

    def load_views(self, views: Sequence[TrainingView], probes: Sequence[TrainingView]) -> None:
        """Take the pictures of a frame; views that it already has are not taken again.

        Args:
            views: training views; ``iterate`` names them by index.
            probes: views on which states are compared, of cameras of ``views``; ``probe`` names them by index.
        """

    def load_state(self, previous: Gaussians) -> None:
        """Take Θ_{t−1}, from which an attempt starts; no motion, nothing learnt."""

    def set_tables(self, tables: Tables) -> None:
        """Set the parameters of the deformation."""

    def begin(self, start: AttemptStart) -> None:
        """Begin the iterations of an attempt, with moments of zero and an empty log."""

    def iterate(self, views: Sequence[int], step: StepScalars) -> None:
        """One iteration: deform, render, compare, carry back, step.

        Args:
            views: of the iteration, by index; the image and mask losses are the mean over them.
        """

    def leave_out(self, views: Sequence[int]) -> None:
        """Views, by index, that have no turn any more in this attempt: their cameras' gains stay."""

    def wait(self, iteration: int) -> None:
        """Wait until the device is near an iteration, so that the host's clock measures its work."""

    def probe(self, which: Sequence[int], *, moved: bool, learnt: bool) -> list[float]:
        """The image loss of a state in some of the probe views.

        Args:
            which: indices of the views. moved: Θ_{t−1} deformed by the tables, else as it is.
            learnt: with the colours, gloss and environment learnt so far, else those of Θ_{t−1}.
        """

    def tables(self) -> Tables:
        """The parameters of the deformation as they are now."""

    def log(self) -> IterationLog:
        """The log of the iterations so far."""

    def state(self, learnt: bool) -> Gaussians:
        """Θ_{t−1} deformed by the tables, with material rotations (house rule: turns accumulate).

        Args:
            learnt: with the colours, gloss and environment learnt so far, else those of Θ_{t−1}.
        """

    def gradients(self) -> dict[str, Array]:
        """Gradients of the last iteration's loss, before its step: for tests, before anything else is rendered.

        By table: "cluster 0" and so on [K, 10] and "deltas" [M, 9] in the columns of ``Tables``; where they are learnt,
        "colours" [N, 3], "gloss" [M, 3] and "environment".
        """

    def exposures(self) -> Mapping[str, Array]:
        """[C, 2] gain and offset of each camera that has views, by name, as they are now."""

    def gains(self) -> Array:
        """[cameras, 3] the gains of the cameras, with what the renderings since the last round say."""
