"""The parts that effects put into an update, and the hooks at which the loop calls them.

The loop of an update (``update.frame_update``) calls hooks and knows no effect. A hook that no part of the scene
overrides costs nothing: it is not called.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from scas4d_core.effects.freedom import Freedom
from scas4d_core.frame_outcome import Candidate
from scas4d_core.gaussians import Gaussians
from scas4d_core.guards import GuardCounts

if TYPE_CHECKING:
    from torch import Tensor

    from scas4d_core.rasterize.cpu import Gradients
    from scas4d_core.settings import SceneSettings, UpdateSettings
    from scas4d_core.structure.hierarchy import Hierarchy
    from scas4d_core.update.deformation import CpuDeformation
    from scas4d_core.update.picture_loss import PictureLoss, ViewFactory
    from scas4d_core.update.rates import Rates
    from scas4d_core.update.training_view import TrainingView

Array = NDArray[np.float32]
Arrays = dict[str, NDArray[Any]]
NOTHING: Mapping[str, Arrays] = MappingProxyType({})
"""Arrays of no effect."""

P = TypeVar("P", bound="Part")


class Work:
    """The arrays that one attempt at a frame works on, shared by the loop and the parts.

    Attributes:
        previous: Θ_{t−1}. deformation: has taken it. rates: of this attempt. views: that it learns from.
        picture: renders them.
        colours: [N, 3] RGB now. gloss, environment: now, where a part learns them; else those of Θ_{t−1}.
        features: [N, 4] as they are rendered, RGB and label.
        sample: entries of the hierarchy's order whose neighbours this iteration looks at.
        gradients: of the pictures of the iteration; parts add to them. carried: arrays that the part left at the frame
            before, by effect; replaced by those for the frame after.
        tells: whether figures that the report alone needs are worked out. kept: the candidate that becomes Θ_t; known
            at the end.
    """

    sample: NDArray[np.int64]
    gradients: Gradients
    tells = True
    kept = Candidate.END

    def __init__(
        self,
        previous: Gaussians,
        deformation: CpuDeformation,
        rates: Rates,
        views: list[TrainingView],
        picture: PictureLoss,
        carried: dict[str, Arrays],
    ) -> None:
        self.previous, self.deformation, self.rates, self.views = previous, deformation, rates, views
        self.picture, self.carried = picture, carried
        self.colours = previous.colours.copy()
        self.gloss, self.environment = previous.gloss, previous.environment
        self.features = previous.features(previous.colours)

    @property
    def look(self) -> Gaussians:
        """Θ_{t−1}, unmoved, with what has been learnt of its looks so far."""
        return self.previous.replace(colours=self.colours, gloss=self.gloss, environment=self.environment)


class Part:
    """The work of one effect in the updates of a scene. Each hook does nothing unless a part overrides it.

    A part that several effects share is made with the builder alone (``PartsBuilder.shared``).

    Attributes:
        guards: how often each guard acted in the attempt; None: it has none.
        known_to_devices: whether the update of a torch device does its work in another way. Of other parts it calls
            ``start``, ``end`` and ``twin`` alone: effects that need more are refused there (``switches.refusal``).
    """

    guards: GuardCounts | None = None
    known_to_devices = False

    def start(self, work: Work) -> None:
        """Called before the first iteration of an attempt."""

    def show(self, work: Work, view: TrainingView) -> None:
        """Called before a view is rendered: may change ``work.features``, and the view's exposure (``exposes``)."""

    def saw(self, work: Work, view: TrainingView, picture: PictureLoss, gradients: Gradients) -> None:
        """Called with the gradients of a view: reads its own, and turns those of features into those of colours."""

    def loss(self, work: Work) -> float:
        """Adds the gradient of a term to ``work.gradients``, and returns the term, weighted."""
        return 0.0

    def step(self, work: Work, iteration: int, planned: int) -> None:
        """Steps its parameters."""

    def end(self, work: Work, state: Gaussians) -> Gaussians:
        """Called with Θ_t once it is chosen, and leaves ``work.carried`` for the frame after. Returns Θ_t."""
        return state

    def twin(self, means: Tensor) -> Tensor | None:
        """The term of ``loss`` in torch, from the moving Gaussians' means [M, 3]; None: it has none."""
        return None


def not_on_devices(kind: type[Part]) -> list[str]:
    """The hooks of a part that the update of a torch device would have to call, and does not.

    >>> class Glow(Part):
    ...     def loss(self, work):
    ...         return 0.5
    >>> not_on_devices(Glow)
    ['loss']
    """
    if kind.known_to_devices:
        return []
    asked = ("show", "saw", "step") if kind.twin is not Part.twin else ("show", "saw", "loss", "step")
    return [hook for hook in asked if getattr(kind, hook) is not getattr(Part, hook)]


@dataclass(eq=False)
class PartsBuilder:
    """Collects the parts of the effects that are on, for the updates of one scene.

    Attributes:
        scene, update: the settings, the floor inside. factory: of the scene's views. hierarchy: of the moving.
        first: the roots, Θ_0 with all born since (``preparation``). whole: whether a part needs whole pictures: it
            changes what stands, or how a camera sees it. exposes: whether a part changes the exposures of views.
        follows: whether a part learns from a frame what the state before shows well enough: it never stands then.
        length: weight of the limit of the axes' lengths, which the cascade's kernel has in itself.
        mask: weight of the term of masks, which the comparison of pictures has in itself. learns_labels: whether what
            moves is learnt from motion where no masks are given.
        freedom: the parameters of the deformation that are free.
        parts: of the effects that have joined, in order.
    """

    scene: SceneSettings
    update: UpdateSettings
    factory: ViewFactory
    hierarchy: Hierarchy
    first: Gaussians
    whole: bool = False
    exposes: bool = False
    follows: bool = False
    length: float = 0.0
    mask: float = 0.0
    learns_labels: bool = False
    freedom: Freedom = field(default_factory=Freedom)
    parts: list[Part] = field(default_factory=list)

    def shared(self, kind: type[P]) -> P:
        """The part of a kind that several effects share; made with the first of them.

        Args:
            kind: its class; it is made with this builder as the only argument.
        """
        found = self.find(kind)
        if found is None:
            found = kind(self)  # type: ignore[call-arg]
            self.parts.append(found)
        return found

    def find(self, kind: type[P]) -> P | None:
        """The part of a kind, if there is one."""
        return next((part for part in self.parts if isinstance(part, kind)), None)


class Hooks:
    """The parts of a scene by hook, without those that do nothing there.

    >>> class Glow(Part):
    ...     def loss(self, work):
    ...         return 0.5
    >>> hooks = Hooks([Glow()])
    >>> len(hooks.loss), len(hooks.step)
    (1, 0)
    """

    def __init__(self, parts: Iterable[Part]) -> None:
        self.parts = list(parts)
        self.start: list[Callable[[Work], None]] = self._at("start")
        self.show: list[Callable[[Work, TrainingView], None]] = self._at("show")
        self.saw: list[Callable[[Work, TrainingView, PictureLoss, Gradients], None]] = self._at("saw")
        self.loss: list[Callable[[Work], float]] = self._at("loss")
        self.step: list[Callable[[Work, int, int], None]] = self._at("step")
        self.end: list[Callable[[Work, Gaussians], Gaussians]] = self._at("end")

    def _at(self, hook: str) -> list[Any]:
        return [getattr(part, hook) for part in self.parts if getattr(type(part), hook) is not getattr(Part, hook)]

    @property
    def guards(self) -> list[GuardCounts]:
        """The counts of those that have guards."""
        return [part.guards for part in self.parts if part.guards is not None]
