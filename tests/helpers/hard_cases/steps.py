"""Hard cases for the other steps of the method: Adam, frame 0 parameters, neighbours, losses and clustering."""

from __future__ import annotations

import resource
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hard_cases.case import (
    CPU,
    REFERENCE,
    BackendResult,
    HardCase,
    apart,
    beyond,
    not_finite,
    unexpected_counts,
)
from scas4d_core.guards import EXPONENT
from scas4d_core.kernels import activation, image_loss
from scas4d_core.kernels.adam import COUNTED_GUARDS, EVERY_ROW, adam
from scas4d_core.query.ply import split_factors
from scas4d_core.structure.hierarchy import build_hierarchy
from scas4d_core.structure.neighbours import Neighbours
from studies.apart import in_a_process

Array = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class HardStep:
    """Function of arrays that is computed on the CPU and, if it has a reference implementation, in float64.

    Attributes:
        compute: functions that compute the result, keyed by backend.
        agreement: tolerance of each array compared with float64, relative to its norm; not checked if None.
        bound: largest allowed gradient.
        guards: expected counts of the guards; None accepts any counts.
        more: function that returns violations of further requirements.
    """

    compute: Mapping[str, Callable[[], BackendResult]]
    agreement: float | None = 1e-4
    bound: float = 1e38
    guards: Mapping[str, int] | None = field(default_factory=dict)
    more: Callable[[Mapping[str, BackendResult]], list[str]] = lambda outcomes: []

    def run(self, backend: str) -> BackendResult | None:
        """Computes the result on a backend, or returns None if there is no function for it."""
        return self.compute[backend]() if backend in self.compute else None

    def violations(self, outcomes: Mapping[str, BackendResult]) -> list[str]:
        """Returns a line for each violated check.

        The checks cover finite values, bounds, guard counts, further requirements, and agreement with the reference.
        """
        faults = []
        for backend, outcome in outcomes.items():
            faults += not_finite(outcome, backend) + beyond(outcome, backend, self.bound)
        faults += unexpected_counts(outcomes[CPU], self.guards) + self.more(outcomes)
        if REFERENCE in outcomes and self.agreement is not None:
            truth = {**outcomes[REFERENCE].values, **outcomes[REFERENCE].gradients}
            mine = {**outcomes[CPU].values, **outcomes[CPU].gradients}
            for name in set(truth) & set(mine):
                distance = apart(mine[name], truth[name], least=1e-9)
                faults += [] if distance <= self.agreement else [f"{name} differs by {distance:.2g}"]
        return faults


STEPS = 20
LARGEST = EXPONENT * np.log(2.0)
"""Largest argument that the guards pass to an exponential."""


def _adam(gradient: Callable[[int, Array], None], acted: int, flushed: int = 0, **changes: Any) -> HardStep:
    """Runs twenty Adam steps on a table, with some gradients replaced by ``gradient(step, table)``."""

    def start() -> tuple[Array, list[Array]]:
        rng = np.random.default_rng(11)
        gradients = []
        for step in range(STEPS):
            table = rng.normal(size=(1100, 9)).astype(np.float32)
            gradient(step, table)
            gradients.append(table)
        return np.zeros((1100, 9), np.float32), gradients

    def on_cpu() -> BackendResult:
        parameters, gradients = start()
        first, second = np.zeros_like(parameters), np.zeros_like(parameters)
        rates = np.full(9, 0.01, np.float32)
        counts = np.zeros(2, np.int64)
        for step, table in enumerate(gradients, 1):
            counts += adam(parameters, table, first, second, rates, EVERY_ROW, np.float32(0.9), np.float32(0.999), step)
        values = {"parameters": parameters, "first": first, "second": second}
        return BackendResult(values, {}, dict(zip(COUNTED_GUARDS, counts.tolist(), strict=True)))

    def in_torch() -> BackendResult:
        import torch

        parameters, gradients = start()
        leaf = torch.tensor(parameters, dtype=torch.float64, requires_grad=True)
        optimizer = torch.optim.Adam([leaf], lr=0.01, betas=(0.9, 0.999), eps=1e-15)
        for table in gradients:
            wide = torch.tensor(table, dtype=torch.float64)
            # A NaN gradient counts as 0, and one that is too large as the largest accepted value.
            leaf.grad = torch.nan_to_num(wide, nan=0.0, posinf=1e18, neginf=-1e18).clamp(-1e18, 1e18)
            optimizer.step()
        return BackendResult({"parameters": leaf.detach().numpy()})

    return HardStep(
        {CPU: on_cpu, REFERENCE: in_torch}, guards={COUNTED_GUARDS[0]: acted, COUNTED_GUARDS[1]: flushed}, **changes
    )


