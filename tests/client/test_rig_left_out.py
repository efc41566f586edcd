"""The rig simulator and the commands with images that cannot be used, and scenes that never got a frame."""

from __future__ import annotations

import re
import shutil

import numpy as np
import pytest
from PIL import Image
from running import HEIGHT, WIDTH
from typer.testing import CliRunner

from client.cli.main import app
from client.errors import InvalidRequest, ServiceUnreachable
from client.importers.open_source import open_source
from client.left_out import LeftOut
from client.rig import push
from client.sdk import Client
from client.wire import IngestSettings, ProblemDetails
from scas4d_core.captures import Capture, CaptureError, decode_image


@pytest.fixture
def folder(capture_folder, tmp_path):
    return shutil.copytree(capture_folder, tmp_path / "tiny")


def spoil(folder, camera, frame):
    path = folder / f"ims/{camera}/{frame:06d}.png"
    path.write_bytes(path.read_bytes()[:45])


WAYS = [{}, {"websocket": True}, {"per_camera": True}, {"per_camera": True, "websocket": True}, {"batch": 3}]


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("frame", [0, 2])
def test_a_frame_goes_on_without_a_camera(client, folder, way, frame):
    spoil(folder, 1, frame)
    said = []
    delivery = push(open_source(folder), client, on_message=said.append, **way)
    reports = [client.frame(delivery.scene, index) for index in range(4)]
    assert [report.state for report in reports] == ["committed"] * 4
    assert [report.used_cameras for report in reports] == [
        ["0"] if index == frame else ["0", "1"] for index in range(4)
    ]
    assert (delivery.left_out.images, delivery.left_out.frames, delivery.lost) == (1, [], [])
    (sentence,) = said
    assert re.match(rf"frame {frame}, without camera 1: .*ims/1/00000{frame}.png: the PNG file is truncated", sentence)


def turn(path):
    exif = Image.Exif()
    exif[0x0112] = 6
    with Image.open(path) as picture:
        picture.save(path, "PNG", exif=exif)


def as_jpeg(path):
    with Image.open(path) as picture:
        picture.save(path, "JPEG")


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(
    ("file", "spoiled", "reason"),
    [
        ("ims/1/000002.png", turn, "EXIF orientation is 6"),
        ("seg/1/000002.png", as_jpeg, "masks must be PNG or BMP, not JPEG"),
    ],
)
def test_turned_images_and_lossy_masks_are_left_out_and_named(client, folder, way, file, spoiled, reason):
    spoiled(folder / file)
    said = []
    delivery = push(open_source(folder), client, on_message=said.append, **way)
    reports = [client.frame(delivery.scene, index) for index in range(4)]
    assert [(report.state, report.used_cameras) for report in reports] == [
        ("committed", ["0"] if index == 2 else ["0", "1"]) for index in range(4)
    ]
    (sentence,) = said
    assert sentence.startswith("frame 2, without camera 1: ")
    assert reason in sentence


@pytest.mark.parametrize("way", WAYS)
def test_16_bit_images_are_sent_and_decoded_as_they_are_read(client, folder, way):
    values = np.random.default_rng(0).integers(0, 4096, (4, HEIGHT, WIDTH), np.uint16)
    values[:, 0, 0] = 4095
    for frame, picture in enumerate(values):
        Image.fromarray(picture).save(folder / f"ims/1/{frame:06d}.png")
    source = open_source(folder)
    delivery = push(source, client, **way)
    for frame, picture in enumerate(values):
        assert client.frame(delivery.scene, frame).used_cameras == ["0", "1"]
        stored = decode_image(client.picture(delivery.scene, frame, "1"))  # 8 bits, as the worker decodes it
        assert np.array_equal(stored, source.frame(frame).images["1"])
        assert np.abs(stored[..., 0] - picture * (255 / 4095)).max() <= 0.5 + 1e-9


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("frame", [0, 2])
def test_a_frame_below_the_minimum_is_left_out_and_the_next_one_starts(client, folder, way, frame):
    spoil(folder, 0, frame)
    said = []
    rules = IngestSettings(minimum_cameras=2)
    delivery = push(open_source(folder), client, ingest=rules, on_message=said.append, **way)
    states = [client.frame(delivery.scene, index).state for index in range(4)]
    assert states == ["missing" if index == frame else "committed" for index in range(4)]
    assert delivery.left_out.frames == delivery.lost == [frame]
    assert said[-1] == f"frame {frame} is left out: 1 of 2 images can be used, and at least 2 are required"
    assert "1 frame left out, because fewer than 2 of 2 cameras had a usable image" in delivery.left_out.summary


