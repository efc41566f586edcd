"""`Scene`: states, tracks and parts as arrays in the user's world; the example that follows points."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from export_cases.blob import BLOB, FRAMES, RATE, STEP, WORLD, centre, state
from PIL import Image
from scipy.spatial.transform import Rotation

from client.scene import Scene
from scas4d_core.compact import CompactWriter, FileHeader
from scas4d_core.errors import InputError

ROOT = Path(__file__).parents[3]
NEAR = 0.6
"""Of the user's unit, centimetres: a compact file rounds."""


def test_states_are_in_the_users_unit(source):
    for given in (Scene.open(source), Scene.open(str(source / "states.s4d"))):
        assert given.frames == list(range(FRAMES))
        assert given.seconds == pytest.approx(np.arange(FRAMES) / RATE)
        assert given.rig.names == ("front", "side")
        found = list(given.states("1:2"))
        assert [one.frame for one in found] == [1, 2]
        for one in found:
            true = state(one.frame)
            assert np.abs(one.means - WORLD.to_user(true.means)).max() < NEAR
            wanted = 1e4 * true.factors @ np.swapaxes(true.factors, 1, 2)  # cm²
            assert np.abs(one.covariances - wanted).max() < 0.05 * wanted.max()
            assert (one.colours.shape, one.opacities.shape, one.rotations.shape) == ((293, 3), (293,), (293, 4))
            assert one.ids.tolist() == list(range(50, 343))
            assert one.moving.sum() == BLOB
            assert one.present.all()


def test_tracks_follow_what_moves_or_what_is_asked_for(source):
    with Scene.open(source, frames="1:") as given:
        tracks = given.tracks()
        assert tracks.positions.shape == (FRAMES - 1, BLOB, 3)
        assert tracks.ids.tolist() == [50, 51, 52, 53]
        assert tracks.frames.tolist() == [1, 2, 3, 4]
        assert tracks.present.all()
        gone = tracks.positions.mean(axis=1)
        assert gone[0] == pytest.approx(WORLD.to_user(centre(1)), abs=NEAR)
        assert gone[-1] - gone[0] == pytest.approx(3 * 100 * STEP, abs=NEAR)  # centimetres
        two = given.tracks(ids=[60, 51], frames="2:3")
        assert two.ids.tolist() == [60, 51]
        assert two.positions[:, 1] == pytest.approx(tracks.positions[1:3, 1])
        assert two.seconds == pytest.approx([0.2, 0.3])


def test_what_is_not_there_is_told(tmp_path):
    first = state(0)
    later = first.retire([0])
    born = later.concatenate(first.rows([1, 2]).replace(means=first.means[1:3] + np.float32(0.1)))
    born = born.replace(ids=np.concatenate([first.ids, [400, 401]]))
    with CompactWriter(tmp_path / "states.s4d", FileHeader(WORLD)) as writer:
        for frame, one in enumerate((first, later, born)):
            writer.add(frame, float(frame), one)
    with Scene.open(tmp_path) as given:
        tracks = given.tracks(ids=[50, 51, 401])
        assert tracks.present.tolist() == [[True, True, False], [False, True, False], [False, True, True]]
        assert given.rig is None
        assert (given.parts() == -1).all()
        with pytest.raises(InputError, match="the scene has no parts in these frames"):
            given.part_poses()


def test_parts_and_their_poses(source):
    given = Scene.open(source)
    labels = given.parts()
    assert labels.tolist() == [1] * BLOB + [-1] * (293 - BLOB)
    poses = given.part_poses(frames="1:")
    assert poses.parts.tolist() == [1]
    assert poses.motions.shape == (1, FRAMES - 1, 4, 4)
    assert poses.motions[0, 0] == pytest.approx(np.eye(4), abs=1e-9)
    for place, frame in enumerate(range(1, FRAMES)):
        turn = Rotation.from_matrix(poses.motions[0, place, :3, :3]).as_rotvec()
        assert turn == pytest.approx([0, 0, 0.2 * (frame - 1)], abs=0.1)
        moved = poses.motions[0, place] @ [*WORLD.to_user(centre(1)), 1]
        assert moved[:3] == pytest.approx(WORLD.to_user(centre(frame)), abs=NEAR)
    assert poses.residuals.max() < NEAR
    assert given.joints(frames="1:") == []  # the blob moves freely


def test_faults_have_remedies(source, tmp_path):
    given = Scene.open(source)
    for ask, said in (
        (lambda: given.tracks(ids=[7]), "ids: no Gaussian 7 in frame 4"),
        (lambda: next(given.states("9:")), "no frames in the range 9:; use frames 0 to 4"),
        (lambda: Scene.open(source, frames="8:"), "states has no frames in the range 8:; it contains frames 0 to 4"),
        (lambda: Scene.open(tmp_path), "contains no numbered files .*; use a .s4d file"),
        (lambda: Scene.open(tmp_path / "no.s4d"), "does not exist; use a compact file"),
    ):
        with pytest.raises(InputError, match=said):
            ask()


def test_the_page_does_what_it_says(source):
    page = (ROOT / "docs/python.md").read_text()
    (lines,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert lines.count('"out/robot"') == 1
    names: dict = {}
    exec(compile(lines.replace('"out/robot"', repr(str(source))), "python.md", "exec"), names)
    assert names["tracks"].positions.shape == (FRAMES, BLOB, 3)
    assert names["poses"].motions.shape == (1, FRAMES, 4, 4)
    assert names["poses"].residuals.shape == (1, FRAMES)


def test_the_example_leaves_a_picture(source, tmp_path):
    pytest.importorskip("matplotlib")
    command = [sys.executable, "-W", "error", str(ROOT / "docs/examples/follow_points.py"), str(source)]
    done = subprocess.run(
        [*command, "--out", str(tmp_path / "a.png"), "--count", "3"],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0, done.stderr
    assert "mm in 0.40 s" in done.stdout
    with Image.open(tmp_path / "a.png") as picture:
        assert len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)) > 50
