"""What the frame log holds, which pictures may be deleted, and which are by a rule."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping

from client.wire import Retention
from scas4d_core.storage.history import NEWEST_KEPT
from server.storage.frame_store import frame_of
from server.storage.ledger import Ledger


class Held:
    """The records of the frame log: bytes by name, and their sums, which a status asks for all the time."""

    def __init__(self, sizes: Mapping[str, int]) -> None:
        self._sizes: dict[str, int] = {}
        self._records: Counter[int] = Counter()
        self.bytes = 0
        for name, size in sizes.items():
            self.add(name, size)

    @property
    def frames(self) -> list[int]:
        """Indices of frames with records, rising."""
        return sorted(self._records)

    def __len__(self) -> int:
        """How many frames have records."""
        return len(self._records)

    def add(self, name: str, size: int) -> None:
        """A record is on disk."""
        self._sizes[name] = size
        self._records[frame_of(name)] += 1
        self.bytes += size

    def discard(self, names: Iterable[str]) -> None:
        """Records are deleted."""
        for name in names:
            if (size := self._sizes.pop(name, None)) is not None:
                index = frame_of(name)
                self._records[index] -= 1
                if not self._records[index]:
                    del self._records[index]
                self.bytes -= size

    def size(self, names: Iterable[str]) -> int:
        """Bytes of these records."""
        return sum(self._sizes.get(name, 0) for name in names)


def deletable(ledger: Ledger, held: Held, rule: Retention) -> list[int]:
    """Frames whose pictures the rule deletes now, rising.

    Never those that are not finished, nor those newer than the commit that an interrupted scene may have to go back to:
    they would be needed again.

    Args:
        ledger: of the scene. held: what its frame log holds. rule: how much to keep.
    """
    if len(ledger.committed) < NEWEST_KEPT or (rule.last is None and rule.bytes is None):
        return []
    last_safe = ledger.committed[-NEWEST_KEPT]
    frames = [index for index in held.frames if index in ledger.frames]
    gone: list[int] = []
    total = held.bytes
    for place, index in enumerate(frames):
        entry = ledger.frames[index]
        surplus = rule.last is not None and len(frames) - place > rule.last
        excess = rule.bytes is not None and total > rule.bytes
        if index > last_safe or not (surplus or excess):
            break
        if not entry.finished:
            continue
        total -= held.size(entry.files)
        gone.append(index)
    return gone
