"""``scripts/bench device``: the CPU and a torch device side by side, stage by stage, on a synthetic scene.

Every stage gets the same float32 arrays on both: the picture, its gradients, the cascade and its gradients, the losses,
and one whole update. The difference of two arrays is |a − b| / |b| in the Euclidean norm, b the CPU's: single pixels
where a Gaussian's alpha is 1/255 on one side and just below on the other do not decide.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scas4d_core.preparation import NEIGHBOURS
from scas4d_core.rasterize import cuda, twin
from scas4d_core.rasterize.cpu import CameraArrays, CpuRasterizer
from scas4d_core.rasterize.limits import GSPLAT
from scas4d_core.settings import SceneSettings, UpdateSettings
from scas4d_core.structure.hierarchy import build_hierarchy
from scas4d_core.structure.neighbours import build_neighbours
from scas4d_core.torch_backend import losses
from scas4d_core.torch_backend.deformation import ClusterParams, Deltas, Layer, deform
from scas4d_core.torch_backend.device import require_device
from scas4d_core.torch_backend.device_update import DeviceUpdate
from scas4d_core.update.deformation import CpuDeformation, first_lengths
from scas4d_core.update.frame_update import FrameUpdate
from scas4d_core.update.picture_loss import PictureLoss, ViewFactory
from scas4d_core.update.result import UpdateResult
from scas4d_core.update.warm_start import Motion
from studies.machine import in_words, machine
from studies.synthetic import ball as synthetic

Array = NDArray[np.float32]
Arrays = Mapping[str, Any]

TOLERANCES = {
    "render": 1e-3,
    "render backward": 1e-2,
    "cascade": 1e-5,
    "cascade backward": 1e-4,
    "losses": 1e-3,
    "update": 0.1,
}
"""Largest relative difference with which a stage agrees. Within an update rounding grows: Adam's first steps are of
full size however small a gradient is. One unit in the last place moves the CPU's own result by some hundredths."""


@dataclass(frozen=True)
class Stage:
    """Difference of the two devices in one stage.

    Attributes:
        name: of the stage.
        differences: relative, by array.
        cpu_ms, device_ms: median wall-clock time.
        first_ms: of the device's first call, which compiles.
    """

    name: str
    differences: dict[str, float]
    cpu_ms: float
    device_ms: float
    first_ms: float

    @property
    def agrees(self) -> bool:
        """True where every array is within the stage's tolerance; NaN is not."""
        return all(difference <= TOLERANCES[self.name] for difference in self.differences.values())


