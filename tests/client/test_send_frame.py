"""The sender in C++ beside docs/api.md: it compiles without a warning, and what it sends arrives."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import fakes
import pytest
from running import Running, fake_settings, make_rig, picture, pictures
from waiting import HANG_S, wait_for

from client.sdk import Client
from server.storage.frame_store import read_pictures

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "docs" / "examples" / "send_frame.cpp"
TOKEN = "a-token-of-thirty-two-characters"
COMPILER = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")


@pytest.fixture(scope="module")
def sender(tmp_path_factory):
    """The compiled program."""
    if COMPILER is None:
        pytest.skip("there is no C++ compiler here (c++, g++ or clang++)")
    program = tmp_path_factory.mktemp("sender") / "send_frame"
    strict = ["-std=c++17", "-Wall", "-Wextra", "-Werror", "-O1"]
    done = subprocess.run([COMPILER, *strict, SOURCE, "-o", program], capture_output=True, text=True, timeout=HANG_S)
    assert done.returncode == 0, done.stderr
    return program


@pytest.fixture(scope="module")
def guarded_service(tmp_path_factory):
    """A service that asks for a token."""
    running = Running(fake_settings(tmp_path_factory.mktemp("data"), token=TOKEN))
    yield running
    running.stop()


@pytest.fixture
def sdk(guarded_service):
    with Client(guarded_service.url, token=TOKEN, busy_timeout=HANG_S) as client:
        yield client


@pytest.fixture
def scene(sdk):
    id = sdk.create_scene(make_rig(), frames_per_second=10).id
    yield id
    sdk.delete_scene(id)


@pytest.fixture
def begin(sender, tmp_path):
    """Starts the program with files of a frame; the caller waits for its end."""

    def started(url, scene, index, images, masks=None, *more, token=TOKEN):
        arguments = []
        for field, data in {**images, **{f"mask.{name}": mask for name, mask in (masks or {}).items()}}.items():
            file = tmp_path / f"{index}-{field}.png"
            file.write_bytes(data)
            arguments.append(f"{field}={file}")
        environment = {**os.environ, "SCAS4D_TOKEN": token}
        command = [sender, url, scene, str(index), *arguments, *more]
        return subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, encoding="utf-8"
        )

    return started


def ended(process):
    """Its exit status, and what it wrote to stdout and stderr."""
    out, err = process.communicate(timeout=HANG_S)
    return process.returncode, out, err


def stored(service, scene):
    """The frames of a scene in the service's data folder, by index."""
    files = sorted((service.app.state.settings.data / "scenes" / scene).rglob("*.frame"))
    return {found.index: found for found in (read_pictures(file.parent, file.name) for file in files)}


def test_pictures_arrive_byte_for_byte(guarded_service, sdk, scene, begin):
    images = {"c0": picture(3, format="JPEG"), "c1": picture(4)}
    masks = {name: picture(255, mode="L") for name in images}
    status, out, err = ended(begin(guarded_service.url, scene, 0, images, masks, "time=0.125"))
    assert (status, err) == (0, "")
    assert out.startswith("202 {")
    assert '"time":0.125' in out
    found = stored(guarded_service, scene)[0]
    assert {name: bytes(data) for name, data in found.images.items()} == images
    assert {name: bytes(data) for name, data in found.masks.items()} == masks
    assert ended(begin(guarded_service.url, scene, 0, images, masks, "time=0.125")) == (status, out, err)
    assert sdk.wait(scene, 0).state == "committed"


def test_a_wrong_token_and_a_gap_are_told(guarded_service, scene, begin):
    status, out, err = ended(begin(guarded_service.url, scene, 0, pictures(), token="another-token-of-that-length"))
    assert (status, out) == (1, "")
    assert err.startswith("401 ")
    assert "the token is invalid" in err
    status, out, err = ended(begin(guarded_service.url, scene, 5, pictures()))
    assert (status, out) == (1, "")
    assert err.startswith("409 ")
    assert '"expected": 0' in err