@pytest.mark.parametrize("way", [*WAYS, {"batch": 3, "websocket": True}])
@pytest.mark.parametrize("frame", [1, 2, 3])
def test_a_frame_that_only_the_service_can_refuse_goes_on_without_a_camera(client, folder, monkeypatch, way, frame):
    encoded = Capture.encoded_image

    def truncated(self, index, camera):
        file = encoded(self, index, camera)
        return file[:-9] if (index, camera) == (frame, "1") else file

    monkeypatch.setattr(Capture, "encoded_image", truncated)
    said = []
    delivery = push(open_source(folder), client, on_message=said.append, **way)
    reports = [client.frame(delivery.scene, index) for index in range(4)]
    assert [(report.state, report.used_cameras) for report in reports] == [
        ("committed", ["0"] if index == frame else ["0", "1"]) for index in range(4)
    ]
    assert (delivery.left_out.images, delivery.lost) == (1, [])
    assert said[-1].startswith(f"frame {frame}, without camera 1: refused by the service: ")


def test_the_first_frame_of_a_scene_is_sent_on_its_own(client, folder, monkeypatch):
    spoil(folder, 0, 0)
    batches, put_frames = [], Client.put_frames

    def record(self, scene, frames, on_refusal):
        batches.append([frame.index for frame in frames])
        assert on_refusal == "stop"
        return put_frames(self, scene, frames, on_refusal=on_refusal)

    monkeypatch.setattr("client.rig.sender.Client.put_frames", record)
    push(open_source(folder), client, ingest=IngestSettings(minimum_cameras=2), batch=3)
    assert batches == [[2, 3]]


def test_the_minimum_of_an_existing_scene_applies(client, folder):
    spoil(folder, 0, 2)
    scene = client.create_scene(open_source(folder).rig, ingest=IngestSettings(minimum_cameras=2)).id
    assert push(open_source(folder), client, scene=scene).lost == [2]


def test_a_capture_without_usable_frames_makes_no_scene(client, folder):
    for frame in range(4):
        spoil(folder, 0, frame)
    with pytest.raises(CaptureError, match=r"no frame with usable images of 2 of 2 cameras; .* camera 0: .*000000.png"):
        push(open_source(folder), client, ingest=IngestSettings(minimum_cameras=2))
    assert client.scenes() == []


@pytest.mark.parametrize("way", WAYS)
def test_a_scene_without_a_frame_is_deleted_after_an_error(client, folder, monkeypatch, way):
    capture = open_source(folder)
    refused = InvalidRequest(ProblemDetails(title="", status=422, detail="not now", field="time"))
    for name in ("put_frame", "put_camera"):
        monkeypatch.setattr(
            f"client.rig.sender.{'IngestSocket' if way.get('websocket') else 'Client'}.{name}", _raise(refused)
        )
    with pytest.raises(InvalidRequest, match="not now"):
        push(capture, client, **way)
    assert client.scenes() == []


def test_points_that_are_refused_leave_no_scene(client, folder):
    cloud = np.zeros((5, 7), np.float32)
    cloud[:, 2] = -1e6  # behind all cameras
    np.savez(folder / "init_pt_cld.npz", data=cloud)
    with pytest.raises(InvalidRequest, match="behind all cameras"):
        push(open_source(folder), client)
    assert client.scenes() == []


