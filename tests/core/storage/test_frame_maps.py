"""Ordered mappings from frames to numbers behave like sorted dictionaries."""

from __future__ import annotations

import numpy as np
import pytest

from scas4d_core.storage.frame_maps import FrameStamps, FrameTimes


def test_it_behaves_like_a_sorted_dictionary():
    rng = np.random.default_rng(0)
    found, expected = FrameStamps(), {}
    for _ in range(400):
        index = rng.integers(40)  # a NumPy integer
        if rng.random() < 0.4:
            assert found.pop(index, None) == expected.pop(int(index), None)
        else:
            stamp = int(rng.integers(1 << 40)), -int(rng.integers(1 << 62))
            found[index] = expected[int(index)] = stamp
        assert dict(found) == dict(sorted(expected.items()))
        assert list(reversed(found)) == sorted(expected)[::-1]
        assert [index in found for index in range(40)] == [index in expected for index in range(40)]


def test_missing_frames():
    times = FrameTimes()
    assert (list(times), times.get(1), 1 in times, "1" in times) == ([], None, False, False)
    with pytest.raises(KeyError):
        times[1]
    with pytest.raises(KeyError):
        del times[1]