class Bench:
    """The synthetic scene, and each stage on both devices.

    Args:
        device: "cuda", or "cpu" to compare with the dense twin, for tests.
        gaussians: how many move; a quarter as many stand behind them.
        size: pixels, side of the pictures of the six cameras.
        iterations: of the update.
    """

    def __init__(self, device: str, gaussians: int, size: int, iterations: int) -> None:
        rng = np.random.default_rng(0)
        self.device, self.rig = device, synthetic.rig(size)
        self.before = synthetic.ball_on_a_floor(gaussians, rng)
        self.frame = synthetic.photograph(synthetic.moved(self.before), self.rig)
        self.settings = settings = UpdateSettings(iterations=iterations, clusters=(8, 64, 512), rate_end=0.1)
        self.hierarchy = build_hierarchy(self.before.means, self.before.moving, settings.clusters, 8)
        rows = self.hierarchy.rows
        self.neighbours = build_neighbours(self.before.means[rows], NEIGHBOURS, 200.0)
        self.features = np.concatenate([self.before.colours, self.before.foreground[:, None]], axis=1)
        self.picture_pull = rng.normal(size=(4, size, size)).astype(np.float32)
        self.mean_pull, self.factor_pull = (
            rng.normal(size=shape).astype(np.float32) for shape in ((len(self.before), 3), (len(self.before), 3, 3))
        )
        scales = np.repeat([0.03, 0.01, 0.1], [3, 3, 4])
        self.clusters = [(scales * rng.normal(size=(count, 10))).astype(np.float32) for count in self.hierarchy.sizes]
        self.deltas = (0.01 * rng.normal(size=(len(rows), 9))).astype(np.float32)
        self.factory = ViewFactory(self.rig)
        self.view = self.factory.views(self.frame, {})[0]
        self._deformation = CpuDeformation(
            self.hierarchy, self.neighbours, first_lengths(self.hierarchy, self.before), "centred"
        )
        self._rasterizer = CpuRasterizer(GSPLAT)
        self._picture = PictureLoss(self.factory, (0, 0, 0), 1.0, 1.0, limits=GSPLAT)
        self._motion = self._updated(FrameUpdate, None).motion

    def run(self, repeats: int = 5) -> list[Stage]:
        """Every stage, the medians over so many calls after the first."""
        sides: dict[str, tuple[Callable[[], Arrays], Callable[[], Arrays]]] = {
            "render": (self._cpu_render, self._device_render),
            "render backward": (self._cpu_render_backward, self._device_render_backward),
            "cascade": (self._cpu_cascade, self._device_cascade),
            "cascade backward": (self._cpu_cascade_backward, self._device_cascade_backward),
            "losses": (self._cpu_losses, self._device_losses),
            "update": (lambda: self._update(FrameUpdate), lambda: self._update(DeviceUpdate, device=self.device)),
        }
        return [self._compare(name, *both, repeats) for name, both in sides.items()]

    def _compare(self, name: str, cpu: Callable[[], Arrays], device: Callable[[], Arrays], repeats: int) -> Stage:
        _, wanted = _timed(cpu)
        first, found = _timed(device)
        if wanted.keys() != found.keys():
            raise AssertionError(f"{name}: {sorted(wanted)} and {sorted(found)} are not the same arrays")
        differences = {key: _difference(found[key], wanted[key]) for key in wanted}
        cpu_ms, device_ms = (median(_timed(side)[0] for _ in range(repeats)) for side in (cpu, device))
        return Stage(name, differences, cpu_ms, device_ms, first)

    # The CPU's side.

    def _cpu_render(self) -> Arrays:
        camera, background = CameraArrays.of(self.rig.cameras[0]), np.zeros(4, np.float32)
        given = (self.before.means, self.before.factors, self.before.opacities, self.features)
        picture = self._rasterizer.forward(*given, camera, background)
        return {"features": picture.features.copy(), "alpha": 1 - picture.rest}

    def _cpu_render_backward(self) -> Arrays:
        self._cpu_render()
        g_image, g_alpha = self._rasterizer.gradient_buffers()
        _, height, width = self.picture_pull.shape
        g_image[:, :height, :width] = self.picture_pull
        gradients = self._rasterizer.backward(g_image, g_alpha)
        names = ("means", "factors", "opacities", "features")
        return {name: getattr(gradients, name).copy() for name in names}

    def _cpu_cascade(self) -> Arrays:
        deformation = self._deformation
        deformation.start(self.before)
        for table, values in zip(
            [*deformation.clusters, deformation.deltas], [*self.clusters, self.deltas], strict=True
        ):
            table[:] = values
        deformation.forward()
        return {"means": deformation.means, "factors": deformation.factors, "turns": deformation.turns}

    def _cpu_cascade_backward(self) -> Arrays:
        self._cpu_cascade()
        deformation = self._deformation
        deformation.neighbour_losses(np.zeros(0, np.int64), (0.0, 0.0, 0.0))
        deformation.backward(self.mean_pull, self.factor_pull, 0.0)
        found = {f"layer {k}": table for k, table in enumerate(deformation.cluster_gradients)}
        return {**found, "deltas": deformation.delta_gradients}

    def _cpu_losses(self) -> Arrays:
        self._cpu_cascade()
        deformation = self._deformation
        picture = self._picture
        g = picture.evaluate(deformation.means, deformation.factors, self.before.opacities, self.features, self.view)
        sample = np.arange(len(self.hierarchy.rows))
        tied = deformation.neighbour_losses(sample, (1.0, 1.0, 1.0))
        scale = deformation.backward(g.means, g.factors, 1.0)
        return {"image": picture.image_part, "mask": picture.mask_part, "neighbours": tied, "scale": scale}

    # The device's side.

    def _floats(self, array: NDArray[Any]) -> Tensor:
        return torch.tensor(np.ascontiguousarray(array), dtype=torch.float32, device=self.device)

    def _drawn(self, means: Tensor, factors: Tensor, opacities: Tensor, features: Tensor) -> twin.Rendered:
        render = twin.render if self.device == "cpu" else cuda.render
        camera = twin.CameraParams.of(self.rig.cameras[0], torch.float32, self.device)
        return render(means, factors, opacities, features, camera, means.new_zeros(4), GSPLAT)

    def _given(self) -> list[Tensor]:
        before = self.before
        return [self._floats(a) for a in (before.means, before.factors, before.opacities, self.features)]

    @torch.no_grad()
    def _device_render(self) -> Arrays:
        picture = self._drawn(*self._given())
        return {"features": picture.features.permute(2, 0, 1), "alpha": picture.alpha}

    def _device_render_backward(self) -> Arrays:
        given = [tensor.requires_grad_() for tensor in self._given()]
        pulled = (self._drawn(*given).features.permute(2, 0, 1) * self._floats(self.picture_pull)).sum()
        names = ("means", "factors", "opacities", "features")
        return dict(zip(names, torch.autograd.grad(pulled, given), strict=True))

    def _deformed(self) -> tuple[list[Tensor], Tensor, Tensor, Tensor]:
        """The learnt tables, and all means and factors and the moving Gaussians' turns."""
        rows = torch.as_tensor(self.hierarchy.rows, device=self.device)
        tables = [self._floats(table).requires_grad_() for table in [*self.clusters, self.deltas]]
        layers = [
            Layer(
                torch.as_tensor(labels, dtype=torch.int64, device=self.device),
                ClusterParams(t[:, :3], t[:, 3:6], t[:, 6:9], t[:, 9]),
            )
            for labels, t in zip(self.hierarchy.labels, tables[:-1], strict=True)
        ]
        own = Deltas(tables[-1][:, :3], tables[-1][:, 3:6], tables[-1][:, 6:])
        means, factors = self._floats(self.before.means), self._floats(self.before.factors)
        now = deform(means[rows], factors[rows], layers, own)
        return tables, means.index_copy(0, rows, now.means), factors.index_copy(0, rows, now.factors), now.turns

    @torch.no_grad()
    def _device_cascade(self) -> Arrays:
        _, means, factors, turns = self._deformed()
        return {"means": means, "factors": factors, "turns": turns}

    def _device_cascade_backward(self) -> Arrays:
        tables, means, factors, _ = self._deformed()
        pulled = (means * self._floats(self.mean_pull)).sum() + (factors * self._floats(self.factor_pull)).sum()
        found = torch.autograd.grad(pulled, tables)
        return {**{f"layer {k}": table for k, table in enumerate(found[:-1])}, "deltas": found[-1]}

    def _device_losses(self) -> Arrays:
        tables, means, factors, turns = self._deformed()
        picture = self._drawn(means, factors, self._floats(self.before.opacities), self._floats(self.features)).features
        target = self._floats(np.moveaxis(self.view.target, 0, -1))
        image = losses.image_loss(picture[..., :3], target[..., :3])
        mask = losses.image_loss(picture[..., 3:], target[..., 3:])
        rows = torch.as_tensor(self.hierarchy.rows, device=self.device)
        graph = (
            torch.as_tensor(self.neighbours.index, dtype=torch.int64, device=self.device),
            self._floats(self.neighbours.weights),
        )
        now, before = means[rows], self._floats(self.before.means)[rows]
        rigidity = losses.rigidity_loss(now, turns, before, *graph)
        isometry = losses.isometry_loss(now, self._floats(self.neighbours.distances), *graph)
        tied = torch.stack([rigidity, isometry, losses.rotation_loss(turns, *graph)])
        scale = losses.scale_loss(factors[rows], self._floats(first_lengths(self.hierarchy, self.before)), 0.0)
        torch.autograd.grad(image + mask + tied.sum() + scale, tables)  # the CPU's stage goes backward too
        return {"image": image, "mask": mask, "neighbours": tied, "scale": scale}

    # Both sides.

    def _updated(
        self, kind: type[FrameUpdate] | type[DeviceUpdate], motion: Motion | None, **options: Any
    ) -> UpdateResult:
        updater = kind(
            self.factory, SceneSettings(), self.settings, self.hierarchy, self.neighbours, self.before, **options
        )
        return updater.run(self.before, self.factory.views(self.frame, {}), motion, 1.0, 1)

    def _update(self, kind: type[FrameUpdate] | type[DeviceUpdate], **options: Any) -> Arrays:
        """An update that starts warm: a cold one stands on the kinks of the neighbour terms, where rounding decides."""
        found = self._updated(kind, self._motion, **options)
        rows = self.hierarchy.rows
        return {"losses": np.array(found.trace.losses), "motion": (found.gaussians.means - self.before.means)[rows]}


