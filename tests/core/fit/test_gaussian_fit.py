"""The loop of a fit: gradients, what it leaves alone, where it ends, and how its rows change."""

from __future__ import annotations

import importlib.util
import os
from typing import Any

import numpy as np
import pytest
from box_scene import make_box, make_rig, take_frame
from engine_cases import assert_repeated

from scas4d_core.engines.choose import WARP_DEVICE, fit_engine_of, renderer_of
from scas4d_core.engines.cpu.gloss import GlossShading
from scas4d_core.engines.fit import COLOUR, COLUMNS, LABEL, MEAN, OPACITY, SCALE, FitLoss, FitScalars
from scas4d_core.engines.limits import scene_limits
from scas4d_core.engines.renderer import Renderer
from scas4d_core.engines.views import TrainingView
from scas4d_core.fit.exposures import Exposures
from scas4d_core.fit.gaussian_fit import BETA1, BETA2, FitStep, GaussianFit, each_once
from scas4d_core.fit.initial_gaussians import initial_parameters
from scas4d_core.kernels.appearance.direction import CELLS
from scas4d_core.update.view_factory import ViewFactory

RIG, BOX = make_rig(), make_box()
DEVICES = ["cpu", "gpu"] if importlib.util.find_spec("warp") else ["cpu"]
"""Without a GPU, "gpu" runs the Warp engine on Warp's CPU device."""
RENDERERS: dict[str, Renderer] = {}
COUNT = 150
ALL = np.full(COLUMNS, 1e-3, np.float32)


