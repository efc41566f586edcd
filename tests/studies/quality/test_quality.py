"""The study on a scene made here: two textured plates that part, seen by four cameras, splatted by a z-buffer."""

import dataclasses
import json
import types

import numpy as np
import pytest
from PIL import Image

from client.cli.scores import Store, digest, markdown
from scas4d_core.cameras import Camera, WorldFrame
from scas4d_core.captures import InitialPoints, open_capture
from scas4d_core.captures.reader import FileReader
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.gaussians import Gaussians
from scas4d_core.metrics import evaluation as measures
from scas4d_core.query.parts import parts
from scas4d_core.query.tracks import tracks_of_pixels, tracks_of_points
from scas4d_core.storage.history import History
from studies.quality import quality
from studies.quality.first_frame import first_frame_key, load_first_frame, save_first_frame
from studies.quality.quality import with_means
from studies.quality.settings import settings_of

FRAMES, WIDTH, HEIGHT = 4, 48, 40
TRAIN, TEST = ("0", "1"), ("2", "3")


def camera(number: int) -> Camera:
    pose = np.eye(4)
    pose[:3, 3] = [0.1 * number - 0.15, 0, 3]
    return Camera(str(number), np.array([[60.0, 0, 24], [0, 60, 20], [0, 0, 1]]), pose, WIDTH, HEIGHT)


def plates(t: int) -> np.ndarray:
    """[P, 3]: the left plate travels left, the right one right and back a little."""
    u, v = (g.ravel() for g in np.meshgrid(np.linspace(0, 0.5, 30), np.linspace(-0.4, 0.4, 48)))
    left = np.stack([u - 0.52 - 0.03 * t, v, 0 * u], axis=-1)
    right = np.stack([u + 0.02 + 0.03 * t, v, 0.01 * t + 0 * u], axis=-1)
    return np.vstack([left, right]).astype(np.float32).astype(np.float64)  # as the states will hold them


