from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from running import HEIGHT, WIDTH, Running, fake_settings, make_rig, pictures
from typer.testing import CliRunner
from waiting import HANG_S

from client.cli.changes import parse_changes
from client.cli.commands import frame_line, out_of_step
from client.cli.main import app
from client.errors import ServiceError
from client.pictures import colour_labels, comparison, psnr
from client.rig import push
from client.sdk import Client
from client.wire import FrameReportModel, part_colour
from scas4d_core.captures import open_capture

FAKES = str(Path(__file__).parents[2] / "helpers")


def scas4d(*arguments, cwd=None, **environment):
    path = os.pathsep.join([FAKES, os.getcwd()])
    return subprocess.run(
        [sys.executable, "-m", "client.cli.main", *arguments],
        capture_output=True,
        text=True,
        timeout=HANG_S,
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": path, "COLUMNS": "200", "NO_COLOR": "1", "TERM": "dumb", **environment},
    )


def test_the_command_is_light():
    code = "import client.cli.main, client.rig, client.sdk, sys; print(*[m for m in sys.modules if '.' not in m])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert "client" in loaded
    assert not loaded & {"torch", "numba", "scipy", "sklearn", "fastapi", "uvicorn", "server", "matplotlib"}


def test_push_to_a_running_service(service, capture_folder):
    done = scas4d("push", str(capture_folder), "--url", service.url, "--frames", "2", "--set", "update.iterations=9")
    assert done.returncode == 0, done.stderr
    assert "2 of 2 frames committed, ready" in done.stdout
    assert service.url in done.stdout
    with Client(service.url) as client:
        for status in client.scenes():
            client.delete_scene(status.id)


def test_push_as_a_rig_scenes_and_going_on(service, capture_folder):
    rig = ("--fps", "20", "--jitter", "0.01", "--loop", "--frames", "6", "--per-camera", "--websocket", "--drop", "0")
    done = scas4d("push", str(capture_folder), "--url", service.url, *rig)
    assert done.returncode == 0, done.stderr
    assert "6 of 6 frames committed, ready" in done.stdout
    assert re.search(r"sent 6 frames, those after frame 0 at [\d.]+ of 20 per second", done.stdout), done.stdout
    id = re.search(r"scene (\w+):", done.stdout)[1]
    listed = scas4d("scenes", "--url", service.url)
    assert re.search(rf"{id}\s+tiny\s+ready\s+2\s+6\s+0\s+6", listed.stdout), listed.stdout
    more = scas4d("push", str(capture_folder), "--scene", id, "--loop", "--frames", "8", SCAS4D_URL=service.url)
    assert "8 of 8 frames committed" in more.stdout, more.stderr
    with Client(service.url) as client:
        client.delete_scene(id)


def test_watch_prints_frames_until_the_scene_is_gone(service, capture_folder):
    with Client(service.url) as client:
        scene = client.create_scene(open_capture(capture_folder).rig)
        command = [sys.executable, "-m", "client.cli.main", "watch", scene.id, "--url", service.url]
        watching = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, "TERM": "dumb"})
        assert watching.stdout.readline() == "scene is awaiting_first_frame\n"
        push(open_capture(capture_folder), client, scene=scene.id, frames=1)
        client.declare_missing(scene.id, 1, "gone for ever")
        client.delete_scene(scene.id)
        said, _ = watching.communicate(timeout=HANG_S)
    assert watching.returncode == 0
    assert re.search(r"frame 0: committed .* s$", said, re.MULTILINE) or "frame 1: missing" in said
    missing = scas4d("watch", "nowhere", "--url", service.url)
    assert missing.returncode == 1
    assert "Traceback" not in missing.stderr


