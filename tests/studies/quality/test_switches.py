"""Streams longer than their capture, and the switches that they make."""

from pathlib import Path

import numpy as np

from scas4d_core.captures import open_capture
from studies.quality import switches

SAMPLE = Path(__file__).parents[3] / "samples" / "robot"
QUICK = ("scene.image_scale=0.25", "static.iterations=20", "static.max_gaussians=500", "update.iterations=8")


def test_a_capture_is_played_forwards_and_backwards_with_time_going_on():
    capture = open_capture(SAMPLE, image_scale=0.25)
    last = capture.frame_count - 1
    name = capture.rig.names[0]
    for index, inside in ((1, 1), (last, last), (last + 1, last - 1), (2 * last, 0), (2 * last + 1, 1)):
        frame = switches.played(capture, index)
        assert frame.index == index
        assert frame.time == index / capture.fps
        assert np.array_equal(frame.images[name], capture.frame(inside).images[name])


def test_what_is_switched_is_counted_and_kept(tmp_path):
    lines = list[str]()
    pinned = (*QUICK, 'effects={"shadows": "on"}')
    count = open_capture(SAMPLE).frame_count + 1
    rows = switches.run([SAMPLE], tmp_path, updates=count, changes=pinned, report=lines.append)
    assert [row["updates"] for row in rows] == [count]
    assert "shadows" in rows[0]["on"]
    assert "shadows" not in rows[0]["switches"]  # it is on from the start
    by_frame = rows[0]["by_frame"]
    changes = {name: int(np.abs(np.diff(np.array(on, int))).sum()) for name, on in by_frame.items()}
    assert max(changes.values()) == rows[0]["most"]
    assert all(len(on) == count + 1 for on in by_frame.values())
    assert switches.run([SAMPLE], tmp_path, updates=count, changes=pinned, report=lines.append) == rows
    assert "| robot | 0 |" in (tmp_path / "switches.md").read_text()
