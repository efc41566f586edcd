"""The study of false alarms and planted faults, on the sample."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scas4d_core.captures import open_capture
from studies.hard_frames import alarms
from studies.hard_frames.alarms import FAULTS, Fault, first_faulty, page, run

SAMPLE = Path(__file__).parents[3] / "samples" / "robot"


def test_a_swapped_camera_of_the_sample_is_found_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    changes = ["scene.image_scale=0.5", "static.iterations=150", "update.iterations=40"]
    given = {"variants": ["as it is"], "frames": 2, "changes": changes}
    said: list[str] = []
    (row,) = run([SAMPLE], tmp_path, faults=["swapped"], report=said.append, **given)  # type: ignore[arg-type]
    count = len(row["clean"])
    assert count == first_faulty(open_capture(SAMPLE))
    (fault,) = row["faults"]
    assert fault["by"] == 1
    assert not any(frame["alarms"] or frame["excluded"] or frame["rejected"] for frame in row["clean"])
    assert f"| all | – | {count * row['cameras']} | 0 | 0 | 0 |" in said[-1]
    assert "| swapped | with its neighbour | 1 | 1 | 1 |" in said[-1]
    monkeypatch.setattr(alarms, "_row", pytest.fail)  # a second call reads what is stored
    assert run([SAMPLE], tmp_path, faults=["swapped"], report=said.append, **given) == [row]  # type: ignore[arg-type]


def test_the_page_counts_misses_and_alarms_of_other_cameras() -> None:
    alarm = {"kind": "camera_misfit", "camera": "3", "evidence": "its image fits worse"}
    clean = [{"index": 1, "rejected": True, "excluded": ["3"], "alarms": [alarm, {**alarm, "camera": None}]}]
    found = {"kind": "late", "strength": "1 frame", "camera": "3", "kinds": [], "rejected": 0}
    faults = [{**found, "by": None, "others": ["4 5 light: x"]}, {**found, "by": 3, "others": []}]
    text = page([{"capture": "room", "variant": "later", "seed": 0, "cameras": 9, "clean": clean, "faults": faults}])
    assert "| room | later | 9 | 1 | 1 | 1 |" in text
    assert "| late | 1 frame | 2 | 0 | 1 | 1 |" in text


@pytest.mark.parametrize("fault", FAULTS, ids=[f"{fault.kind} {fault.strength}" for fault in FAULTS])
def test_a_planted_fault_changes_the_image_and_keeps_its_format(fault: Fault) -> None:
    capture = open_capture(SAMPLE)
    index, name = first_faulty(capture), capture.full_rig.names[3]
    image, mask = fault.plant(capture, index, name)
    true = capture.frame(index)
    assert image.dtype == np.uint8
    assert image.shape == true.images[name].shape
    assert (image != true.images[name]).any()
    assert mask is not None
    assert mask.shape == true.masks[name].shape
    assert (mask != true.masks[name]).any() == (fault.kind in ("moved", "late", "frozen", "swapped"))


def test_unknown_variants_and_faults_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="unknown variant 'sideways'; choose from as it is, backwards"):
        run([SAMPLE], tmp_path, variants=["sideways"])
    with pytest.raises(ValueError, match="no fault contains 'stolen'; choose from moved, out of focus"):
        run([SAMPLE], tmp_path, faults=["stolen"])
