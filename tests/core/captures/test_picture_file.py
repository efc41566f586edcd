from __future__ import annotations

import io

import pytest
from mutated_pictures import HEIGHT, WIDTH, mutated, whole_files
from PIL import Image

from scas4d_core.captures import images
from scas4d_core.captures.images import check_image, check_mask, decode_image, decode_mask
from scas4d_core.captures.picture_file import ImageError, picture_header

REFUSED = {"JPEG rotated", "JPEG CMYK", "PNG rotated", "PNG 16 bit", "PNG 16 bit grey", "WebP rotated"}
COMMON = {"JPEG", "JPEG 4:4:4", "JPEG grey", "JPEG restarts", "JPEG EXIF, ICC", "JPEG rotated", "MPO", "PPM", "PGM"}
"""Sequential JPEGs and raw pixels, which are not decoded to be checked."""


@pytest.mark.parametrize("name", whole_files())
def test_whole_files_are_images_unless_a_rule_refuses_them(name):
    data = whole_files()[name]
    if name in REFUSED:
        with pytest.raises(ImageError):
            check_image(data, size=(WIDTH, HEIGHT))
        return
    header = picture_header(data)
    assert header.size == (WIDTH, HEIGHT)
    assert header.decodable == (name in COMMON)
    check_image(data, size=(WIDTH, HEIGHT))
    with pytest.raises(ImageError, match="its camera requires 23x16"):
        check_image(data, size=(WIDTH - 1, HEIGHT))


@pytest.mark.parametrize("name", [name for name in whole_files() if name != "MPO"])
def test_every_cut_is_refused(name):
    data = whole_files()[name]
    for length in {*range(0, len(data), 7), *range(len(data) - 16, len(data))}:
        with pytest.raises(ImageError):
            check_image(data[:length])


def test_a_second_image_may_be_cut():
    data = whole_files()["MPO"]
    check_image(data[:-9])


def test_bytes_after_the_end_are_ignored():
    for name in ("JPEG", "JPEG progressive", "PNG", "WebP"):
        check_image(whole_files()[name] + b"\0\0", size=(WIDTH, HEIGHT))


@pytest.mark.filterwarnings("default")  # of Pillow, about damaged metadata
def test_a_mutated_file_passes_the_check_exactly_if_it_is_decoded():
    passed = {check_image: 0, check_mask: 0}
    for number in range(3000):
        name, data = mutated(number)
        for check, decode in ((check_image, decode_image), (check_mask, decode_mask)):
            outcomes = [outcome(function, data) for function in (check, decode)]
            assert outcomes[0] == outcomes[1], (number, name)
            passed[check] += outcomes[0] is None
    assert min(passed.values()) > 300


def outcome(function, data):
    try:
        function(data, size=(WIDTH, HEIGHT))
    except ImageError as error:
        return str(error)
    return None


@pytest.mark.parametrize("name", ["JPEG", "JPEG with a comment", "PPM"])
def test_pillow_opens_only_files_with_metadata(name, monkeypatch):
    picture = Image.new("RGB", (16, 8), (10, 200, 30))
    file = io.BytesIO()
    picture.save(file, name.split()[0], **({"comment": b"metadata"} if "comment" in name else {}))
    opened, original = [], images._open
    monkeypatch.setattr(images, "_open", lambda *arguments: opened.append(arguments) or original(*arguments))
    check_image(file.getvalue(), size=(16, 8))
    assert len(opened) == ("comment" in name)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 16 * 8 // 4)  # Pillow refuses twice as many
    with pytest.raises(ImageError, match="DecompressionBomb"):
        check_image(file.getvalue(), size=(16, 8))
