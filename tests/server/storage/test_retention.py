"""Which images a retention rule deletes: by number, by size and by age, never those that may be needed again."""

from __future__ import annotations

import os
from dataclasses import dataclass
from unittest.mock import Mock

import pytest

from client.wire import FrameState, Retention
from server.storage import ledger as ledger_module
from server.storage.events import FrameAccepted
from server.storage.frame_store import FrameLogIndex, list_records
from server.storage.ledger import Ledger, SceneLog

COUNT, SIZE = 8, 10
DAY = 24 * 3600.0


@dataclass
class Take:
    """A scene of eight committed frames, one a day, and one that is still queued."""

    log: SceneLog

    def deletable(self, now=0.0, **rule):
        return self.log.deletable(Retention(**rule), now)


@pytest.fixture
def take(tmp_path):
    ledger = Ledger("a")
    for index in range(COUNT + 1):
        name = f"{index:010d}-{index:012x}.frame"
        (tmp_path / name).write_bytes(bytes(SIZE))
        os.utime(tmp_path / name, (index * DAY, index * DAY))
        ledger.apply(FrameAccepted(index=index, time=float(index), identity=f"{index:064x}", files=(name,)))
        if index < COUNT:
            ledger.set_state(index, FrameState.COMMITTED)
    return Take(SceneLog(ledger, Mock(), FrameLogIndex(tmp_path, list_records(tmp_path)), Mock()))


def test_without_a_rule_everything_stays(take):
    assert take.deletable(now=1000 * DAY) == []


def test_by_age(take):
    assert take.deletable(now=10.5 * DAY, seconds=8 * DAY) == [0, 1, 2]
    assert take.deletable(now=2 * DAY, seconds=8 * DAY) == []


def test_the_stricter_of_two_rules_decides(take):
    assert take.deletable(now=10.5 * DAY, seconds=8 * DAY, last=COUNT) == [0, 1, 2]
    assert take.deletable(now=10.5 * DAY, seconds=8 * DAY, last=4) == [0, 1, 2, 3, 4]
    assert take.deletable(now=10.5 * DAY, seconds=8 * DAY, bytes=5 * SIZE) == [0, 1, 2, 3]


def test_what_may_be_needed_again_stays(take):
    assert take.deletable(now=1000 * DAY, seconds=DAY) == [*range(COUNT - 1)]


def test_few_are_deleted_at_once_and_none_is_skipped(take, monkeypatch):
    monkeypatch.setattr(ledger_module, "MOST_DELETED", 3)
    gone = []
    while some := take.deletable(last=0):
        assert len(some) <= 3
        gone += some
        take.log.pictures.discard([name for index in some for name in take.log.ledger.frames[index].files])
    assert gone == [*range(COUNT - 1)]
    assert take.log.pictures.frames == [COUNT - 1, COUNT]
    assert take.log.pictures.bytes == 2 * SIZE


def test_records_that_arrive_out_of_order_are_listed_in_order(tmp_path):
    index = FrameLogIndex(tmp_path, {})
    for frame, part in ((5, 0), (3, 0), (5, 1), (4, 0)):
        index.add(f"{frame:010d}-{part:012x}.frame", SIZE)
    assert index.frames == [3, 4, 5]
    index.discard([f"{5:010d}-{0:012x}.frame"])
    assert (index.frames, len(index)) == ([3, 4, 5], 3)
    index.discard([f"{5:010d}-{1:012x}.frame"])
    assert index.frames == [3, 4]
