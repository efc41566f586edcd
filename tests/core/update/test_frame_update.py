"""One frame's update: it finds a known motion, agrees with its float64 twin, and repeats itself to the bit."""

from __future__ import annotations

from collections.abc import Iterator
from time import perf_counter
from typing import Any

import numba
import numpy as np
import pytest
import torch
from box_scene import MOVING, SHIFT, TURN, make_box, make_rig, moved, take_frame
from effect_cases import of_whole_pictures

from scas4d_core.engines.cpu.adam import Adam
from scas4d_core.engines.cpu.deformation import CpuDeformation
from scas4d_core.engines.cpu.engine import CpuEngine
from scas4d_core.engines.cpu.renderer import CpuRenderer
from scas4d_core.engines.engine import REPORT, StepScalars
from scas4d_core.engines.limits import DEFAULT
from scas4d_core.engines.plan import MAX_SCALE
from scas4d_core.engines.torch import losses, rasterizer
from scas4d_core.engines.torch.deformation import ClusterParams, Deltas, Layer, deform
from scas4d_core.engines.views import TrainingView
from scas4d_core.gaussians import Gaussians
from scas4d_core.kernels import neighbour_terms
from scas4d_core.preparation import SMALLEST_CLUSTER
from scas4d_core.settings import UpdateSettings
from scas4d_core.structure.hierarchy import Hierarchy, build_hierarchy
from scas4d_core.structure.neighbours import Neighbours
from scas4d_core.update import rates, schedule
from scas4d_core.update.frame_update import FrameUpdate
from scas4d_core.update.result import AttemptOptions, Current, Stopwatch, UpdateResult
from scas4d_core.update.schedule import Stopping, ViewPlan, plan_samples, view_order
from scas4d_core.update.view_factory import ViewFactory

BEFORE = make_box()
AFTER = moved(BEFORE)
RIG = make_rig()
SETTINGS = UpdateSettings(clusters=(2, 12, 48), final_rate=1.0, cold_start_rates=1.0)
NEIGHBOURS, FALLOFF = 20, 200.0
"""The box has few Gaussians, far apart."""
CALM = SETTINGS.model_copy(update={"final_rate": 0.1})
"""Rates that fall: what is found is not blurred by the last steps."""


def tied(settings: UpdateSettings, gaussians: Gaussians, count: int = NEIGHBOURS) -> tuple[Hierarchy, Neighbours]:
    hierarchy = build_hierarchy(gaussians.means, gaussians.moving, settings.clusters, SMALLEST_CLUSTER)
    return hierarchy, Neighbours(gaussians.means[hierarchy.rows], count, FALLOFF)


def prepare(
    settings: UpdateSettings = SETTINGS,
    truth: Gaussians = AFTER,
    masks: bool = True,
    count: int = NEIGHBOURS,
    engine: CpuEngine | None = None,
) -> tuple[FrameUpdate, list[TrainingView]]:
    """The updater of the box and the views of a frame that shows ``truth``."""
    factory = ViewFactory(RIG)
    hierarchy, neighbours = tied(settings, BEFORE, count)
    built = of_whole_pictures(factory, settings, hierarchy, BEFORE)
    updater = FrameUpdate(engine or CpuEngine(), built, neighbours)
    return updater, factory.views(take_frame(1, 1.0, truth, RIG, masks), {})


def update(settings: UpdateSettings = SETTINGS, truth: Gaussians = AFTER, masks: bool = True) -> UpdateResult:
    updater, views = prepare(settings, truth, masks)
    return updater.run(BEFORE, views, None, 1.0, seed=1)


def errors(found: Gaussians, truth: Gaussians) -> np.ndarray:
    """[M] metres between the means of the moving Gaussians."""
    distance: np.ndarray = np.linalg.norm(found.means - truth.means, axis=1)[:MOVING]
    return distance


@pytest.fixture(scope="module")
def found() -> UpdateResult:
    return update(CALM)


@pytest.fixture
def threads() -> Iterator[None]:
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("NUMBA_NUM_THREADS allows one thread only")
    before = numba.get_num_threads()
    yield
    numba.set_num_threads(before)


