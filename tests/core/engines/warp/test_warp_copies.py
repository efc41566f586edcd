"""Device copies of host arrays: uploaded once, never out of date, bounded."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("warp", reason="NVIDIA Warp is not installed: pip install warp-lang")

import warp as wp
from warp_cases import DEVICE, Uploads

from scas4d_core.engines.warp.copies import MISSING, MOST, DeviceCopies, features_on, upload
from scas4d_core.gaussians import Gaussians


@pytest.fixture
def copies() -> DeviceCopies:
    return DeviceCopies(DEVICE)


def points(value: float = 1) -> np.ndarray:
    return np.full((4, 3), value, np.float32)


def test_an_array_is_uploaded_once_and_becomes_read_only(copies: DeviceCopies) -> None:
    array = points()
    copy = copies.of(array, wp.vec3)
    assert copies.of(array, wp.vec3) is copy
    assert np.array_equal(copy.numpy(), array)
    with pytest.raises(ValueError, match="read-only"):
        array[0] = 2


def test_a_view_that_may_change_is_uploaded_when_it_does(copies: DeviceCopies, monkeypatch: pytest.MonkeyPatch) -> None:
    array = points()
    copies.of(array[1:], wp.vec3)
    uploads = Uploads(monkeypatch)
    assert (copies.of(array[1:], wp.vec3).numpy() == 1).all()
    assert not uploads.bytes
    array[1:] = 2
    assert (copies.of(array[1:], wp.vec3).numpy() == 2).all()


def test_equal_arrays_are_not_confused_when_one_is_freed(copies: DeviceCopies) -> None:
    for value in range(3 * MOST):  # memory of arrays, and with it their ids, is used again
        assert (copies.of(points(value), wp.vec3).numpy() == value).all()


def test_the_copies_used_last_are_kept(copies: DeviceCopies) -> None:
    first, second = points(), points()
    kept, dropped = copies.of(first, wp.vec3), copies.of(second, wp.vec3)
    for value in range(MOST - 1):
        copies.of(points(value), wp.vec3)
        assert copies.of(first, wp.vec3) is kept
    assert copies.of(second, wp.vec3) is not dropped


def test_features_follow_colours_and_labels(copies: DeviceCopies) -> None:
    state = Gaussians.of_points(points(), radius=0.1, colours=[1, 0.5, 0])
    features = features_on(copies, state)
    assert np.array_equal(features.numpy(), state.features(state.colours))
    assert features_on(copies, state.replace(means=state.means + 1)) is features
    other = state.replace(foreground=np.zeros(4, np.float32))
    assert (features_on(copies, other).numpy()[:, 3] == 0).all()


def test_an_array_computed_on_the_device_is_a_copy(copies: DeviceCopies) -> None:
    host, device = points(), wp.array(points(), dtype=wp.vec3, device=DEVICE)
    copies.store(device, host)
    assert copies.of(host, wp.vec3) is device


def test_only_rows_that_were_added_are_uploaded(copies: DeviceCopies, monkeypatch: pytest.MonkeyPatch) -> None:
    before, born = np.arange(30, dtype=np.float32).reshape(10, 3), points()
    after, changed = np.concatenate([before, born]), before + (np.arange(10) == 0)[:, None].astype(np.float32)
    copies.of(before, wp.vec3)
    uploads = Uploads(monkeypatch)
    for array, size in ((after, born.nbytes), (before[:7].copy(), 0), (after.copy(), 0), (changed, changed.nbytes)):
        uploads.bytes.clear()
        assert np.array_equal(copies.of(array, wp.vec3).numpy(), array)
        assert sum(uploads.bytes.values()) == size


@pytest.mark.parametrize(("largest", "size"), [(MISSING - 1, 2), (MISSING, 4), (10**6, 4)])
def test_indices_that_fit_are_uploaded_in_two_bytes(largest: int, size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    indices, uploads = np.array([[0, -1, 5], [largest, 7, -1]]), Uploads(monkeypatch)
    assert np.array_equal(upload(indices, wp.int32, DEVICE).numpy(), indices)
    assert sum(uploads.bytes.values()) == size * indices.size
