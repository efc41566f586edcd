"""A data folder of an earlier version is opened, read and resumed (README.md here says what it holds)."""

from __future__ import annotations

import io
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from blake3 import blake3
from box_scene import SHIFT, make_box, make_rig, moved, take_frame
from PIL import Image
from running import Running
from scipy.spatial.transform import Rotation
from waiting import HANG_S

from client.sdk import Client
from scas4d_core.storage.history import History
from server.settings import ServerSettings
from server.storage.definition import check_definition
from server.storage.layout import SceneFolder

HERE = Path(__file__).parent
EXPECTED = json.loads((HERE / "expected.json").read_text())
ID = EXPECTED["id"]
ARRAYS = ("means", "factors", "rotations", "colours")
CLOSE = {"means": 0.02, "factors": 0.02, "rotations": 0.06, "colours": 0.3}
"""Metres, metres, and parts of 1, within which states are those that the earlier version would have made."""
TIMED = ("seconds", "received", "committed_at", "peak_memory_mb", "curve")
"""What a report says of the machine that made it."""


def png(array):
    file = io.BytesIO()
    Image.fromarray(array).save(file, "PNG")
    return file.getvalue()


def pictures_of(index):
    state = moved(make_box(), Rotation.from_rotvec([0, 0.03 * index, 0]), 0.3 * index * SHIFT)
    frame = take_frame(index, 0.1 * index, state, make_rig())
    return {name: (png(image), png(255 * frame.masks[name])) for name, image in frame.images.items()}


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    """The folder opened by this version, the frames that were acknowledged reconstructed, the last one completed."""
    folder = tmp_path_factory.mktemp("older") / "data"
    shutil.copytree(HERE / "data_folder", folder)
    running = Running(ServerSettings(data=folder, scrub_mb_per_second=0), core=None)
    try:
        with Client(running.url, patience=HANG_S) as sdk:
            read = {index: sdk.frame(ID, index) for index in (0, 1, 2, 3, 4)}
            sdk.wait(ID, 5, seconds=HANG_S)
            for name, (image, mask) in list(pictures_of(6).items())[3:]:
                sdk.put_camera(ID, 6, name, image, mask, 0.6)
            sdk.wait(ID, 6, seconds=HANG_S)
            yield sdk, read, folder / "scenes" / ID
    finally:
        running.stop()


def same(found, expected, path=""):
    """Compares what the earlier version said with what this one says; new names may have come."""
    if isinstance(expected, dict):
        for name, value in expected.items():
            if name not in TIMED:
                same(found[name], value, f"{path}.{name}")
    elif isinstance(expected, list):
        assert len(found) == len(expected), path
        for at, value in enumerate(expected):
            same(found[at], value, f"{path}[{at}]")
    elif isinstance(expected, float):
        assert found == pytest.approx(expected, rel=1e-3, abs=1e-5), path
    else:
        assert found == expected, path


@pytest.mark.parametrize("index", [0, 1, 2, 3, 4])
def test_reports_of_before_are_read(opened, index):
    _, read, _ = opened
    same(read[index].model_dump(mode="json"), EXPECTED["reports"][str(index)])


@pytest.mark.parametrize("index", [5, 6])
def test_what_was_acknowledged_is_reconstructed_as_it_would_have_been(opened, index):
    sdk, _, folder = opened
    report = sdk.frame(ID, index)
    assert (report.state, report.iterations, report.degraded) == ("committed", 25, None)
    assert report.used_cameras == [f"c{k}" for k in range(6)]
    state = History.load(folder / "states").gaussians(index)
    # Colours follow the pictures in another way since; that moves things a little.
    rows = np.flatnonzero(state.moving)
    with np.load(HERE / "expected.npz") as expected:
        for key in ARRAYS:
            assert np.abs(getattr(state, key) - expected[f"{key}_{index}"])[rows].max() < CLOSE[key], key


def test_answers_are_those_of_before(opened):
    sdk, _, _ = opened
    tracks = np.array(sdk.tracks(ID, ids=[0, 10, 400]).positions, dtype=float)
    assert np.abs(tracks - np.array(EXPECTED["tracks"])).max() < 1e-2  # two updates are of this version
    labels = np.array(sdk.parts(ID, 2).labels)
    assert np.mean(labels != np.array(EXPECTED["labels"])) < 0.01  # by tracks, of which two updates are new
    assert sdk.budget(ID).model_dump(mode="json") == EXPECTED["budget"]
    assert sdk.scene(ID).state == "ready"


def test_a_scene_made_with_another_value_of_a_former_setting_is_refused_by_name(tmp_path):
    folder = SceneFolder(tmp_path / ID)
    shutil.copytree(HERE / "data_folder" / "scenes" / ID, folder.path)
    stored = json.loads(folder.definition.read_text())
    stored["scene"]["settings"]["update"]["max_scale"] = 0.05
    stored["blake3"] = blake3(json.dumps(stored["scene"], indent=1).encode()).hexdigest()
    folder.definition.write_text(json.dumps(stored))
    fault = check_definition(folder)
    assert "max_scale cannot be 0.05" in fault
    assert "damaged" not in fault