def test_a_link_is_printed(tmp_path):
    token = "a-token-that-is-long-enough"
    running = Running(fake_settings(tmp_path, token=token))
    try:
        given = ("scenes", "share", "all", "--url", running.url, "--token", token)
        link, until = scas4d(*given, "--hours", "2").stdout.splitlines()
        assert link.startswith(f"{running.url}/#token=scas4d.read.*.")
        assert until.startswith("valid until 20")
        reader = scas4d(*given, "--only-token").stdout.strip()
        with Client(running.url, token=reader) as client:
            assert client.scenes() == []
            with pytest.raises(ServiceError, match="is read-only"):
                client.create_scene(make_rig())
    finally:
        running.stop()


def test_scenes_are_managed(service):
    with Client(service.url) as client:
        id = client.create_scene(make_rig(), name="first take").id
        other = client.create_scene(make_rig()).id

        def scenes(*given, input=None):
            return CliRunner().invoke(app, ["scenes", *given, "--url", service.url], input=input)

        assert "second take" in scenes("rename", id, "second take").stdout
        assert client.scene(id).name == "second take"
        scenes("pause", id, other)
        assert (client.scene(id).paused, client.scene(other).paused) == (True, True)
        scenes("resume", id, other)
        assert (client.scene(id).paused, client.scene(other).paused) == (False, False)
        scenes("keep", id, "--frames", "5", "--states", "all")
        kept = client.scene(id).ingest
        assert (kept.keep_frames.last, kept.keep_states.last) == (5, None)
        assert "--frames must be a number of frames or all" in scas4d("scenes", "keep", id, "--frames", "few").stderr
        assert "asleep" in scenes("sleep", id).stdout
        assert "archived" in scenes("archive", id).stdout
        assert id not in scenes().stdout
        assert "1 archived; to include them: scas4d scenes --all" in scenes().stdout
        assert id in scenes("--all").stdout
        scenes("restore", id)
        assert id in scenes().stdout
        refused = scenes("delete", id, input="n\n")
        assert "delete scene" in refused.stdout
        assert client.scene(id)
        assert scenes("delete", id, other, "--yes").exit_code == 0
        assert not {id, other} & {status.id for status in client.scenes()}


def test_import_makes_a_capture_that_can_be_pushed(service, tmp_path):
    pytest.importorskip("cv2")
    studio = tmp_path / "studio"
    k = {"w": WIDTH, "h": HEIGHT, "fl_x": 20, "fl_y": 20, "cx": 12, "cy": 8, "k1": -0.05, "camera_model": "OPENCV"}
    frames = []
    for i in range(3):
        (studio / f"images/c{i}").mkdir(parents=True)
        for t in range(2):
            Image.new("RGB", (WIDTH, HEIGHT), (0, i, t)).save(studio / f"images/c{i}/{t}.png")
        matrix = [[1, 0, 0, i], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]
        frames.append({"file_path": f"images/c{i}/0.png", "transform_matrix": matrix})
    (studio / "transforms.json").write_text(json.dumps({**k, "frames": frames}))
    out = tmp_path / "out"
    done = scas4d("import", str(studio), str(out), "--test", "c1", "--encoding", "png")
    assert done.returncode == 0, done.stderr
    assert (out / "test_meta.json").exists()
    for folder, cameras in ((out, 2), (studio, 3)):
        pushed = scas4d("push", str(folder), "--url", service.url)
        assert "2 of 2 frames committed" in pushed.stdout, pushed.stderr
        with Client(service.url) as client:
            (status,) = client.scenes()
            assert len(status.cameras) == cameras
            client.delete_scene(status.id)
    broken = scas4d("push", str(studio), "--pictures", "videos")
    assert broken.returncode == 1
    assert "its video in videos/<camera>.mp4" in broken.stderr


def test_unlike_cameras_are_pushed_straight_from_their_folder(service, tmp_path):
    pytest.importorskip("cv2")
    from made_rigs.mixed import COUNT, write_rig

    folder = write_rig(tmp_path / "mixed")
    done = scas4d("push", str(folder), "--url", service.url, "--test", "c8", COLUMNS="200")
    assert "2 of 2 frames committed" in done.stdout, done.stderr
    assert "camera 'c2': 16-bit images are converted to 8 bits" in done.stdout
    with Client(service.url) as client:
        (status,) = client.scenes()
        assert status.cameras == [f"c{number}" for number in range(COUNT - 1)]
        client.delete_scene(status.id)