def test_an_older_scene_and_one_with_frames_are_kept_after_an_error(client, folder, monkeypatch):
    capture = open_source(folder)
    older = client.create_scene(capture.rig).id
    with monkeypatch.context() as patch:
        patch.setattr("client.rig.sender.Client.put_frame", _raise(RuntimeError("later")))
        with pytest.raises(RuntimeError, match="later"):
            push(capture, client, scene=older)
    assert [status.id for status in client.scenes()] == [older]
    put_frame = Client.put_frame

    def only_first(self, scene, index, *arguments, **named):
        if index:
            raise RuntimeError("later")
        return put_frame(self, scene, index, *arguments, **named)

    monkeypatch.setattr("client.rig.sender.Client.put_frame", only_first)
    with pytest.raises(RuntimeError, match="later"):
        push(capture, client)
    assert len(client.scenes()) == 2


def test_a_scene_that_cannot_be_deleted_is_named(client, folder, monkeypatch):
    said = []
    monkeypatch.setattr("client.rig.sender.Client.put_frame", _raise(ServiceUnreachable("gone")))
    with pytest.raises(ServiceUnreachable, match="gone"):
        push(open_source(folder), client, on_message=said.append)
    (status,) = client.scenes()
    assert said == [f"scene {status.id} may be empty; if so: scas4d scenes delete {status.id}"]


def _raise(error):
    def fail(*_, **__):
        raise error

    return fail


def test_push_says_how_many_images_were_left_out(service, client, folder):
    spoil(folder, 1, 3)
    done = CliRunner().invoke(app, ["push", str(folder), "--url", service.url])
    assert done.exit_code == 0, done.output
    assert "frame 3, without camera 1: " in done.output
    assert "4 of 4 frames committed" in done.output
    assert done.output.rstrip().endswith("1 image could not be used; no frame was left out")
    spoil(folder, 0, 3)
    done = CliRunner().invoke(app, ["push", str(folder), "--url", service.url])
    assert done.exit_code == 1
    assert "3 of 4 frames committed" in done.output
    assert str(done.exception).startswith("2 images could not be used; 1 frame left out")


def test_import_says_how_many_images_were_left_out(folder, tmp_path):
    spoil(folder, 1, 3)
    done = CliRunner().invoke(app, ["import", str(folder), str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    assert "frame 3, without camera 1: " in done.output
    assert "1 image could not be used" in done.output
    assert not (tmp_path / "out/ims/1/000003.png").exists()


def test_a_lasting_reason_is_said_once():
    from running import make_rig

    left_out = LeftOut(make_rig(4))
    assert left_out.record(0, {"c0": "a.mp4 ends after 0 frames"}) == [
        "frame 0, without camera c0: a.mp4 ends after 0 frames"
    ]
    assert left_out.record(1, {"c0": "a.mp4 ends after 0 frames"}) == []
    assert left_out.record(1, {"c1": "sent again"}) == []
    assert left_out.record(2, {"c0": "a.mp4 ends after 0 frames", "c1": "1/2.png: no such file"}) == [
        "frame 2, without camera c1: 1/2.png: no such file"
    ]
    assert (left_out.images, left_out.frames) == (4, [])
    assert LeftOut(make_rig(4)).summary is None


def test_a_picture_that_the_service_refuses_is_left_out(client, folder, monkeypatch):
    (folder / "ims/1/000002.png").write_bytes(b"unknown to the client")
    own = Capture.encoded_image

    def unchecked(self, index, camera):
        return b"unknown" if (index, camera) == (2, "1") else own(self, index, camera)

    monkeypatch.setattr(Capture, "encoded_image", unchecked)
    said = []
    delivery = push(open_source(folder), client, on_message=said.append)
    assert client.frame(delivery.scene, 2).used_cameras == ["0"]
    assert said[0].startswith("frame 2, without camera 1: refused by the service: 1: not a JPEG, PNG, WebP")
    with pytest.raises(InvalidRequest, match="not a JPEG"):
        push(open_source(folder), client, ingest=IngestSettings(minimum_cameras=2))


def test_a_picture_of_another_size_is_left_out(client, folder):
    Image.new("RGB", (WIDTH, HEIGHT - 2)).save(folder / "ims/1/000001.png")
    delivery = push(open_source(folder), client)
    assert client.frame(delivery.scene, 1).used_cameras == ["0"]
