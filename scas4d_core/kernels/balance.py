"""Distribution of items of different sizes to parallel tasks.

``prange`` gives each thread the same number of consecutive tasks. Kernels whose items differ in cost
therefore run one task per thread, which processes the items that ``distribute`` assigns to it.
"""

from __future__ import annotations

import numpy as np

from scas4d_core.kernels.jit import kernel


@kernel
def distribute(sizes, tasks):
    """Distributes items to tasks so that the total sizes of the tasks are similar.

    Items are assigned in order of decreasing size, each to the task with the smallest total so far
    (Graham 1969). The result of a task must not depend on the order of its items.

    Args:
        sizes: [n] int64 sizes.
        tasks: number of tasks.

    Returns:
        Items, grouped by task [n] int64, and the start of each task's items [tasks + 1] int64.
    """
    descending = np.argsort(-sizes, kind="mergesort")
    totals, starts = np.zeros(tasks, np.int64), np.zeros(tasks + 1, np.int64)
    task_of = np.empty(len(sizes), np.int64)
    for item in descending:
        task = np.argmin(totals)
        totals[task] += sizes[item]
        task_of[item] = task
        starts[task + 1] += 1
    for task in range(tasks):
        starts[task + 1] += starts[task]
    places, items = starts[:-1].copy(), np.empty(len(sizes), np.int64)
    for item in descending:
        items[places[task_of[item]]] = item
        places[task_of[item]] += 1
    return items, starts