def _spoil(value: float, once: bool) -> Callable[[int, Array], None]:
    def spoil(step: int, table: Array) -> None:
        if step == 2 or not once:
            table[1050, 4] = value

    return spoil


def _tiny(value: float) -> Callable[[int, Array], None]:
    """Returns a function that sets all gradients of a table to ``value``."""

    def spoil(step: int, table: Array) -> None:
        table[:] = value

    return spoil


def denormal(array: NDArray[Any]) -> int:
    """Returns the number of values that are neither 0 nor normal in float32."""
    return int(np.count_nonzero((array != 0) & (np.abs(array) < np.finfo(np.float32).tiny)))


def _no_denormals(outcomes: Mapping[str, BackendResult]) -> list[str]:
    values = outcomes[CPU].values
    return [f"{denormal(values[name])} denormal numbers in the {name} moments" for name in ("first", "second")
            if denormal(values[name])]  # fmt: skip


def _activation(
    columns: slice, value: Any, guards: dict[str, int], agreement: float | None = 1e-4, pull: float = 1.0
) -> HardStep:
    """Activates 300 rows of frame 0 parameters, with some columns replaced by ``value`` in every tenth row."""
    rng = np.random.default_rng(12)
    table = rng.normal(size=(300, activation.COLUMNS)).astype(np.float32)
    table[::10, columns] = value
    pulls = [(pull * rng.normal(size=shape)).astype(np.float32) for shape in ((300, 3), (300, 3, 3), (300,), (300, 4))]

    def on_cpu() -> BackendResult:
        names = ("means", "factors", "opacities", "features")
        arrays = [np.full_like(pull, np.nan) for pull in pulls]
        counts = activation.activate(table, *arrays)
        gradients = np.full_like(table, np.nan)
        activation.activate_backward(table, *arrays[1:], *pulls, gradients)
        acted = dict(zip(activation.COUNTED_GUARDS, counts.tolist(), strict=True))
        return BackendResult(dict(zip(names, arrays, strict=True)), {"parameters": gradients}, acted)

    def in_torch() -> BackendResult:
        import torch

        from scas4d_core.engines.torch.deformation import quaternion_matrices

        leaf = torch.tensor(table, dtype=torch.float64, requires_grad=True)
        squares = leaf[:, 3:7].square().sum(dim=1, keepdim=True)
        none = leaf.new_tensor([1.0, 0, 0, 0])
        aimed = squares > 1e-30
        quaternions = torch.where(aimed, leaf[:, 3:7], none)
        quaternions = quaternions / quaternions.norm(dim=1, keepdim=True)
        clamped = leaf.clamp(-LARGEST, LARGEST)
        factors = quaternion_matrices(quaternions) * torch.exp(clamped[:, None, 7:10])
        features = torch.cat([leaf[:, 11:14], torch.sigmoid(clamped[:, 14:])], dim=1)
        values = {
            "means": leaf[:, :3], "factors": factors, "opacities": torch.sigmoid(clamped[:, 10]), "features": features
        }  # fmt: skip
        loss = sum((v * torch.tensor(pull)).sum() for v, pull in zip(values.values(), pulls, strict=True))
        (gradients,) = torch.autograd.grad(loss, [leaf])  # type: ignore[arg-type]
        return BackendResult({n: v.detach().numpy() for n, v in values.items()}, {"parameters": gradients.numpy()})

    return HardStep({CPU: on_cpu, REFERENCE: in_torch}, guards=guards, agreement=agreement)


