from __future__ import annotations

import time

import fakes
import httpx
import numpy as np
import pytest
from PIL import Image
from running import HEIGHT, WIDTH, picture, pictures, problem
from sending import declares
from waiting import HANG_S


def put(http, scene, index, images, masks=None, **data):
    files = {name: (name, body) for name, body in images.items()}
    files |= {f"mask.{name}": ("m", body) for name, body in (masks or {}).items()}
    return http.put(f"/v1/scenes/{scene}/frames/{index}", files=files, data=data)


def test_frames_are_committed_in_order(sdk, scene):
    for index in range(3):
        receipt = sdk.put_frame(scene, index, pictures(index))
        assert receipt.time == index / 10  # from frames_per_second of the scene
    report = sdk.wait(scene, 2)
    assert (report.state, report.psnr, report.loss, report.gaussians) == ("committed", 31.5, [0.5, 0.25], 2)
    status = sdk.scene(scene)
    assert (status.state, status.committed, status.last_committed, status.queued) == ("ready", 3, 2, 0)


def test_a_gap_answers_with_the_index_expected(http, quiet_scene):
    document = problem(put(http, quiet_scene, 3, pictures()), 409)
    assert document["expected"] == 0
    assert document["value"] == "3"


def test_the_same_frame_again_gets_the_same_answer_and_other_content_is_refused(http, scene):
    first = put(http, scene, 0, pictures(5))
    assert first.status_code == 202
    again = put(http, scene, 0, pictures(5))
    assert (again.status_code, again.json()) == (202, first.json())
    assert problem(put(http, scene, 0, pictures(6)), 409)["expected"] == 1
    assert problem(put(http, scene, 0, pictures(5), time="0.25"), 409)["expected"] == 1  # the time belongs to it
    masks = {name: picture(1) for name in pictures()}
    assert problem(put(http, scene, 0, pictures(5), masks), 409)["expected"] == 1
    assert http.get(f"/v1/scenes/{scene}").json()["next_frame"] == 1


def test_a_full_queue_answers_429_and_takes_the_frame_later(http, sdk, scene):
    sdk.put_frame(scene, 0, pictures())
    sdk.wait(scene, 0)
    sdk.put_frame(scene, 1, pictures(fakes.SLOW))
    sdk.put_frame(scene, 2, pictures())
    refused = put(http, scene, 3, pictures())
    problem(refused, 429)
    assert int(refused.headers["Retry-After"]) >= 1
    assert sdk.scene(scene).next_frame == 3
    sdk.put_frame(scene, 3, pictures())  # the SDK waits as long as it is told
    assert sdk.wait(scene, 3).state == "committed"


def test_a_slow_first_frame_is_not_what_the_queue_takes(http, sdk, scene):
    sdk.put_frame(scene, 0, pictures(fakes.SLOW))
    sdk.wait(scene, 0)
    assert sdk.frame(scene, 0).state == "committed"
    http.post(f"/v1/scenes/{scene}/pause")
    sdk.put_frame(scene, 1, pictures())
    sdk.put_frame(scene, 2, pictures())
    paused = problem(put(http, scene, 3, pictures()), 429)
    assert "paused" in paused["detail"]
    assert paused["remedy"].endswith(f"/v1/scenes/{scene}/resume")
    http.post(f"/v1/scenes/{scene}/resume")
    sdk.wait(scene, 2)
    sdk.put_frame(scene, 3, pictures(fakes.SLOW))
    sdk.put_frame(scene, 4, pictures())
    refused = put(http, scene, 5, pictures())
    # Updates 1 and 2 took a moment, frame 0 took 2 s.
    assert problem(refused, 429)["retry_after_seconds"] < fakes.SLOW_S / 2
    assert refused.headers["Retry-After"] == "1"