def test_the_options_of_a_capture_are_those_of_every_command():
    names = ("--calibration", "--pictures", "--capture-fps", "--masks", "--test", "--size-mismatch", "--bit-depth")
    for command in ("push", "import", "reconstruct", "evaluate", "demo"):
        said = scas4d(command, "--help", COLUMNS="200").stdout
        assert [name for name in names if name not in said] == [], command


def test_scenes_are_listed_whole_in_a_narrow_terminal(service):
    with Client(service.url) as client:
        rig = make_rig(2)
        long = client.create_scene(rig, name="a name that is longer than the terminal is wide " * 2)
        try:
            lines = scas4d("scenes", "--url", service.url, COLUMNS="40").stdout.splitlines()
        finally:
            client.delete_scene(long.id)
    assert len(lines) == 2
    assert lines[1].startswith(f"{long.id}  {long.name}")
    assert "awaiting_first_frame" in lines[1]
    assert lines[0].index("state") == lines[1].index("awaiting_first_frame")


def test_a_budget_is_told_set_and_taken_back(service):
    def said(*arguments):
        done = scas4d("budget", scene, *arguments, "--url", service.url, COLUMNS="200")
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    with Client(service.url) as client:
        scene = client.create_scene(make_rig(2)).id
        try:
            made = said()
            assert made.startswith("100 iterations per frame")
            assert "fit in 500 ms per frame, or fewer: stop gain 0.02" in said(
                "--milliseconds", "500", "--stop-gain", "0.02"
            )
            assert client.budget(scene).requested.budget_ms == 500
            assert "as 25 frames per second allow per frame" in said("--keep-up", "25")
            assert client.budget(scene).effective.budget_ms == 36
            assert said("--iterations", "50").startswith("50 iterations per frame")
            assert said("--reset") == made
            refused = scas4d("budget", scene, "--reset", "--iterations", "5", "--url", service.url)
            assert (refused.returncode, "omit one of them" in refused.stderr) == (1, True)
        finally:
            client.delete_scene(scene)


def test_a_scene_begins_again(service, tmp_path):
    def said(*arguments, code=0):
        done = scas4d("begin-again", scene, *arguments, "--url", service.url, COLUMNS="200")
        assert done.returncode == code, done.stderr
        return (done.stderr if code else done.stdout).strip()

    np.savez(tmp_path / "cloud.npz", positions=np.zeros((4, 3)), colours=np.zeros((4, 3)))
    np.savez(tmp_path / "bare.npz", positions=np.zeros((4, 3)))
    with Client(service.url, busy_timeout=HANG_S) as client:
        scene = client.create_scene(make_rig(2)).id
        try:
            for index in range(2):
                client.put_frame(scene, index, pictures())
            client.wait(scene, 1)
            assert "discard" in said(code=1)
            assert "missing colours" in said("--points", str(tmp_path / "bare.npz"), code=1)
            assert "mutually exclusive" in said("--points", "x.npz", "--no-points", code=1)
            given = (
                "--discard",
                "--frame",
                "1",
                "--set",
                "update.iterations=9",
                "--points",
                str(tmp_path / "cloud.npz"),
            )
            assert said(*given) == f"scene {scene}: reconstruction 1 starts at frame 1; 1 queued"
            assert client.wait(scene, 1).state == "committed"
            status = client.scene(scene)
            assert (status.gaussians, status.settings["update"]["iterations"]) == (4, 9)
        finally:
            client.delete_scene(scene)


