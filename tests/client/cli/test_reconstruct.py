"""`scas4d reconstruct` and `evaluate` on a tiny capture: what they leave, and that they can be run again."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from client.cli.evaluate import evaluate
from client.cli.reconstruct import reconstruct
from client.importers.open_source import CaptureOptions, open_source
from client.pictures import psnr
from scas4d_core.captures import CaptureError
from scas4d_core.compact import CompactReader
from scas4d_core.query.ply import read_ply
from scas4d_core.storage.history import History
from scas4d_core.storage.scratch_frames import ScratchFile, ScratchFrame

pytestmark = pytest.mark.slow

CHANGES = {"static": {"iterations": 2}, "update": {"iterations": 2}}


def test_it_leaves_pictures_states_and_a_ply_each_time_it_is_run(capture_folder, tmp_path):
    for frames in (3, 2):
        reconstruct(open_source(capture_folder), tmp_path, frames=frames, preset="scas4d", changes=CHANGES)
        history = History.load(tmp_path / "states")
        assert history.indices == list(range(frames))  # of this run alone
        assert len(read_ply(tmp_path / "last.ply")) == len(history.gaussians(0))
        with CompactReader(tmp_path / "states.s4d") as compact:
            assert compact.frames == list(range(frames))
            assert compact.times.tolist() == history.times.tolist()
            last, true = compact.state(frames - 1), history.newest
            assert np.abs(last.means - true.means).max() < 0.1 * np.linalg.norm(true.factors, axis=(1, 2)).max()
            assert compact.head.rig is not None
            assert compact.head.world.to_user([0, 0, 0]) == pytest.approx(compact.head.rig.centre)
    assert [path.name for path in sorted((tmp_path / "camera_2").iterdir())] == [f"{t:06d}.png" for t in range(3)]


@pytest.mark.parametrize("frame", [0, 1])
def test_images_that_cannot_be_used_are_left_out(capture_folder, tmp_path, capsys, frame):
    folder = shutil.copytree(capture_folder, tmp_path / "tiny")
    broken = [folder / f"ims/{camera}/{frame:06d}.png" for camera in (0, 1, 2)]
    for path in (broken[0], broken[2]):  # a training and the test camera
        path.write_bytes(path.read_bytes()[:45])
    reconstruct(open_source(folder), tmp_path / "out", frames=3, preset="scas4d", changes=CHANGES)
    assert History.load(tmp_path / "out/states").indices == [0, 1, 2]
    said = capsys.readouterr().out
    assert f"frame {frame}, without camera 0: {broken[0]}: the PNG file is truncated" in said
    assert f"frame {frame}, not compared with camera 2: {broken[2]}: the PNG file is truncated" in said
    assert said.rstrip().endswith("1 image could not be used; no frame was left out")
    broken[1].write_bytes(b"")
    with pytest.raises(CaptureError, match="2 images could not be used; 1 frame left out"):
        reconstruct(open_source(folder), tmp_path / "out", frames=3, preset="scas4d", changes=CHANGES)
    history = History.load(tmp_path / "out/states")
    assert history.indices == [index for index in range(3) if index != frame]
    with pytest.raises(CaptureError, match=r"truncated .*; scores need every frame"):
        evaluate(folder, tmp_path / "scores", frames=3, changes=CHANGES, report=lambda line: None)


def test_scores_of_training_cameras_need_every_image(capture_folder, tmp_path):
    folder = shutil.copytree(capture_folder, tmp_path / "tiny")
    (folder / "test_meta.json").unlink()
    (folder / "ims/0/000001.png").write_bytes(b"")
    said: list[str] = []
    with pytest.raises(CaptureError, match=r"frame 1, without camera 0: .*; scores of training cameras need every"):
        evaluate(folder, tmp_path / "scores", frames=3, changes=CHANGES, report=said.append)
    assert any("frame   0/2" in line for line in said)


def test_scores_are_printed_and_not_measured_twice(capture_folder, tmp_path):
    said: list[str] = []
    row = evaluate(capture_folder, tmp_path, frames=2, changes=CHANGES, report=said.append)
    assert (row["updates"], row["iterations"], row["capture"]) == (1, 2, capture_folder.name)
    assert np.isfinite(row["psnr"])
    warned = [line.strip() for line in said if line.strip().startswith("all ")]
    assert [line.split("; ")[0] for line in warned] == ["all 2 images are black (0, 1)", warned[1].split("; ")[0]]
    assert warned[1].startswith("all masks are full")
    assert any(re.fullmatch(r" +frame +1/1 +[\d.]+ dB +[\d.]+ s", line) for line in said)
    assert "Median seconds per update, by stage" in said[-1]
    assert f"| {capture_folder.name} | scas4d | 2 | static.iterations=2 |" in said[-1]
    assert (tmp_path / "table.md").read_text() == said[-1] + "\n"
    pictures = tmp_path / "pictures" / row["key"]
    assert sorted(path.name for path in pictures.iterdir())[0] == "frame0000_camera2.png"
    with (
        Image.open(pictures / "frame0000_camera2.png") as picture,
        Image.open(capture_folder / "ims/2/000000.png") as truth,
    ):
        assert picture.size == (3 * truth.width, truth.height)
    table = said[-1]
    assert evaluate(capture_folder, tmp_path, frames=2, changes=CHANGES, report=said.append) == row
    assert said[-2].endswith("already measured")
    assert said[-1] == table


def test_scores_are_the_same_with_the_states_in_a_scratch_file(capture_folder, tmp_path, monkeypatch):
    """A long capture does not fit into memory."""
    moved = []
    own = ScratchFile.store

    def noted(self, frame):
        if "means" in frame:  # else it is a report
            moved.append(isinstance(frame, ScratchFrame))
        return own(self, frame)

    rows = []
    for taken in (lambda self, frame: frame, noted):
        monkeypatch.setattr(ScratchFile, "store", taken)
        out = tmp_path / str(len(rows))
        rows.append(evaluate(capture_folder, out, frames=4, changes=CHANGES, report=lambda line: None))
        assert sorted(path.name for path in out.iterdir()) == ["frames", "pictures", "rows", "table.md"]
    assert moved.count(False) == 2  # frames 1 and 2, once each
    timed = {name for name in rows[0] if "seconds" in name} | {"measured", "peak_mb"}
    assert {k: v for k, v in rows[0].items() if k not in timed} == {k: v for k, v in rows[1].items() if k not in timed}
    assert rows[0]["updates"] == 3


def test_a_capture_without_test_cameras_is_measured_on_those_it_has_and_says_so(capture_folder, tmp_path):
    folder = tmp_path / "capture"
    folder.mkdir()
    for path in capture_folder.iterdir():
        if path.name != "test_meta.json":
            (folder / path.name).symlink_to(path)
    said: list[str] = []
    row = evaluate(folder, tmp_path / "out", frames=2, changes=CHANGES, report=said.append)
    assert row["measured_on"] == "training cameras"
    assert "    no test cameras: scoring the training cameras instead (use --test to hold some out)" in said
    assert "static.iterations=2, training cameras |" in said[-1]
    held = CaptureOptions(test=("1",))
    other = evaluate(folder, tmp_path / "out", options=held, frames=2, changes=CHANGES, report=said.append)
    assert (other["measured_on"], other["key"] == row["key"]) == ("test cameras", False)
    assert "static.iterations=2, held out 1 |" in said[-1]
    assert [path.name for path in sorted((tmp_path / "out/pictures" / other["key"]).glob("frame*"))] == [
        "frame0000_camera1.png",
        "frame0001_camera1.png",
    ]


def test_a_calibration_that_is_refined_is_said_and_measured_with(tmp_path, capsys):
    """The third camera of the sample is turned by three pixels; without test cameras the refined ones are measured."""
    folder, sample = tmp_path / "capture", Path("samples/robot").resolve()
    folder.mkdir()
    for path in sample.iterdir():
        if path.name not in ("train_meta.json", "test_meta.json"):
            (folder / path.name).symlink_to(path)
    meta = json.loads((sample / "train_meta.json").read_text())
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([3 / meta["k"][0][2][0][0], 0, 0]).as_matrix()
    for poses in meta["w2c"]:
        poses[2] = (turn @ poses[2]).tolist()
    (folder / "train_meta.json").write_text(json.dumps(meta))
    few = {"scene": {"image_scale": 0.25}, "static": {"iterations": 2, "refine_calibration": True}}
    said: list[str] = []
    row = evaluate(folder, tmp_path / "out", frames=1, changes=few, report=said.append)
    assert row["measured_on"] == "training cameras"
    assert any("the calibration was refined as requested" in line for line in said)
    reconstruct(open_source(folder), tmp_path / "shown", frames=1, preset="scas4d", changes=few)
    assert "the calibration was refined as requested" in " ".join(capsys.readouterr().out.split())


def test_unlike_cameras_are_reconstructed_straight_from_their_folder(tmp_path):
    """Three sizes, a fisheye, grey, 16 bits and a palette; two cameras of other sizes are held out."""
    pytest.importorskip("cv2")
    from made_rigs.mixed import write_rig

    folder = write_rig(tmp_path / "mixed")
    given = open_source(folder, test=("c0", "c5"))
    changes = {"static": {"iterations": 150}, "update": {"iterations": 10}}
    reconstruct(given, tmp_path / "out", frames=2, preset="scas4d", changes=changes)
    for name, (width, height) in {"c0": (96, 72), "c5": (104, 64)}.items():
        for t in range(2):
            with Image.open(tmp_path / f"out/camera_{name}/{t:06d}.png") as picture:
                assert picture.size == (3 * width, height)
                truth, render, _ = np.split(np.asarray(picture.convert("RGB")), 3, axis=1)
            assert psnr(truth, render) > 18
    row = evaluate(
        folder, tmp_path / "scores", options=CaptureOptions(test=("c0", "c5")), frames=2, changes=changes, report=print
    )
    assert row["measured_on"] == "test cameras"
    assert row["psnr_first"] > 18


def test_videos_show_what_the_pictures_show(capture_folder, tmp_path):
    given = open_source(capture_folder)
    reconstruct(given, tmp_path, frames=3, preset="scas4d", changes=CHANGES, videos=True)
    for folder in sorted(tmp_path.glob("camera_*/")):
        shown = imageio.imread(folder.with_suffix(".mp4"), plugin="pyav")
        assert len(shown) == 3
        assert imageio.immeta(folder.with_suffix(".mp4"), plugin="pyav")["fps"] == pytest.approx(given.fps, rel=0.01)
        for index, frame in enumerate(shown):
            picture = np.asarray(Image.open(folder / f"{index:06d}.png"))
            height, width = frame.shape[:2]
            assert picture.shape[0] - height in (0, 1)
            assert psnr(picture[:height, :width], frame) > 25
