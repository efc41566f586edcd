from __future__ import annotations

import numpy as np
import pytest
from running import HEIGHT, WIDTH, picture

from server.ingest.pictures import StructureError, image_header

FILES = {
    "png": picture(40),
    "jpeg": picture(40, format="JPEG"),
    "progressive": picture(40, format="JPEG", progressive=True),
    "restarts": picture(40, format="JPEG", restart_marker_blocks=1),
    "webp": picture(40, format="WEBP"),
    "lossless webp": picture(40, format="WEBP", lossless=True),
    "webp with alpha": picture(40, format="WEBP", mode="RGBA", exact=True),
    "ppm": picture(40, format="PPM"),
    "pgm": picture(40, format="PPM", mode="L"),
}


@pytest.mark.parametrize("name", FILES)
def test_a_whole_file_tells_its_size(name):
    header = image_header(FILES[name])
    assert (header.width, header.height) == (WIDTH, HEIGHT)


@pytest.mark.parametrize("name", FILES)
def test_every_cut_is_found(name):
    data = FILES[name]
    for length in range(len(data)):
        with pytest.raises(StructureError):
            image_header(data[:length])


@pytest.mark.parametrize("name", FILES)
def test_damage_raises_nothing_else(name):
    rng = np.random.default_rng(0)
    data = FILES[name]
    refused = 0
    for _ in range(400):
        damaged = bytearray(data)
        for at in rng.integers(0, len(data), 3):
            damaged[at] = rng.integers(256)
        try:
            image_header(bytes(damaged))
        except StructureError:
            refused += 1
    # Checksums find every change of a PNG; the others only what breaks their segments.
    assert refused >= (395 if name == "png" else 1)


def test_what_follows_the_end_is_let_be():
    assert image_header(FILES["jpeg"] + b"\0\0") == image_header(FILES["jpeg"])
