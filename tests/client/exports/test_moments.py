"""States at times: which frame is nearest, what lies between two, and how many are in memory."""

from __future__ import annotations

import weakref

import numpy as np
import pytest
from export_cases.blob import BLOB, RATE, centre, state
from scipy.spatial.transform import Rotation

from client.exports.video.moments import interpolate, moments
from scas4d_core.gaussians import Gaussians
from scas4d_core.kernels.appearance.direction import ROWS


def spectra(of):
    return np.linalg.eigvalsh((of.factors @ np.swapaxes(of.factors, 1, 2)).astype(np.float64))


def test_what_turns_keeps_its_size_between_frames():
    a = state(0)
    turn = Rotation.from_rotvec([0.3, -0.9, 0.4])
    turned = a.rotations.copy()
    turned[:] = np.roll(turn.as_quat(), 1)
    b = a.replace(factors=np.float32(turn.as_matrix() @ a.factors), rotations=-turned)  # −q is the same turn
    for share in (0.25, 0.5):
        middle = interpolate(a, b, share)
        assert spectra(middle) == pytest.approx(spectra(a), rel=1e-3)
        half = Rotation.from_rotvec(share * turn.as_rotvec()).as_matrix() @ a.factors
        assert np.abs(middle.factors - half).max() < 0.01 * np.abs(a.factors).max()
    assert interpolate(state(0), state(1), 0.5).means[:BLOB].mean(axis=0) == pytest.approx(centre(0.5), abs=1e-3)


def test_what_comes_and_goes_fades_where_it_is():
    a = state(0).retire([0])
    b = state(2).retire([1]).concatenate(Gaussians.of_points([[0, 1, 2]], radius=0.1))
    middle = interpolate(a, b, 0.25)
    assert len(middle) == len(b)
    assert middle.opacities[[0, 1, 2, -1]] == pytest.approx(0.9 * np.array([0.25, 0.75, 1, 0.25]))
    assert middle.means[0] == pytest.approx(b.means[0])  # not on the way from where it was retired
    assert middle.means[1] == pytest.approx(a.means[1])
    both = interpolate(a, state(1).retire([0]), 0.5)
    assert both.retired[0]
    assert both.opacities[0] == 0


def test_gloss_goes_along():
    gloss, around = np.ones((3, 3), np.float32), np.zeros((ROWS, 3), np.float32)
    a = state(0).replace(gloss=gloss, environment=around)
    b = state(1).replace(gloss=3 * gloss, environment=around + 1)
    middle = interpolate(a, b, 0.5)
    assert middle.gloss == pytest.approx(2 * gloss)
    assert middle.environment == pytest.approx(around + 0.5)


def test_no_more_than_a_few_states_are_in_memory():
    alive, most = weakref.WeakSet(), 0

    def coming():
        for frame in range(12):
            made = state(frame)
            alive.add(made)
            yield frame, frame / RATE, made

    for between in (False, True):
        for _ in moments(coming(), np.arange(0, 1.2, 0.03), between=between):
            most = max(most, len(alive))
    assert most <= 3


def test_times_that_are_not_even():
    at = [(3, 1.0, state(0)), (4, 1.1, state(1)), (9, 2.0, state(2))]
    assert [moment.frame for moment in moments(at, [1.0, 1.04, 1.06, 1.54, 1.56, 2.0, 7.0])] == [3, 3, 4, 4, 9, 9, 9]
    assert [moment.frame for moment in moments(at[:1], [1.0, 3.0], between=True)] == [3, 3]
