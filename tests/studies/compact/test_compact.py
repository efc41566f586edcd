"""The study of compact files on the sample, a little of it."""

from __future__ import annotations

from pathlib import Path

from client.cli.reconstruct import reconstruct
from client.importers.open_source import open_source
from studies.compact.compact import back_and_forth, measure, summarize

SAMPLE = Path(__file__).parents[3] / "samples" / "robot"
CHANGES = {
    "scene": {"image_scale": 0.25},
    "static": {"iterations": 20, "max_gaussians": 500},
    "update": {"iterations": 4},
}


def test_states_go_back_and_forth() -> None:
    assert back_and_forth([3, 4, 6], 8) == [3, 4, 6, 4, 3, 4, 6, 4]
    assert back_and_forth([3], 3) == [3, 3, 3]


def test_a_compact_file_of_the_sample_is_measured(tmp_path: Path) -> None:
    reconstruct(open_source(SAMPLE), tmp_path, frames=3, preset="scas4d", changes=CHANGES)
    loose = measure(SAMPLE, tmp_path / "states", 12, {}, None)
    tight = measure(SAMPLE, tmp_path / "states", 12, {"position": 0.001, "axes": 0.001, "colour": 0.0005}, 4)
    assert loose.size < tight.size < loose.exact
    assert 0 < tight.tracks < loose.tracks < 0.1
    assert loose.psnr is not None
    assert tight.psnr is not None
    assert abs(tight.psnr) < 0.01
    assert abs(loose.psnr) < 0.5
    assert f"{loose.size / 1e3:.1f} |" in summarize(loose)
    assert loose.write > 0
    assert loose.read > 0
