"""Which frames' pictures may be deleted, and which are by a rule."""

from __future__ import annotations

from client.wire import Retention
from scas4d_core.history import NEWEST_KEPT
from server.ledger import Ledger


def deletable(ledger: Ledger, sizes: dict[str, int], rule: Retention) -> list[int]:
    """Frames whose pictures the rule deletes now, rising.

    Never those that are not finished, nor those newer than the commit that an interrupted scene may have to go back to:
    they would be needed again.

    Args:
        ledger: of the scene. sizes: bytes of the records in the frame log. rule: how much to keep.
    """
    if len(ledger.committed) < NEWEST_KEPT or (rule.last is None and rule.bytes is None):
        return []
    last_safe = ledger.committed[-NEWEST_KEPT]
    held = [index for index in sorted({int(name.partition("-")[0]) for name in sizes}) if index in ledger.frames]
    gone: list[int] = []
    total = sum(sizes.values())
    for place, index in enumerate(held):
        entry = ledger.frames[index]
        surplus = rule.last is not None and len(held) - place > rule.last
        excess = rule.bytes is not None and total > rule.bytes
        if index > last_safe or not (surplus or excess):
            break
        if not entry.finished:
            continue
        total -= sum(sizes.get(name, 0) for name in entry.files)
        gone.append(index)
    return gone
