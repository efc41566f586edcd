"""The study of crossings lists the files that a frame and a render run."""

from __future__ import annotations

from pathlib import Path

import pytest

from scas4d_core.captures import open_capture
from studies.service.crossing import crossed

SAMPLE = Path(__file__).parents[3] / "samples" / "robot"


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return crossed(tmp_path_factory.mktemp("crossing"), open_capture(SAMPLE))


def test_the_files_are_those_that_run(files):
    assert {"server/routes/frames.py", "scas4d_core/reconstruction.py"} <= set(files["frame"])
    assert {"server/routes/render.py", "scas4d_core/engines/cpu/rasterizer.py"} <= set(files["render"])
    assert not [name for names in files.values() for name in names if not (SAMPLE.parents[1] / name).is_file()]