def _timed(side: Callable[[], Arrays]) -> tuple[float, dict[str, NDArray[np.float64]]]:
    """Milliseconds of a call until its results are on the host, and the results."""
    began = time.perf_counter()
    found = {name: _host(array) for name, array in side().items()}
    return 1000 * (time.perf_counter() - began), found


def _host(array: Any) -> NDArray[np.float64]:
    return np.array(array.detach().cpu().numpy() if isinstance(array, Tensor) else array, np.float64)


def _difference(found: NDArray[np.float64], wanted: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(found - wanted)) / max(float(np.linalg.norm(wanted)), 1e-12)


def page(stages: Sequence[Stage], heading: str) -> str:
    """The table as Markdown."""
    lines = [
        heading, "",
        "| stage | relative difference | tolerance | agrees | CPU ms | device ms | first call ms |",
        "|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for stage in stages:
        found = ", ".join(f"{name} {value:.1e}" for name, value in stage.differences.items())
        times = f"{stage.cpu_ms:.1f} | {stage.device_ms:.1f} | {stage.first_ms:.0f}"
        agrees = "yes" if stage.agrees else "NO"
        lines.append(f"| {stage.name} | {found} | {TOLERANCES[stage.name]:g} | {agrees} | {times} |")
    return "\n".join(lines)


def run(*, gaussians: int = 8000, size: int = 384, iterations: int = 20, repeats: int = 5) -> tuple[str, bool]:
    """The table of this machine's GPU against its CPU, and whether all stages agree.

    Raises:
        DeviceError: there is no GPU, or what it takes is not installed.
    """
    require_device("cuda")
    stages = Bench("cuda", gaussians, size, iterations).run(repeats)
    scene = f"{gaussians:,} moving Gaussians, {size}×{size} pixels, an update of {iterations} iterations"
    gpu = f"{torch.cuda.get_device_name()}, torch {torch.__version__}, CUDA {torch.version.cuda}"
    return page(stages, f"{gpu}; against {in_words(machine())}. {scene}."), all(stage.agrees for stage in stages)
