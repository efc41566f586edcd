"""Distribution of items to tasks."""

from __future__ import annotations

import numpy as np
import pytest

from scas4d_core.kernels.balance import distribute


@pytest.mark.parametrize("tasks", [1, 2, 16])
def test_every_item_is_assigned_once_and_the_tasks_are_balanced(tasks: int) -> None:
    sizes = np.random.default_rng(0).integers(10, 90, 50)
    items, starts = distribute(sizes, tasks)
    assert sorted(items.tolist()) == list(range(50))
    assert (starts[0], starts[-1], len(starts)) == (0, 50, tasks + 1)
    totals = np.add.reduceat(sizes[items], starts[:-1])
    assert totals.max() <= 4 / 3 * max(sizes.sum() / tasks, sizes.max())


def test_tasks_without_items_are_empty() -> None:
    items, starts = distribute(np.array([3]), 3)
    assert items.tolist() == [0]
    assert starts.tolist() == [0, 1, 1, 1]
    items, starts = distribute(np.zeros(0, np.int64), 2)
    assert (len(items), starts.tolist()) == (0, [0, 0, 0])
