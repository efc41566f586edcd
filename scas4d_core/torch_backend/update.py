"""Update of one frame in plain torch: the CUDA path, and the twin of the fused loop on the CPU.

Θ_{t−1} and the pictures of frame t in, Θ_t out. The loop is the paper's: cascade, render one training view, image
loss and neighbour terms, backward, Adam. Not yet run on a GPU.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scas4d_core.gaussians import Gaussians
from scas4d_core.rasterize import cuda, twin
from scas4d_core.rasterize.limits import DEFAULT, GSPLAT, Limits
from scas4d_core.rasterize.twin import CameraParams, Rendered
from scas4d_core.torch_backend import losses
from scas4d_core.torch_backend.arrays import ClusterArrays, DeltaArrays, Graph, TermWeights, TorchResult, TorchView
from scas4d_core.torch_backend.deformation import (
    ClusterMap,
    ClusterParams,
    Covariance,
    Deformed,
    Deltas,
    Layer,
    deform,
    material_rotations,
)
from scas4d_core.update.rates import Rates
from scas4d_core.update.schedule import Stopping

Floats: TypeAlias = NDArray[np.floating[Any]]
Render: TypeAlias = Callable[[Tensor, Tensor, Tensor, Tensor, CameraParams, Tensor, Limits], Rendered]

ADAM_EPSILON = 1e-15
"""As in 3D Gaussian Splatting: steps keep the size of the rate however small the gradients are."""

TIMED_EVERY = 10
"""Iterations after which an update by the clock waits for the device."""


@dataclass(frozen=True, eq=False)
class TorchUpdate:
    """The update of one scene: what stays the same from frame to frame.

    Attributes:
        moving: [M] int64 rows of the Gaussians that the cascade moves; of the others only the colour is free.
        labels: [M] int64 per layer, coarse to fine; none leaves every Gaussian to itself.
        graph: neighbours among the moving.
        first_lengths: [M, 3] metres, lengths of the moving Gaussians' axes at frame 0.
        rates, weights: of the parameters and of the terms.
        max_scale: metres; longer axes are held at their length of frame 0.
        background: RGB behind everything.
        cluster_map: form of equation (6). covariance: what moves a Gaussian's, see ``deformation.Covariance``.
        terms: of the parts of effects (``effects.parts.Part.twin``), from the moving means [M, 3].
        near: metres; nothing nearer to a camera is drawn.
        device: "cpu" rasterizes with the twin, "cuda" with gsplat.
        dtype: torch.float32, or torch.float64 on the CPU.
    """

    moving: NDArray[np.int64]
    labels: Sequence[NDArray[np.int64]]
    graph: Graph
    first_lengths: Floats
    rates: Rates
    weights: TermWeights = field(default_factory=TermWeights)
    max_scale: float = 0.02
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    cluster_map: ClusterMap = "centred"
    covariance: Covariance = "entangled"
    terms: tuple[Callable[[Tensor], Tensor | None], ...] = ()
    near: float = DEFAULT.near
    device: str = "cpu"
    dtype: torch.dtype = torch.float32

    def __post_init__(self) -> None:
        found, wanted = len(self.rates.layers), len(self.labels)
        if found != wanted:
            raise ValueError(f"rates.layers has {found} entries for {wanted} layers of labels; give one a layer")
        if self.on_cuda and self.dtype != torch.float32:
            raise ValueError(f"dtype {self.dtype} on device {self.device!r}: gsplat knows torch.float32 only")

    @property
    def on_cuda(self) -> bool:
        """True where gsplat rasterizes."""
        return torch.device(self.device).type == "cuda"

    def run(
        self,
        gaussians: Gaussians,
        views: Sequence[TorchView],
        order: Sequence[int | Sequence[int]],
        *,
        start: Sequence[ClusterArrays] | None = None,
        deltas: DeltaArrays | None = None,
        rows: Sequence[NDArray[np.int64]] | None = None,
        on_iteration: Callable[[int], None] | None = None,
        stopping: Stopping | None = None,
        look: Callable[[Gaussians], float] | None = None,
    ) -> TorchResult:
        """Find the deformation from Θ_{t−1} to the pictures of frame t.

        Args:
            gaussians: Θ_{t−1}.
            views: training views of frame t.
            order: index of the view of each iteration, or of its views, whose mean counts; its length is the number of
                iterations.
            start: cluster parameters to start from (warm start), coarse to fine; None: the identity.
            deltas: per-Gaussian parameters to start from; None: the identity.
            rows: per iteration the rows among the moving whose neighbours are looked at; None: all.
            on_iteration: called with the number of iterations done.
            stopping: decides how many of the order's are taken; None: all.
            look: the error of a state, for a stopping rule that looks at it.

        Raises:
            IndexError: the order names a view that is not there.
        """
        scene = _Scene.of(self, gaussians, views, start, deltas)
        optimizer = torch.optim.Adam(
            scene.parameter_groups(self.rates), betas=(self.rates.beta1, self.rates.beta2), eps=ADAM_EPSILON
        )
        base = [(group["lr"], group["learns"]) for group in optimizer.param_groups]
        history: list[tuple[Tensor, Tensor]] = []
        for iteration, view in enumerate(order):
            if self.on_cuda and stopping is not None and stopping.end is not None and iteration % TIMED_EVERY == 0:
                torch.cuda.synchronize()  # the host runs ahead: its clock would not see the device's work
            planned = len(order) if stopping is None else stopping.planned(iteration)
            if iteration >= planned:
                break
            for group, (rate, learns) in zip(optimizer.param_groups, base, strict=True):
                group["lr"] = rate * self.rates.factor(iteration, planned, *learns)
            sampled = None if rows is None else torch.as_tensor(rows[iteration], dtype=torch.int64, device=self.device)
            optimizer.zero_grad(set_to_none=True)
            loss = scene.loss(view, sampled)
            loss.backward()  # type: ignore[no-untyped-call]
            for group in optimizer.param_groups:
                if group["lr"] == 0:  # not begun: its moments stay those of no step; or it rests
                    for tensor in group["params"]:
                        tensor.grad = None
            optimizer.step()
            history.append((loss.detach(), scene.psnr))
            if on_iteration is not None:
                on_iteration(iteration + 1)
            if stopping is not None and look is not None and stopping.looks(iteration + 1):
                stopping.saw(iteration + 1, look(scene.result(gaussians, [], []).gaussians))
        # The losses stay on the device until here: reading each would make the host wait for it.
        found = torch.stack([loss for loss, _ in history]).tolist() if history else []
        psnr = torch.cat([psnr for _, psnr in history]).tolist() if history else []
        return scene.result(gaussians, found, psnr)


@dataclass(eq=False)
class _Scene:
    """The tensors of one update on their device."""

    update: TorchUpdate
    means: Tensor
    factors: Tensor
    rotations: Tensor
    opacities: Tensor
    previous_colours: Tensor
    foreground: Tensor
    free_colours: tuple[Tensor, Tensor]
    moving: Tensor
    standing: Tensor
    layers: list[Layer]
    deltas: Deltas
    neighbours: Tensor
    pair_weights: Tensor
    distances: Tensor
    first_lengths: Tensor
    views: list[tuple[CameraParams, Tensor, Tensor | None, Tensor | None]]
    psnr: Tensor = field(default_factory=lambda: torch.zeros(0))

    @classmethod
    def of(
        cls,
        update: TorchUpdate,
        gaussians: Gaussians,
        views: Sequence[TorchView],
        start: Sequence[ClusterArrays] | None,
        deltas: DeltaArrays | None,
    ) -> _Scene:
        """Everything copied to the device in the update's dtype."""

        def floats(array: Floats) -> Tensor:
            return torch.tensor(np.asarray(array), dtype=update.dtype, device=update.device)

        def integers(array: NDArray[np.int64]) -> Tensor:
            return torch.tensor(np.asarray(array), dtype=torch.int64, device=update.device)

        layers = []
        for index, labels in enumerate(update.labels):
            if start is None:
                params = ClusterParams.identity(int(labels.max(initial=-1)) + 1, update.dtype, update.device)
            else:
                params = ClusterParams(*(floats(array) for array in start[index]))
            layers.append(Layer(integers(labels), params))
        if deltas is None:
            own = Deltas.identity(len(update.moving), update.dtype, update.device)
        else:
            own = Deltas(*(floats(array) for array in deltas))
        seen = [
            (
                CameraParams.of(view.camera, update.dtype, update.device),
                floats(view.image),
                None if view.mask is None else floats(view.mask)[..., None],
                None if view.exposure is None else floats(view.exposure),
            )
            for view in views
        ]
        colours = floats(gaussians.colours)
        standing = np.setdiff1d(np.arange(len(gaussians)), update.moving)
        graph = update.graph
        return cls(
            update=update,
            means=floats(gaussians.means),
            factors=floats(gaussians.factors),
            rotations=floats(gaussians.rotations),
            opacities=floats(gaussians.opacities),
            previous_colours=colours,
            foreground=floats(gaussians.foreground),
            free_colours=(colours[integers(update.moving)], colours[integers(standing)]),
            moving=integers(update.moving),
            standing=integers(standing),
            layers=layers,
            deltas=own,
            neighbours=integers(graph.neighbours),
            pair_weights=floats(graph.weights),
            distances=floats(graph.distances),
            first_lengths=floats(update.first_lengths),
            views=seen,
        )

    @property
    def colours(self) -> Tensor:
        """[N, 3] RGB now: of what moves and of what stands, which learn at rates of their own."""
        moving, standing = self.free_colours
        return self.previous_colours.index_copy(0, self.moving, moving).index_copy(0, self.standing, standing)

    def parameter_groups(self, rates: Rates) -> list[dict[str, Any]]:
        """Adam's groups of parameters; those of rate 0 are left out and need no gradient."""
        groups: list[tuple[float, tuple[float, float], list[Tensor]]] = []
        for k, ((_, params), (rotation, translation, scaling)) in enumerate(
            zip(self.layers, rates.layers, strict=True)
        ):
            learns = rates.start_of(k), rates.rest_of(k)
            groups += [
                (rotation, learns, [params.r]),
                (translation, learns, [params.t]),
                (scaling, learns, [params.c, params.s]),
            ]
        own, whole = (rates.start, 1.0), (0.0, 1.0)
        groups += [
            (rates.position, own, [self.deltas.dp]),
            (rates.rotation, own, [self.deltas.dr]),
            (rates.scale, own, [self.deltas.ds]),
            (rates.colour, whole, [self.free_colours[0]]),
            (rates.colour_standing, whole, [self.free_colours[1]]),
        ]
        learnt = [(rate, learns, tensors) for rate, learns, tensors in groups if rate > 0]
        for _, _, tensors in learnt:
            for tensor in tensors:
                tensor.requires_grad_(True)
        return [{"params": tensors, "lr": rate, "learns": learns} for rate, learns, tensors in learnt]

    def deformed(self) -> Deformed:
        """The moving Gaussians under the present parameters."""
        means, factors = self.means[self.moving], self.factors[self.moving]
        return deform(means, factors, self.layers, self.deltas, self.update.cluster_map, self.update.covariance)

    def loss(self, views: int | Sequence[int], rows: Tensor | None) -> Tensor:
        """The weighted sum of the terms, those of pictures the mean over the views; leaves the views' ``psnr``."""
        numbers = [views] if isinstance(views, int) else list(views)
        now = self.deformed()
        seen = [self._picture_terms(number, now) for number in numbers]
        self.psnr = torch.stack([psnr for _, psnr in seen])
        terms = [term / len(numbers) for terms_of_view, _ in seen for term in terms_of_view]
        weights = self.update.weights
        if weights.soft_colour > 0:
            terms.append(weights.soft_colour * losses.soft_colour_loss(self.colours, self.previous_colours))
        if len(self.moving):
            terms += self._motion_terms(now, rows)
        return torch.stack(terms).sum()

    def _picture_terms(self, view: int, now: Deformed) -> tuple[list[Tensor], Tensor]:
        """The weighted terms of one view's pictures, and its PSNR."""
        camera, image, mask, exposure = self.views[view]
        features, background = self.colours, [*self.update.background]
        if mask is not None and self.update.weights.mask > 0:
            features = torch.cat([features, self.foreground[:, None]], dim=1)
            background.append(0.0)
        render: Render = cuda.render if self.update.on_cuda else twin.render
        picture = render(
            self.means.index_copy(0, self.moving, now.means),
            self.factors.index_copy(0, self.moving, now.factors),
            self.opacities,
            features,
            camera,
            image.new_tensor(background),
            (GSPLAT if self.update.on_cuda else DEFAULT)._replace(near=self.update.near),
        ).features
        weights, colour = self.update.weights, picture[..., :3]
        if exposure is not None:
            colour = colour * exposure[:, 0] + exposure[:, 1]
        terms = [weights.image * losses.image_loss(colour, image)]
        if mask is not None and weights.mask > 0:
            terms.append(weights.mask * losses.image_loss(picture[..., 3:], mask))
        return terms, losses.psnr(colour.detach(), image)

    def _motion_terms(self, now: Deformed, rows: Tensor | None) -> list[Tensor]:
        """The weighted terms over the moving Gaussians."""
        weights, graph = self.update.weights, (self.neighbours, self.pair_weights)
        terms = []
        if weights.rigidity > 0:
            previous = self.means[self.moving]
            terms.append(weights.rigidity * losses.rigidity_loss(now.means, now.turns, previous, *graph, rows))
        if weights.isometry > 0:
            terms.append(weights.isometry * losses.isometry_loss(now.means, self.distances, *graph, rows))
        if weights.rotation > 0:
            terms.append(weights.rotation * losses.rotation_loss(now.turns, *graph, rows))
        if weights.scale > 0:
            terms.append(weights.scale * losses.scale_loss(now.factors, self.first_lengths, self.update.max_scale))
        found = (term(now.means) for term in self.update.terms)
        return [*terms, *(term for term in found if term is not None)]

    @torch.no_grad()
    def result(self, gaussians: Gaussians, history: list[float], psnr: list[float]) -> TorchResult:
        """Θ_t and the parameters, as numpy."""

        def array(tensor: Tensor) -> NDArray[np.float32]:
            result: NDArray[np.float32] = tensor.detach().to("cpu", torch.float32).numpy()
            return result

        now = self.deformed()
        turned = material_rotations(now.turns, self.rotations[self.moving])
        state = gaussians.replace(
            means=array(self.means.index_copy(0, self.moving, now.means)),
            factors=array(self.factors.index_copy(0, self.moving, now.factors)),
            rotations=array(self.rotations.index_copy(0, self.moving, turned)),
            colours=array(self.colours),
        )
        layers = [ClusterArrays(*(array(tensor) for tensor in layer.params)) for layer in self.layers]
        own = DeltaArrays(*(array(tensor) for tensor in self.deltas))
        return TorchResult(state, array(now.turns), layers, own, history, psnr)
