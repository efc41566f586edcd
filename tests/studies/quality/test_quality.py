"""The study on a scene made here: two textured plates that part, seen by four cameras, splatted by a z-buffer."""

import dataclasses
import types

import numpy as np
import pytest
from PIL import Image
from plates import FRAMES, HEIGHT, TEST, WIDTH, Perfect, Slow, colours, plates, write_capture

from client.cli.evaluate import Job
from client.cli.scores import Store, markdown
from scas4d_core.captures import InitialPoints, open_capture
from scas4d_core.captures.reader import FileReader
from scas4d_core.first_frame.static_result import StaticResult
from studies.quality import quality
from studies.quality.first_frame import first_frame_key, load_first_frame, save_first_frame
from studies.quality.quality import with_means
from studies.quality.settings import settings_of


@pytest.fixture(scope="module")
def capture_folder(tmp_path_factory):
    return write_capture(tmp_path_factory.mktemp("captures") / "plates")


def measured(folder, out, lines, *presets, iterations=None, **given):
    jobs = [Job(folder, name, settings_of(name, iterations), **given) for name in presets or ("scas4d",)]
    return quality.run_jobs(jobs, out, report=lines.append)


@pytest.fixture
def stand_in(monkeypatch):
    """Lets the study reconstruct with the given class, in this process."""

    def install(kind):
        monkeypatch.setitem(
            __import__("sys").modules, "scas4d_core.reconstruction", types.SimpleNamespace(Reconstruction=kind)
        )
        monkeypatch.setattr(quality, "_apart", lambda job, folder: quality.measure(job, folder, lambda line: None))

    return install


def test_the_study_measures_saves_and_goes_on_where_it_stopped(capture_folder, tmp_path, stand_in, monkeypatch):
    stand_in(Slow)
    monkeypatch.setattr(Slow, "fitted", 0)
    lines: list[str] = []
    rows = measured(capture_folder, tmp_path, lines, "scas4d", "dynamic3dgs", iterations=7)
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
    assert measured(capture_folder, tmp_path, lines, iterations=7) == rows[:1]
    assert any(line.endswith("already measured") for line in lines)
    monkeypatch.setattr(quality, "core_version", lambda: "another")
    measured(capture_folder, tmp_path, lines, iterations=7)
    assert any(line.endswith("already measured, with another version of the core") for line in lines)
    with pytest.raises(AssertionError):
        measured(capture_folder, tmp_path, lines, iterations=8)
    with pytest.raises(AssertionError):
        measured(capture_folder, tmp_path, lines, iterations=7, masks=False)


def test_another_constant_of_frame_0_is_another_frame_0(capture_folder, tmp_path, stand_in):
    stand_in(Perfect)
    constants = ("scas4d_core.first_frame.static_scene.RATE_COLOUR", "scas4d_core.update.warm_start.WARM_START")
    for place in (None, *constants):
        given = ((place, 0.5),) if place else ()
        job = Job(capture_folder, "scas4d", settings_of("scas4d"), frames=2, constants=given)
        Store(tmp_path)
        quality.measure(job, tmp_path, lambda _: None)
    names = sorted(file.stem.count("-") for file in (tmp_path / "first").iterdir())
    assert names == [1, 2]  # that of the default and of an update's constant, and that of frame 0's own


def test_frame_0_alone_without_help(capture_folder, tmp_path, stand_in):
    stand_in(Perfect)
    lines: list[str] = []
    (row,) = measured(capture_folder, tmp_path, lines, frames=1, masks=False, points=False)
    assert row["updates"] == 0
    assert row["given"] == {"frames": 1, "masks": False, "points": False}
    assert row["psnr_first"] > 80
    assert "psnr" not in row
    assert "track_3d_median" not in row
    assert "| plates | scas4d | 100 | no masks, no points |" in lines[-1]
    assert "by stage" not in lines[-1]


def test_changes_are_what_differs_from_the_preset(tmp_path):
    job = Job(tmp_path, "scas4d", settings_of("scas4d", 300, 5, ["update.clusters=[64]"]), points=False)
    assert job.changes == "update.clusters=[64], no points"
    assert Job(tmp_path, "scas4d", settings_of("scas4d", 300, 5)).changes == ""
    keys = {dataclasses.replace(job, **other).key for other in ({}, {"masks": False}, {"frames": 3}, {"lpips": True})}
    assert len(keys) == 4


def test_a_row_that_fails_says_so_and_is_tried_again(tmp_path, monkeypatch):
    lines: list[str] = []
    (row,) = measured(tmp_path / "nowhere", tmp_path / "out", lines)  # in a process of its own
    assert "CaptureError" in row["error"]
    assert "nowhere" in lines[-1]
    assert "failed" in lines[-1]
    tried: list[Job] = []
    monkeypatch.setattr(quality, "_apart", lambda job, folder: tried.append(job) or row)
    measured(tmp_path / "nowhere", tmp_path / "out", lines)
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
