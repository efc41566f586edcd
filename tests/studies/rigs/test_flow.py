"""Tracks against optical flow, on pictures whose motion is known."""

import cv2
import numpy as np
import pytest

from scas4d_core.captures import open_capture
from scas4d_core.query.tracks import Tracks
from studies.rigs.flow import flow_consistency, followed

CAPTURE = open_capture("samples/robot")
FRAMES = 4


def test_points_are_followed_to_a_tenth_of_a_pixel_and_lost_where_nothing_is():
    rng = np.random.default_rng(0)
    texture = cv2.resize(rng.integers(0, 255, (24, 60)).astype(np.uint8), (240, 96), interpolation=cv2.INTER_CUBIC)
    film = [cv2.warpAffine(texture, np.float32([[1, 0, 1.5 * t], [0, 1, 0.5 * t]]), (240, 96)) for t in range(FRAMES)]
    film[-1][:, 160:] = 0
    start = np.array([[30.0, 40.0], [40.5, 50.5], [190.0, 40.0]])
    found = followed(film, start)
    true = start + np.arange(FRAMES)[:, None, None] * [1.5, 0.5]
    assert np.abs(found[:, :2] - true[:, :2]).max() < 0.1
    assert np.isnan(found[-1, 2]).all()
    assert np.isfinite(found[:-1, 2]).all()


class Known:
    """A scene that answers with the true points nearest to what it is asked for, moved by so much."""

    def __init__(self, shift):
        self.truth, self.shift = CAPTURE.ground_truth.points, shift

    def tracks_of_pixels(self, camera, uv, index, indices):
        drawn, depth = camera.project(self.truth[index])
        near = np.linalg.norm(uv[:, None] - drawn[None], axis=-1) + 0.02 * depth[None]
        chosen = self.truth[indices][:, near.argmin(axis=1)].copy()
        # on the pixel's ray, as a rendered depth would have it
        chosen += self.on_ray(camera, uv, chosen[0]) - chosen[0]
        chosen[1:] += self.shift
        count = len(uv)
        return Tracks(chosen, np.ones((len(indices), count)), np.zeros(count, np.int64), np.array(indices))

    @staticmethod
    def on_ray(camera, uv, points):
        depth = camera.project(points)[1]
        inside = np.column_stack([(uv - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(len(uv))])
        return (inside * depth[:, None] - camera.translation) @ camera.rotation


@pytest.mark.parametrize(("shift", "low", "high"), [(0.0, 0.0, 3.0), (0.2, 10.0, 60.0)])
def test_tracks_that_leave_what_moves_are_told(shift, low, high):
    row = flow_consistency(Known(np.array([shift, 0.0, 0.0])), CAPTURE, FRAMES)
    assert row["flow_points"] > 50
    assert low <= row["flow_px"] < high
    assert row["epipolar_px"] < 3.0  # of the pictures and the calibration alone
