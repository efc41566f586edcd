"""Selects the states that retention deletes, oldest first. The states of a chunk are deleted together."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

GoWith = Callable[[int], list[int]]
"""Function that returns a frame and all frames to delete together with it. Some may already have been deleted."""


def surplus(
    indices: Sequence[int],
    size_of: Callable[[int], int],
    newest: int,
    last: int | None,
    size_bytes: int | None,
    go_with: GoWith | None = None,
) -> list[int]:
    """Returns the indices of the states to delete, in increasing order. The first and newest states are always kept.

    Args:
        indices: indices of all states, in increasing order.
        size_of: function that returns the size of a state in bytes.
        newest: number of newest states that are always kept.
        last: number of states to keep in addition to the first, or None to keep all. A chunk is deleted once it
            contains none of these states.
        size_bytes: maximum total size in bytes, enforced by deleting whole chunks, or None for no limit.
        go_with: function that returns the states to delete together with a state, or None to delete each separately.

    >>> ten = lambda index: 10
    >>> surplus(range(8), ten, 2, None, 61)
    [1, 2]
    >>> chunk = lambda index: [1, 2, 3] if 1 <= index <= 3 else [index]
    >>> surplus(range(8), ten, 2, 5, None, chunk), surplus(range(8), ten, 2, 4, None, chunk)
    ([], [1, 2, 3])
    """
    candidates = indices[1 : len(indices) - newest]
    most = 0 if last is None else max(0, len(indices) - 1 - last)
    excess = 0 if size_bytes is None else sum(map(size_of, indices)) - size_bytes
    deleted: list[int] = []
    for group in _groups(candidates, go_with):
        if len(deleted) + len(group) > most and excess <= 0:
            break
        excess -= sum(map(size_of, group))
        deleted += group
    return sorted(deleted)


def _groups(candidates: Sequence[int], go_with: GoWith | None) -> Iterator[list[int]]:
    """Yields groups of frames that are deleted together, oldest first."""
    known, taken = set(candidates) if go_with is not None else set(), set[int]()
    for index in candidates:
        if index not in taken:
            group = [index] if go_with is None else [other for other in go_with(index) if other in known]
            taken.update(group)
            yield group
