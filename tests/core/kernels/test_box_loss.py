"""Rows of a box that two bands compose at the same time."""

from __future__ import annotations

from typing import Any

import numpy as np

from scas4d_core.kernels.box_loss import compose_row


class Composed(np.ndarray[Any, Any]):
    """Array that another band has composed already: every write must repeat its value."""

    def __setitem__(self, place: Any, value: Any) -> None:
        assert self[place] == value


def test_a_row_that_another_band_is_reading_never_changes() -> None:
    rng = np.random.default_rng(0)
    planes, base = rng.uniform(size=(2, 1, 20, 40)).astype(np.float32)
    blocks, box = rng.integers(0, 1 << 63, 6, np.uint64), (3, 18, 5, 37)
    part = np.full((1, 15, 32), np.nan, np.float32)
    compose = compose_row.py_func  # interpreted, so that writes can be observed
    shifts = [compose(0, y, planes, base, blocks, 3, box, part) for y in range(3, 18)]
    assert (part == base[:, 3:18, 5:37]).any()
    assert (part == planes[:, 3:18, 5:37]).any()
    np.testing.assert_allclose(sum(shifts), (part - base[:, 3:18, 5:37]).sum(dtype=np.float64), rtol=1e-6)
    for y in range(3, 18):
        compose(0, y, planes, base, blocks, 3, box, part.view(Composed))
