"""The ceiling of the updates: a later frame from scratch, beside what the updates have there."""

from pathlib import Path

import pytest

from client.cli.scores import Store
from studies.quality import refit
from studies.quality.settings import settings_of

SAMPLE = Path(__file__).parents[3] / "samples" / "robot"
QUICK = ("scene.image_scale=0.25", "static.iterations=20", "static.max_gaussians=500")


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    out = tmp_path_factory.mktemp("study")
    settings = settings_of("scas4d", None, 0, QUICK).model_dump(mode="json")
    row = {"key": "one", "capture": "robot", "preset": "scas4d", "settings": settings, "psnr_by_frame": [30.0, 12.0]}
    Store(out).put(row)
    found = [refit.run([SAMPLE], out, frame=1, changes=QUICK, report=lambda _: None) for _ in range(2)]
    return out, found


def test_a_later_frame_is_fitted_alone_and_compared(rows):
    out, (first, again) = rows
    (row,) = first
    assert row["frame"] == 1
    assert row["psnr"] > 10
    assert row["psnr_update"] == 12.0
    assert row["below"] == pytest.approx(12.0 - row["psnr"])
    assert again == first  # what is on disk is not fitted again
    assert "| robot | 1 |" in (out / "refit.md").read_text()


def test_other_settings_have_no_figure_beside(rows):
    out, _ = rows
    settings = settings_of("scas4d", None, 1, QUICK)
    assert refit._beside({"capture": "robot", "frame": 1}, settings, Store(out)) == {}


def test_a_frame_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"robot has no frame 99; use 0 to \d+"):
        refit.run([SAMPLE], tmp_path, frame=99, report=lambda _: None)
