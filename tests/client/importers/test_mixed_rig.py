"""A rig of unlike cameras: three sizes, a fisheye, grey, 16 bits and a palette, opened, written and fitted to sizes."""

from __future__ import annotations

import json

import numpy as np
import pytest

pytest.importorskip("cv2")

from made_rigs.mixed import COUNT, DEEP, FISHEYE, GREY, PALETTE, SIZES, STEP, camera, seen_by, write_rig
from PIL import Image

from client.importers.open_source import open_source
from client.importers.write import write_dynamic3dgs
from scas4d_core.captures import CaptureError, decode_image, open_capture


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_rig(tmp_path_factory.mktemp("mixed"))


def test_each_camera_keeps_its_size_and_sees_the_ball_where_it_is(folder):
    capture = open_source(folder)
    assert {(one.width, one.height) for one in capture.rig.cameras} == set(SIZES)
    for t in (0, 1):
        frame = capture.frame(t)
        for one in capture.rig.cameras:
            assert frame.images[one.name].shape == (one.height, one.width, 3)
            truth, mask = seen_by(one, t)  # what the pinhole of the rig sees, whatever the lens was
            found = np.argwhere(frame.masks[one.name]).mean(axis=0)
            assert np.abs(found - np.argwhere(mask).mean(axis=0)).max() < 0.3
            if one.name != GREY:
                off = np.abs(frame.images[one.name] / 255 - truth)[mask & frame.masks[one.name].astype(bool)]
                assert off.mean() < {PALETTE: 0.05, FISHEYE: 0.03}.get(one.name, 0.003)
    assert np.ptp(capture.frame(0).images[GREY], axis=-1).max() == 0


def test_what_is_not_as_usual_is_said(folder):
    remarks = open_source(folder).remarks
    assert any(
        remark.startswith(f"camera {DEEP!r}: 16-bit images are converted to 8 bits from a bit depth of 16")
        for remark in remarks
    )
    assert any(remark.startswith(f"grayscale cameras among colour ones: {GREY};") for remark in remarks)
    assert len(remarks) == 2


def test_files_to_be_sent_have_eight_bits(folder):
    capture = open_source(folder, encoding="png")
    for name in capture.rig.names:
        file = capture.encoded_image(1, name)
        assert file[24] == 8
        np.testing.assert_array_equal(decode_image(file), capture.frame(1).images[name])


def test_it_is_written_and_read_again(folder, tmp_path):
    source = open_source(folder, encoding="png", test=("c0", "c4"))
    write_dynamic3dgs(source, tmp_path / "out")
    again = open_capture(tmp_path / "out")
    assert len(again.remarks) == 1  # 16 bits are no more
    assert again.remarks[0].startswith("grayscale cameras among colour ones: c1; ")
    for of in ("full_rig", "full_test_rig"):
        for one, other in zip(getattr(source, of).cameras, getattr(again, of).cameras, strict=True):
            assert (one.name, one.width, one.height) == (other.name, other.width, other.height)
            np.testing.assert_array_equal(one.intrinsics, other.intrinsics)
    for name in again.full_rig.names:
        np.testing.assert_array_equal(again.frame(1).images[name], source.frame(1).images[name])
        np.testing.assert_array_equal(again.frame(1).masks[name], source.frame(1).masks[name])
    half = again.scaled(0.5)
    assert {name: image.shape for name, image in half.test_frame(0).images.items()} == {
        one.name: (one.height, one.width, 3) for one in half.test_rig.cameras
    }


def resized(folder, out, change):
    """The rig with the pictures of all cameras changed; masks are left out."""
    write_rig(out)
    for path in sorted((out / "images").rglob("*.png")):
        with Image.open(path) as picture:
            change(picture.convert("RGB")).save(path)
    for path in sorted((out / "masks").rglob("*.png")):
        path.unlink()
    for path in (out / "masks").iterdir():
        path.rmdir()
    (out / "masks").rmdir()
    return out


def test_pictures_at_half_of_the_calibrated_size_scale_their_cameras_and_say_so(folder, tmp_path):
    half = resized(folder, tmp_path / "half", lambda picture: picture.reduce(2))
    capture = open_source(half)
    full = open_source(folder, image_scale=0.5)
    for one, other in zip(capture.rig.cameras, full.rig.cameras, strict=True):
        assert (one.width, one.height) == (other.width, other.height)
        # The fisheye's pinhole is found from sampled edges.
        np.testing.assert_allclose(one.intrinsics, other.intrinsics, rtol=1e-3 if one.name == FISHEYE else 1e-12)
    said = [remark for remark in capture.remarks if "scaled by 0.5" in remark]
    assert len(said) == COUNT
    assert said[0] == "camera 'c0': calibrated for 96x72, but images are 48x36; intrinsics scaled by 0.5"


def test_pictures_a_little_off_are_refused_until_it_is_said_why(folder, tmp_path):
    cut = resized(folder, tmp_path / "cut", lambda picture: picture.crop((0, 0, picture.width - 8, picture.height)))
    with pytest.raises(
        CaptureError, match=r"c0/0.png is 88x72 .* 'c0' was calibrated for 96x72.* --size-mismatch corner"
    ):
        open_source(cut)
    shown = {}
    for size_mismatch in ("corner", "centre", "stretch"):
        capture = open_source(cut, size_mismatch=size_mismatch)
        assert sum("calibrated for" in remark for remark in capture.remarks) == COUNT
        shown[size_mismatch] = capture.rig["c0"]
    full = camera(0)
    assert (shown["corner"].cx, shown["corner"].fx) == (full.cx, full.fx)
    assert (shown["centre"].cx, shown["centre"].fx) == (full.cx - 4, full.fx)
    assert shown["stretch"].cx == pytest.approx(full.cx * 88 / 96)
    assert shown["stretch"].fx == pytest.approx(full.fx * 88 / 96)
    # Cut at the right, the ball stays where the camera projects it.
    uv, _ = shown["corner"].project(STEP)
    assert np.linalg.norm(uv - full.project(STEP)[0]) < 1e-9


def test_the_layout_of_the_core_takes_the_same_remedies(folder, tmp_path):
    write_dynamic3dgs(open_source(folder, encoding="png"), tmp_path / "out")
    for path in sorted((tmp_path / "out/ims").rglob("*.png")):
        with Image.open(path) as picture:
            picture.convert("RGB").reduce(2).save(path)
    capture = open_source(tmp_path / "out", use_masks=False)
    assert sum("scaled by 0.5" in remark for remark in capture.remarks) == COUNT
    assert (capture.rig["c0"].width, capture.rig["c0"].fx) == (48, 55.0)
    meta = json.loads((tmp_path / "out/train_meta.json").read_text())
    (tmp_path / "out/train_meta.json").write_text(json.dumps(meta | {"w": [w // 2 - 4 for w in meta["w"]]}))
    with pytest.raises(CaptureError, match=r"--size-mismatch corner"):
        open_source(tmp_path / "out", use_masks=False)
    assert open_source(tmp_path / "out", use_masks=False, size_mismatch="centre").rig["c0"].width == 48