def test_serve_refuses_to_listen_beyond_this_machine():
    done = scas4d("serve", "--host", "0.0.0.0")
    assert done.returncode == 1
    assert "SCAS4D_TOKEN" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("push", "nowhere"), "nowhere: no such folder"),
        (("push", "TINY", "--url", "http://127.0.0.1:9"), "start a service with: scas4d serve"),
        (("push", "TINY", "--set", "iterations"), "update.iterations=200"),
        (("push", "TINY", "--node", "stage-a"), "use the form NAME=VALUE, such as rig=stage-a"),
        (("push", "TINY", "--node", "rig=a", "--node", "rig=b"), "'rig' is set to both"),
        (("push", "TINY", "--node", "rig=a", "--scene", "x"), "--node applies only to new scenes"),
    ],
)
def test_what_a_user_can_mend_is_one_line(capture_folder, arguments, said):
    done = scas4d(*(str(capture_folder) if word == "TINY" else word for word in arguments))
    assert done.returncode == 1
    assert said in done.stderr
    assert "Traceback" not in done.stderr


def test_a_setting_the_service_refuses_is_named(service, capture_folder):
    done = scas4d("push", str(capture_folder), "--url", service.url, "--set", "update.iteration=1")
    assert done.returncode == 1
    assert "settings.update.iteration" in done.stderr


def test_labels_where_there_is_no_cluster_are_refused(service, capture_folder):
    done = scas4d("push", str(capture_folder), "--url", service.url, "--node", "rig=stage-a")
    assert done.returncode == 1
    assert "--placement ray" in done.stderr


def test_changes_are_parsed():
    changes = ["update.iterations=200", "device=cpu", "update.clusters=[64]", "scene.metres_per_unit=auto"]
    assert parse_changes(changes) == {
        "update": {"iterations": 200, "clusters": [64]},
        "device": "cpu",
        "scene": {"metres_per_unit": "auto"},
    }
    for bad in (["update"], ["a=1", "a.b=2"]):
        with pytest.raises(ValueError, match="setting"):
            parse_changes(bad)


def test_pictures():
    truth, render = np.zeros((2, 3, 3), np.uint8), np.full((2, 3, 3), 100, np.uint8)
    side = comparison(truth, render)
    assert side.shape == (2, 9, 3)
    assert side[0, [0, 3, 6], 0].tolist() == [0, 100, 255]
    assert psnr(truth, render) == pytest.approx(20 * np.log10(2.55))
    assert psnr(truth, truth) == float("inf")
    colours = colour_labels(np.array([[0, 1, 8]], np.uint8))
    assert colours[0, 0].tolist() == [0, 0, 0]
    assert [tuple(colour) for colour in colours[0, 1:].tolist()] == [part_colour(0), part_colour(7)]


def test_the_line_of_a_frame_names_alarms_that_it_does_not_tell_already():
    alarms = [
        {"kind": "camera_colours", "camera": "c1", "evidence": "its colours are off"},
        {"kind": "light", "evidence": "the pictures are brighter"},
        {"kind": "camera_left_out", "camera": "c2", "evidence": "left out of this frame: dark"},
    ]
    report = {"scene": "s", "index": 3, "time": 0.1, "state": "committed", "dropped_cameras": {"c2": "dark"}}
    line = frame_line(FrameReportModel.model_validate({**report, "alarms": alarms}))
    assert line == "frame 3: committed  without c2  camera c1: its colours are off  the pictures are brighter"
    assert frame_line(FrameReportModel.model_validate(report)) == "frame 3: committed  without c2"


def test_the_line_of_a_frame_names_a_camera_out_of_step_once():
    timing = {
        name: {"frames": way, "error": 0.02, "out_of_step": abs(way) > 0.2} for name, way in (("c1", -0.4), ("c2", 0.1))
    }
    report = {"scene": "s", "index": 3, "time": 0.1, "state": "committed", "timing": timing}
    model = FrameReportModel.model_validate(report)
    assert frame_line(model) == "frame 3: committed  camera c1: out of step by -0.40 frames"
    assert out_of_step(model) == {"c1"}
    assert frame_line(model, off=out_of_step(model)) == "frame 3: committed"