@pytest.fixture(params=DEVICES, autouse=True)
def device(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Runs each test on each engine."""
    monkeypatch.setenv(WARP_DEVICE, os.environ.get(WARP_DEVICE, "cpu"))
    use(request.param)
    return str(request.param)


def use(device: str) -> None:
    """Selects the engine of the following fits."""
    RENDERERS["now"] = renderer_of(device, (0.1, 0.2, 0.3), scene_limits("auto", RIG.radius))


def make_views() -> list[TrainingView]:
    return ViewFactory(RIG).views(take_frame(0, 0.0, BOX, RIG), {})


def table(seed: int = 0) -> np.ndarray:
    """Parameters near the surfaces, with colours, scales and labels that are off."""
    rng = np.random.default_rng(seed)
    made = initial_parameters(BOX.means.astype(np.float64), BOX.colours, BOX.foreground, COUNT, rng)
    made[:, MEAN.start : COLOUR.stop] += rng.normal(0, 0.02, (COUNT, 14)).astype(np.float32)
    made[:, OPACITY] += 2
    return made


def make_fit(parameters: np.ndarray | None = None, mask_weight: float = 0.0, **more: Any) -> GaussianFit:
    engine = fit_engine_of(RENDERERS["now"], mask_weight)
    return GaussianFit(engine, make_views(), table() if parameters is None else parameters, **more)


def only(columns: slice, rate: float = 1e-2) -> FitScalars:
    rates = np.zeros(COLUMNS, np.float32)
    rates[columns] = rate
    return FitScalars(rates)


def loss_of(parameters: np.ndarray, mask_weight: float) -> float:
    fit = make_fit(parameters.copy(), mask_weight=mask_weight)
    fit.run([0], lambda now: FitScalars(0 * ALL))
    return fit.losses[0]


@pytest.mark.parametrize(
    ("columns", "mask_weight", "step"),
    [(MEAN, 0.0, 2e-4), (SCALE, 0.0, 4e-3), (OPACITY, 0.0, 2e-2), (COLOUR, 0.0, 4e-3), (LABEL, 3.0, 2e-2)],
)
def test_gradients_are_those_of_finite_differences(columns: slice, mask_weight: float, step: float) -> None:
    fit = make_fit(mask_weight=mask_weight)
    fit.run([0], lambda now: FitScalars(ALL))
    gradient = np.zeros((COUNT, COLUMNS))
    gradient[:, columns] = fit.table.first[:, columns] / (1 - BETA1)
    direction = gradient / np.abs(gradient).max()
    ahead, behind = (loss_of((table() + side * step * direction).astype(np.float32), mask_weight) for side in (1, -1))
    slope = float((gradient * direction).sum())
    assert (ahead - behind) / (2 * step) == pytest.approx(slope, rel=0.05)


@pytest.mark.parametrize("columns", [MEAN, OPACITY, COLOUR])
def test_columns_whose_rate_is_zero_stay_bit_for_bit(columns: slice) -> None:
    before, fit = table(), make_fit()
    fit.run([0, 1, 2, 3], lambda now: only(columns))
    after, others = fit.table.parameters, np.ones(COLUMNS, bool)
    others[columns] = False
    np.testing.assert_array_equal(after[:, others], before[:, others])
    assert (after[:, columns] != before[:, columns]).any()


def test_colours_that_learn_alone_have_the_bits_that_they_have_beside_the_rest() -> None:
    alone, together = make_fit(), make_fit()
    alone.run([0], lambda now: only(COLOUR, 1e-3))
    together.run([0], lambda now: FitScalars(ALL))
    assert_repeated(alone.table.parameters[:, COLOUR], together.table.parameters[:, COLOUR])
    assert_repeated(alone.losses, together.losses)


def test_fixed_gaussians_are_drawn_and_stay_as_they_are() -> None:
    faint, before = table(), {name: array.copy() for name, array in BOX.arrays().items()}
    faint[:, OPACITY] = -4
    beside, alone = make_fit(faint.copy(), fixed=[BOX] * len(RIG.cameras)), make_fit(faint.copy())
    for fit in (beside, alone):
        fit.run([0, 1] * 10, lambda now: FitScalars(10 * ALL))
        assert len(fit.state()) == len(fit) == COUNT
        assert fit.losses[-1] < fit.losses[1]
    for name, array in BOX.arrays().items():
        np.testing.assert_array_equal(array, before[name])
    assert beside.psnr[0] > alone.psnr[0] + 2


def test_glossy_fixed_gaussians_are_drawn_as_each_camera_sees_them() -> None:
    normals = BOX.means / np.linalg.norm(BOX.means, axis=1, keepdims=True)
    environment = GlossShading.fresh(normals, BOX.means).environment
    environment[:CELLS] = np.random.default_rng(0).uniform(-0.5, 1, (CELLS, 3))
    glossy = BOX.replace(gloss=normals, environment=environment)
    clear = table()[:1]
    clear[:, OPACITY] = -20
    fit = make_fit(clear, fixed=[glossy] * len(RIG.cameras))
    fit.run(range(len(RIG.cameras)), lambda now: FitScalars(0 * ALL))
    assert fit.psnr == [pytest.approx(one.psnr, rel=1e-5) for one in RENDERERS["now"].compare(glossy, fit.views)]
    assert abs(fit.psnr[0] - RENDERERS["now"].compare(BOX, fit.views[:1])[0].psnr) > 1


def test_a_fit_with_no_fixed_gaussians_in_a_view_has_the_bits_of_one_without() -> None:
    empty = make_fit(fixed=[BOX.rows(np.zeros(0, np.int64))] * len(RIG.cameras))
    plain = make_fit()
    for fit in (empty, plain):
        fit.run([0, 1, 2], lambda now: FitScalars(ALL))
    assert_repeated(empty.table.parameters, plain.table.parameters)


def test_the_caller_ends_a_fit_before_or_after_an_iteration() -> None:
    fit = make_fit()
    fit.run([0] * 9, lambda now: FitScalars(ALL), lambda done: each_once(done) if done < 2 else None)
    assert len(fit.losses) == len(fit.psnr) == 2
    steps: list[tuple[FitStep, int]] = []

    def end(now: FitStep, last: FitLoss) -> bool:
        steps.append((now, last.view))
        return len(steps) == 3

    fit.run([4, 3, 2, 1], lambda now: FitScalars(ALL, colour_shift=True), end=end)
    assert steps == [(FitStep(0, 1), 4), (FitStep(1, 2), 3), (FitStep(2, 3), 2)]
    assert fit.table.steps == len(fit.losses) == 5


def test_kept_rows_keep_their_moments_and_new_ones_have_none() -> None:
    fit = make_fit(statistics=True)
    fit.run([0, 1], lambda now: FitScalars(ALL))
    before = fit.table
    assert before.statistics is not None
    assert before.statistics.rendered.max() == 2
    assert (before.statistics.screen_gradients > 0).any()
    kept, added = np.array([5, 1, 7]), table(1)[:2]
    fit.replace_rows(kept, added, np.array([5, 5]))
    after = fit.table
    assert (len(fit), after.steps) == (5, 2)
    for name in ("parameters", "first", "second"):
        np.testing.assert_array_equal(getattr(after, name)[:3], getattr(before, name)[kept])
    np.testing.assert_array_equal(after.parameters[3:], added)
    assert not after.first[3:].any()
    assert after.statistics is not None
    assert not after.statistics.rendered.any()
    fit.run([2], lambda now: FitScalars(ALL))
    assert make_fit().table.statistics is None


def test_gloss_is_learnt_where_it_is_given_and_new_rows_inherit_it() -> None:
    plain = make_fit()
    assert plain.table.gloss is None
    assert plain.state().gloss is None
    normals = (BOX.means[:COUNT] / np.linalg.norm(BOX.means[:COUNT], axis=1, keepdims=True)).astype(np.float32)
    gloss = GlossShading.fresh(0.5 * normals, table()[:, MEAN])
    fit = make_fit(gloss=gloss)
    fit.run([0, 1, 2], lambda now: only(COLOUR))
    state = fit.state()
    assert state.gloss is not None
    assert state.environment is not None
    assert state.environment.any()
    assert (state.gloss != 0.5 * normals).any()
    fit.replace_rows(np.arange(4), table(1)[:1], np.array([3]))
    assert fit.table.gloss is not None
    np.testing.assert_array_equal(fit.table.gloss.gloss[4], state.gloss[3])


def test_a_gloss_that_the_host_edits_is_the_one_that_is_learnt_on() -> None:
    normals = (BOX.means[:COUNT] / np.linalg.norm(BOX.means[:COUNT], axis=1, keepdims=True)).astype(np.float32)
    fit = make_fit(gloss=GlossShading.fresh(0.5 * normals, table()[:, MEAN]))
    fit.run([0, 1], lambda now: only(COLOUR))
    gloss = fit.table.gloss
    assert isinstance(gloss, GlossShading)
    gloss.gloss[:] = -0.3 * normals
    fit.set_gloss(gloss)
    assert fit.table.gloss is not None
    np.testing.assert_array_equal(fit.table.gloss.gloss, -0.3 * normals)
    fit.run([0], lambda now: only(COLOUR))
    assert np.abs(fit.table.gloss.gloss + 0.3 * normals).max() < 0.01


def test_exposures_are_learnt_where_they_are_given() -> None:
    fit = make_fit()
    fit.run([0, 1], lambda now: FitScalars(ALL))
    assert all((view.exposure == (1, 0)).all() for view in fit.views)
    views = make_views()
    learnt = Exposures(views, True, 1e-3, BETA1, BETA2)
    fit = GaussianFit(fit_engine_of(RENDERERS["now"]), views, table(), exposures=learnt)
    fit.run([0, 1, 2], lambda now: FitScalars(0 * ALL))
    gains = np.array([view.exposure[:3, 0] for view in views])
    assert (gains[:3] != 1).all()
    np.testing.assert_allclose(gains.mean(axis=0), 1, atol=1e-6)


@pytest.mark.skipif(len(DEVICES) < 2, reason="NVIDIA Warp is not installed: pip install warp-lang")
@pytest.mark.parametrize("case", ["plain", "masks", "fixed", "gloss", "exposures"])
def test_the_engines_agree(case: str) -> None:
    ends = {}
    for device in DEVICES:
        use(device)
        more: dict[str, Any] = {}
        if case == "fixed":
            more["fixed"] = [BOX.rows(np.arange(10 * k)) for k in range(len(RIG.cameras))]
        if case == "gloss":
            normals = (BOX.means[:COUNT] / np.linalg.norm(BOX.means[:COUNT], axis=1, keepdims=True)).astype(np.float32)
            more["gloss"] = GlossShading.fresh(0.5 * normals, table()[:, MEAN])
        fit = make_fit(mask_weight=3.0 * (case == "masks"), statistics=True, **more)
        if case == "exposures":
            fit.exposures = Exposures(fit.views, True, 1e-2, BETA1, BETA2)
        fit.run([0, 1, 2, 3, 0, 1], lambda now: FitScalars(ALL, colour_shift=True))
        ends[device] = fit
    mine, true = ends["gpu"], ends["cpu"]
    assert mine.losses == pytest.approx(true.losses, rel=1e-3)
    assert mine.psnr == pytest.approx(true.psnr, rel=1e-3)
    before = table()
    changes = [fit.table.parameters - before for fit in (mine, true)]
    assert np.linalg.norm(changes[0] - changes[1]) < 0.05 * np.linalg.norm(changes[1])
    for name in ("screen_gradients", "rendered", "factors"):
        one, other = (getattr(fit.table.statistics, name) for fit in (mine, true))
        assert np.linalg.norm(one - other) < 0.01 * np.linalg.norm(other), name
    if case == "gloss":
        assert mine.table.gloss is not None
        assert true.table.gloss is not None
        for name in ("gloss", "environment"):
            one, other = (getattr(fit.table.gloss, name) for fit in (mine, true))
            assert np.linalg.norm(one - other) < 0.01 * np.linalg.norm(other), name
    exposures = [np.stack([view.exposure for view in fit.views]) for fit in (mine, true)]
    np.testing.assert_allclose(*exposures, atol=1e-4)
    assert (case == "exposures") == bool(np.ptp(exposures[0][:, 0, 0]) > 1e-3)