def test_a_turn_and_a_shift_are_found(found: UpdateResult) -> None:
    # A pixel is 21 mm wide at the box. Masks have hard edges and the rendered label soft ones: that costs about 2 mm.
    standing_still = errors(BEFORE, AFTER)
    assert np.median(standing_still) > 0.025
    error = errors(found.gaussians, AFTER)
    assert np.median(error) < 0.1 * np.median(standing_still)
    assert np.quantile(error, 0.95) < 0.25 * np.median(standing_still)
    assert np.mean(found.trace.losses[-12:]) < 0.7 * np.mean(found.trace.losses[:6])
    assert np.mean(found.trace.psnr[-12:]) > np.mean(found.trace.psnr[:6]) + 8
    # Material rotation: the angle of what is left of the true turn.
    wanted = AFTER.rotations[:MOVING]
    off = 2 * np.arccos(np.clip(np.abs((found.gaussians.rotations[:MOVING] * wanted).sum(axis=1)), 0, 1))
    assert np.median(off) < 0.15 * TURN.magnitude()
    assert np.abs(np.linalg.norm(found.gaussians.rotations, axis=1) - 1).max() < 1e-5


def test_what_stands_stays_to_the_bit_and_identity_is_kept(found: UpdateResult) -> None:
    state = found.gaussians
    for name in ("means", "factors", "rotations"):
        np.testing.assert_array_equal(getattr(state, name)[MOVING:], getattr(BEFORE, name)[MOVING:])
        assert not np.shares_memory(getattr(state, name), getattr(BEFORE, name))
    for name in ("opacities", "foreground", "ids"):
        np.testing.assert_array_equal(getattr(state, name), getattr(BEFORE, name))
    assert all(array.dtype in (np.float32, np.int64) for array in state.arrays().values())


@pytest.mark.parametrize("cluster_map", ["centred", "published"])
def test_motion_is_found_without_masks(cluster_map: str) -> None:
    found = update(CALM.model_copy(update={"cluster_map": cluster_map}), masks=False)
    assert np.median(errors(found.gaussians, AFTER)) < 1e-3
    assert errors(found.gaussians, AFTER).max() < 2e-3
    assert np.mean(found.trace.losses[-12:]) < 0.1 * np.mean(found.trace.losses[:6])


@pytest.mark.parametrize(
    ("settings", "masks", "typical", "worst"),
    [(CALM, False, 1e-3, 2e-3), (CALM, True, 2e-3, 0.015), (SETTINGS, False, 7e-3, 0.015)],
)
def test_a_scene_that_stands_still_stays(settings: UpdateSettings, masks: bool, typical: float, worst: float) -> None:
    error = errors(update(settings, truth=BEFORE, masks=masks).gaussians, BEFORE)
    assert np.median(error) < typical
    assert error.max() < worst


def test_nothing_moving_only_changes_colours() -> None:
    still = BEFORE.replace(foreground=np.zeros(len(BEFORE), np.float32))
    settings = SETTINGS.model_copy(update={"iterations": 5})
    factory = ViewFactory(RIG)
    hierarchy, neighbours = tied(settings, still)
    updater = FrameUpdate(CpuEngine(), of_whole_pictures(factory, settings, hierarchy, still), neighbours)
    after = updater.run(still, factory.views(take_frame(1, 1.0, AFTER, RIG), {}), None, 1.0, 1).gaussians
    np.testing.assert_array_equal(after.means, still.means)
    np.testing.assert_array_equal(after.rotations, still.rotations)
    assert np.abs(after.colours - still.colours).max() > 1e-3


def test_the_same_seed_gives_the_same_bits_also_from_used_buffers(found: UpdateResult) -> None:
    updater, views = prepare(CALM)
    other = updater.run(BEFORE, views, None, 1.0, seed=2)
    again = updater.run(BEFORE, views, None, 1.0, seed=1)
    assert again.trace.losses == found.trace.losses
    for name, array in found.gaussians.arrays().items():
        np.testing.assert_array_equal(getattr(again.gaussians, name), array)
    assert other.trace.losses != found.trace.losses


