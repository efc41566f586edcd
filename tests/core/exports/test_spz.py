"""SPZ, read by a decoder of its own after Niantic's description, and by gsply's two readers."""

import gzip
import struct

import numpy as np
import pytest
from export_cases import corner

from scas4d_core.errors import InputError
from scas4d_core.exports.spz import write_spz

gsply = pytest.importorskip("gsply", reason="SPZ needs gsply: pip install 'scas4d[exports]'")
C0 = 0.28209479177387814
LIMITS = {"means": 4e-7, "covariances": 0.08, "colours": 0.004, "opacities": 0.002}


def decoded(content: bytes) -> tuple[corner.Found, np.ndarray, int]:
    """Version 3 by hand: Gaussians in the file's axes, harmonics [N, 16, 3], and the fractional bits."""
    raw = gzip.decompress(content)
    magic, version, count, degree, bits, _, reserved = struct.unpack("<IIIBBBB", raw[:16])
    assert (magic, version, reserved) == (0x5053474E, 3, 0)
    sizes = [9, 1, 3, 3, 4, {0: 0, 3: 45}[degree]]
    ends = 16 + np.cumsum([size * count for size in sizes])
    assert len(raw) == ends[-1]
    parts = [np.frombuffer(raw[end - size * count : end], np.uint8) for end, size in zip(ends, sizes, strict=True)]
    triples = parts[0].reshape(count, 3, 3).astype(np.int64)
    fixed = triples @ [1, 256, 65536]
    fixed -= (fixed >= 2**23) * 2**24
    packed = parts[4].view("<u4")
    largest = packed >> 30
    turns = np.zeros((count, 4))
    for row in range(count):
        rest = int(packed[row])
        for axis in (3, 2, 1, 0):
            if axis != largest[row]:
                size = (rest & 511) / 511 / np.sqrt(2)
                turns[row, axis] = -size if rest & 512 else size
                rest >>= 10
        turns[row, largest[row]] = np.sqrt(1 - np.square(turns[row]).sum())
    base = (parts[2].reshape(count, 3) / 255 - 0.5) / 0.15
    found = corner.Found(
        fixed / 2**bits,
        corner.covariances(turns, np.exp(parts[3].reshape(count, 3) / 16 - 10)),
        0.5 + C0 * base,
        parts[1] / 255,
    )
    rest = (parts[5].reshape(count, -1, 3).astype(np.float64) - 128) / 128
    return found, np.concatenate([base[:, None], rest], axis=1), bits


def of_gsply(data) -> corner.Found:
    return corner.Found(
        np.float64(data.means),
        corner.covariances(np.roll(data.quats, -1, axis=1), np.exp(np.float64(data.scales))),
        0.5 + C0 * np.float64(data.sh0),
        1 / (1 + np.exp(-np.float64(data.opacities).reshape(-1))),
    )


def test_version_3_by_hand(tmp_path):
    state = corner.state()
    write_spz(tmp_path / "a.spz", state, corner.WORLD)
    found, _, bits = decoded((tmp_path / "a.spz").read_bytes())
    corner.assert_same(found, corner.wanted(state, corner.Y_UP, metres=True), **LIMITS)
    corner.assert_y_up(found.means)
    assert bits == 21  # the farthest coordinate is 2.35 m, so a step is half a micrometre


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("backend", ["python", "cpp"])
def test_by_gsply(tmp_path, version, backend):
    if version == 4:
        pytest.importorskip("zstandard", reason="SPZ 4 needs zstandard")
    state = corner.state()
    write_spz(tmp_path / "a.spz", state, corner.WORLD, version=version)
    gsply.use_backend(backend)
    try:
        data = gsply.read_spz(tmp_path / "a.spz")
    finally:
        gsply.use_backend("python")
    corner.assert_same(of_gsply(data), corner.wanted(state, corner.Y_UP, metres=True), **LIMITS)


def test_gloss_is_turned_with_the_axes(tmp_path):
    state = corner.state(gloss=True)
    write_spz(tmp_path / "a.spz", state, corner.WORLD)
    _, harmonics, _ = decoded((tmp_path / "a.spz").read_bytes())
    truth = corner.seen_truly(state)
    assert np.ptp(truth[: corner.GLOSSY], axis=1).max() > 0.1  # it depends on direction
    assert np.abs(corner.seen(harmonics, corner.Y_UP) - truth).max() < 0.03
    assert np.abs(corner.seen(harmonics, np.ones(3)) - truth).max() > 0.1


def test_positions_take_as_many_bits_as_fit(tmp_path):
    far = corner.state().replace(means=corner.state().means * np.float32(1000))
    write_spz(tmp_path / "a.spz", far, corner.WORLD)
    found, _, bits = decoded((tmp_path / "a.spz").read_bytes())
    truth = corner.wanted(far, corner.Y_UP, metres=True)
    assert np.abs(found.means - truth.means).max() <= 0.5 / 2**bits * 1.3
    beyond = corner.state().replace(means=corner.state().means * np.float32(1e7))
    with pytest.raises(InputError, match=r"m from the origin .*SPZ allows at most 4,194,304 m; move the origin"):
        write_spz(tmp_path / "b.spz", beyond, corner.WORLD)
    assert [path.name for path in tmp_path.iterdir()] == ["a.spz"]


def test_other_versions_are_refused(tmp_path):
    with pytest.raises(InputError, match="SPZ version 2 is not supported; use 3 or 4"):
        write_spz(tmp_path / "b.spz", corner.state(), corner.WORLD, version=2)
