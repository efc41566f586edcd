"""The object that users hold: start, step, what failed steps leave, and reading through it; in the user's world."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from box_scene import SHIFT, SIZE, held_out_camera, make_box, make_rig, moved, take_frame
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import Rig, WorldFrame, rig_inside
from scas4d_core.captures.frame import Frame, InitialPoints
from scas4d_core.engines.choose import DeviceError, gpu_fault
from scas4d_core.frame_outcome import FrameOutcome
from scas4d_core.frame_times import FrameTime, time_after
from scas4d_core.kernels import neighbour_terms
from scas4d_core.query.ply import read_ply
from scas4d_core.reconstruction import FrameReport, Progress, Reconstruction, StepError
from scas4d_core.settings import SceneSettings, Settings, StaticSettings, UpdateSettings, Weights
from scas4d_core.storage.history import History, run_now
from scas4d_core.storage.npz import read_npz
from studies.constants import varied

BOX = make_box()
TURN = Rotation.from_rotvec([0, 0.05, 0])
STATES = [BOX, moved(BOX, TURN, SHIFT), moved(BOX, TURN**2, TURN.apply(SHIFT) + SHIFT)]
FRAMES = [take_frame(10 + 2 * k, 5.0 + k / 30, state, make_rig()) for k, state in enumerate(STATES)]
METRES = 0.25
WORLD = WorldFrame(np.array([4.0, -7.0, 11.0]), METRES)
SETTINGS = Settings(
    scene=SceneSettings(metres_per_unit=METRES),
    static=StaticSettings(iterations=300, max_gaussians=600),
    update=UpdateSettings(iterations=40, clusters=(2, 12, 48), final_rate=0.1),
)


@pytest.fixture(scope="module", autouse=True)
def few_iterations_do() -> Iterator[None]:
    """Frame 0 at higher rates; the box has few Gaussians, far apart."""
    static_scene = "scas4d_core.first_frame.static_scene"
    with (
        varied(f"{static_scene}.RATE_COLOUR", 1e-2),
        varied(f"{static_scene}.RATE_POSITION", 8e-4),
        varied("scas4d_core.preparation.NEIGHBOUR_FALLOFF", 200.0),
    ):
        yield


def user_rig(world: WorldFrame = WORLD) -> Rig:
    """The rig as a user gives it."""
    outside = WorldFrame(-world.origin * world.metres_per_unit, 1 / world.metres_per_unit)
    return rig_inside(outside, [*make_rig().cameras, held_out_camera()])


def training(world: WorldFrame = WORLD) -> Rig:
    return Rig(user_rig(world).cameras[:-1])


def points(world: WorldFrame = WORLD, foreground: bool = True) -> InitialPoints:
    rng = np.random.default_rng(0)
    noisy = BOX.means + rng.normal(0, 0.005, BOX.means.shape)
    return InitialPoints(world.to_user(noisy), BOX.colours.copy(), BOX.foreground.copy() if foreground else None)


def start(settings: Settings = SETTINGS, frame: Frame = FRAMES[0], world: WorldFrame = WORLD) -> Reconstruction:
    return Reconstruction.start(training(world), frame, settings, points=points(world))


def shortened(**changes: object) -> Settings:
    """Few iterations; changes of ``update``."""
    static = SETTINGS.static.model_copy(update={"iterations": 20})
    update = SETTINGS.update.model_copy(update={"iterations": 3, "cold_start_iterations": 1.0, **changes})
    return SETTINGS.model_copy(update={"static": static, "update": update})


@pytest.fixture(scope="module")
def stepped() -> tuple[Reconstruction, list[FrameReport]]:
    scene = start()
    return scene, [scene.step(frame) for frame in FRAMES[1:]]


def test_frames_are_committed_and_reported(stepped: tuple[Reconstruction, list[FrameReport]]) -> None:
    scene, reports = stepped
    assert scene.history.indices == [10, 12, 14]
    np.testing.assert_allclose(scene.history.times, [frame.time for frame in FRAMES])
    # Updates run 40 iterations, but three times as many after frame 0, and twice as many after a missing frame.
    for report, frame, iterations in zip(reports, FRAMES[1:], (120, 80), strict=True):
        assert (report.index, report.time, report.iterations) == (frame.index, frame.time, iterations)
        assert len(report.loss) == iterations
        assert report.gaussians == len(scene.history.gaussians(10))
        assert report.moving == scene.history.gaussians(10).moving.sum()
        assert report.pairs is not None
        assert 0 < report.pairs.mean < report.pairs.percentile_99
        assert 20 < report.psnr < 60
        assert all(seconds >= 0 for seconds in report.seconds.values())
        assert {"decode", "cascade", "render", "adam"} <= set(report.seconds)


def test_no_time_that_the_service_accepts_stops_a_scene() -> None:
    sent = [0.0, 5e-324, 86_400.0, 1e10, 1e10, 1e19, 0.0, 1e-9, 0.1]
    scene = start(shortened())
    last = FrameTime(10, FRAMES[0].time, FRAMES[0].time)
    for index, time in enumerate(sent, 11):
        last = FrameTime(index, time_after(last, index, time, 30.0), time)
        report = scene.step(replace(FRAMES[index % 3], index=index, time=last.time))
        assert not report.outcome.rejected
    assert np.isfinite(scene.history.newest.means).all()


def test_points_are_followed_in_the_users_world(stepped: tuple[Reconstruction, list[FrameReport]]) -> None:
    scene, _ = stepped
    rows = np.arange(0, 384, 7)
    asked = WORLD.to_user(BOX.means[rows])
    tracks = scene.tracks_of_points(asked, 10, [10, 12, 14])
    for t, state in enumerate(STATES):
        truth = WORLD.to_user(state.means[rows])
        error = np.linalg.norm(tracks.positions[t] - truth, axis=1) * METRES
        assert np.median(error) < 0.006, t
    travelled = np.linalg.norm(STATES[2].means[rows] - BOX.means[rows], axis=1)
    assert np.median(travelled) > 0.04


def test_a_held_out_camera_sees_every_frame(stepped: tuple[Reconstruction, list[FrameReport]]) -> None:
    scene, _ = stepped
    camera = user_rig()["held"]
    for frame, state in zip(FRAMES, STATES, strict=True):
        view = scene.render(camera, frame.index)
        truth = take_frame(0, 0, state, Rig((held_out_camera(),))).images["held"] / 255
        psnr = -10 * np.log10(np.square(view.colour.clip(0, 1) - truth).mean())
        assert psnr > 19, frame.index
    # Depth is in the user's units: the box's middle is 1.3 m away, its near side about 0.2 m nearer.
    assert view.depth[SIZE // 2, SIZE // 2] * METRES == pytest.approx(1.1, abs=0.08)


def test_pixels_parts_visibility_and_ply_through_the_object(
    stepped: tuple[Reconstruction, list[FrameReport]], tmp_path: Path
) -> None:
    scene, _ = stepped
    camera = user_rig()["held"]
    tracks = scene.tracks_of_pixels(camera, np.array([[24.0, 24.0], [23.0, 20.0]]), 10, [10, 14])
    assert np.isfinite(tracks.positions).all()
    seen = scene.with_visibility(tracks, user_rig()["c0"], 10)
    assert seen.visibility["c0"].shape == (2, 2)
    labels = scene.parts(2)
    state = scene.history.gaussians(14)
    assert set(labels[state.moving]) <= {0, 1}
    assert (labels[~state.moving] == -1).all()
    view = scene.render(camera, labels=labels)
    assert view.parts is not None
    assert view.parts[24, 24] in (1, 2)
    scene.write_ply(tmp_path / "frame.ply", 12)
    np.testing.assert_allclose(
        read_ply(tmp_path / "frame.ply").means, WORLD.to_user(scene.history.gaussians(12).means), atol=1e-5
    )


WRONG: dict[str, tuple[Callable[[Frame], Frame], str]] = {
    "index again": (lambda f: replace(f, index=10), "frame 10 is not after"),
    "index before": (lambda f: replace(f, index=3), "frame 3 is not after"),
    "time again": (lambda f: replace(f, time=FRAMES[0].time), "must be after"),
    "time is not a number": (lambda f: replace(f, time=float("nan")), "time nan"),
    "time is infinite": (lambda f: replace(f, time=float("inf")), "time inf"),
    "no picture": (lambda f: replace(f, images={}), "no image of any of the rig's cameras"),
    "strange cameras": (lambda f: replace(f, images={"x": f.images["c0"]}), "no image of any of the rig's cameras"),
    "size": (lambda f: replace(f, images={**f.images, "c3": f.images["c3"][:, :-8]}), r"c3.*40x48.*48x48"),
    "grey": (lambda f: replace(f, images={**f.images, "c3": f.images["c3"][..., 0]}), "c3"),
    "size of a mask": (lambda f: replace(f, masks={**f.masks, "c2": f.masks["c2"][:-1]}), r"c2.*mask"),
}


@pytest.mark.parametrize("image_scale", [1.0, 0.5])
@pytest.mark.parametrize("name", WRONG)
def test_a_frame_that_is_refused_leaves_no_trace(name: str, image_scale: float) -> None:
    spoil, message = WRONG[name]
    settings = shortened()
    settings = settings.model_copy(update={"scene": settings.scene.model_copy(update={"image_scale": image_scale})})
    scene, other = start(settings), start(settings)
    before = {key: array.copy() for key, array in scene.history.gaussians(10).arrays().items()}
    with pytest.raises(StepError, match=message):
        scene.step(spoil(FRAMES[1]))
    assert scene.history.indices == [10]
    for key, array in scene.history.gaussians(10).arrays().items():
        np.testing.assert_array_equal(array, before[key])
    assert scene.step(FRAMES[1]).loss == other.step(FRAMES[1]).loss


def test_a_history_that_cannot_be_written_leaves_no_trace(monkeypatch: pytest.MonkeyPatch) -> None:
    """The motion that the next step starts from belongs to the state: it is not kept when the commit fails."""
    scene, other = start(shortened()), start(shortened())
    with monkeypatch.context() as patch:

        def full(*_: object, **__: object) -> None:
            raise OSError("disk full")

        patch.setattr(History, "append", full)
        with pytest.raises(OSError, match="disk full"):
            scene.step(FRAMES[1])
    assert scene.history.indices == [10]
    assert scene.step(FRAMES[1]).loss == other.step(FRAMES[1]).loss


def test_a_camera_may_be_missing() -> None:
    scene = start(shortened())
    some = {name: FRAMES[1].images[name] for name in ("c1", "c4")}
    report = scene.step(replace(FRAMES[1], images=some, masks={}))
    assert scene.history.indices == [10, 12]
    assert report.iterations == 6  # twice as many, because frame 11 is missing


def test_pictures_are_scaled_and_views_are_not() -> None:
    settings = SETTINGS.model_copy(update={"scene": SceneSettings(metres_per_unit=METRES, image_scale=0.5)})
    scene = start(settings)
    assert {(camera.width, camera.height) for camera in scene.rig.cameras} == {(SIZE // 2, SIZE // 2)}
    report = scene.step(FRAMES[1])
    assert report.psnr > 20
    view = scene.render(user_rig()["held"])
    assert view.colour.shape == (SIZE, SIZE, 3)


@pytest.mark.parametrize("metres", [1.0, 0.01, 40.0])
def test_the_users_unit_does_not_matter(metres: float, stepped: tuple[Reconstruction, list[FrameReport]]) -> None:
    """The same scene in metres, centimetres or forty-metre units: the same views, tracks in proportion."""
    world = WorldFrame(np.array([-1.0, 2.0, 3.0]), metres)
    settings = SETTINGS.model_copy(update={"scene": SceneSettings(metres_per_unit=metres)})
    scene = start(settings, world=world)
    scene.step(FRAMES[1])
    reference, _ = stepped
    one, two = scene.render(user_rig(world)["held"], 12), reference.render(user_rig()["held"], 12)
    np.testing.assert_allclose(one.alpha, two.alpha, atol=0.05)
    assert np.abs(one.colour - two.colour).mean() < 0.01
    both = (one.alpha > 0.9) & (two.alpha > 0.9)
    assert np.median(np.abs(one.depth[both] * metres / (two.depth[both] * METRES) - 1)) < 2e-3
    asked = BOX.means[:384:9]
    found = world.to_inside(scene.tracks_of_points(world.to_user(asked), 10, [12]).positions[0])
    wanted = WORLD.to_inside(reference.tracks_of_points(WORLD.to_user(asked), 10, [12]).positions[0])
    assert np.median(np.linalg.norm(found - wanted, axis=1)) < 2e-3


def test_automatic_scale_makes_the_rig_three_metres_wide() -> None:
    settings = shortened()
    settings = settings.model_copy(update={"scene": SceneSettings(metres_per_unit="auto")})
    assert start(settings).rig.radius == pytest.approx(3.0)


def test_without_masks_everything_moves_until_motion_tells() -> None:
    frames = [replace(frame, masks={}) for frame in FRAMES]
    scene = start(shortened(), frames[0])
    report = scene.step(frames[1])
    assert scene.history.gaussians(frames[0].index).moving.all()
    assert 0 < report.moving < report.gaussians


def unmet(patch: pytest.MonkeyPatch) -> None:
    """From here on no frame is met."""
    patch.setattr("scas4d_core.robust.outliers.misfit_reason", lambda past, psnr, iterations: "it is another scene")


def test_what_seems_to_move_in_a_frame_that_is_held_is_not_learnt() -> None:
    frames = [replace(frame, masks={}) for frame in FRAMES]
    scene, other = start(shortened(), frames[0]), start(shortened(), frames[0])
    with pytest.MonkeyPatch.context() as patch:
        unmet(patch)
        held = scene.step(frames[2])
    assert held.outcome is FrameOutcome.REJECTED_MISFIT
    assert held.moving == held.gaussians
    assert scene.history.gaussians(frames[2].index).moving.all()
    assert not scene.history.report(frames[2].index)["learn_labels"]
    back = replace(frames[1], index=15, time=frames[2].time + 1 / 30)
    assert scene.step(back).moving == other.step(frames[1]).moving < held.gaussians


def test_what_another_light_changes_has_not_moved(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scas4d_core.robust.checks.ENOUGH", 1)
    frames = [replace(frame, masks={}) for frame in FRAMES]
    # The box is not followed well at so few pixels, and looks as if it had entered beside itself.
    scene = start(SETTINGS.model_copy(update={"effects": {"entering": "off"}}), frame=frames[0])
    usual = scene.step(frames[1])
    dim = {name: (0.75 * picture).astype(np.uint8) for name, picture in frames[1].images.items()}
    report = scene.step(replace(frames[1], index=13, time=frames[1].time + 0.01, images=dim))
    assert report.exposure == pytest.approx(0.75, abs=0.03)
    again = scene.step(replace(frames[1], index=14, time=frames[1].time + 0.02))
    assert again.exposure == 1.0
    assert again.moving == report.moving == usual.moving < usual.gaussians


def test_pictures_that_were_not_believed_are_not_taken_for_what_stands() -> None:
    scene = start(shortened())
    with pytest.MonkeyPatch.context() as patch:
        unmet(patch)
        for index in (11, 12):
            report = scene.step(replace(FRAMES[1], index=index, time=5 + index / 1000))
            assert report.outcome is FrameOutcome.REJECTED_MISFIT
    back = scene.step(replace(FRAMES[0], index=13, time=5.03))
    assert (back.attempts, back.degraded) == (["repeated images"], None)


def test_masks_that_weigh_nothing_or_are_not_used_are_not_rendered(monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = [
        start(shortened(use_masks=False)),
        start(shortened(weights=Weights(mask=0, mask_alone=0))),
    ]
    bare = replace(FRAMES[1], masks={})
    for scene in scenes:
        seen: list[int] = []
        run = scene._prepared.updater.run  # type: ignore[union-attr]

        def spy(previous, views, *rest, run=run, seen=seen):  # type: ignore[no-untyped-def]
            seen.extend(len(view.target) for view in views)
            return run(previous, views, *rest)

        monkeypatch.setattr(scene._prepared.updater, "run", spy)
        assert scene.step(FRAMES[1]).loss == start(shortened()).step(bare).loss
        assert set(seen) == {3}


def test_without_weights_no_graph_is_built_and_no_neighbour_term_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("computed")

    monkeypatch.setattr(neighbour_terms, "neighbour_terms", refuse)
    monkeypatch.setattr("scas4d_core.preparation.Neighbours", refuse)
    scene = start(shortened(weights=Weights(rigidity=0, isometry=0, rotation=0)))
    assert len(scene.step(FRAMES[1]).loss) == 6


def test_a_device_that_is_not_there_is_refused() -> None:
    if gpu_fault() is None:
        pytest.skip("there is a GPU")
    with pytest.raises(DeviceError, match="device 'gpu' cannot be used"):
        start(shortened().model_copy(update={"device": "gpu"}))


def test_progress_tells_stage_and_count() -> None:
    told: list[Progress] = []
    Reconstruction.start(training(), FRAMES[0], shortened(), points=points(), progress=told.append)
    fitting = [report for report in told if report.stage == "fitting frame 0"]
    assert [report.done for report in fitting] == list(range(1, 21))
    assert {report.total for report in fitting} == {20}
    assert all(report.detail["loss"] > 0 for report in fitting)


def test_the_same_scene_gives_the_same_bits(tmp_path: Path) -> None:
    one = start(shortened())
    history = History(tmp_path / "scene")
    two = Reconstruction.start(training(), FRAMES[0], shortened(), points=points(), history=history)
    for scene in (one, two):
        for frame in FRAMES[1:]:
            scene.step(frame)
    again = History.load(tmp_path / "scene")
    assert again.indices == [10, 12, 14]
    for index in again.indices:
        for key, array in one.history.gaussians(index).arrays().items():
            np.testing.assert_array_equal(array, getattr(again.gaussians(index), key))


def test_per_gaussian_updates_run_as_well() -> None:
    scene = start(shortened(clusters=(), momentum=1.0))
    losses = [scene.step(frame).loss for frame in FRAMES[1:]]
    assert np.isfinite(losses).all()


def test_one_camera_moves_what_it_sees_about_three_metres_away() -> None:
    rig, points_seen = Rig(make_rig().cameras[:1]), InitialPoints(BOX.means, BOX.colours.copy(), BOX.foreground.copy())
    frames = [replace(frame, images={rig.names[0]: frame.images[rig.names[0]]}) for frame in FRAMES]
    frames = [replace(frame, masks={name: frame.masks[name] for name in rig.names}) for frame in frames]
    settings = shortened(iterations=20).model_copy(update={"scene": SceneSettings()})
    scene = Reconstruction.start(rig, frames[0], settings, points=points_seen)
    assert scene.rig.radius == 3.0
    report = scene.step(frames[1])
    assert report.degraded is None
    before, after = (scene.history.gaussians(frame.index).means for frame in frames[:2])
    assert np.linalg.norm(after - before, axis=1).max() > 0.01
    automatic = settings.model_copy(update={"scene": SceneSettings(metres_per_unit="auto")})
    with pytest.raises(ValueError, match="set metres_per_unit to a number"):
        Reconstruction.start(rig, frames[0], automatic, points=points_seen)


def test_a_report_tells_what_it_costs_and_what_writing_the_one_before_did(tmp_path: Path) -> None:
    scene = Reconstruction.start(training(), FRAMES[0], shortened(), points=points(), history=History(tmp_path))
    written = scene.history.record_seconds
    assert written > 0
    report = scene.step(FRAMES[1])
    committed = History.load(tmp_path).report(FRAMES[1].index)
    assert committed["seconds"] == report.seconds
    assert written < report.seconds["report"] < 0.5 * sum(report.seconds.values())


def test_the_report_shows_the_camera_whose_colours_changed() -> None:
    reconstruction = start(shortened(iterations=20))
    bumped = reconstruction.rig.names[1]
    images = dict(FRAMES[1].images)
    images[bumped] = np.clip(images[bumped].astype(int) + np.array([40, 0, 0]), 0, 255).astype(np.uint8)
    cameras = reconstruction.step(replace(FRAMES[1], images=images)).cameras
    assert set(cameras) == set(reconstruction.rig.names)
    red = {name: fit["colour_shift"][0] for name, fit in cameras.items() if fit["colour_shift"]}
    others = [shift for name, shift in red.items() if name != bumped]
    assert red[bumped] > 0.05 + max(others)  # the Gaussians' colours go part of the way, for all cameras
    assert all(5 < fit["psnr"] < 60 for fit in cameras.values())


def test_a_deferred_commit_is_in_memory_at_once_and_on_disk_later(tmp_path):
    """Two updates whose files are written late leave the same files as two that are written at once."""

    def run(folder: Path, late: bool) -> Reconstruction:
        scene = Reconstruction.start(training(), FRAMES[0], SETTINGS, points=points(), history=History(folder))
        writes: list[Callable[[], None]] = []
        for frame in FRAMES[1:]:
            for write in writes:  # those of the frame before, which is needed only in memory
                write()
            writes.clear()
            scene.step(frame, defer=writes.append if late else run_now)
            assert scene.history.indices[-1] == frame.index
            assert History.load(folder).indices[-1] == (frame.index - 2 if late else frame.index)
        for write in writes:
            write()
        return scene

    run(tmp_path / "late", True)
    run(tmp_path / "at once", False)
    late, at_once = (
        {path.name: read_npz(path) for path in (tmp_path / name).glob("*.npz")} for name in ("late", "at once")
    )
    assert late.keys() == at_once.keys()
    for name, arrays in late.items():
        assert arrays.keys() == at_once[name].keys()
        for key, array in arrays.items():
            if key != "report":  # it has times
                np.testing.assert_array_equal(array, at_once[name][key], err_msg=f"{name} {key}")
