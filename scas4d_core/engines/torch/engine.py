"""Reference engine for updates in PyTorch, which runs each iteration in the order given by algorithm 1."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from scas4d_core.engines.cpu.gloss import (
    NEIGHBOURS,
    SAME_SIDE,
    UPDATE_RATE_ENVIRONMENT,
    UPDATE_RATE_GLOSS,
    UPDATE_RATE_NEARNESS,
    gloss_rate,
)
from scas4d_core.engines.engine import (
    GAINS_MISSING,
    AttemptStart,
    IterationLog,
    Probe,
    StepScalars,
    Tables,
    Thinned,
    ViewRecord,
)
from scas4d_core.engines.gains import GainEstimator
from scas4d_core.engines.plan import MAX_SCALE, Structure, UpdatePlan
from scas4d_core.engines.torch import losses
from scas4d_core.engines.torch.gloss import cell_shares, no_turns
from scas4d_core.engines.torch.parameters import GlossParameters, Parameters, deformation_of, leaf
from scas4d_core.engines.torch.rasterizer import CameraParams, render
from scas4d_core.engines.torch.renderer import TorchRenderer
from scas4d_core.engines.torch.scene import Moved, Scene
from scas4d_core.engines.views import LABEL, TrainingView
from scas4d_core.gaussians import Gaussians
from scas4d_core.kernels.appearance.direction import CELLS, MIDDLE, NEARNESS

Array = NDArray[np.float32]


class TorchEngine:
    """The reference ``UpdateEngine`` for tests. It supports every effect and uses autograd in float64.

    Attributes:
        name: name of the engine, used in messages.
        renderer: renderer for states, with the plan's background and limits.
    """

    name = "torch"
    renderer: TorchRenderer

    def bind(self, plan: UpdatePlan, structure: Structure) -> None:
        """See ``UpdateEngine.bind``. This engine supports all plans."""
        self._plan, self._structure = plan, structure
        self.renderer = TorchRenderer(plan.background, plan.limits)
        self._camera_rows = {name: row for row, name in enumerate(plan.cameras)}
        self._views: list[TrainingView] = []
        self._probes: list[TrainingView] = []

    def load_views(self, views: Sequence[TrainingView], probes: Sequence[TrainingView]) -> None:
        """See ``UpdateEngine.load_views``."""
        exposures = {view.name: view.exposure.copy() for view in views}
        self._views = [replace(view, exposure=exposures[view.name]) for view in views]
        self._probes = [replace(view, exposure=exposures[view.name]) for view in probes]

    def load_state(self, previous: Gaussians) -> None:
        """See ``UpdateEngine.load_state``."""
        self._scene = scene = Scene(self._plan, self._structure, previous)
        moving, static = scene.colours[scene.rows].clone(), scene.colours[scene.static].clone()
        self._parameters = Parameters(*deformation_of(Tables.identity(self._structure.hierarchy)), moving, static)
        self._gains: GainEstimator | None = None
        self._smoothing: tuple[Tensor, Tensor] | None = None
        self._log, self._gradients = IterationLog(), dict[str, Array]()

    def set_tables(self, tables: Tables) -> None:
        """See ``UpdateEngine.set_tables``."""
        self._parameters.set_tables(tables)

    def begin(self, start: AttemptStart) -> None:
        """See ``UpdateEngine.begin``."""
        self._start, self._log, previous = start, IterationLog(), self._scene.previous
        if self._plan.gloss and previous.gloss is not None and previous.environment is not None:
            rate, environment = gloss_rate(UPDATE_RATE_GLOSS, previous.gloss), leaf(previous.environment)
            self._parameters.gloss = GlossParameters(
                leaf(previous.gloss), environment[:MIDDLE].clone(), environment[NEARNESS:].clone(),
                environment[MIDDLE:NEARNESS].clone(), (rate, UPDATE_RATE_ENVIRONMENT, UPDATE_RATE_NEARNESS),
            )  # fmt: skip
        if start.gains is not None:
            self._gains = GainEstimator(start.gains, self._camera_rows, self._views)
        self._parameters.free(start, self._plan.colours)

    def iterate(self, views: Sequence[int], step: StepScalars) -> None:
        """See ``UpdateEngine.iterate``."""
        for parameter in self._named().values():
            parameter.grad = None
        moved = self._scene.moved(self._parameters)
        colours = self._scene.all_colours(self._parameters)
        pictures = [self._picture(index, moved, colours, step) for index in views]
        loss = torch.stack(pictures).mean() + self._terms(moved, colours, step)
        loss.backward()  # type: ignore[no-untyped-call]
        self._gradients = {
            name: (torch.zeros_like(parameter) if parameter.grad is None else parameter.grad).numpy().copy()
            for name, parameter in self._named().items()
        }
        self._parameters.step(step)
        self._settle_gloss(step)
        self._log.losses.append(float(loss.detach()))

    def _picture(self, index: int, moved: Moved, colours: Tensor, step: StepScalars) -> Tensor:
        """Renders a view, logs the result, and returns the sum of the image and mask losses."""
        view, plan, learnt = self._views[index], self._plan, self._parameters.gloss
        gloss, environment = (None, None) if learnt is None else (learnt.gloss, learnt.environment)
        features = self._scene.seen(moved, colours, gloss, environment, view.camera)
        planes, alpha = self._rendered(view, moved, features)
        gain, offset = leaf(view.exposure[:3, 0]), leaf(view.exposure[:3, 1])
        shown, target = planes[..., :LABEL] * gain + offset, leaf(view.target).permute(1, 2, 0)
        loss = plan.image * losses.image_loss(shown, target[..., :LABEL])
        if plan.mask > 0 and len(view.target) > LABEL:
            loss = loss + plan.mask * losses.image_loss(planes[..., LABEL:], target[..., LABEL:])
        picture = planes.detach().permute(2, 0, 1).float().numpy()
        if self._gains is not None:
            self._gains.record_rendering(view, picture[:LABEL])
            gain, offset = leaf(view.exposure[:3, 0]), leaf(view.exposure[:3, 1])
        psnr = float(losses.psnr(shown.detach(), target[..., :LABEL]))
        mean = planes.detach()[..., :LABEL].mean(dim=(0, 1)) * gain + offset
        red, green, blue = (view.mean - mean.numpy()).tolist()
        self._log.rendered.append(ViewRecord(index, psnr, (red, green, blue)))
        if step.keep_pictures:
            self._log.keep(index, Thinned.of(picture, (1 - alpha.detach()).float().numpy()))
        return loss

    def _rendered(self, view: TrainingView, moved: Moved, features: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the rendering [H, W, 4] of a view before exposure, and its alpha [H, W]."""
        background = leaf([*self._plan.background, 0.0])
        camera = CameraParams.of_arrays(view.camera)
        given = (moved.means, moved.factors, self._scene.opacities, features, camera, background, self._plan.limits)
        picture = render(*given)
        return picture.features, picture.alpha

    def _terms(self, moved: Moved, colours: Tensor, step: StepScalars) -> Tensor:
        """Returns the weighted sum of all loss terms except the image and mask losses."""
        plan, scene = self._plan, self._scene
        sound = scene.rows[scene.sound]
        share = len(sound) / max(len(scene.rows), 1)  # losses are averaged over all moving Gaussians
        terms = [torch.zeros((), dtype=torch.float64)]
        if plan.neighbour_terms and self._structure.neighbours is not None and len(sound):
            terms += self._neighbour_terms(moved, step)
        if plan.axis_length > 0 and len(sound):
            lengths = scene.first_lengths[scene.sound]
            terms.append(plan.axis_length * share * losses.scale_loss(moved.factors[sound], lengths, MAX_SCALE))
        if plan.floor is not None and len(sound):
            terms.append(plan.floor_weight * share * losses.floor_loss(moved.means[sound], plan.floor))
        if plan.colours is not None:
            terms.append(plan.soft_colour * losses.soft_colour_loss(colours, scene.colours))
        return torch.stack(terms).sum()

    def _neighbour_terms(self, moved: Moved, step: StepScalars) -> list[Tensor]:
        plan, scene = self._plan, self._scene
        middle = scene.means[scene.rows[scene.sound]].mean(dim=0)  # replaces non-finite positions, which have weight 0
        now, before = (
            torch.where(scene.sound[:, None], means[scene.rows], middle) for means in (moved.means, scene.means)
        )
        graph = scene.neighbours, scene.pair_weights, torch.as_tensor(self._start.samples[step.sample])
        terms = []
        if step.rigidity > 0:
            terms.append(step.rigidity * losses.rigidity_loss(now, moved.turns, before, *graph))
        if plan.isometry > 0:
            terms.append(plan.isometry * losses.isometry_loss(now, scene.distances, *graph))
        if plan.rotation > 0:
            terms.append(plan.rotation * losses.rotation_loss(moved.turns, *graph))
        return terms

    @torch.no_grad()
    def _settle_gloss(self, step: StepScalars) -> None:
        """Makes the environment sum to zero, clamps its nearness to ≥ 0, and smooths the gloss if requested."""
        learnt = self._parameters.gloss
        if learnt is None:
            return
        cells = learnt.light[:CELLS]
        cells -= (cell_shares()[:, None] * cells).sum(dim=0)
        learnt.nearness.clamp_(min=0)
        if step.smooth_gloss:
            before = leaf(self._scene.previous.gloss)
            index, weights = self._neighbours_on_surface(learnt.gloss)
            learnt.gloss.copy_(before + (weights[..., None] * (learnt.gloss - before)[index]).sum(dim=1))

    def _neighbours_on_surface(self, gloss: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the frame-0 neighbours [M, k] and weights, which are equal on the same surface and 0 elsewhere."""
        if self._smoothing is None:
            count = len(gloss)
            roots = self._structure.roots[:count]
            index = torch.as_tensor(cKDTree(roots).query(roots, min(NEIGHBOURS, count))[1].reshape(count, -1))
            normals = gloss / gloss.norm(dim=1, keepdim=True).clamp(min=1e-9)
            alike = (torch.einsum("nkc,nc->nk", normals[index], normals) > SAME_SIDE).double()
            alike[:, 0] = 1
            self._smoothing = index, alike / alike.sum(dim=1, keepdim=True)
        return self._smoothing

    def leave_out(self, views: Sequence[int]) -> None:
        """See ``UpdateEngine.leave_out``."""
        if self._gains is not None:
            self._gains.leave_out([self._views[index] for index in views])

    def wait(self, iteration: int) -> None:
        """See ``UpdateEngine.wait``. Does nothing, because the host itself is the device."""

    @torch.no_grad()
    def probe(self, *probes: Probe, state_next: bool = False) -> list[list[float]]:
        """See ``UpdateEngine.probe``."""
        return [self._losses(probe) for probe in probes]

    def _losses(self, probe: Probe) -> list[float]:
        """Returns the image loss on each view of a probe."""
        scene, previous = self._scene, self._scene.previous
        still = Moved(scene.means, scene.factors, no_turns(len(scene.rows)))
        now = scene.moved(self._parameters) if probe.moved else still
        colours, looks = scene.colours, self._parameters.gloss
        gloss = None if previous.gloss is None else leaf(previous.gloss)
        environment = None if previous.environment is None else leaf(previous.environment)
        if probe.learnt:
            colours = scene.all_colours(self._parameters)
            gloss, environment = (gloss, environment) if looks is None else (looks.gloss, looks.environment)
        errors = []
        for index in probe.views:
            view = self._probes[index]
            features = scene.seen(now, colours, gloss, environment, view.camera)
            planes, _ = self._rendered(view, now, features)
            shown = planes[..., :LABEL] * leaf(view.exposure[:3, 0]) + leaf(view.exposure[:3, 1])
            target = leaf(view.target[:LABEL]).permute(1, 2, 0)
            errors.append(self._plan.image * float(losses.image_loss(shown, target)))
        return errors

    def tables(self) -> Tables:
        """See ``UpdateEngine.tables``."""
        return self._parameters.tables()

    def log(self) -> IterationLog:
        """See ``UpdateEngine.log``."""
        held = int((~self._scene.sound).sum())
        self._log.guards = {"held_back": held} if held else {}
        return self._log

    @torch.no_grad()
    def state(self, learnt: bool) -> Gaussians:
        """See ``UpdateEngine.state``."""
        return self._scene.state(self._scene.moved(self._parameters), self._parameters if learnt else None)

    def exposures(self) -> Mapping[str, Array]:
        """See ``UpdateEngine.exposures``."""
        return {view.name: view.exposure.copy() for view in self._views}

    def gains(self) -> Array:
        """See ``UpdateEngine.gains``."""
        if self._gains is None:
            raise ValueError(GAINS_MISSING)
        self._gains.finish_round()
        return self._gains.gains.copy()

    def gradients(self) -> dict[str, Array]:
        """See ``UpdateEngine.gradients``. The gradients are float64."""
        tables = tables_of_gradients(self._gradients, self._scene, len(self._parameters.clusters))
        if self._plan.colours is None:
            del tables["colours"]
        return tables

    def _named(self) -> dict[str, Tensor]:
        parameters, gloss = self._parameters, self._parameters.gloss
        named = {
            f"{k}.{name}": v for k, params in enumerate(parameters.clusters) for name, v in params._asdict().items()
        }
        named |= parameters.deltas._asdict()
        named |= {"moving": parameters.moving_colours, "static": parameters.static_colours}
        if gloss is not None:
            named |= {"gloss": gloss.gloss, "light": gloss.light, "nearness": gloss.nearness}
        return named


def tables_of_gradients(named: Mapping[str, Array], scene: Scene, layers: int) -> dict[str, Array]:
    """Returns the parameter gradients as tables with the keys and columns of ``UpdateEngine.gradients``."""
    tables = {
        f"cluster {k}": np.concatenate(
            [named[f"{k}.{name}"].reshape(-1, 1 if name == "s" else 3) for name in "rtcs"], axis=1
        )
        for k in range(layers)
    }
    tables["deltas"] = np.concatenate([named[name] for name in ("dp", "dr", "ds")], axis=1)
    colours = np.zeros((len(scene.means), 3))
    colours[scene.rows.numpy()], colours[scene.static.numpy()] = named["moving"], named["static"]
    tables["colours"] = colours
    if "gloss" in named:
        tables["gloss"] = named["gloss"]
        tables["environment"] = np.concatenate([named["light"], np.zeros((1, 3)), named["nearness"]])
    return tables
