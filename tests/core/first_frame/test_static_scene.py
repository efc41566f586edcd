"""Frame 0 of a tiny scene: it is fitted, within its budget, and so are the cameras' exposures."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from box_scene import held_out_camera, make_box, make_rig, photograph, take_frame

from scas4d_core.captures.frame import Frame
from scas4d_core.engines.choose import renderer_of
from scas4d_core.engines.fit import OPACITY, SCALE
from scas4d_core.engines.limits import scene_limits
from scas4d_core.engines.renderer import PairCounts, pair_counts
from scas4d_core.engines.views import CameraArrays
from scas4d_core.first_frame import static_scene
from scas4d_core.first_frame.fit_schedule import FitProgress
from scas4d_core.first_frame.static_scene import (
    STOP_ROUNDS,
    StaticResult,
    StaticTrainer,
    first_trainer,
)
from scas4d_core.fit.exposures import SPREAD
from scas4d_core.fit.initial_gaussians import initial_parameters, logit
from scas4d_core.gaussians import Gaussians
from scas4d_core.settings import SceneSettings, StaticSettings
from scas4d_core.update.view_factory import ViewFactory

RIG = make_rig()
BOX = make_box()
SETTINGS = StaticSettings(iterations=1000, max_gaussians=900, exposure=False)


@pytest.fixture(scope="module", autouse=True)
def few_iterations_do() -> Iterator[None]:
    """Densified early and often, at higher rates."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (
            ("DENSIFY_FROM", 50),
            ("DENSIFY_EVERY", 50),
            ("RATE_COLOUR", 1e-2),
            ("RATE_POSITION", 8e-4),
        ):
            patch.setattr(static_scene, name, value)
        yield


