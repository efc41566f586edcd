"""Which states retention deletes: the oldest, those of a chunk together."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import groupby

ChunkOf = Callable[[int], int | None]
"""The chunk that a frame is in, by its first frame; None for a frame with a file of its own."""


def surplus(
    indices: Sequence[int],
    size_of: Callable[[int], int],
    newest: int,
    last: int | None,
    size_bytes: int | None,
    chunk_of: ChunkOf | None = None,
) -> list[int]:
    """The states to delete, rising. The first and the newest stay whatever the rule.

    Args:
        indices: of all states, rising. size_of: bytes that each takes. newest: so many of the newest stay.
        last: states to keep besides the first; a chunk goes when it has none of them. None: all.
        size_bytes: of all together; a chunk goes when they are more. None: any. chunk_of: None: there are no chunks.

    >>> ten = lambda index: 10
    >>> surplus(range(8), ten, 2, None, 61)
    [1, 2]
    >>> one_to_three = lambda index: 1 if 1 <= index <= 3 else None
    >>> surplus(range(8), ten, 2, 5, None, one_to_three), surplus(range(8), ten, 2, 4, None, one_to_three)
    ([], [1, 2, 3])
    """
    candidates = indices[1 : len(indices) - newest]
    most = 0 if last is None else max(0, len(indices) - 1 - last)
    excess = 0 if size_bytes is None else sum(map(size_of, indices)) - size_bytes
    found: list[int] = []
    for group in _groups(candidates, chunk_of):
        if len(found) + len(group) > most and excess <= 0:
            break
        excess -= sum(map(size_of, group))
        found += group
    return found


def _groups(candidates: Sequence[int], chunk_of: ChunkOf | None) -> Iterator[list[int]]:
    """Frames that go together, the oldest first."""
    keyed = ((index, None if chunk_of is None else chunk_of(index)) for index in candidates)
    for _, pairs in groupby(keyed, lambda pair: (pair[1], pair[0] if pair[1] is None else None)):
        yield [index for index, _ in pairs]