def which() -> np.ndarray:
    return np.repeat([1, 2], len(plates(0)) // 2)


def colours() -> np.ndarray:
    return np.random.default_rng(0).integers(1, 64, size=(len(plates(0)), 3)) * 3 / 255


def splat(seen_by: Camera, points: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every point paints 3×3 pixels with its value, the nearest on top: values [H, W, C] and depth (NaN: empty)."""
    uv, z = seen_by.project(points)
    depth, picture = np.full((HEIGHT, WIDTH), np.nan), np.zeros((HEIGHT, WIDTH, values.shape[1]))
    for i in np.argsort(-z):
        column, row = uv[i].astype(int)
        block = slice(max(row - 1, 0), row + 2), slice(max(column - 1, 0), column + 2)
        picture[block], depth[block] = values[i], z[i]
    return picture, depth


@pytest.fixture(scope="module")
def capture_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures") / "plates"
    for file, names in (("train_meta.json", TRAIN), ("test_meta.json", TEST)):
        cameras = [camera(int(name)) for name in names]
        meta = {
            "w": WIDTH,
            "h": HEIGHT,
            "k": [[c.intrinsics.tolist() for c in cameras]] * FRAMES,
            "w2c": [[c.world_to_camera.tolist() for c in cameras]] * FRAMES,
            "fn": [[f"{name}/{t:06d}.png" for name in names] for t in range(FRAMES)],
            "cam_id": [[int(name) for name in names]] * FRAMES,
        }
        folder.mkdir(exist_ok=True)
        (folder / file).write_text(json.dumps(meta))
    visible = np.zeros((FRAMES, 4, 100), dtype=bool)
    chosen = np.random.default_rng(1).choice(len(plates(0)), 100, replace=False)
    for name in (*TRAIN, *TEST):
        for t in range(FRAMES):
            picture, _ = splat(camera(int(name)), plates(t), np.hstack([colours(), which()[:, None]]))
            labels = picture[..., 3].astype(np.uint8)
            for kind, image in (
                ("ims", (picture[..., :3] * 255).round().astype(np.uint8)),
                ("seg", (labels > 0).astype(np.uint8)),
                *([("gt_parts", labels)] if name in TEST else []),
            ):
                (folder / kind / name).mkdir(parents=True, exist_ok=True)
                Image.fromarray(image).save(folder / kind / name / f"{t:06d}.png")
            uv = camera(int(name)).project(plates(t)[chosen])[0]
            visible[t, int(name)] = ((uv >= 0) & (uv < (WIDTH, HEIGHT))).all(axis=-1)
    np.savez(
        folder / "gt_tracks.npz",
        points=np.stack([plates(t)[chosen] for t in range(FRAMES)]).astype(np.float32),
        part_id=which()[chosen],
        visible=visible,
        colour=colours()[chosen],
    )
    pose = [np.eye(4).tolist()] * FRAMES
    part = {"rigid": True, "static": False, "foreground": True, "pose": pose}
    (folder / "scene.json").write_text(
        json.dumps({"extent": 1.2, "parts": [{"id": 1, "name": "left", **part}, {"id": 2, "name": "right", **part}]})
    )
    return folder


class Perfect:
    """Stands in for Reconstruction: one Gaussian a point, moved as the truth moves, drawn by the same z-buffer."""

    speed = 1.0
    brightness = 1.0
    report = None
    fitted = 0

    @classmethod
    def start(cls, rig, frame, settings, *, points=None, progress=None, static=None, history=None, dropped=None):
        self = cls()
        self.world, self.history = WorldFrame(np.zeros(3)), History()
        self._commit(0)
        self.static = static or StaticResult(self.history.gaussians(0), {}, [0.5, 0.25])
        cls.fitted = cls.fitted + (static is None)
        return self

    def step(self, frame, dropped=None, started=None):
        self._commit(frame.index)
        return types.SimpleNamespace(seconds={"render": 0.5, "losses": 0.25}, moving=2, gaussians=3, alarms=[])

    def _commit(self, t):
        n = len(plates(0))
        means = plates(0) + self.speed * (plates(t) - plates(0))
        self.history.append(t, t / 30, Gaussians(
            means=means.astype(np.float32),
            factors=np.tile(np.diag([0.01, 0.01, 0.001]).astype(np.float32), (n, 1, 1)),
            rotations=np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
            opacities=np.full(n, 0.9, np.float32),
            colours=colours().astype(np.float32),
            foreground=np.ones(n, np.float32),
            ids=np.arange(n),
        ))  # fmt: skip

    def render(self, camera, index=None, *, background=(0, 0, 0), labels=None):
        n = len(plates(0))
        values = np.hstack([colours() * self.brightness, (np.zeros(n) if labels is None else labels + 1)[:, None]])
        picture, depth = splat(camera, self.history.gaussians(index).means, values)
        return types.SimpleNamespace(
            colour=picture[..., :3].astype(np.float32),
            depth=depth,
            alpha=np.isfinite(depth).astype(float),
            parts=None if labels is None else picture[..., 3].astype(np.uint8),
        )

    def tracks_of_points(self, points, index, indices):
        return tracks_of_points(self.history, self.world, points, index, indices)

    def tracks_of_pixels(self, camera, uv, index, indices):
        return tracks_of_pixels(self.history, self.world, camera, uv, index, indices, self._depth)

    def with_visibility(self, tracks, camera, index):
        return tracks.with_visibility(self.history, self.world, camera, index)

    def _depth(self, seen_by, at):
        view = self.render(seen_by, at)
        return view.depth, view.alpha

    def parts(self, count=None):
        return parts(self.history, count)


class Slow(Perfect):
    """Follows only half of the motion, and is too dark."""

    speed = 0.5
    brightness = 0.8


@pytest.fixture
def stand_in(monkeypatch):
    """Lets the study reconstruct with the given class, in this process."""

    def install(kind):
        monkeypatch.setitem(
            __import__("sys").modules, "scas4d_core.reconstruction", types.SimpleNamespace(Reconstruction=kind)
        )
        monkeypatch.setattr(quality, "_apart", lambda job, folder: quality.measure(job, folder, lambda line: None))

    return install


def test_a_perfect_reconstruction_scores_perfectly(capture_folder, tmp_path):
    scene = Perfect.start(None, None, None)
    for t in range(1, FRAMES):
        scene.step(types.SimpleNamespace(index=t))
    capture = open_capture(capture_folder)
    mean, by_camera = measures.measure_pictures(scene, capture, 2)
    assert set(by_camera) == set(TEST)
    assert mean["psnr"] > 80  # colours are multiples of 3/255, so the file holds them exactly
    assert mean["ssim"] > 0.9999
    assert mean["psnr_changed"] > 80
    tracks = measures.measure_tracks(scene, capture, range(FRAMES))
    assert tracks["track_3d_median"] < 1e-3
    assert tracks["track_points"] == 100
    assert tracks["visibility_accuracy"] > 0.99
    assert tracks["mte_2d_oracle"] < 0.01
    assert tracks["mte_2d"] < 0.1
    assert measures.measure_parts(scene, capture, range(FRAMES)) == {
        "parts_ari": 1.0, "parts_count": 2.0, "parts_ari_found": 1.0, "parts_count_found": 2.0,
    }  # fmt: skip


def test_static_true_parts_count_as_one_if_no_number_is_given(capture_folder):
    scene = Perfect.start(None, None, None)
    for t in range(1, FRAMES):
        scene.step(types.SimpleNamespace(index=t))
    capture = open_capture(capture_folder)
    static = tuple(dataclasses.replace(part, static=True) for part in capture.ground_truth.parts)
    truth = dataclasses.replace(capture.ground_truth, parts=static)
    scores = measures.measure_parts(scene, dataclasses.replace(capture, ground_truth=truth), range(FRAMES))
    assert (scores["parts_ari"], scores["parts_ari_found"]) == (1.0, 0.0)  # one true part, but two are found


def test_half_the_motion_is_half_the_error(capture_folder):
    scene = Slow.start(None, None, None)
    for t in range(1, FRAMES):
        scene.step(types.SimpleNamespace(index=t))
    capture = open_capture(capture_folder)
    tracks = measures.measure_tracks(scene, capture, range(FRAMES))
    moved = np.linalg.norm(np.stack([plates(t) - plates(0) for t in range(1, FRAMES)]), axis=-1)[:, [0, -1]]
    assert tracks["track_3d_median"] == pytest.approx(np.median(moved) / 2 / 1.2 * 100, rel=0.05)
    assert tracks["track_3d_last"] == pytest.approx(np.median(moved[-1]) / 2 / 1.2 * 100, rel=0.05)
    pixels = 60 / 3 * np.median(moved, axis=0) / 2
    assert tracks["mte_2d"] == pytest.approx(pixels.mean() / np.hypot(WIDTH, HEIGHT) * 100, rel=0.25)
    assert tracks["mte_2d"] > tracks["mte_2d_oracle"] > 0.05


def test_standing_points_do_not_flatter_the_error():
    points = np.zeros((3, 2, 3))
    points[2, 0, 1] = 0.02
    assert measures.moving_points(points, 1.0).tolist() == [True, False]
    assert measures.moving_points(points, 2.5).tolist() == [False, False]


def test_the_study_measures_saves_and_goes_on_where_it_stopped(capture_folder, tmp_path, stand_in, monkeypatch):
    stand_in(Slow)
    monkeypatch.setattr(Slow, "fitted", 0)
    lines: list[str] = []
    rows = quality.run([capture_folder], tmp_path, ["scas4d", "dynamic3dgs"], iterations=[7], report=lines.append)
    assert [row["preset"] for row in rows] == ["scas4d", "dynamic3dgs"]
    assert Slow.fitted == 1  # both presets start from the same frame 0
    assert len(list((tmp_path / "first").iterdir())) == 1
    assert rows[0]["seconds_first"] == rows[1]["seconds_first"] > 0
    row = rows[0]
    assert row["updates"] == FRAMES - 1
    assert row["iterations"] == 7
    assert row["settings"]["update"]["iterations"] == 7
    frames = Store(tmp_path).frames(row["key"])
    assert [frame["index"] for frame in frames] == [0, 1, 2, 3]
    assert row["psnr_first"] == pytest.approx(frames[0]["psnr"])
    assert row["psnr"] == pytest.approx(np.mean([frame["psnr"] for frame in frames[1:]]))
    assert row["psnr_worst"] == min(frame["psnr"] for frame in frames[1:])
    assert row["seconds_stages"] == {"render": 0.5, "losses": 0.25}
    assert row["capture_frames"] == FRAMES
    assert "| plates | scas4d | 7 | " in lines[-1].split("by stage")[1]
    assert row["parts_ari"] > 0.5
    pictures = sorted(f.name for f in (tmp_path / "pictures" / row["key"]).iterdir())
    assert pictures == [f"frame{t:04d}_camera{c}.png" for t in (0, 1, 3) for c in TEST] + [
        f"parts0003_camera{c}.png" for c in TEST
    ]
    with Image.open(tmp_path / "pictures" / row["key"] / "frame0000_camera2.png") as first:
        assert first.size == (3 * WIDTH, HEIGHT)
    assert (tmp_path / "table.md").read_text() == lines[-1] + "\n"

    class NeverAgain(Slow):
        @classmethod
        def start(cls, *args, **options):
            raise AssertionError("the row was there already")

    stand_in(NeverAgain)
    assert quality.run([capture_folder], tmp_path, ["scas4d"], iterations=[7], report=lines.append) == rows[:1]
    assert any(line.endswith("already measured") for line in lines)
    monkeypatch.setattr(quality, "core_version", lambda: "another")
    quality.run([capture_folder], tmp_path, ["scas4d"], iterations=[7], report=lines.append)
    assert any(line.endswith("already measured, with another version of the core") for line in lines)
    with pytest.raises(AssertionError):
        quality.run([capture_folder], tmp_path, ["scas4d"], iterations=[8], report=lines.append)
    with pytest.raises(AssertionError):
        quality.run([capture_folder], tmp_path, ["scas4d"], iterations=[7], masks=False, report=lines.append)


def test_another_constant_of_frame_0_is_another_frame_0(capture_folder, tmp_path, stand_in):
    stand_in(Perfect)
    constants = ("scas4d_core.first_frame.static_scene.RATE_COLOUR", "scas4d_core.update.warm_start.WARM_START")
    for place in (None, *constants):
        given = ((place, 0.5),) if place else ()
        job = quality.Job(capture_folder, "scas4d", settings_of("scas4d"), frames=2, constants=given)
        Store(tmp_path)
        quality.measure(job, tmp_path, lambda _: None)
    names = sorted(file.stem.count("-") for file in (tmp_path / "first").iterdir())
    assert names == [1, 2]  # that of the default and of an update's constant, and that of frame 0's own


def test_frame_0_alone_without_help(capture_folder, tmp_path, stand_in):
    stand_in(Perfect)
    lines: list[str] = []
    (row,) = quality.run([capture_folder], tmp_path, frames=1, masks=False, points=False, report=lines.append)
    assert row["updates"] == 0
    assert row["given"] == {"frames": 1, "masks": False, "points": False}
    assert row["psnr_first"] > 80
    assert "psnr" not in row
    assert "track_3d_median" not in row
    assert "| plates | scas4d | 100 | no masks, no points |" in lines[-1]
    assert "by stage" not in lines[-1]


def test_changes_are_what_differs_from_the_preset(tmp_path):
    job = quality.Job(tmp_path, "scas4d", settings_of("scas4d", 300, 5, ["update.clusters=[64]"]), points=False)
    assert job.changes == "update.clusters=[64], no points"
    assert quality.Job(tmp_path, "scas4d", settings_of("scas4d", 300, 5)).changes == ""
    keys = {dataclasses.replace(job, **other).key for other in ({}, {"masks": False}, {"frames": 3}, {"lpips": True})}
    assert len(keys) == 4


def test_a_row_that_fails_says_so_and_is_tried_again(tmp_path, monkeypatch):
    lines: list[str] = []
    (row,) = quality.run([tmp_path / "nowhere"], tmp_path / "out", report=lines.append)  # in a process of its own
    assert "CaptureError" in row["error"]
    assert "nowhere" in lines[-1]
    assert "failed" in lines[-1]
    tried: list[quality.Job] = []
    monkeypatch.setattr(quality, "_apart", lambda job, folder: tried.append(job) or row)
    quality.run([tmp_path / "nowhere"], tmp_path / "out", report=lines.append)
    assert [job.key for job in tried] == [row["key"]]


def test_frame_0_comes_back_as_it_was_kept(tmp_path):
    gaussians = Perfect.start(None, None, None).history.gaussians(0)
    exposures = {name: np.random.default_rng(0).normal(size=(3, 2)).astype(np.float32) for name in ("10", "9", "a")}
    assert load_first_frame(tmp_path / "first" / "x.npz") is None
    for kept in ({}, exposures):
        save_first_frame(tmp_path / "first" / "x.npz", StaticResult(gaussians, kept, [0.5, 0.25]), 3.5)
        result, seconds = load_first_frame(tmp_path / "first" / "x.npz")
        assert seconds == 3.5
        assert result.losses == [0.5, 0.25]
        assert {name: value.tolist() for name, value in result.exposures.items()} == {
            name: value.tolist() for name, value in kept.items()
        }
        for name, array in gaussians.arrays().items():
            np.testing.assert_array_equal(result.gaussians.arrays()[name], array)
    assert [f.name for f in (tmp_path / "first").iterdir()] == ["x.npz"]


def test_frame_0_is_shared_by_those_who_see_the_same(capture_folder):
    settings = settings_of("scas4d")
    capture = open_capture(capture_folder)
    name = first_frame_key(capture, settings)
    assert name.startswith("plates-")
    for same in (["update.clusters=[64]"], ["update.iterations=2000"]):
        assert first_frame_key(capture, settings_of("scas4d", changes=same)) == name
    assert first_frame_key(capture, settings_of("dynamic3dgs", 300)) == name
    later = FileReader(
        capture.pictures.images[1:],
        capture.pictures.masks,
        {camera.name: (camera.width, camera.height) for camera in capture.full_rig.cameras},
    )
    others = {
        name,
        first_frame_key(open_capture(capture_folder, use_masks=False), settings),
        first_frame_key(dataclasses.replace(capture, points=InitialPoints(plates(0), colours())), settings),
        first_frame_key(dataclasses.replace(capture, points=InitialPoints(plates(1), colours())), settings),
        first_frame_key(dataclasses.replace(capture, pictures=later), settings),
        first_frame_key(capture, settings_of("scas4d", seed=1)),
        first_frame_key(capture, settings_of("scas4d", changes=["static.iterations=5"])),
        first_frame_key(capture, settings_of("scas4d", changes=["scene.image_scale=0.5"])),
    }
    assert len(others) == 8


def test_settings_are_the_preset_with_checked_changes():
    settings = settings_of("scas4d", 300, 5, ["update.clusters=[64]", "update.cluster_map=published"])
    assert settings.update.iterations == 300
    assert settings.update.seed == settings.static.seed == 5
    assert settings.update.clusters == (64,)
    assert settings.update.cluster_map == "published"
    with pytest.raises(ValueError, match="clasters"):
        settings_of("scas4d", changes=["update.clasters=[64]"])
    with pytest.raises(ValueError, match="no such setting"):
        settings_of("scas4d", changes=["upd.clusters=[64]"])
    with pytest.raises(ValueError, match=r"use the form NAME=VALUE, such as update\.iterations=200"):
        settings_of("scas4d", changes=["update.iterations"])


def test_the_table_has_means_of_complete_variants_only():
    row = {"preset": "p", "iterations": 100, "gaussians": 1000, "psnr": 30.0, "psnr_worst": 29.0}
    rows = [row | {"capture": c, "variant": "v", "psnr": 30.0 + i} for i, c in enumerate(("a", "b"))]
    rows.append(row | {"capture": "a", "variant": "w"})
    table = with_means(rows, over=("a", "b"), label="mean")
    assert len(table) == 4
    assert table[-1]["capture"] == "mean"
    assert table[-1]["psnr"] == 30.5
    assert "psnr_worst" not in table[-1]
    text = markdown([*table, {"capture": "c", "preset": "p", "iterations": 100, "error": "no pictures"}]).splitlines()
    assert text[2].startswith("| a | p | 100 | – | 1,000 | – |")
    assert "| 30.50 |" in text[-2]
    assert text[-1] == "| c | p | 100 | failed: no pictures |"


def test_digest_tells_settings_apart():
    assert digest({"a": 1, "b": 2}) == digest({"b": 2, "a": 1})
    assert digest({"a": 1}) != digest({"a": 2})
    assert len(digest()) == 8