def _opposite(scale: float) -> HardStep:
    """Compares quaternions q and −q of any length, which must yield the same Gaussian and opposite gradients."""
    rng = np.random.default_rng(13)
    table = rng.normal(size=(64, activation.COLUMNS)).astype(np.float32)
    table[:, 3:7] *= np.float32(scale)
    table[32:] = table[:32]
    table[32:, 3:7] *= -1

    def on_cpu() -> BackendResult:
        shapes = ((64, 3), (64, 3, 3), (64,), (64, 4))
        arrays = [np.empty(shape, np.float32) for shape in shapes]
        counts = activation.activate(table, *arrays)
        gradients = np.empty_like(table)
        pulls = [np.ones(shape, np.float32) for shape in shapes]
        activation.activate_backward(table, *arrays[1:], *pulls, gradients)
        acted = dict(zip(activation.COUNTED_GUARDS, counts.tolist(), strict=True))
        return BackendResult({"factors": arrays[1]}, {"parameters": gradients}, acted)

    def opposite(outcomes: Mapping[str, BackendResult]) -> list[str]:
        factors, g = outcomes[CPU].values["factors"], outcomes[CPU].gradients["parameters"][:, 3:7]
        same = np.array_equal(factors[:32], factors[32:]) and np.array_equal(g[:32], -g[32:])
        return [] if same else ["q and −q are not the same Gaussian"]

    return HardStep({CPU: on_cpu}, more=opposite)


def _pictures(rendered: Any, target: Any, size: tuple[int, int] = (40, 37), agreement: float | None = 2e-3) -> HardStep:
    """Evaluates the image loss of two images (arrays or constants) and bounds the gradient of each pixel."""
    height, width = size
    shape = (3, height, width)
    image = np.broadcast_to(np.asarray(rendered, np.float32), shape).copy()
    truth = np.broadcast_to(np.asarray(target, np.float32), shape).copy()

    def on_cpu() -> BackendResult:
        pitch = image_loss.stride(width)
        scratch = np.zeros((6, 3, height + 2 * image_loss.REACH, pitch), np.float32)
        means, squares = np.empty_like(truth), np.empty_like(truth)
        image_loss.target_moments(truth, scratch, means, squares)
        scratch[:] = 0
        gradient, rows = np.empty_like(image), np.empty((3, height, 2), np.float32)
        by_exposure = np.empty((3, height, 2), np.float32)
        exposure = np.tile(np.array([1, 0], np.float32), (3, 1))
        weights = np.full(3, 1 / 3, np.float32)
        image_loss.image_loss(
            1, image, exposure, truth, means, squares, weights, truth[0].size, scratch, image_loss.EVERYWHERE, gradient,
            rows, by_exposure,
        )  # fmt: skip
        return BackendResult({"loss": rows[..., 0].sum(dtype=np.float64)[None]}, {"picture": gradient})

    def in_torch() -> BackendResult:
        import torch

        from scas4d_core.engines.torch import losses

        leaf = torch.tensor(image, dtype=torch.float64, requires_grad=True)
        other = torch.tensor(truth, dtype=torch.float64)
        loss = losses.image_loss(leaf.permute(1, 2, 0), other.permute(1, 2, 0))
        (gradient,) = torch.autograd.grad(loss, [leaf])
        figure = losses.psnr(leaf.detach().permute(1, 2, 0), other.permute(1, 2, 0))
        return BackendResult(
            {"loss": loss.detach().numpy()[None], "psnr": figure.numpy()[None]}, {"picture": gradient.numpy()}
        )

    return HardStep({CPU: on_cpu, REFERENCE: in_torch}, agreement=agreement, bound=100 / image.size)


def _noise(seed: int) -> Array:
    return np.random.default_rng(seed).integers(0, 2, (3, 40, 37)).astype(np.float32)