def test_the_number_of_threads_does_not_matter(threads: None) -> None:
    settings = SETTINGS.model_copy(update={"iterations": 10})
    results = []
    for count in (1, 2):
        numba.set_num_threads(count)
        results.append(update(settings))
    assert results[0].trace.losses == results[1].trace.losses
    for name, array in results[0].gaussians.arrays().items():
        np.testing.assert_array_equal(getattr(results[1].gaussians, name), array)


class Iteration:
    """Two iterations of the fused update without Adam, the second at chosen parameters; keeps its gradients."""

    def __init__(
        self, settings: UpdateSettings, monkeypatch: pytest.MonkeyPatch, masks: bool, count: int = NEIGHBOURS
    ) -> None:
        rng = np.random.default_rng(5)
        updater, views = prepare(settings.model_copy(update={"iterations": 2}), masks=masks, count=count)
        self.hierarchy, self.neighbours = tied(settings, BEFORE, count)
        scales = np.repeat([0.03, 0.01, 0.1], [3, 3, 4])
        clusters = [(scales * rng.normal(size=(size, 10))).astype(np.float32) for size in self.hierarchy.sizes]
        deltas = (0.01 * rng.normal(size=(MOVING, 9))).astype(np.float32)
        deltas[:, 6:] *= 20
        colours = (BEFORE.colours + 0.05 * rng.normal(size=BEFORE.colours.shape)).astype(np.float32)
        self.parameters = [*clusters, deltas, colours]
        self.gradients: list[np.ndarray] = []
        seen: list[int] = []

        def step(optimizer: Adam, gradients: np.ndarray, factor: float) -> None:
            table = len(self.gradients) % len(self.parameters)
            self.gradients.append(gradients.copy())
            optimizer._parameters[:] = self.parameters[table]

        evaluate, neighbour_losses = CpuRenderer.forward_backward, CpuDeformation.neighbour_losses

        def rendered(loss: CpuRenderer, *given: Any) -> Any:
            seen.append(RIG.names.index(given[4].name))
            return evaluate(loss, *given)

        def looked_at(deformation: CpuDeformation, sample: np.ndarray, *given: Any) -> Any:
            self.sample = sample.copy()
            return neighbour_losses(deformation, sample, *given)

        monkeypatch.setattr(Adam, "step", step)
        monkeypatch.setattr(CpuRenderer, "forward_backward", rendered)
        monkeypatch.setattr(CpuDeformation, "neighbour_losses", looked_at)
        self.near = updater.plan.limits.near
        self.loss = updater.run(BEFORE, views, None, 1.0, seed=9).trace.losses[1]
        self.gradients = self.gradients[len(self.parameters) :]
        assert len(seen) == 2 * settings.views
        self.views = seen[settings.views :]


