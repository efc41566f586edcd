"""Colour by direction: found where things are glossy and only there, kept with the state, seen in views; off is off."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from box_scene import look_at
from effect_cases import BEFORE, UPDATE, same, updated
from effect_cases.glossy_ball import COUNT, RADIUS, frame, picture, rig, sphere
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import WorldFrame
from scas4d_core.effects.appearance.direction import EFFECT
from scas4d_core.effects.evidence import Evidence, FrameObservation
from scas4d_core.effects.switches import first_switches, names_on, register_effects
from scas4d_core.engines.cpu.engine import CpuEngine
from scas4d_core.engines.cpu.gloss import (
    GLOSS,
    GlossShading,
    colours_seen,
    gloss_rate,
    without_turn,
)
from scas4d_core.engines.cpu.renderer import CpuRenderer
from scas4d_core.engines.renderer import Neighbourhoods
from scas4d_core.engines.views import CameraArrays
from scas4d_core.first_frame.gloss_strengths import estimate_strengths
from scas4d_core.first_frame.glossy import fit_with_gloss_trial
from scas4d_core.first_frame.normals import surface_normals
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.first_frame.static_scene import first_trainer
from scas4d_core.gaussians import Gaussians
from scas4d_core.kernels.appearance.direction import CELLS, MIDDLE, NEARNESS, SIDE
from scas4d_core.preparation import SMALLEST_CLUSTER
from scas4d_core.query.committed import CommittedScene
from scas4d_core.query.harmonics import basis_of
from scas4d_core.query.ply import write_ply
from scas4d_core.settings import SceneSettings, Settings, StaticSettings
from scas4d_core.storage.history import History
from scas4d_core.structure.hierarchy import build_hierarchy
from scas4d_core.update.frame_update import FrameUpdate
from scas4d_core.update.parts import PlanBuilder
from scas4d_core.update.view_factory import ViewFactory


def fitted(state: Gaussians, mode: str, iterations: int = 1200) -> StaticResult:
    static = StaticSettings(iterations=iterations, max_gaussians=COUNT, exposure=False)
    factory, rng = ViewFactory(rig()), np.random.default_rng(0)
    views = factory.views(frame(state), {})
    points = state.means + rng.normal(0, 0.003, state.means.shape)
    return fit_with_gloss_trial(
        lambda: first_trainer(factory, views, points, state.colours, None, SceneSettings(), static),
        mode,  # type: ignore[arg-type]
    )


def after(before: Gaussians, truth: Gaussians, effects: list[str]) -> tuple[Gaussians, Evidence | None]:
    """The state after an update to another, and the evidence for direction in it."""
    factory = ViewFactory(rig())
    views = factory.views(frame(truth, 1), {}, use_masks=False)
    hierarchy = build_hierarchy(before.means, before.moving, (2, 12), SMALLEST_CLUSTER)
    settings = UPDATE.model_copy(update={"iterations": 24})
    built = register_effects(PlanBuilder(SceneSettings(), settings, factory, hierarchy, before), effects)
    updater = FrameUpdate(CpuEngine(), built, None)
    result = updater.run(before, views, None, 1.0, seed=1)
    return result.gaussians, EFFECT.evidence(FrameObservation(1, before, result, rig(), views, CpuRenderer((0, 0, 0))))


@pytest.mark.slow
def test_a_glossy_ball_is_found_in_frame_0_and_a_dull_one_is_fitted_as_if_nobody_had_looked() -> None:
    glossy, dull = fitted(sphere(), "auto"), fitted(sphere(False), "auto")
    shares = [result.evidence["direction"].share for result in (glossy, dull) if result.evidence]
    assert shares[0] > EFFECT.on_above + 0.03
    assert shares[1] < EFFECT.on_above - 0.03
    assert glossy.gaussians.environment is not None
    assert same(dull.gaussians.arrays(), fitted(sphere(False), "off").gaussians.arrays())
    assert "gloss" not in dull.gaussians.arrays()
    for result, on in ((glossy, True), (dull, False)):
        switch = first_switches(Settings(), 0, result.evidence or {})["direction"]
        assert (switch.on, switch.since) == (on, 0)
        assert switch.text.startswith("view-dependent colour explains ")
    without = fitted(sphere(), "off")
    assert np.mean(glossy.psnr[-24:]) > np.mean(without.psnr[-24:]) + 0.5


def test_a_pin_needs_no_evidence_and_off_is_never_tried() -> None:
    assert fitted(sphere(False), "on", 40).gaussians.gloss is not None
    assert fitted(sphere(), "off", 40).evidence is None
    off = Settings.model_validate({"effects": {"direction": "off"}})
    assert not first_switches(off, 0, {"direction": Evidence(1, "")})["direction"].on
    assert "direction" not in names_on(first_switches(Settings(), 0))


def test_normals_are_those_of_the_ball() -> None:
    state = sphere()
    views = ViewFactory(rig()).views(frame(state), {})
    found = surface_normals(state, views, CpuRenderer((0, 0, 0)))
    cosines = np.clip(np.einsum("nc,nc->n", found, state.means / RADIUS), -1, 1)
    assert np.degrees(np.arccos(cosines)).max() < 25
    assert np.degrees(np.arccos(np.median(cosines))) < 6


def test_the_surface_of_a_rough_body_in_a_haze_is_the_haze(monkeypatch: pytest.MonkeyPatch) -> None:
    ball = sphere(False)
    depth = np.random.default_rng(2).uniform(0.8, 0.98, (COUNT, 1)).astype(np.float32)
    body = ball.replace(means=depth * ball.means, factors=np.tile(np.float32(0.012) * np.eye(3), (COUNT, 1, 1)))
    haze = ball.replace(opacities=np.full(COUNT, 0.15, np.float32))
    state = body.replace(factors=body.factors.astype(np.float32)).concatenate(haze)
    views = ViewFactory(rig()).views(frame(state), {})

    def median_angle() -> float:
        found = surface_normals(state, views, CpuRenderer((0, 0, 0)))[COUNT:]
        cosines = np.einsum("nc,nc->n", found, ball.means / RADIUS)
        return float(np.degrees(np.arccos(np.median(cosines))))

    angle = median_angle()
    monkeypatch.setattr("scas4d_core.first_frame.normals.SKIN", 1)
    assert angle < 0.8 * median_angle()


def test_strengths_tell_what_is_glossy_from_what_is_dull() -> None:
    truth = sphere()
    assert truth.gloss is not None
    assert truth.environment is not None
    dull = truth.means[:, 0] < 0
    half = truth.replace(gloss=np.where(dull[:, None], 0, truth.gloss).astype(np.float32))
    views = ViewFactory(rig()).views(frame(half), {})
    normals = (truth.means / RADIUS).astype(np.float32)
    found = estimate_strengths(normals, truth.environment, truth, views, CpuRenderer((0, 0, 0)))[:, 0]
    far = np.abs(truth.means[:, 0]) > 0.05  # neighbours share a strength
    assert np.median(found[dull & far]) < 0.15
    assert 0.3 < np.median(found[~dull & far]) < 0.7
    assert np.isfinite(found).all()
    # Three cameras see few places in the light of a lamp and out of it: the rest has the strength of what is about it.
    found = estimate_strengths(normals, truth.environment, truth, views[:3], CpuRenderer((0, 0, 0)))[:, 0]
    assert np.median(found[dull & far]) < 0.05
    assert 0.3 < np.median(found[~dull & far]) < 0.7


def test_normals_turn_as_fast_whatever_the_strength_that_frame_0_came_out_with() -> None:
    state, camera = sphere(), CameraArrays.of(rig().cameras[0])
    assert state.gloss is not None
    assert state.environment is not None
    pull = np.random.default_rng(0).normal(0, 1, (COUNT, 4)).astype(np.float32)
    turned = []
    for factor in (0.2, 1.0):
        gloss, environment = np.float32(factor) * state.gloss, state.environment.copy()
        environment[: CELLS + 1] /= np.float32(factor)  # the sheen as well
        shading = GlossShading.fresh(gloss.copy(), state.means, environment)
        shading.shade_backward(state.means, without_turn(COUNT), 0 * state.colours, camera, pull.copy())
        shading.step()
        turned.append((shading.gloss - gloss) / factor)
    assert gloss_rate(1e-3, GLOSS * state.means / RADIUS) == pytest.approx(1e-3)
    moved = np.linalg.norm(turned[1], axis=1) > 0
    assert moved.sum() > COUNT / 10
    np.testing.assert_allclose(turned[0][moved], turned[1][moved], rtol=0.01, atol=1e-6)


def test_what_is_seen_from_everywhere_is_colour_and_not_environment() -> None:
    state, rng = sphere(), np.random.default_rng(0)
    assert state.gloss is not None
    shading, camera = GlossShading.fresh(state.gloss.copy(), state.means), CameraArrays.of(rig().cameras[0])
    for _ in range(5):
        pull = rng.normal(1, 1, (COUNT, 4)).astype(np.float32)
        shading.shade_backward(state.means, without_turn(COUNT), state.colours, camera, pull)
        shading.step()
    cells = shading.environment[:CELLS]
    assert np.abs(cells).max() > 0.01
    directions = rng.normal(size=(200_000, 3))
    x, y, z = (directions / np.abs(directions).sum(axis=1, keepdims=True)).T
    u = np.where(z < 0, (1 - np.abs(y)) * np.sign(x), x)
    v = np.where(z < 0, (1 - np.abs(x)) * np.sign(y), y)
    nearest = np.rint((v + 1) / 2 * (SIDE - 1)).astype(int) * SIDE + np.rint((u + 1) / 2 * (SIDE - 1)).astype(int)
    assert np.abs(cells[nearest].mean(axis=0)).max() < 0.03 * np.abs(cells).max()
    assert shading.environment[NEARNESS, 0] >= 0
    assert (shading.environment[MIDDLE] == np.median(state.means, axis=0)).all()


@pytest.mark.slow
def test_highlights_stay_with_the_world_while_the_ball_turns() -> None:
    state = sphere().replace(colours=np.full((COUNT, 3), 0.3, np.float32))
    turn = Rotation.from_rotvec([0.1, 0.5, 0.2])
    means = turn.apply(state.means).astype(np.float32)
    there = CpuRenderer((0, 0, 0)).turn_normals(state, state.replace(means=means), Neighbourhoods(state.means))
    assert there.gloss is not None
    np.testing.assert_allclose(there.gloss, turn.apply(state.gloss), atol=1e-4)
    camera = CameraArrays.of(rig().cameras[3])
    turned, still = (colours_seen(one, camera) for one in (there, state))
    near = np.linalg.norm(there.means[:, None] - state.means[None], axis=-1).argmin(axis=1)
    assert np.abs(turned - still).mean() > 2 * np.abs(turned - still[near]).mean()


def test_an_update_learns_it_and_says_so() -> None:
    truth = sphere()
    assert truth.environment is not None
    before = truth.replace(environment=0 * truth.environment)
    effects = ["moving_colour", "direction"]
    state, evidence = after(before, truth, effects)
    assert evidence is not None
    assert evidence.share > 0.05
    assert evidence.text == f"view-dependent colour explains {100 * evidence.share:.0f}% of the residual"
    assert state.gloss is not None
    assert before.gloss is not None
    assert not np.array_equal(state.gloss, before.gloss)
    assert after(before.replace(gloss=None, environment=None), truth, effects)[1] is None


def test_without_gloss_nothing_changes_a_bit() -> None:
    effects = ["rigidity", "moving_colour"]
    assert same(updated(effects), updated([*effects, "direction"]))
    assert colours_seen(BEFORE, CameraArrays.of(rig().cameras[0])) is BEFORE.colours


def test_states_on_disk_have_it_and_views_show_it(tmp_path: Path) -> None:
    state, camera, world = sphere(), rig().cameras[2], WorldFrame(np.zeros(3))
    for name, kept in (("glossy", state), ("dull", state.replace(gloss=None, environment=None))):
        History(tmp_path / name).append(0, 0.0, kept)
    found, dull = (History.load(tmp_path / name) for name in ("glossy", "dull"))
    assert found.gaussians(0).gloss is not None
    assert same(state.arrays(), found.gaussians(0).arrays())
    shown = CommittedScene(found, world).render(camera).colour
    np.testing.assert_allclose(np.clip(shown, 0, 1), picture(state, camera) / 255.0, atol=1 / 255)
    assert np.abs(CommittedScene(dull, world).render(camera).colour - shown).max() > 0.1
    with np.load(next((tmp_path / "dull").glob("frame_*.npz"))) as file:
        assert not {"gloss", "environment"} & set(file.files)


def test_splat_files_have_harmonics_of_it(tmp_path: Path) -> None:
    state, world = sphere(), WorldFrame(np.zeros(3))
    write_ply(tmp_path / "a.ply", state, world)
    table = PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    rest = np.stack([table[f"f_rest_{k}"] for k in range(45)], axis=1).reshape(COUNT, 3, 15)
    first = np.stack([table[f"f_dc_{k}"] for k in range(3)], axis=1)[:, :, None]
    coefficients = np.concatenate([first, rest], axis=2)
    camera = look_at("far", [600, -200, 900])
    away = -np.asarray(camera.centre) / np.linalg.norm(camera.centre)
    shown = 0.5 + coefficients @ basis_of(away[None])[0]
    truth = colours_seen(state, CameraArrays.of(camera))
    assert np.square(shown - truth).mean() < 0.5 * np.square(truth - truth.mean(axis=0)).mean()
    glints = (truth - state.colours).min(axis=1) > 0.1
    assert glints.any()
    assert (shown - state.colours)[glints].mean() > 0.3 * (truth - state.colours)[glints].mean()
    write_ply(tmp_path / "b.ply", sphere(False), world)
    assert "f_rest_0" not in PlyData.read(str(tmp_path / "b.ply"))["vertex"].data.dtype.names


def test_those_born_later_are_dull() -> None:
    state = sphere()
    grown = state.concatenate(Gaussians.of_points(np.zeros((3, 3)), 0.02))
    assert grown.gloss is not None
    assert len(grown.gloss) == COUNT
    seen = colours_seen(grown, CameraArrays.of(rig().cameras[0]))
    assert (seen[COUNT:] == 0.5).all()
    assert not (seen[:COUNT] == state.colours).all()
    some = grown.rows([COUNT + 1, 7])
    assert some.gloss is not None
    assert not some.gloss[0].any()
    assert (some.gloss[1] == state.gloss[7]).all()  # type: ignore[index]