def cloud() -> tuple[np.ndarray, np.ndarray]:
    """Points near the surfaces (1 cm off), two thirds of them, with noisy colours."""
    rng = np.random.default_rng(3)
    rows = rng.permutation(len(BOX))[: 2 * len(BOX) // 3]
    noise = rng.normal(0, 0.1, (len(rows), 3))
    colours = np.clip(BOX.colours[rows] + noise, 0, 1).astype(np.float32)
    return BOX.means[rows] + rng.normal(0, 0.01, (len(rows), 3)), colours


def fit(settings: StaticSettings = SETTINGS, frame: Frame | None = None, masks: bool = True) -> StaticResult:
    factory = ViewFactory(RIG)
    frame = frame or take_frame(0, 0.0, BOX, RIG, masks)
    trainer = first_trainer(factory, factory.views(frame, {}), *cloud(), None, SceneSettings(), settings)
    return trainer.result(trainer.train())


def new_trainer(settings: StaticSettings = SETTINGS) -> StaticTrainer:
    factory = ViewFactory(RIG)
    views = factory.views(take_frame(0, 0.0, BOX, RIG), {})
    parameters = initial_parameters(*cloud(), None, 1000, np.random.default_rng(0))
    return StaticTrainer(factory, views, parameters, SceneSettings(), settings)


def psnr(gaussians: Gaussians) -> float:
    """dB of the camera that no fit has seen."""
    camera = held_out_camera()
    found, truth = (photograph(state, camera)[0] / 255.0 for state in (gaussians, BOX))
    return float(-10 * np.log10(np.square(found - truth).mean()))


@pytest.fixture(scope="module")
def fitted() -> StaticResult:
    return fit()


def test_loss_falls_and_a_held_out_view_is_close(fitted: StaticResult) -> None:
    assert len(fitted.losses) == SETTINGS.iterations
    assert np.mean(fitted.losses[-20:]) < 0.5 * np.mean(fitted.losses[:20])
    start = fit(SETTINGS.model_copy(update={"iterations": 1})).gaussians
    assert psnr(fitted.gaussians) > 21
    assert psnr(fitted.gaussians) > psnr(start) + 4


def test_the_state_is_well_formed(fitted: StaticResult) -> None:
    state = fitted.gaussians
    count = len(state)
    assert len(cloud()[0]) < count <= SETTINGS.max_gaussians
    for name, array in state.arrays().items():
        assert len(array) == count, name
        assert np.isfinite(array).all(), name
        assert array.dtype == (np.int64 if name == "ids" else np.float32), name
    assert (np.linalg.det(state.factors) > 0).all()
    assert ((state.opacities > 0) & (state.opacities < 1)).all()
    np.testing.assert_array_equal(state.ids, np.arange(count))
    np.testing.assert_array_equal(state.rotations, np.tile(np.float32([1, 0, 0, 0]), (count, 1)))
    assert fitted.exposures == {}


def test_masks_tell_what_moves(fitted: StaticResult) -> None:
    state = fitted.gaussians
    opaque = state.opacities > 0.5
    in_box = (np.abs(state.means) < 0.19).all(axis=1) | ((np.abs(state.means) < 0.22).all(axis=1))
    on_plate = state.means[:, 1] > 0.3
    assert state.moving[opaque & in_box].mean() > 0.9
    assert state.moving[opaque & on_plate].mean() < 0.1


def test_without_masks_everything_moves() -> None:
    state = fit(SETTINGS.model_copy(update={"iterations": 3}), masks=False).gaussians
    np.testing.assert_array_equal(state.foreground, 1)
    assert state.moving.all()


def test_the_same_seed_gives_the_same_bits_and_another_others() -> None:
    short = SETTINGS.model_copy(update={"iterations": 120})
    one, two, other = fit(short), fit(short), fit(short.model_copy(update={"seed": 1}))
    assert one.losses == two.losses
    for name, array in one.gaussians.arrays().items():
        np.testing.assert_array_equal(array, getattr(two.gaussians, name))
    assert one.losses != other.losses


@pytest.mark.parametrize("limit", [50, 250, 320])
def test_the_budget_is_kept_also_where_the_cloud_exceeds_it(limit: int) -> None:
    settings = SETTINGS.model_copy(update={"iterations": 160, "max_gaussians": limit})
    assert len(fit(settings).gaussians) <= limit


def test_faint_gaussians_are_removed_but_never_all() -> None:
    trainer = new_trainer()
    trainer.fit.run([0], trainer.scalars)
    count = len(trainer.fit)
    trainer.fit.table.parameters[5:25, OPACITY] = logit(np.array(0.5 * static_scene.PRUNE_OPACITY))
    trainer.control_density(0)  # no room: nothing is added
    assert len(trainer.fit) == count - 20
    assert trainer.gaussians().opacities.min() >= static_scene.PRUNE_OPACITY
    trainer.fit.table.parameters[:, OPACITY] = -9
    trainer.control_density(0)
    assert len(trainer.fit) > 0


def test_exposures_of_the_cameras_are_recovered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(static_scene, "RATE_EXPOSURE", 5e-3)
    frame = take_frame(0, 0.0, BOX, RIG)
    gains = dict(zip(RIG.names, (1.2, 0.85, 1.0, 1.1, 0.9, 0.95), strict=True))
    dimmed = {name: image * (0.75 * gains[name]) for name, image in frame.images.items()}
    images = {name: image.round().astype(np.uint8) for name, image in dimmed.items()}
    settings = SETTINGS.model_copy(update={"exposure": True})
    result = fit(settings, Frame(0, 0.0, images, frame.masks))
    assert set(result.exposures) == set(RIG.names)
    found = np.array([result.exposures[name][:, 0].mean() for name in RIG.names])
    truth = np.array(list(gains.values())) / np.mean(list(gains.values()))
    assert found.mean() == pytest.approx(1, abs=1e-3)
    np.testing.assert_allclose(found, truth, atol=0.07)  # of up to 0.2 at the start
    assert np.abs([result.exposures[name][:, 1] for name in RIG.names]).max() < 0.02


@pytest.mark.parametrize(("spread", "kept"), [(0.5 * SPREAD, False), (2.0 * SPREAD, True)])
def test_exposures_are_given_up_where_the_cameras_are_alike(spread: float, kept: bool) -> None:
    trainer = new_trainer(SETTINGS.model_copy(update={"exposure": "auto"}))
    for view, side in zip(trainer.views, (-1, 1, -1, 1, -1, 1), strict=True):
        view.exposure[:3] = (1 + side * spread, 0.02 * side)
    trainer.exposures.assess()
    assert trainer.exposures.on == kept
    assert all((view.exposure == (1, 0)).all() for view in trainer.views) != kept


def test_an_empty_cloud_is_refused() -> None:
    factory = ViewFactory(RIG)
    views = factory.views(take_frame(0, 0.0, BOX, RIG), {})
    nothing = np.zeros((0, 3)), np.zeros((0, 3), np.float32)
    with pytest.raises(ValueError, match="is empty; provide points"):
        first_trainer(factory, views, *nothing, None, SceneSettings(), SETTINGS)


def test_progress_counts_every_iteration() -> None:
    factory = ViewFactory(RIG)
    views = factory.views(take_frame(0, 0.0, BOX, RIG), {})
    seen: list[FitProgress] = []
    short = SETTINGS.model_copy(update={"iterations": 5})
    trainer = first_trainer(factory, views, *cloud(), None, SceneSettings(), short)
    result = trainer.result(trainer.train(seen.append))
    assert [(now.done, now.loss) for now in seen] == list(enumerate(result.losses, start=1))
    assert {now.planned for now in seen} == {5}


def test_gaussians_shrink_only_in_deep_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = SETTINGS.model_copy(update={"iterations": 400})
    cameras = [CameraArrays.of(camera) for camera in RIG.cameras]
    renderer = renderer_of("cpu", (0, 0, 0), scene_limits("auto", RIG.radius))
    monkeypatch.setattr(static_scene, "DEEP", 1000.0)
    shallow = fit(settings)
    monkeypatch.setattr(static_scene, "DEEP", 0.0)
    deep = fit(settings)
    before, after = (pair_counts(renderer, result.gaussians, cameras).mean for result in (shallow, deep))
    assert 0 < after < 0.8 * before
    assert psnr(deep.gaussians) > psnr(shallow.gaussians) - 1
    monkeypatch.setattr(static_scene, "DEEP", 0.9 * before)  # below the number without shrinking
    assert fit(settings).losses != shallow.losses
    monkeypatch.setattr(static_scene, "DEEP_SHRINK", 1.0)
    np.testing.assert_array_equal(fit(settings).losses, shallow.losses)


def test_a_deep_scene_stays_deep(monkeypatch: pytest.MonkeyPatch) -> None:
    counts = iter([PairCounts(1.0, 1), PairCounts(1000.0, 1000)])  # a third count would fail
    monkeypatch.setattr(static_scene, "pair_counts", lambda *given: next(counts))
    trainer = new_trainer()
    shrunk = static_scene.DEEP_SHRINK
    for stride, factor in ((1.0, 1.0), (1.0, shrunk), (1.0, shrunk), (2.0, shrunk**0.5)):
        trainer.schedule.stride = stride
        before = trainer.fit.table.parameters.copy()
        trainer.control_density(0)  # no room: nothing is added
        after = trainer.fit.table.parameters
        np.testing.assert_allclose(after[:, SCALE], before[:, SCALE] + np.log(factor), rtol=1e-5)
        np.testing.assert_array_equal(np.delete(after, np.r_[SCALE], 1), np.delete(before, np.r_[SCALE], 1))


def test_frame_0_ends_early_once_nothing_is_gained(monkeypatch: pytest.MonkeyPatch) -> None:
    """The verdict comes after densification, at the end of some rounds, and one more round follows it."""
    monkeypatch.setattr(static_scene, "DENSIFY_UNTIL", 0.3)
    settings = SETTINGS.model_copy(update={"iterations": 120})
    whole = fit(settings)
    assert len(whole.losses) == 120
    never = fit(settings.model_copy(update={"stop_gain": 0.0}))
    np.testing.assert_array_equal(never.losses, whole.losses)
    cameras = len(RIG.cameras)
    early = fit(settings.model_copy(update={"stop_gain": 0.99}))
    assert 0.3 * 120 < len(early.losses) - cameras < 120  # 60, in fact: the first end of rounds with as many before
    assert (len(early.losses) - cameras) % (STOP_ROUNDS * cameras) == 0
    np.testing.assert_array_equal(early.losses[:-cameras], whole.losses[: len(early.losses) - cameras])
    assert set(early.cameras) == set(RIG.names)