def twin_iteration(fused: Iteration, settings: UpdateSettings, masks: bool) -> tuple[float, list[np.ndarray]]:
    """Loss and gradients of the same parameters and views in float64 torch."""
    rows, weights, frame = fused.hierarchy.rows, settings.weights, take_frame(1, 1.0, AFTER, RIG, masks)
    graph = torch.tensor(fused.neighbours.index.astype(np.int64)), doubles(fused.neighbours.weights)
    given = [doubles(table).requires_grad_() for table in fused.parameters]
    *clusters, deltas, colours = given
    layers = [
        Layer(torch.tensor(labels.astype(np.int64)), ClusterParams(p[:, :3], p[:, 3:6], p[:, 6:9], p[:, 9]))
        for labels, p in zip(fused.hierarchy.labels, clusters, strict=True)
    ]
    own = Deltas(deltas[:, :3], deltas[:, 3:6], deltas[:, 6:])
    means, factors, before = doubles(BEFORE.means), doubles(BEFORE.factors), doubles(BEFORE.colours)
    now = deform(means[rows], factors[rows], layers, own, settings.cluster_map, settings.covariance)
    features, background = colours, [0.0] * 3
    if masks:
        features, background = torch.cat([colours, doubles(BEFORE.foreground)[:, None]], dim=1), [0.0] * 4
    terms = []
    for index in fused.views:
        camera = RIG.cameras[index]
        moved_means, moved_factors = (
            whole.index_copy(0, torch.tensor(rows), part)
            for whole, part in ((means, now.means), (factors, now.factors))
        )
        picture = rasterizer.render(
            moved_means, moved_factors, doubles(BEFORE.opacities), features,
            rasterizer.CameraParams.of(camera), doubles(background), DEFAULT._replace(near=fused.near),
        ).features  # fmt: skip
        image = doubles(frame.images[camera.name] / 255.0)
        terms.append(schedule.IMAGE_WEIGHT * losses.image_loss(picture[..., :3], image) / len(fused.views))
        if masks:
            mask = doubles(frame.masks[camera.name])[..., None]
            terms.append(weights.mask * losses.image_loss(picture[..., 3:], mask) / len(fused.views))
    sample, distances = torch.tensor(fused.sample), doubles(fused.neighbours.distances)
    lengths = doubles(np.linalg.norm(BEFORE.factors[rows].astype(np.float64), axis=1))
    terms += [
        schedule.SOFT_COLOUR_WEIGHT * losses.soft_colour_loss(colours, before),
        weights.rigidity * losses.rigidity_loss(now.means, now.turns, means[rows], *graph, sample),
        weights.isometry * losses.isometry_loss(now.means, distances, *graph, sample),
        weights.rotation * losses.rotation_loss(now.turns, *graph, sample),
        weights.scale * losses.scale_loss(now.factors, lengths, MAX_SCALE),
    ]
    loss = torch.stack(terms).sum()
    loss.backward()
    return loss.item(), [tensor.grad.numpy() for tensor in given]


def doubles(array: Any) -> torch.Tensor:
    return torch.tensor(np.asarray(array), dtype=torch.float64)


