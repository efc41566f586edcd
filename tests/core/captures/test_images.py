import io
import struct
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mutated_pictures import join, sixteen_bit_png, split
from PIL import Image, ImageCms

from scas4d_core.cameras import Camera
from scas4d_core.captures.bit_depth import find_bit_depth
from scas4d_core.captures.images import (
    check_image,
    decode_image,
    decode_labels,
    decode_mask,
    describe_pictures,
    picture_size,
    resize_area,
    resize_mask,
    scaled_size,
)
from scas4d_core.captures.picture_file import ImageError


def encoded(picture, kind="PNG", **options):
    buffer = io.BytesIO()
    picture.save(buffer, kind, **options)
    return buffer.getvalue()


def rgb(seed=0, height=6, width=8):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def png(width, height, depth, colour_type, rows):
    """A PNG by hand: for the kinds that Pillow does not write."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, depth, colour_type, 0, 0, 0)
    body = zlib.compress(b"".join(b"\0" + row for row in rows))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


def test_an_rgb_picture_comes_as_it_is(tmp_path):
    data = encoded(Image.fromarray(rgb()))
    np.testing.assert_array_equal(decode_image(data), rgb())
    (tmp_path / "a.png").write_bytes(data)
    np.testing.assert_array_equal(decode_image(tmp_path / "a.png", size=(8, 6)), rgb())
    assert picture_size(tmp_path / "a.png") == (8, 6)


def test_a_raw_picture_comes_as_it_is():
    np.testing.assert_array_equal(decode_image(encoded(Image.fromarray(rgb()), "PPM"), size=(8, 6)), rgb())
    grey = decode_image(b"P5\n8 6\n255\n" + rgb()[..., 0].tobytes())
    np.testing.assert_array_equal(grey, rgb()[..., :1].repeat(3, axis=2))


UPRIGHT = Image.Exif()
UPRIGHT[0x0112] = 1


def test_an_orientation_is_refused_and_upright_is_not():
    for orientation in range(2, 9):
        exif = Image.Exif()
        exif[0x0112] = orientation
        for kind in ("JPEG", "PNG", "WEBP"):
            with pytest.raises(ImageError, match=f"EXIF orientation is {orientation}; the intrinsics"):
                decode_image(encoded(Image.fromarray(rgb()), kind, exif=exif), size=(6, 8))
    for orientation in (0, 1):
        exif = Image.Exif()
        exif[0x0112] = orientation
        np.testing.assert_array_equal(decode_image(encoded(Image.fromarray(rgb()), exif=exif)), rgb())


def test_alpha_is_composited_over_black():
    rgba = np.dstack([np.full((1, 3, 3), 200, np.uint8), np.array([[0, 128, 255]], np.uint8)])
    assert decode_image(encoded(Image.fromarray(rgba)))[0, :, 0].tolist() == [0, 100, 200]
    la = np.dstack([np.full((1, 3), 200, np.uint8), np.array([[0, 128, 255]], np.uint8)])
    assert decode_image(encoded(Image.fromarray(la)))[0, :, 2].tolist() == [0, 100, 200]


def test_a_transparent_palette_entry_is_black():
    picture = Image.new("P", (2, 1))
    picture.putpalette([250, 10, 20, 40, 50, 60])
    picture.putpixel((1, 0), 1)
    assert decode_image(encoded(picture)).tolist() == [[[250, 10, 20], [40, 50, 60]]]
    assert decode_image(encoded(picture, transparency=0)).tolist() == [[[0, 0, 0], [40, 50, 60]]]


def test_grey_is_replicated():
    grey = np.array([[0, 90, 255]], np.uint8)
    np.testing.assert_array_equal(decode_image(encoded(Image.fromarray(grey))), np.dstack([grey] * 3))
    assert decode_image(encoded(Image.fromarray(grey > 100)))[0, :, 1].tolist() == [0, 0, 255]


def test_16_bit_is_rounded_for_all_kinds_of_channels():
    values = np.random.default_rng(0).integers(0, 65536, (9, 7, 4)).astype(np.uint16)
    values[..., 3] = 65535
    for colour_type, channels in ((0, [0]), (2, [0, 1, 2]), (4, [0, 3]), (6, [0, 1, 2, 3])):
        shown = decode_image(sixteen_bit_png(values[..., channels], colour_type), bit_depth=16)
        colours = values[..., [0] * 3 if colour_type in (0, 4) else [0, 1, 2]]
        np.testing.assert_array_equal(shown, np.rint(colours / 257))


@pytest.mark.parametrize("depth", [10, 12, 14])
def test_the_bit_depth_of_16_bit_files_is_found_and_scaled(depth):
    values = np.linspace(0, 2**depth - 1, 48).astype(np.uint16).reshape(6, 8)
    dark = sixteen_bit_png(values // 64, 0)
    files = [dark, sixteen_bit_png(values, 0)]
    assert find_bit_depth(files) == depth
    assert find_bit_depth([sixteen_bit_png(np.dstack([values] * 3), 2)]) == depth
    np.testing.assert_array_equal(
        decode_image(files[1], bit_depth=depth)[..., 0], np.rint(values / (2**depth - 1) * 255)
    )
    with pytest.raises(ImageError, match=rf"the value {2**depth - 1} exceeds 8 bits.*--bit-depth"):
        decode_image(files[1], bit_depth=8)


def test_a_stated_bit_depth_counts_if_the_values_are_not_scaled():
    dark = np.full((6, 8), 200, np.uint16)
    assert find_bit_depth([sixteen_bit_png(dark, 0, sBIT=b"\x0c")]) == 12
    assert find_bit_depth([sixteen_bit_png(dark * 300, 0, sBIT=b"\x0c")]) == 16  # scaled, as the format requires
    assert find_bit_depth([sixteen_bit_png(0 * dark, 0)]) == 16


def test_without_a_bit_depth_16_bit_is_refused_with_the_scale():
    data = sixteen_bit_png(np.full((6, 8), 4000, np.uint16), 0)
    with pytest.raises(ImageError, match=r"16 bits per channel; .* use 12 bits, so multiply them by 255/4095"):
        decode_image(data)


def test_cmyk_and_unknown_formats_are_refused():
    with pytest.raises(ImageError, match=r"front.jpg: unsupported JPEG format: CMYK"):
        decode_image(encoded(Image.new("CMYK", (4, 4)), "JPEG"), name="front.jpg")
    with pytest.raises(ImageError, match=r"not a JPEG.*it starts with 47 49 46"):
        decode_image(encoded(Image.fromarray(rgb()), "GIF"))


@pytest.mark.parametrize("kind", ["MPO", "PNG", "WEBP"])
def test_of_several_images_in_a_file_the_first_is_used_with_a_remark(tmp_path, kind):
    first, second = (Image.fromarray(np.full((16, 16, 3), value, np.uint8)) for value in (10, 200))
    path = tmp_path / "a"
    path.write_bytes(encoded(first, kind, save_all=True, append_images=[second]))
    assert np.abs(decode_image(path).astype(int) - 10).max() <= 2
    check_image(path)
    assert describe_pictures({"north": path}, [{"north": path}])[1] == [
        "camera 'north': files contain several images; only the first of each file is used"
    ]


def linear_profile():
    """A profile with sRGB's primaries and no transfer curve, made from sRGB's by exchanging its three curves."""
    data = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    count = struct.unpack_from(">I", data, 128)[0]
    for entry in range(count):
        tag, offset, _ = struct.unpack_from(">4sII", data, 132 + 12 * entry)
        if tag in (b"rTRC", b"gTRC", b"bTRC"):
            data[offset : offset + 12] = struct.pack(">4sII", b"curv", 0, 0)  # no entries: the identity
            struct.pack_into(">I", data, 132 + 12 * entry + 8, 12)
        if tag == b"desc":
            place = data.index("sRGB".encode("utf-16-be"), offset)
            data[place : place + 8] = "line".encode("utf-16-be")
    return bytes(data)


def test_an_icc_profile_is_converted_to_srgb_and_srgb_itself_left_alone():
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    np.testing.assert_array_equal(decode_image(encoded(Image.fromarray(rgb()), icc_profile=srgb)), rgb())
    grey = np.full((2, 2, 3), 55, np.uint8)  # linear 55/255 = 0.2157 is 1.055 · 0.2157^(1/2.4) − 0.055 = 0.5018 in sRGB
    shown = decode_image(encoded(Image.fromarray(grey), icc_profile=linear_profile()))
    np.testing.assert_allclose(shown, 255 * 0.5018, atol=1.01)
    with pytest.raises(ImageError, match="ICC profile cannot be read"):
        decode_image(encoded(Image.fromarray(rgb()), icc_profile=b"nonsense"))


@pytest.mark.parametrize("options", [{}, {"exif": UPRIGHT}, {"progressive": True}])
@pytest.mark.parametrize("mode", ["RGB", "L"])
@pytest.mark.parametrize("sampling", ["4:4:4", "4:2:2", "4:2:0"])
def test_a_jpeg_has_the_pixels_that_pillow_decodes(mode, sampling, options):
    smooth = Image.fromarray(rgb(height=5, width=7)).resize((61, 43), Image.Resampling.BICUBIC).convert(mode)
    data = encoded(smooth, "JPEG", subsampling=sampling, **options)
    np.testing.assert_array_equal(decode_image(data), Image.open(io.BytesIO(data)).convert("RGB"))
    check_image(data, size=(61, 43))
    for call in (check_image, decode_image):
        with pytest.raises(ImageError, match="61x43 pixels, but its camera requires 43x61"):
            call(data, size=(43, 61))


def test_a_jpeg_with_damaged_pixels_is_decoded_as_far_as_possible():
    data = bytearray(encoded(Image.fromarray(rgb(height=40, width=60)), "JPEG", quality=95))
    middle = (data.index(b"\xff\xda") + len(data)) // 2
    data[middle : middle + 40] = bytes(40)
    np.testing.assert_array_equal(decode_image(bytes(data)), Image.open(io.BytesIO(data)).convert("RGB"))


def test_the_size_of_the_camera_is_checked_before_decoding():
    huge = png(50_000, 50_000, 8, 2, [])
    with pytest.raises(ImageError, match=r"cam3: the image is 50000x50000 pixels, but its camera requires 16x12"):
        decode_image(huge, size=(16, 12), name="cam3")


def test_files_that_are_missing_damaged_or_empty_are_named(tmp_path):
    with pytest.raises(ImageError, match=r"gone\.png: no such file"):
        decode_image(tmp_path / "gone.png")
    with pytest.raises(ImageError, match=r"gone\.png: no such file"):
        picture_size(tmp_path / "gone.png")
    without_last_pixels = [
        part[:-9] if part[:4] == b"IDAT" else part for part in split(encoded(Image.fromarray(rgb())))
    ]
    for data, fault in (
        (b"", "front: the file is empty; send the image as JPEG"),
        (b"text", "front: not a JPEG"),
        (encoded(Image.fromarray(rgb()))[:-30], "front: the PNG file is truncated"),
        (join(without_last_pixels, encoded(Image.fromarray(rgb()))), "front cannot be read as an image .*truncated"),
    ):
        with pytest.raises(ImageError, match=fault):
            decode_image(data, name="front")


@settings(max_examples=150, deadline=None)
@given(kind=st.sampled_from(["PNG", "JPEG", "WEBP", "BMP"]), place=st.floats(0, 1), value=st.integers(0, 255))
def test_damage_gives_a_picture_or_an_image_error(kind, place, value):
    data = bytearray(encoded(Image.fromarray(rgb(0, 16, 16)), kind))
    data[int(place * (len(data) - 1))] = value
    try:
        picture = decode_image(bytes(data), size=(16, 16))
    except ImageError:
        return
    assert picture.shape == (16, 16, 3)


def test_halving_averages_four_pixels():
    small = resize_area(rgb(), (rgb().shape[1] // 2, rgb().shape[0] // 2))
    expected = rgb().reshape(3, 2, 4, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(small, expected, atol=0.5)


@pytest.mark.parametrize("scale", [0.5, 0.4, 0.37, 2.0])
def test_a_resized_edge_lies_where_the_scaled_camera_sees_it(scale):
    full = Camera("a", np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]), np.eye(4), 64, 48)
    picture = np.zeros((48, 64, 3), np.uint8)
    picture[:, 23:] = 250  # an edge at u = 23
    picture[31:] = 0  # and one at v = 31
    small = resize_area(picture, scaled_size((64, 48), scale))
    scaled = full.scaled(scale)
    assert small.shape == (scaled.height, scaled.width, 3)
    edge = scaled.project(full.unproject([23.0, 31.0], 1.0))[0]
    # A row's sum gives the place of its edge to a fraction of a pixel.
    assert scaled.width - small[0, :, 0].sum() / 250 == pytest.approx(edge[0], abs=0.01)
    assert small[:, -1, 0].sum() / 250 == pytest.approx(edge[1], abs=0.01)


@given(width=st.integers(1, 20), height=st.integers(1, 20))
def test_resizing_keeps_a_flat_picture_flat(width, height):
    flat = np.full((7, 11, 3), 201, np.uint8)
    resized = resize_area(flat, (width, height))
    assert resized.shape == (height, width, 3)
    assert (resized == 201).all()


def test_image_scale_must_be_positive():
    for scale in (0.0, -1.0, float("nan")):
        with pytest.raises(ImageError, match="image_scale"):
            scaled_size((64, 48), scale)


@pytest.mark.parametrize("value", [1, 128, 255])
def test_any_value_but_zero_is_foreground(value):
    mask = np.array([[0, value, 0, value]], np.uint8)
    assert decode_mask(encoded(Image.fromarray(mask))).tolist() == [[0, 1, 0, 1]]
    assert decode_mask(encoded(Image.fromarray(mask > 0))).tolist() == [[0, 1, 0, 1]]
    blue = np.dstack([0 * mask, 0 * mask, mask])
    assert decode_mask(encoded(Image.fromarray(blue))).tolist() == [[0, 1, 0, 1]]


def test_masks_with_two_readings_are_refused():
    with pytest.raises(ImageError, match="alpha channel is ambiguous"):
        decode_mask(encoded(Image.new("RGBA", (4, 4))))
    with pytest.raises(ImageError, match="masks must be PNG or BMP, not JPEG; encode masks as PNG"):
        decode_mask(encoded(Image.new("L", (4, 4)), "JPEG"))


def test_a_scaled_mask_is_foreground_where_half_of_the_area_is():
    mask = np.array([[1, 0, 1, 0], [1, 0, 0, 0]], np.uint8)
    assert resize_mask(mask, (2, 1)).tolist() == [[1, 0]]


def test_labels_are_picked_never_averaged():
    labels = np.arange(16, dtype=np.uint8).reshape(4, 4)
    data = encoded(Image.fromarray(labels))
    np.testing.assert_array_equal(decode_labels(data, size=(4, 4), target=(4, 4)), labels)
    np.testing.assert_array_equal(decode_labels(data, size=(4, 4), target=(2, 2)), labels[1::2, 1::2])
    with pytest.raises(ImageError, match="single 8-bit channel"):
        decode_labels(encoded(Image.fromarray(rgb())), size=(8, 6), target=(8, 6))
