"""The study of cost against size: exponents, its processes, and that it goes on after a stop."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings
from studies.scale import scale
from studies.wall import Size, known, rig, shown, wall

TINY = Size(gaussians=400, width=32, height=24, cameras=3)


def test_exponents_are_those_of_powers() -> None:
    assert scale.slope([2, 4, 8], [5, 20, 80]) == pytest.approx(2)
    assert scale.slope([2, 4, 8], [3, 3, 3]) == pytest.approx(0)


def test_the_wall_is_the_same_picture_whatever_it_is_made_of() -> None:
    pictures = [
        next(iter(shown(wall(Size(gaussians=count)), 0, rig(Size(cameras=1))).images.values()))
        for count in (10_000, 40_000)
    ]
    assert np.abs(pictures[0].astype(int) - pictures[1]).mean() < 20


def test_the_middle_moves_as_far_as_is_asked() -> None:
    for share in (0.1, 0.5, 1.0):
        assert wall(Size(moving=share)).moving.mean() == pytest.approx(share, abs=0.02)


def test_frame_0_shows_what_was_photographed() -> None:
    """Where it did not, births mended the wall, a third of the cameras were left out, and that was measured."""
    size = Size(gaussians=2_500, width=64, height=64, cameras=5)
    state, cameras = wall(size), rig(size)
    frame = shown(state, 0, cameras)
    settings = Settings.model_validate({"scene": scale.SCENE})
    scene = Reconstruction.start(cameras, frame, settings, static=known(state, cameras))
    for camera in cameras.cameras:
        seen = 255 * np.clip(scene.render(camera).colour, 0, 1)
        assert np.square(seen - frame.images[camera.name]).mean() < 1


def test_sizes_are_measured_once_and_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scale, "SWEEPS", {"cameras": [TINY]})
    said: list[str] = []
    found = scale.run(tmp_path, ["cameras"], said.append)
    (one,) = found["cameras"]
    assert min(one.values()) > 0
    monkeypatch.setattr(scale, "in_a_process", pytest.fail)
    assert scale.run(tmp_path, ["cameras"], said.append) == found
    monkeypatch.setattr(scale, "SWEEPS", {"cameras": [TINY, Size(cameras=6)]})
    text = scale.summarize({"cameras": [{"update": 1.0, "view": 10.0, "frame_0": 2.0, "memory": 100.0}] * 2})
    assert "| 3 | 1.00 | 10 | 2.00 | 100 |" in text
    assert "| **exponent** | **0.00** |" in text
