"""The study of the viewer's drawing makes scenes of any number of Gaussians, which move like the recorded ones."""

from __future__ import annotations

import browser_engine
import numpy as np
from export_cases import bent

from scas4d_core.compact import CompactReader
from studies.live.drawing import with_count


def test_added_gaussians_stay_beside_those_that_they_copy(tmp_path):
    source = bent.write(tmp_path / "bent.s4d", browser_engine.make_rig())
    target = tmp_path / "more.s4d"
    with_count(source, target, 3 * bent.BORN)
    with CompactReader(source) as old, CompactReader(target) as new:
        assert new.frames == old.frames
        for index in old.frames:
            few, many = old.state(index), new.state(index)
            assert len(many) == 3 * bent.BORN
            sizes = np.linalg.norm(few.factors[: bent.BORN], axis=(1, 2))
            away = np.linalg.norm(many.means.reshape(3, bent.BORN, 3) - few.means[: bent.BORN], axis=-1)
            assert (away[0] < 0.1 * sizes).all()
            assert (away[1:] < 4 * sizes).all()
            assert np.median(away[1:] / sizes) > 0.2
            np.testing.assert_array_equal(many.retired.reshape(3, -1), [few.retired[: bent.BORN]] * 3)
