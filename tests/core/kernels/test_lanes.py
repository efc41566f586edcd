"""Sixteen numbers at once: each function against numpy, and the covers of tiles against a search of all pixels."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scas4d_core.kernels import lanes, tiles
from scas4d_core.kernels.jit import kernel
from scas4d_core.kernels.projection import (
    LOWEST_X,
    MEAN_X,
    MEAN_Y,
    REACH,
    SLOPE,
    SPLAT_COLUMNS,
    SPREAD,
    THIN,
    TILE,
)

COUNT = lanes.COUNT


@kernel
def powers_and_logarithms(x, out):
    for k in range(0, x.size, lanes.COUNT):
        lanes.store(out, k, lanes.exp2(lanes.load(x, k)))
        lanes.store(out, x.size + k, lanes.log2(lanes.exp2(lanes.load(x, k))))


def test_powers_and_logarithms_of_two():
    x = np.linspace(-125, 125, 16 * 4096).astype(np.float32)
    out = np.zeros((2, x.size), np.float32)
    powers_and_logarithms(x, out)
    np.testing.assert_allclose(out[0], np.exp2(x.astype(np.float64)), rtol=3e-7)
    expected = np.log2(out[0].astype(np.float64))
    np.testing.assert_allclose(out[1], expected, rtol=2e-7, atol=2e-7)


@kernel
def exponentials(x, out):
    for k in range(0, x.size, lanes.COUNT):
        lanes.store(out, k, lanes.exp(-lanes.load(x, k)))


def test_exponentials_are_clamped_and_keep_what_is_no_number():
    x = np.linspace(-86, 86, 16 * 1024).astype(np.float32)
    out = np.zeros_like(x)
    exponentials(x, out)
    # The exponent's own rounding, of up to 124, is 4e-6 of the result.
    np.testing.assert_allclose(out, np.exp(-x.astype(np.float64)), rtol=8e-6)
    near = np.abs(x) < 1
    np.testing.assert_allclose(out[near], np.exp(-x[near].astype(np.float64)), rtol=3e-7)
    exponentials(np.repeat(np.float32([np.nan, 1e9, -np.inf, 0]), 4), out[:16])
    out = out[:16]
    assert np.isnan(out[:4]).all()
    assert (out[4:8] > 0).all()
    assert np.isfinite(out[4:]).all()


@kernel
def picks(array, rows, out):
    lanes.scatter_column(out, rows, 16, 2, 1, lanes.gather_column(array, rows, 16, 3, 2))


def test_columns_of_named_rows():
    rng = np.random.default_rng(1)
    array, rows = rng.normal(size=(50, 3)).astype(np.float32), rng.permutation(50)[:32].reshape(2, 16)
    out = np.zeros((50, 2), np.float32)
    picks(array, rows, out)
    expected = np.zeros_like(out)
    expected[rows[1], 1] = array[rows[1], 2]
    np.testing.assert_array_equal(out, expected)


@kernel
def whole_rows(array, rows, sums, out):
    taken = lanes.gather_rows(array, rows, 0)
    for k in range(16):
        lanes.store(out, 16 * k, taken[k])
    columns = lanes.transposed(taken)
    lanes.add_halves(
        sums, rows, 0, (columns[0], columns[1], columns[2], columns[3], columns[4], columns[5], columns[6], columns[7])
    )


def test_whole_rows_and_sums_of_rows_named_twice():
    rng = np.random.default_rng(2)
    array, rows = rng.normal(size=(20, 16)).astype(np.float32), rng.integers(0, 12, 16)
    sums, out = np.ones((20, 8), np.float32), np.zeros((16, 16), np.float32)
    whole_rows(array, rows, sums, out)
    np.testing.assert_array_equal(out, array[rows])
    expected = np.ones((20, 8))
    np.add.at(expected, rows, array[rows, :8].astype(np.float64))
    np.testing.assert_allclose(sums, expected, rtol=1e-5, atol=1e-6)


@kernel
def beginnings(x, out):
    for count in range(20):
        some = lanes.load_first(x, 0, count)
        lanes.store_first(out, 48 * count, count, some)
        lanes.store(out, 48 * count + 16, some)
        lanes.store(out, 48 * count + 32, lanes.only_first(lanes.load(x, 0), count))


def test_beginnings_of_rows():
    x = np.arange(1, 17, dtype=np.float32)
    out = np.full((20, 3, 16), -1, np.float32)
    beginnings(x, out)
    for count in range(20):
        np.testing.assert_array_equal(out[count, 0], np.where(np.arange(16) < count, x, -1))
        np.testing.assert_array_equal(out[count, 1:], np.where(np.arange(16) < count, x, 0) * np.ones((2, 1)))


@kernel
def arithmetic(x, y, factor, out):
    a, b = lanes.load(x, 0), lanes.load(y, 0)
    lanes.store(out, 0, (a + b) * factor - a / b)
    lanes.store(out, 16, lanes.choose((a < b) & (b >= factor), lanes.minimum(a, b), lanes.maximum(a, b)))
    lanes.store(out, 32, lanes.square_root(lanes.magnitude(a)) + lanes.floor(a) + lanes.nearest(b))
    return lanes.any_of(a > b), lanes.any_of(a > lanes.fill(np.float32(99)))


def test_arithmetic_goes_lane_by_lane():
    rng = np.random.default_rng(0)
    a, b = rng.normal(0, 3, (2, COUNT)).astype(np.float32)
    out = np.zeros((3, COUNT), np.float32)
    assert arithmetic(a, b, np.float32(0.7), out) == (True, False)
    np.testing.assert_allclose(out[0], (a + b) * np.float32(0.7) - a / b, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(out[1], np.where((a < b) & (b >= 0.7), np.minimum(a, b), np.maximum(a, b)))
    np.testing.assert_allclose(out[2], np.sqrt(np.abs(a)) + np.floor(a) + np.round(b), rtol=1e-6, atol=1e-6)


@kernel
def moves(x, sums, columns, back):
    a, b, c = lanes.load(x, 0), lanes.load(x, 16), lanes.load(x, 32)
    lanes.store(sums, 0, lanes.sums_of((a, b, c, a, b)))
    sums[16] = lanes.sum_of(b)
    rows = lanes.transposed((a, b, c, a, b, c, a, b, c, a, b, c, a, b, c, c))
    for k in range(16):
        lanes.store(columns, 16 * k, rows[k])
    lanes.scatter(back, 2, 3, lanes.gather(x, 1, 3))


def test_sums_transposes_and_strides():
    x = np.random.default_rng(1).normal(size=(3, COUNT)).astype(np.float32)
    sums, columns, back = (np.zeros(shape, np.float32) for shape in (17, (16, 16), 48))
    moves(x, sums, columns, back)
    totals = x.sum(axis=1)
    np.testing.assert_allclose(sums[:5], totals[[0, 1, 2, 0, 1]], atol=1e-5)
    np.testing.assert_array_equal(sums[5:16], 0)
    assert sums[16] == pytest.approx(totals[1], abs=1e-5)
    np.testing.assert_array_equal(columns, x[[0, 1, 2] * 5 + [2]].T)
    np.testing.assert_array_equal(back[2::3], x.ravel()[1::3])
    np.testing.assert_array_equal(np.delete(back, np.s_[2::3]), 0)


@kernel
def cover(splat, tile_x, tile_y):
    return tiles.cover(splat, tile_x, tile_y)


def splat_of(mean: np.ndarray, covariance: np.ndarray, reach: float) -> np.ndarray:
    (sxx, sxy), (_, syy) = covariance
    splat = np.zeros(SPLAT_COLUMNS, np.float32)
    splat[[MEAN_X, MEAN_Y]] = mean
    splat[[REACH, SLOPE, THIN]] = reach, sxy / sxx, 1 / sxx
    splat[SPREAD] = np.linalg.det(covariance) / sxx
    splat[LOWEST_X] = sxy * np.sqrt(reach / syy)
    return splat


@pytest.mark.parametrize("lengths", [(0.6, 0.6), (3.0, 1.0), (20.0, 0.6), (200.0, 0.6), (30.0, 20.0)])
def test_a_cover_is_the_blocks_that_the_support_meets(lengths):
    rng = np.random.default_rng(2)
    found = 0
    for _ in range(200):
        turn = Rotation.from_rotvec([0, 0, rng.uniform(0, np.pi)]).as_matrix()[:2, :2] * lengths
        mean, reach = rng.uniform(-0.3 * TILE, 1.3 * TILE, 2), rng.uniform(0.01, 11)
        covariance = turn @ turn.T
        bits = int(cover(splat_of(mean + TILE * np.array([2, 3]), covariance, reach), 2, 3))
        met = np.array([[bits >> (8 * x + y) & 1 for x in range(8)] for y in range(8)], bool)
        inverse = np.linalg.inv(covariance)
        # Rows at pixel centres; columns as finely as wanted between the outer centres of a block.
        y = np.arange(TILE) + 0.5 - mean[1]
        fine = (0.5 + np.linspace(0, 3, 61) + 4 * np.arange(8)[:, None]) - mean[0]
        dx, dy = np.broadcast_arrays(fine, y[:, None, None])
        form = inverse[0, 0] * dx**2 + 2 * inverse[0, 1] * dx * dy + inverse[1, 1] * dy**2
        nearest = form.reshape(8, 4, 8, 61).min(axis=(1, 3))
        pixels = form[..., ::20].reshape(8, 4, 8, 4).min(axis=(1, 3))
        assert met[pixels <= reach].all()
        # Sampling a needle misses its middle by half a step.
        assert not met[nearest > 1.01 * reach + 0.01 + 0.05 * inverse[0, 0]].any()
        found += int(met.sum())
    assert found > 0