@pytest.mark.parametrize("masks", [True, False])
@pytest.mark.parametrize("cluster_map", ["centred", "published"])
@pytest.mark.parametrize("clusters", [(2, 12, 48), ()])
def test_one_whole_iteration_agrees_with_the_float64_twin(
    clusters: tuple[int, ...], cluster_map: str, masks: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    agrees_with_the_twin({"clusters": clusters, "cluster_map": cluster_map}, masks, monkeypatch)


@pytest.mark.parametrize("masks", [True, False])
def test_an_iteration_of_two_views_agrees_with_the_float64_twin(masks: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    agrees_with_the_twin({"views": 2}, masks, monkeypatch)


def test_an_iteration_with_a_separate_covariance_agrees_with_the_float64_twin(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    agrees_with_the_twin({"covariance": "separate"}, True, monkeypatch)


def test_motion_is_found_with_a_separate_covariance() -> None:
    found = update(CALM.model_copy(update={"covariance": "separate"}), masks=False)
    assert np.median(errors(found.gaussians, AFTER)) < 1e-3


def agrees_with_the_twin(changes: dict[str, Any], masks: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(schedule, "NEIGHBOUR_SAMPLE", 150)
    settings = SETTINGS.model_copy(update=changes)
    fused = Iteration(settings, monkeypatch, masks, count=6)
    _, gradients = twin_iteration(fused, settings, masks)
    assert len(gradients) == len(fused.gradients)
    for table, (value, wanted) in enumerate(zip(fused.gradients, gradients, strict=True)):
        scale = np.abs(wanted).max(axis=0)
        assert (scale > 0).all()
        np.testing.assert_allclose(value / scale, wanted / scale, atol=2e-3, err_msg=f"table {table}")
        assert np.linalg.norm((value - wanted) / scale) < 1e-3 * np.linalg.norm(wanted / scale), f"table {table}"


@pytest.mark.parametrize("views", [1, 2])
@pytest.mark.parametrize("masks", [True, False])
def test_the_reported_loss_is_that_of_the_twin(masks: bool, views: int, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = SETTINGS.model_copy(update={"views": views})
    fused = Iteration(settings, monkeypatch, masks)
    assert fused.loss == pytest.approx(twin_iteration(fused, settings, masks)[0], rel=2e-5)


def test_several_views_are_a_mean_and_one_is_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """The mean of a view and itself is that view to the last bit, and so is the whole update."""
    given: list[tuple[bool, float]] = []
    inside, evaluate = CpuEngine._pictures, CpuRenderer.forward_backward
    last: list[Any] = []

    def rendered(picture: CpuRenderer, *arguments: Any) -> Any:
        last[:] = [evaluate(picture, *arguments), picture.image_part + picture.mask_part]
        return last[0]

    def pictures(engine: CpuEngine, views: Any, step: StepScalars) -> Any:
        loss, gradients = inside(engine, views, step)
        given.append((gradients is last[0], loss - last[1]))
        return loss, gradients

    monkeypatch.setattr(CpuRenderer, "forward_backward", rendered)
    monkeypatch.setattr(CpuEngine, "_pictures", pictures)
    found = []
    for count in (1, 2, 4):
        updater, views = prepare(SETTINGS.model_copy(update={"iterations": 4, "views": count}))
        found.append(updater.run(BEFORE, views[:1], None, 1.0, seed=1))
        assert len(found[-1].trace.losses) == 4
        assert len(found[-1].trace.psnr) == 4 * count
    assert given == [(True, 0.0)] * 4 + [(False, 0.0)] * 8
    for other in found[1:]:
        assert other.trace.losses == found[0].trace.losses
        for name, array in found[0].gaussians.arrays().items():
            np.testing.assert_array_equal(getattr(other.gaussians, name), array)


@pytest.mark.parametrize("each", [1, 2, 5])
def test_each_view_has_its_turn_before_any_has_another(each: int) -> None:
    settings = SETTINGS.model_copy(update={"views": each})
    _, views = prepare(settings)
    count, most = len(views), 30
    plan = ViewPlan(count, each, most, np.random.default_rng(7))
    taken = [plan.take() for _ in range(most)]
    assert {len(seen) for seen in taken} == {each}
    order = [view for seen in taken for view in seen]
    assert order == view_order(count, most * each, np.random.default_rng(7))
    rounds = [order[start : start + count] for start in range(0, len(order) - count + 1, count)]
    assert all(len(set(seen)) == count for seen in rounds)


def test_cameras_are_judged_once_all_were_seen() -> None:
    _, views = prepare()
    for each in (1, 2, len(views) + 2):
        asked: list[int] = []
        updater, _ = prepare(SETTINGS.model_copy(update={"iterations": 2 * len(views), "views": each}))

        def gate(first: Any, current: Current, asked: list[int] = asked) -> dict[str, str]:
            asked.append(len(first))
            state, now = current()
            assert np.isfinite(state.means).all()
            assert [view.name for view in now] == [view.name for view in views]
            return {}

        updater.run(BEFORE, views, None, 1.0, 1, AttemptOptions(stopping=Stopping(2 * len(views)), gate=gate))
        assert asked == [len(views)]


def test_without_a_graph_no_neighbour_term_is_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("computed")

    monkeypatch.setattr(neighbour_terms, "neighbour_terms", refuse)
    settings = SETTINGS.model_copy(update={"iterations": 2})
    updater, views = prepare(settings)
    with pytest.raises(AssertionError, match="computed"):
        updater.run(BEFORE, views, None, 1.0, seed=1)
    factory = ViewFactory(RIG)
    bare = FrameUpdate(CpuEngine(), of_whole_pictures(factory, settings, updater.hierarchy, BEFORE), None)
    assert len(bare.run(BEFORE, views, None, 1.0, seed=1).trace.losses) == 2


@pytest.mark.parametrize("name", ["mask", "rigidity", "isometry", "rotation", "scale", "SOFT_COLOUR_WEIGHT"])
def test_each_weight_enters_the_loss(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The loss is linear in each weight: 0, 1 and 3 times a weight lie on a line that is not level."""
    losses = []
    for factor in (0.0, 1.0, 3.0):
        weights = SETTINGS.weights
        with monkeypatch.context() as patch:
            if name == "SOFT_COLOUR_WEIGHT":
                patch.setattr(schedule, name, factor)
            else:
                weights = weights.model_copy(update={name: factor})
            losses.append(Iteration(SETTINGS.model_copy(update={"weights": weights}), patch, masks=True).loss)
    assert losses[1] - losses[0] > 1e-5
    assert losses[2] - losses[0] == pytest.approx(3 * (losses[1] - losses[0]), rel=2e-2)


def test_samples_cover_every_moving_gaussian_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(schedule, "NEIGHBOUR_SAMPLE", 100)
    samples = plan_samples(MOVING, np.random.default_rng(0))
    assert [len(sample) for sample in samples] == [100, 100, 100, 84]
    np.testing.assert_array_equal(np.sort(np.concatenate(samples)), np.arange(MOVING))
    assert [len(sample) for sample in plan_samples(0, np.random.default_rng(0))] == [0]


def test_a_shift_of_everything_is_found_by_clusters() -> None:
    truth = moved(BEFORE, turn=TURN**0, shift=SHIFT)
    settings = CALM.model_copy(update={"clusters": (1, 12, 48), "momentum": 1.0})  # otherwise own shifts are not kept
    updater, views = prepare(settings, truth, masks=False)
    state = updater.run(BEFORE, views, None, 1.0, seed=1)
    assert np.median(errors(state.gaussians, truth)) < 1e-3
    assert state.motion is not None
    layers = zip(state.motion.shifts, updater.hierarchy.labels, strict=True)
    by_clusters = np.sum([shifts[labels] for shifts, labels in layers], axis=0)
    assert np.median(np.linalg.norm(by_clusters - SHIFT, axis=1)) < 0.15 * np.linalg.norm(SHIFT)
    assert np.median(np.linalg.norm(state.motion.own_shifts, axis=1)) < 0.1 * np.linalg.norm(SHIFT)


def test_deformation_starts_from_what_it_is_given() -> None:
    hierarchy, _ = tied(SETTINGS, BEFORE)
    deformation = CpuDeformation(hierarchy, None, np.full((MOVING, 3), 1, np.float32), "centred")
    deformation.start(BEFORE)
    deformation.forward()
    np.testing.assert_array_equal(deformation.means, BEFORE.means)
    np.testing.assert_array_equal(deformation.factors, BEFORE.factors)
    np.testing.assert_array_equal(deformation.turns, np.tile(np.float32([1, 0, 0, 0]), (MOVING, 1)))


def test_a_layer_that_begins_late_stays_where_it_was_before(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rates, "LAYER_STARTS", (0.0, 0.5, 0.5))
    settings = SETTINGS.model_copy(update={"deltas_start": 0.5, "iterations": 3})
    engine = CpuEngine()
    updater, views = prepare(settings, engine=engine)
    seen: list[list[np.ndarray]] = []
    inside = engine._deformation
    forward = inside.forward

    def record() -> None:
        seen.append([table.copy() for table in [*inside.clusters, inside.deltas]])
        forward()

    inside.forward = record  # type: ignore[method-assign]
    updater.run(BEFORE, views, None, 1.0, seed=1)
    moved_by = [[bool(np.abs(table).max() > 0) for table in tables] for tables in seen]
    # Half of three iterations, rounded, is two: in the third (from 0) all learn, and the commit sees it.
    assert moved_by == [[False] * 4, [True, False, False, False], [True, False, False, False], [True] * 4]


def test_the_stages_are_all_the_time_and_the_timers_are_a_part_of_the_report() -> None:
    watch = Stopwatch(perf_counter())
    for stage in ("one", "two", "one"):
        watch.lap(stage)
    assert set(watch.seconds) == {"one", "two", REPORT}
    assert watch.seconds[REPORT] > 0
    assert sum(watch.seconds.values()) == pytest.approx(watch.total)