def test_a_render_does_not_wait_for_the_update_at_work(sdk, scene):
    sdk.put_frame(scene, 0, pictures())
    sdk.wait(scene, 0)
    sdk.render(scene, "c0")  # the reader process is up
    sdk.put_frame(scene, 1, pictures(fakes.SLOW))
    began = time.monotonic()
    while sdk.scene(scene).state != "updating" and time.monotonic() < began + 30:
        time.sleep(0.01)
    view = sdk.render(scene, "c0")
    status = sdk.scene(scene)
    assert (status.state, status.last_committed) == ("updating", 0)  # the update is still at work
    assert view.shape == (HEIGHT, WIDTH, 3)
    assert sdk.wait(scene, 1).state == "committed"
    assert sdk.render(scene, "c0")[0, 0, 0] == round(255 * 0.1)  # and now it is of frame 1


def test_a_frame_that_fails_is_set_aside_and_the_scene_goes_on(sdk, scene):
    sdk.put_frame(scene, 0, pictures())
    sdk.put_frame(scene, 1, pictures(fakes.RAISES))
    report = sdk.wait(scene, 1)
    assert report.state == "failed"
    assert "told to raise" in report.error
    assert sdk.scene(scene).state == "degraded"
    sdk.put_frame(scene, 2, pictures())
    assert sdk.wait(scene, 2).state == "committed"
    assert sdk.scene(scene).state == "ready"


def test_a_first_frame_that_fails_fails_the_scene(http, sdk, scene):
    sdk.put_frame(scene, 0, pictures(fakes.RAISES))
    assert sdk.wait(scene, 0).state == "failed"
    assert sdk.scene(scene).state == "failed"
    assert "told to raise" in problem(put(http, scene, 1, pictures()), 409)["detail"]


def test_frames_that_waited_behind_a_failed_first_one_do_not_bring_the_scene_back(sdk, scene):
    sdk.put_frame(scene, 0, pictures(fakes.SLOW_RAISES))
    sdk.put_frame(scene, 1, pictures())  # is taken: frame 0 is still at work
    until = time.monotonic() + HANG_S
    while sdk.frame(scene, 1).state != "failed":
        assert time.monotonic() < until
        time.sleep(0.05)
    status = sdk.scene(scene)
    assert (status.state, status.committed) == ("failed", 0)
    assert "told to raise" in status.error


def test_a_frame_that_kills_its_worker_twice_is_set_aside_and_the_scene_goes_on(sdk, scene):
    sdk.put_frame(scene, 0, pictures())
    sdk.wait(scene, 0)
    sdk.put_frame(scene, 1, pictures(fakes.DIES))
    report = sdk.wait(scene, 1)
    assert (report.state, report.worker_deaths) == ("failed", 2)
    assert "exit code 7" in report.error
    status = sdk.scene(scene)
    assert (status.state, status.worker_deaths) == ("degraded", 2)
    assert sdk.render(scene, "c0", 0).shape == (HEIGHT, WIDTH, 3)  # what was committed can still be seen
    sdk.put_frame(scene, 2, pictures())
    assert sdk.wait(scene, 2).state == "committed"
    assert sdk.scene(scene).state == "ready"


def damaged_tables():
    """A JPEG whose segments are whole, but whose Huffman tables no decoder takes."""
    damaged = bytearray(picture(30, format="JPEG"))
    start = damaged.index(b"\xff\xc4") + 5  # the code lengths
    damaged[start : start + 16] = b"\xf0" * 16
    return bytes(damaged)


def turned():
    exif = Image.Exif()
    exif[0x0112] = 6
    return picture(format="JPEG", exif=exif)


