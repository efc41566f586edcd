"""Faults of calibrations: each is what it says, the tables have a line for each, and fits are kept."""

from pathlib import Path

import numpy as np
import pytest

from scas4d_core.captures import open_capture
from studies.rigs import calibration

SAMPLE = Path(__file__).parents[3] / "samples" / "robot"
QUICK = ("scene.image_scale=0.25", "static.iterations=5", "static.max_gaussians=300")


@pytest.mark.parametrize(
    ("kind", "moved"), [("across", (3, 0)), ("down", (0, -3)), ("centre", (3, 0)), ("focal", (0, 0))]
)
def test_a_fault_moves_the_picture_of_a_camera_by_so_many_pixels(kind, moved):
    camera = open_capture(SAMPLE).rig.cameras[0]
    ahead = camera.unproject([camera.cx, camera.cy], 5.0)
    other = calibration.faulty(camera, kind, 0.03 if kind == "focal" else 3.0)
    np.testing.assert_allclose(other.project(ahead)[0] - camera.project(ahead)[0], moved, atol=0.01)
    assert other.fx / camera.fx == pytest.approx(1.03 if kind == "focal" else 1)


def test_rigs_have_the_faults_that_they_are_named_for():
    rig = open_capture(SAMPLE).rig
    changed = [
        [not np.allclose(a.world_to_camera, b.world_to_camera) for a, b in zip(rig.cameras, other.cameras, strict=True)]
        for other in (
            calibration.faulty_rig(rig, way, size) for way, size in (("right", 0.0), ("one", 2.0), ("all", 2.0))
        )
    ]
    assert [sum(each) for each in changed] == [0, 1, len(rig)]


def test_tables_have_every_fault_and_fits_are_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(calibration, "FAULTS", (("across", 4.0),))
    monkeypatch.setattr(calibration, "RIGS", (("one", 4.0),))
    lines = list[str]()
    rows = calibration.run([SAMPLE], tmp_path, changes=QUICK, report=lines.append)
    assert [row["fault"] for row in rows[:2]] == ["none", "across 4"]
    assert rows[0]["named"] == "0 of 16"
    assert int(rows[1]["named"].split()[0]) > 12
    assert rows[2]["accepted"] == "yes"
    assert rows[2]["given"] != rows[2]["refined"]
    assert "| across 4 |" in (tmp_path / "calibration.md").read_text()
    again = calibration.run([SAMPLE], tmp_path, changes=QUICK, report=lines.append)
    assert again[2]["refined"] == rows[2]["refined"]
    assert len(calibration.run([SAMPLE], tmp_path, fit=False, report=lines.append)) == 2
