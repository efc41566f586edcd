"""Made-up footage for the time of an update against the share of pixels that move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scas4d_core.settings import Settings
from studies.kernels import moving
from studies.synthetic.wall import Size


@pytest.mark.parametrize("share", [0.05, 0.2, 1.0])
def test_so_many_of_the_pixels_show_something_that_moves(share: float) -> None:
    size = replace(moving.SIZE, moving=share)
    state, cameras = moving.wall(size), moving.rig(size)
    found = np.mean([mask.mean() for mask in moving.shown(state, 0, cameras).masks.values()])
    assert found == pytest.approx(share, rel=0.25)


def test_the_variants_are_updated_and_met(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(moving, "SIZE", size := Size(gaussians=900, width=32, height=32, cameras=3))
    settings = Settings.model_validate(
        {"scene": {"metres_per_unit": 1.0}, "update": {"iterations": 5, "clusters": (2, 12)}}
    )
    results = moving.measure((0.2, 1.0), 2, settings)
    assert [one.moving for one in results] == [
        int(moving.wall(replace(size, moving=share)).moving.sum()) for share in (0.2, 1.0)
    ]
    assert all(one.psnr > 20 for one in results)
    assert moving.table(results).splitlines()[-1].count("|") == 6
