"""`scas4d reconstruct` on a tiny capture: what it leaves, and that it can be run again."""

from __future__ import annotations

from client.cli.reconstruct import reconstruct
from scas4d_core.query.ply import read_ply
from scas4d_core.storage.history import History

CHANGES = ["static.iterations=2", "update.iterations=2"]


def test_it_leaves_pictures_states_and_a_ply_each_time_it_is_run(capture_folder, tmp_path):
    for frames in (3, 2):
        reconstruct(capture_folder, tmp_path, frames=frames, preset="scas4d", changes=CHANGES)
        history = History.load(tmp_path / "states")
        assert history.indices == list(range(frames))  # of this run alone
        assert len(read_ply(tmp_path / "last.ply")) == len(history.gaussians(0))
    assert [path.name for path in sorted((tmp_path / "camera_2").iterdir())] == [f"{t:06d}.png" for t in range(3)]
