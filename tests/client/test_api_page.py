"""docs/api.md does what it says: its commands run as they stand there, and the service has what it specifies."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from running import Running
from waiting import HANG_S

from client.wire import FRAME_MEDIA_TYPE, FrameFile, FrameHead, RenderRequest, SceneCreate, frame_chunks
from client.wire.base import MAX_CAMERAS
from client.wire.framing import MAGIC, MAX_HEAD, MAX_INDEX
from scas4d_core.captures import open_capture
from scas4d_core.compact import CompactReader
from scas4d_core.metrics.image import psnr
from server.settings import ServerSettings

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
FENCE = re.compile(r"^(<!-- not run by the test: [^\n]+ -->\n)?```(\w*)\n(.*?)^```$", re.M | re.S)
BLOCKS = [(reason, text) for reason, language, text in FENCE.findall(PAGE) if language == "sh"]
RUN = [text for reason, text in BLOCKS if not reason]
TOKEN = "a-token-of-thirty-two-characters"
OLDEST_CURL = (7, 76)
"""The first with --fail-with-body."""


def curl_version():
    """Version of curl here, (0, 0) where there is none."""
    if shutil.which("curl") is None:
        return 0, 0
    said = subprocess.run(["curl", "--version"], capture_output=True, text=True, timeout=10).stdout
    return tuple(map(int, re.match(r"curl (\d+)\.(\d+)", said).groups()))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folder of files that the page's commands made, run as written, one block after another in one shell."""
    if curl_version() < OLDEST_CURL:
        pytest.skip("there is no curl here, or one before 7.76")
    folder = tmp_path_factory.mktemp("checkout")
    (folder / "samples").symlink_to(ROOT / "samples")
    running = Running(ServerSettings(data=folder / "data", token=TOKEN, warm_up=False), core=None)
    said = "".join(f"echo '== block {number} of the page' >&2\n{text}\n" for number, text in enumerate(RUN))
    environment = {**os.environ, "SCAS4D_URL": running.url, "SCAS4D_TOKEN": TOKEN, "NO_PROXY": "127.0.0.1"}
    try:
        done = subprocess.run(
            ["sh", "-eu", "-c", said], cwd=folder, env=environment, capture_output=True, text=True, timeout=HANG_S
        )
        assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
        scenes = running.app.state.scenes
        assert len(scenes) == 0  # the page deletes what it made
    finally:
        running.stop()
    return folder / "out" / "api"


def test_every_command_is_run_or_says_why_not():
    outside = FENCE.sub("", PAGE)
    assert not re.findall(r"^\s*(?:curl|scas4d) .*$", outside, re.M)
    assert len(RUN) > 15
    assert not [text for reason, text in BLOCKS if reason and "curl" in text]


def test_its_rig_is_that_of_the_sample():
    scene = json.loads(re.search(r"scene\.json <<'END'\n(.*?)^END$", PAGE, re.M | re.S)[1])
    view = json.loads(re.search(r"view\.json <<'END'\n(.*?)^END$", PAGE, re.M | re.S)[1])
    rig, capture = SceneCreate.model_validate(scene).rig.rig(), open_capture(ROOT / "samples" / "robot")
    for camera, name in zip(rig.cameras, ("3", "9", "7", "5"), strict=True):
        assert np.abs(camera.world_to_camera - capture.rig[name].world_to_camera).max() < 1e-6
        assert np.array_equal(camera.intrinsics, capture.rig[name].intrinsics)
    other = RenderRequest.model_validate(view).camera.camera()
    assert np.abs(other.world_to_camera - capture.test_rig["4"].world_to_camera).max() < 1e-6


def test_the_picture_of_a_rig_camera_is_what_it_saw(made):
    with Image.open(made / "east.png") as file, Image.open(ROOT / "samples/robot/ims/9/000000.png") as seen:
        assert file.format == "PNG"
        picture, truth = np.asarray(file.convert("RGB")), np.asarray(seen.convert("RGB"))
    assert psnr(picture / 255, truth / 255) > 25


def test_another_camera_sees_the_robot(made):
    with Image.open(made / "mine.png") as file, Image.open(ROOT / "samples/robot/ims/4/000003.png") as seen:
        assert (file.format, file.size) == ("PNG", (512, 512))
        picture, truth = np.asarray(file.convert("RGB").resize(seen.size)), np.asarray(seen.convert("RGB"))
    assert psnr(picture / 255, truth / 255) > 18  # a camera that nothing was learnt from, and 30 iterations
    with np.load(made / "depth.npz") as depth:
        assert np.isfinite(depth["depth"]).any()
    with Image.open(made / "west.png") as woken:
        assert np.asarray(woken).std() > 10


def test_tracks_parts_and_the_export_have_content(made):
    tracks = json.loads((made / "tracks.json").read_text())
    assert tracks["frames"] == [0, 1, 2, 3]
    assert tracks["ids"][0] >= 0
    assert np.ptp(tracks["positions"][0], axis=0).max() > 0.1  # metres: the forearm swings
    assert list(tracks["pixels"]) == list(tracks["visible"]) == ["north"]
    assert json.loads((made / "parts.json").read_text())["count"] == 3
    assert (made / "frame3.ply").read_bytes().startswith(b"ply\n")
    with CompactReader(made / "states.s4d") as compact:
        assert compact.frames == [0, 1, 2, 3]
        assert len(set(compact.parts().tolist()) - {-1}) > 1
    with zipfile.ZipFile(made / "frames.zip") as archive:
        assert archive.namelist() == ["frame_000002.glb", "frame_000003.glb"]


def test_the_token_does_not_stay_behind(made):
    assert not (made / "curl.conf").exists()


def dump(data):
    """The bytes, sixteen a line: offset, hexadecimal, ASCII."""
    rows = ((at, data[at : at + 16]) for at in range(0, len(data), 16))
    shown = ((at, row.hex(" "), "".join(chr(byte) if 32 <= byte < 127 else "." for byte in row)) for at, row in rows)
    return "".join(f"{at:04x}  {hexadecimal:47}  {text}\n" for at, hexadecimal, text in shown)


def test_the_dump_of_a_frame_is_what_the_client_sends():
    (shown,) = [text for _, language, text in FENCE.findall(PAGE) if not language and "S4DF" in text]
    first, *rest = frame_chunks(7, {"a": b"\xff\xd8\xff", "b": b"\x89P"}, {"a": b"M"}, 0.25)
    assert shown == dump(b"".join([first, *rest]))
    assert f"H is {len(first) - 8} (`{len(first) - 8:02x} 00 00 00`)" in PAGE
    assert f"begins at offset {len(first)} (`{len(first):x}`)" in PAGE


def test_the_head_and_its_limits_are_those_of_the_wire():
    head, files = set(FrameHead.model_fields), set(FrameFile.model_fields)
    rows = set(re.findall(r"^\| `([a-z_\[\].]+)` \| [^|]*(?:integer|number|array|string|image|boolean)", PAGE, re.M))
    assert rows == head | {f"files[].{name}" for name in files}
    for said in (
        MAGIC.decode(),
        FRAME_MEDIA_TYPE,
        f"{MAX_HEAD:,}",
        f"0…{MAX_INDEX:,}",
        f"1…{2 * MAX_CAMERAS:,} objects",
    ):
        assert said in PAGE