BAD = {
    "missing camera": ({"c0": picture()}, 422, "c1"),
    "unknown camera": ({**pictures(), "c9": picture()}, 422, "c9"),
    "wrong size": ({"c0": picture(), "c1": picture(size=(7, 5))}, 422, "c1"),
    "huge header": ({"c0": picture(), "c1": declares(50_000, 50_000)}, 422, "c1"),
    "turned": ({"c0": picture(), "c1": turned()}, 422, "c1"),
    "truncated png": ({"c0": picture()[:-9], "c1": picture()}, 422, "c0"),
    "truncated jpeg": ({"c0": picture(format="JPEG")[:-2], "c1": picture()}, 422, "c0"),
    "truncated webp": ({"c0": picture(format="WEBP")[:-2], "c1": picture()}, 422, "c0"),
    "flipped bit": ({"c0": picture().replace(b"IDAT", b"IDAU"), "c1": picture()}, 422, "c0"),
    "cmyk": ({"c0": picture(format="JPEG", mode="CMYK"), "c1": picture()}, 422, "c0"),
    "damaged tables": ({"c0": picture(), "c1": damaged_tables()}, 422, "c1"),
    "no picture": ({"c0": b"hello", "c1": picture()}, 422, "c0"),
    "empty": ({"c0": b"", "c1": picture()}, 422, "c0"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_upload_is_refused_by_name_and_leaves_the_scene_alone(http, quiet_scene, name):
    images, status, field = BAD[name]
    document = problem(put(http, quiet_scene, 0, images), status)
    assert document["field"] == field
    assert document["remedy"]


def test_masks_belong_to_all_cameras_and_are_png(http, sdk, scene):
    assert problem(put(http, scene, 0, pictures(), {"c0": picture()}), 422)["field"] == "mask.c1"
    jpeg = dict.fromkeys(("c0", "c1"), picture(format="JPEG"))
    assert problem(put(http, scene, 0, pictures(), jpeg), 422)["field"] == "mask.c0"
    assert put(http, scene, 0, pictures(), dict.fromkeys(("c0", "c1"), picture())).status_code == 202
    assert sdk.wait(scene, 0).dropped_cameras == {}


def test_time_is_a_number_in_bounds(http, scene):
    assert problem(put(http, scene, 0, pictures(), time="noon"), 422)["field"] == "time"
    assert problem(put(http, scene, 0, pictures(), time="nan"), 422)["field"] == "time"
    assert put(http, scene, 0, pictures(), time="1.5").json()["time"] == 1.5
    assert problem(put(http, scene, 1, pictures(), time="1e20"), 422)["field"] == "time"


def test_other_bodies_are_refused(http, scene):
    url = f"/v1/scenes/{scene}/frames/0"
    assert problem(http.put(url, content=b"x"), 415)["field"] == "Content-Type"
    broken = {"Content-Type": "multipart/form-data; boundary=x"}
    problem(http.put(url, content=b"no part here", headers=broken), 400)
    problem(http.put(url, files={"c0": (None, "text")}), 422)
    twice = [("c0", ("a", picture())), ("c0", ("b", picture()))]
    assert problem(http.put(url, files=twice), 422)["field"] == "c0"
    problem(http.put(url, content=b"\0" * 2_100_000, headers=broken), 413)
    problem(http.put("/v1/scenes/none/frames/0", files={"c0": ("a", picture())}), 404)
    problem(http.put(f"/v1/scenes/{scene}/frames/-1", files={"c0": ("a", picture())}), 422)


def test_a_body_without_a_length_is_counted(http, quiet_scene):
    def endless():
        for _ in range(30):
            yield b"\0" * 100_000

    try:
        response = http.put(f"/v1/scenes/{quiet_scene}/points", content=endless())
    except httpx.WriteError:  # the service may close on the one who goes on sending
        return
    problem(response, 413)


def test_grey_and_webp_are_taken(sdk, scene):
    # Grey and WebP have defined answers: nothing is dropped.
    sdk.put_frame(scene, 0, {"c0": picture(40, mode="L"), "c1": picture(40, format="WEBP", lossless=True)})
    report = sdk.wait(scene, 0)
    assert (report.state, report.dropped_cameras) == ("committed", {})
    assert np.isfinite(report.seconds["total"])
