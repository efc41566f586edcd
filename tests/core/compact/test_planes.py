"""Planes of integers: every value comes back, small ones take little, and bytes that are no plane are refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scas4d_core.compact.planes import MOST, NARROW, WIDE, PlaneError, compress, decompress, pack, unpack


@given(st.lists(st.integers(-MOST + 1, MOST - 1), max_size=50), st.sampled_from([1, 3, 100, 70_000, MOST]))
def test_every_plane_comes_back(values: list[int], most: int) -> None:
    plane = np.array([value % most for value in values] + [-(value % most) for value in values], np.int64)
    data = b"before" + pack(plane) + b"after"
    found, end = unpack(data, len(plane), 6)
    assert found.tolist() == plane.tolist()
    assert data[end:] == b"after"


@pytest.mark.parametrize(("spread", "mode"), [(0.2, 2), (0.6, 4), (4, 8), (5000, WIDE)])
def test_the_packing_goes_by_the_spread(spread: float, mode: int) -> None:
    plane = np.rint(np.random.default_rng(0).normal(0, spread, 40_000)).astype(np.int64)
    data = pack(plane)
    assert data[0] == mode
    shares = np.unique(plane, return_counts=True)[1] / len(plane)
    entropy = -float(shares @ np.log2(shares)) * len(plane) / 8
    least = len(plane) * min(mode, 8) / 64  # of Huffman codes: a bit for each byte
    assert len(data) < 1.25 * max(entropy, least) + 200


def test_a_plane_of_zeros_takes_a_head_alone() -> None:
    assert len(pack(np.zeros(10_000, np.int64))) == 9


@pytest.mark.parametrize("values", [[MOST], [-MOST], [0, 2**40]])
def test_values_that_are_too_large_are_refused(values: list[int]) -> None:
    with pytest.raises(OverflowError, match="below"):
        pack(np.array(values))


@pytest.mark.parametrize("bits", [*NARROW, WIDE])
def test_another_number_of_values_is_refused(bits: int) -> None:
    plane = np.rint(np.random.default_rng(1).normal(0, {2: 0.2, 4: 2, 8: 30, WIDE: 5000}[bits], 800)).astype(np.int64)
    data = pack(plane)
    assert data[0] == bits
    with pytest.raises(PlaneError):
        unpack(data, 8000)
    with pytest.raises(PlaneError):
        unpack(data[:-1], 800)
    with pytest.raises(PlaneError):
        unpack(data[:5], 800)
    with pytest.raises(PlaneError):
        unpack(bytes([7]) + data[1:], 800)


def test_nothing_larger_than_told_is_unpacked() -> None:
    bomb = compress(bytes(50_000_000))
    assert len(bomb) < 10_000
    with pytest.raises(PlaneError, match="expected 100 bytes after decompression, got 50000000"):
        decompress(bomb, 100)
    with pytest.raises(PlaneError, match="not a zstandard frame"):
        decompress(b"nothing", 100)