def _clustering(points: Callable[[np.random.Generator], NDArray[Any]], wished: tuple[int, ...]) -> HardStep:
    """Checks that every finite Gaussian is in one cluster per layer, and that clusters are nested and reproducible."""

    def on_cpu() -> BackendResult:
        means = points(np.random.default_rng(14)).astype(np.float32)
        hierarchy = build_hierarchy(means, np.ones(len(means), bool), wished, 8)
        again = build_hierarchy(means, np.ones(len(means), bool), wished, 8)
        finite = np.isfinite(means).all(axis=1)
        whole = np.array_equal(np.sort(hierarchy.rows), np.flatnonzero(finite))
        same = np.array_equal(hierarchy.rows, again.rows)
        nested = all(set(a) <= set(b) for a, b in zip(hierarchy.starts, hierarchy.starts[1:], strict=False))
        full = all((np.diff(starts) > 0).all() and starts[-1] == len(hierarchy.rows) for starts in hierarchy.starts)
        capped = all(size <= wish for size, wish in zip(hierarchy.sizes, wished, strict=False))
        laws = np.array([whole, same, nested, full, capped, hierarchy.left_out == np.count_nonzero(~finite)], float)
        return BackendResult({"laws": laws}, {}, {"left_out_of_hierarchy": hierarchy.left_out})

    def lawful(outcomes: Mapping[str, BackendResult]) -> list[str]:
        names = (
            "each finite row occurs once",
            "reproducible",
            "nested",
            "no cluster is empty",
            "no more clusters than requested",
            "rows left out are counted",
        )
        laws = outcomes[CPU].values["laws"]
        return [f"clustering violates: {name}" for name, law in zip(names, laws, strict=True) if not law]

    return HardStep({CPU: on_cpu}, guards=None, more=lawful)


MILLION_MB = 600
"""Largest additional memory, in MB, that clustering a million Gaussians may use."""


