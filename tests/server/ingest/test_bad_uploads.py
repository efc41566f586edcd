"""What is bad is refused at every door by field, value and remedy, and the scene is unharmed."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
from mutated_pictures import exif, join, split
from PIL import Image
from running import HEIGHT, WIDTH, make_rig, picture, pictures, problem
from sending import declares
from websockets.sync.client import connect

from client.wire import FRAME_MEDIA_TYPE, RigModel, frame_chunks


def sixteen_bits(largest):
    file = io.BytesIO()
    Image.fromarray(np.full((HEIGHT, WIDTH), largest, np.uint16)).save(file, "PNG")
    return file.getvalue()


def without_last_pixels():
    """A PNG whose checksums fit."""
    data = picture()
    parts = split(data)
    return join([part[:-9] if part[:4] == b"IDAT" else part for part in parts], data)


BAD = {
    "truncated JPEG": (lambda: picture(format="JPEG")[:-5], "bytes", "the original file again"),
    "truncated PNG": (lambda: picture()[:-5], "bytes", "the original file again"),
    "truncated WebP": (lambda: picture(format="WEBP")[:-5], "bytes", "the original file again"),
    "wrong size": (lambda: picture(size=(WIDTH + 1, HEIGHT)), f"{WIDTH + 1}x{HEIGHT}", "for which the camera was"),
    "16 bits": (lambda: sixteen_bits(60_000), "16 bits", "convert the image to 8 bits per channel"),
    "12 bits in 16": (lambda: sixteen_bits(4000), "16 bits", "its values use 12 bits, so multiply them by 255/4095"),
    "CMYK": (lambda: picture(format="JPEG", mode="CMYK"), "CMYK", "use 8-bit RGB"),
    **{
        f"rotated {kind}": (lambda kind=kind: picture(format=kind, exif=exif(6)), "6", "remove the tag")
        for kind in ("JPEG", "PNG", "WEBP")
    },
    "damaged ICC profile": (lambda: picture(icc_profile=b"nonsense"), "bytes", "convert the image to sRGB"),
    "PNG without its last pixels": (without_last_pixels, "bytes", "send the original again"),
    "50,000 x 50,000 header": (lambda: declares(50_000, 50_000), "50000x50000", "for which the camera was"),
    "PPM with 16 bits": (lambda: b"P6 16 16 65535\n" + bytes(1536), "maximum value 65535", "use 255"),
    "PPM with extra bytes": (lambda: picture(format="PPM") + b"\0", "bytes", "and nothing else"),
    "PPM with a comment": (lambda: b"P6\n# rig\n" + picture(format="PPM")[3:], "bytes", "without comments"),
    "no picture": (lambda: b"GIF89a or so", "bytes", "encode the image"),
}


def by_form(http, url, scene, data):
    files = {"c0": ("c0", picture()), "c1": ("c1", data)}
    return problem(http.put(f"/v1/scenes/{scene}/frames/0", files=files), 422)


def by_frame(http, url, scene, data):
    body = b"".join(frame_chunks(0, {"c0": picture(), "c1": data}))
    headers = {"Content-Type": FRAME_MEDIA_TYPE}
    return problem(http.put(f"/v1/scenes/{scene}/frames/0", content=body, headers=headers), 422)


def by_camera(http, url, scene, data):
    return problem(http.put(f"/v1/scenes/{scene}/frames/0/cameras/c1", content=data), 422)


def by_socket(http, url, scene, data):
    with connect(f"{url.replace('http', 'ws')}/v1/scenes/{scene}/ingest") as socket:
        socket.send(b"".join(frame_chunks(0, {"c0": picture(), "c1": data})))
        answer = json.loads(socket.recv())
    assert answer["status"] == 422
    return answer["problem"]


DOORS = {"form": by_form, "frame": by_frame, "camera": by_camera, "socket": by_socket}


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize("name", BAD)
def test_a_bad_picture_is_refused_at_every_door(http, service, quiet_scene, name, door):
    data, value, remedy = BAD[name]
    document = DOORS[door](http, service.url, quiet_scene, data())
    assert document["field"] == "c1"
    assert value in document["value"]
    assert remedy in document["remedy"]
    status = http.get(f"/v1/scenes/{quiet_scene}").json()
    assert (status["next_frame"], status["open_frames"], status["frames_kept"]) == (0, [], 0)


BAD_MASKS = {
    "JPEG": (lambda: picture(format="JPEG"), "JPEG", "encode masks as PNG"),
    "alpha": (lambda: picture(mode="RGBA"), "alpha", "use a single channel"),
    "rotated": (lambda: picture(exif=exif(3)), "3", "remove the tag"),
}


@pytest.mark.parametrize("name", BAD_MASKS)
def test_a_bad_mask_is_refused(http, quiet_scene, name):
    data, value, remedy = BAD_MASKS[name]
    files = {**pictures(), "mask.c0": picture(), "mask.c1": data()}
    answer = http.put(
        f"/v1/scenes/{quiet_scene}/frames/0", files={field: (field, file) for field, file in files.items()}
    )
    document = problem(answer, 422)
    assert (document["field"], document["value"]) == ("mask.c1", value)
    assert remedy in document["remedy"]
    assert "BytesIO" not in document["detail"]


@pytest.mark.parametrize("door", ["form", "frame", "camera"])
def test_a_wrong_camera_is_refused(http, quiet_scene, door):
    url = f"/v1/scenes/{quiet_scene}/frames/0"
    images = {**pictures(), "c9": picture()}
    if door == "form":
        answer = http.put(url, files={name: (name, data) for name, data in images.items()})
    elif door == "frame":
        body = b"".join(frame_chunks(0, images))
        answer = http.put(url, content=body, headers={"Content-Type": FRAME_MEDIA_TYPE})
    else:
        answer = http.put(f"{url}/cameras/c9", content=picture())
    document = problem(answer, 422)
    assert document["value"] == "c9"
    assert "use one of c0, c1" in document["remedy"]


CAMERAS = {
    "NaN": ("intrinsics", [[float("nan"), 0, 1], [0, 1, 1], [0, 0, 1]], "finite"),
    "singular intrinsics": ("intrinsics", [[0, 0, 1], [0, 0, 1], [0, 0, 1]], "focal"),
    "no rotation": ("world_to_camera", [[2.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "rotation"),
    "mirrored": ("world_to_camera", [[-1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "rotation"),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_a_camera_that_cannot_be_is_refused(http, name):
    field, value, said = CAMERAS[name]
    body = {"rig": RigModel.of(make_rig()).model_dump(mode="json")}
    body["rig"]["cameras"][1][field] = value
    before = len(http.get("/v1/scenes").json()["scenes"])
    text = json.dumps(body)  # writes NaN, as many do
    document = problem(http.post("/v1/scenes", content=text, headers={"Content-Type": "application/json"}), 422)
    assert "cameras.1" in document["field"]
    assert document["value"]
    assert said in document["remedy"]
    assert len(http.get("/v1/scenes").json()["scenes"]) == before
