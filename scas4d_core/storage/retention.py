"""Chooses the states that retention deletes: the oldest, those of a chunk together."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

GoWith = Callable[[int], list[int]]
"""The frames that a frame can only be deleted with, itself among them; some may be deleted already."""


def surplus(
    indices: Sequence[int],
    size_of: Callable[[int], int],
    newest: int,
    last: int | None,
    size_bytes: int | None,
    go_with: GoWith | None = None,
) -> list[int]:
    """The states to delete, rising. The first and the newest stay whatever the rule.

    Args:
        indices: of all states, rising. size_of: bytes that each takes. newest: so many of the newest stay.
        last: states to keep besides the first; a chunk goes when it has none of them. None: all.
        size_bytes: of all together; a chunk goes when they are more. None: any. go_with: None: each goes alone.

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
    """Frames that go together, the oldest first."""
    known, taken = set(candidates) if go_with is not None else set(), set[int]()
    for index in candidates:
        if index not in taken:
            group = [index] if go_with is None else [other for other in go_with(index) if other in known]
            taken.update(group)
            yield group