def _megabytes_of_clustering(count: int) -> float:
    """Returns the increase in peak memory, in MB, caused by ``build_hierarchy`` for ``count`` points on a sphere."""
    rng = np.random.default_rng(16)
    means = rng.normal(size=(count, 3)).astype(np.float32)
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    build_hierarchy(means[:2000], np.ones(2000, bool), (16, 64), 8)  # loads the libraries
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    hierarchy = build_hierarchy(means, np.ones(count, bool), (64, 320, 1280), 8)
    assert len(hierarchy.rows) == count
    return (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024


def _million(count: int) -> HardStep:
    def on_cpu() -> BackendResult:
        return BackendResult({"MB": np.array([in_a_process(_megabytes_of_clustering, count)])})

    def bounded(outcomes: Mapping[str, BackendResult]) -> list[str]:
        took = float(outcomes[CPU].values["MB"][0])
        return [] if took <= MILLION_MB else [f"clustering {count:,} took {took:.0f} MB; the limit is {MILLION_MB} MB"]

    return HardStep({CPU: on_cpu}, more=bounded)


def _graph(points: NDArray[Any]) -> HardStep:
    """Checks that neighbours have finite weights and distances, and that no Gaussian is its own neighbour."""

    def on_cpu() -> BackendResult:
        graph = Neighbours(points, 20, 2000.0)
        return BackendResult({"weights": graph.weights, "distances": graph.distances, "index": graph.index})

    def apart_from_itself(outcomes: Mapping[str, BackendResult]) -> list[str]:
        index, weights = outcomes[CPU].values["index"], outcomes[CPU].values["weights"]
        own = (index == np.arange(len(index))[:, None]) & (weights > 0)
        return [f"{own.sum()} Gaussians are their own neighbours"] if own.any() else []

    return HardStep({CPU: on_cpu}, more=apart_from_itself)


def _split(lengths: tuple[float, float, float]) -> HardStep:
    """Splits factors into rotations and lengths, as for exports, and checks Σ, even for nearly equal lengths."""

    def on_cpu() -> BackendResult:
        rng = np.random.default_rng(15)
        turns = np.linalg.qr(rng.normal(size=(2, 200, 3, 3)))[0]
        factors = (turns[0] * np.array(lengths) @ turns[1]).astype(np.float32)
        axes, scales = split_factors(factors)
        matrices = axes * np.square(scales)[:, None, :] @ np.swapaxes(axes, 1, 2)
        wide = factors.astype(np.float64)
        truth = wide @ np.swapaxes(wide, 1, 2)
        off = np.abs(matrices - truth).max() / np.abs(truth).max()
        return BackendResult({"off": np.array([off]), "hands": np.linalg.det(axes)})

    def same(outcomes: Mapping[str, BackendResult]) -> list[str]:
        off, hands = float(outcomes[CPU].values["off"][0]), outcomes[CPU].values["hands"]
        return ([] if off < 1e-6 else [f"Σ differs by {off:.2g} after the split"]) + (
            [] if np.abs(hands - 1).max() < 1e-6 else ["the axes of a split are not a rotation"]
        )

    return HardStep({CPU: on_cpu}, more=same)


QUATERNION, SCALE, OPACITY = slice(3, 7), slice(7, 10), slice(10, 11)

CASES = (
    HardCase(
        "NaN gradient",
        "whether one entry is NaN once or in every step; it counts as 0 and affects no other entry",
        "gsplat#248",
        (True, False),
        lambda once: _adam(_spoil(np.nan, once), 1 if once else STEPS),
    ),
    HardCase(
        "huge gradient",
        "value of one entry, once; the parameter continues as after 1e18",
        "gsplat#248",
        (1e20, 1e30, np.inf, -np.inf),
        lambda v: _adam(_spoil(v, True), 1),
    ),
    HardCase(
        "tiny gradients",
        "value of all gradients; the moments contain no denormal numbers",
        "denormals",
        (1e-18, 1e-25, 1e-40),
        lambda v: _adam(
            _tiny(v), 0, STEPS * 9900 if v < 1e-19 else 0, agreement=None if v < 1e-19 else 1e-2, more=_no_denormals
        ),
    ),
    HardCase(
        "decaying moments",
        "value of a single gradient, followed by zeros; the first moment does not become denormal",
        "denormals",
        (1e-19, 1.5e-19),
        lambda v: _adam(
            lambda step, table: table.fill(v if step == 0 else 0),
            0,
            9900 if v <= 1e-19 else 0,
            agreement=None,
            more=_no_denormals,
        ),
    ),
    HardCase(
        "no gradient",
        "value of all gradients in twenty steps; nothing moves, and 0/0 does not occur",
        "Adam's epsilon",
        (0.0,),
        lambda v: _adam(_tiny(v), 0),
    ),
    HardCase(
        "zero quaternion",
        "value of all entries; no rotation and no gradient, and the guard is counted",
        "oppo-us-research/SpacetimeGaussians#96",
        (0.0, 1e-20, 1e-16),
        lambda v: _activation(QUATERNION, v, {"quaternion_floor": 30}),
    ),
    HardCase(
        "short and long quaternions",
        "value of all entries",
        "oppo-us-research/SpacetimeGaussians#96",
        (1e-14, 1e-6, 1e6, 1e15),
        lambda v: _activation(QUATERNION, v, {}, 1e-3),
    ),
    HardCase(
        "q against −q",
        "length of the quaternions; both represent the same Gaussian",
        "double cover of rotations",
        (1e-6, 1.0, 1e6),
        _opposite,
    ),
    HardCase(
        "log scales",
        "value; clamped beyond ±87",
        "gsplat#613, graphdeco-inria/gaussian-splatting#41",
        (-200.0, -80.0, 20.0),
        lambda v: _activation(SCALE, v, {"exponent": 30} if abs(v) > 87 else {}, None if v < -87 else 1e-4),
    ),
    HardCase(
        "log scale beyond e^87",
        "value for one axis of every tenth Gaussian; clamped, and the result is finite",
        "gsplat#613",
        (88.0, 200.0),
        lambda v: _activation(slice(7, 8), v, {"exponent": 30}, 1e-3, 1e-3),
    ),
    HardCase(
        "opacity logits",
        "value; saturated at either end",
        "fastgs/FastGS#58",
        (-200.0, -30.0, 30.0, 200.0),
        lambda v: _activation(OPACITY, v, {"exponent": 30} if abs(v) > 87 else {}),
    ),
    HardCase(
        "black on black",
        "height and width",
        "lights off",
        ((40, 37), (1, 1), (5, 100)),
        lambda size: _pictures(0, 0, size),
    ),
    HardCase(
        "flat images",
        "value of a uniform grey image compared with itself",
        "SSIM without contrast",
        (1e-6, 0.5, 1.0),
        lambda v: _pictures(v, v, agreement=None),
    ),
    HardCase(
        "white on black",
        "value of the render; the target is black",
        "lights off and on",
        (1.0, 100.0),
        lambda v: _pictures(v, 0),
    ),
    HardCase(
        "black on white",
        "value of the target; the render is black",
        "lights off and on",
        (1.0, 0.004),
        lambda v: _pictures(0, v),
    ),
    HardCase(
        "saturated noise",
        "random seed; pixels are 0 or 1, and differ between the two images",
        "sensor faults",
        (1, 2),
        lambda seed: _pictures(_noise(seed), _noise(seed + 100)),
    ),
    HardCase(
        "unbounded colours",
        "factor on the render, which is compared with noise",
        "colours are not clamped",
        (1e3, 1e6, 1e9),
        lambda v: _pictures(v * _noise(3), _noise(4), agreement=2e-2),
    ),
    HardCase(
        "fewer Gaussians than clusters",
        "number of Gaussians for layers of 64, 320 and 1280 clusters",
        "edge of K-means",
        (1, 2, 9, 63),
        lambda n: _clustering(lambda rng: rng.normal(size=(n, 3)), (64, 320, 1280)),
    ),
    HardCase(
        "clustering coincident points",
        "number of coincident points",
        "coincident points",
        (20, 2000),
        lambda n: _clustering(lambda rng: np.ones((n, 3)), (2, 16, 64)),
    ),
    HardCase(
        "clustering collinear points",
        "number of points on a line",
        "collinear points",
        (100, 2000),
        lambda n: _clustering(lambda rng: rng.normal(size=(n, 1)) * np.array([1, 2, 3]), (2, 16, 64)),
    ),
    HardCase(
        "clustering two places",
        "number of points, half of them 1 km away",
        "outliers",
        (200,),
        lambda n: _clustering(lambda rng: rng.normal(size=(n, 3)) + 1e3 * (np.arange(n) % 2)[:, None], (2, 8)),
    ),
    HardCase(
        "clustering NaN",
        "number of non-finite points out of 300; they stay in place and are counted",
        "gsplat#248",
        (1, 299, 300),
        lambda n: _clustering(
            lambda rng: np.where((np.arange(300) < n)[:, None], np.nan, rng.normal(size=(300, 3))), (4, 16)
        ),
    ),
    HardCase(
        "clustering a million points",
        f"number of points, in layers of 64, 320 and 1280 clusters, within {MILLION_MB} MB",
        "uynitsuj/POGS#3",
        (1_000_000,),
        _million,
        slow=True,
    ),
    HardCase(
        "neighbours in one place",
        "number of Gaussians",
        "coincident points",
        (2, 19, 200),
        lambda n: _graph(np.ones((n, 3))),
    ),
    HardCase(
        "neighbours far apart",
        "distance between neighbours in metres; weights become 0",
        "users' units",
        (1.0, 1e6, 1e18),
        lambda d: _graph(d * np.arange(60)[:, None] * np.ones(3)),
    ),
    HardCase(
        "one neighbour or none",
        "number of Gaussians",
        "edge of the graph",
        (1, 2, 3),
        lambda n: _graph(np.random.default_rng(0).normal(size=(n, 3))),
    ),
    HardCase(
        "nearly equal axes",
        "relative difference of the lengths; the split keeps Σ and yields a proper rotation",
        "re-splitting Σ",
        (0.0, 1e-7, 1e-4),
        lambda d: _split((1.0, 1.0 + d, 1.0 - d)),
    ),
    HardCase(
        "very unequal axes",
        "shortest axis over longest",
        "re-splitting Σ",
        (1e-3, 1e-6),
        lambda d: _split((1.0, 0.5, d)),
    ),
)