def test_a_full_queue_is_waited_out(guarded_service, sdk, scene, begin):
    sdk.put_frame(scene, 0, pictures())
    sdk.wait(scene, 0)
    sdk.put_frame(scene, 1, pictures(fakes.SLOW))
    sdk.put_frame(scene, 2, pictures())
    status, out, err = ended(begin(guarded_service.url, scene, 3, pictures(7)))
    assert status == 0, err
    assert err.startswith("429 ")
    assert "sending again in" in err
    assert out.startswith("202 ")
    assert bytes(stored(guarded_service, scene)[3].images["c0"]) == pictures(7)["c0"]


def test_several_frames_are_sent_in_one_request(guarded_service, sdk, scene, begin, tmp_path):
    sent = {index: pictures(index + 5) for index in (0, 1, 2)}
    more = []
    for index in (1, 2):
        more.append(str(index))
        for camera, data in sent[index].items():
            (tmp_path / f"next-{index}-{camera}.png").write_bytes(data)
            more.append(f"{camera}={tmp_path / f'next-{index}-{camera}.png'}")
    status, out, err = ended(begin(guarded_service.url, scene, 0, sent[0], None, *more))
    assert status == 0, err
    assert out.count('"status":202') == 3
    assert {index: found.images for index, found in stored(guarded_service, scene).items()} == sent


def test_frames_without_room_are_sent_again_and_a_refused_frame_is_reported(
    guarded_service, sdk, scene, begin, tmp_path
):
    sdk.put_frame(scene, 0, pictures())
    sdk.wait(scene, 0)
    sdk.pause(scene)
    (tmp_path / "next.png").write_bytes(picture(9))
    (tmp_path / "damaged.png").write_bytes(b"damaged")
    more = [
        part
        for index in (2, 3, 4, 5, 6)
        for part in (str(index), f"c0={tmp_path / 'next.png'}", f"c1={tmp_path / 'next.png'}")
    ]
    process = begin(guarded_service.url, scene, 1, pictures(3), None, *more)
    wait_for(lambda: sdk.scene(scene).queued == 2)
    sdk.resume(scene)
    status, out, err = ended(process)
    assert status == 0, err
    assert "sending again in" in err
    assert out.count('"status":202') == 6
    process = begin(
        guarded_service.url,
        scene,
        7,
        pictures(3),
        None,
        "8",
        f"c0={tmp_path / 'damaged.png'}",
        f"c1={tmp_path / 'next.png'}",
    )
    status, out, err = ended(process)
    assert (status, out) == (1, "")
    last = err.splitlines()[-1]
    assert last.startswith("207 ")
    assert ('"index":7,"status":202' in last, '"index":8,"status":422' in last) == (True, True)


@pytest.mark.parametrize(
    ("arguments", "expected", "message"),
    [
        ([], 2, "usage: send_frame"),
        (["https://127.0.0.1:8000", "scene", "0", "c0=a.png"], 2, "usage: send_frame"),
        (["http://127.0.0.1:8000", "scene", "x", "c0=a.png"], 2, "usage: send_frame"),
        (["http://127.0.0.1:8000", "scene", "0", "c0=nowhere.png"], 1, "nowhere.png cannot be read"),
        (["http://127.0.0.1:8000", "scene", "0", "c0"], 1, "'c0' is not CAMERA=PICTURE"),
        (["http://127.0.0.1:8000", "scene", "0", f'c"0={SOURCE}'], 1, "cannot be the name of a camera"),
        (["http://127.0.0.1:1", "scene", "0", f"c0={SOURCE}"], 1, "127.0.0.1:1 cannot be reached"),
    ],
)
def test_wrong_arguments_are_told(sender, arguments, expected, message):
    done = subprocess.run([sender, *arguments], capture_output=True, text=True, timeout=HANG_S)
    assert done.returncode == expected
    assert message in done.stderr
