from __future__ import annotations

import asyncio
import errno
import io
import os

import numpy as np
import pytest
from blake3 import blake3

from client.wire import FrameFile, FrameHead
from server.problems import Problem
from server.storage import record_log
from server.storage.events import FrameAccepted, FrameMissing, PauseChanged
from server.storage.frame_store import FrameDamage, Upload, list_records, read_pictures
from server.storage.journal import Journal
from server.storage.record_log import Damage, LogRecord, LogRecordKind, encode_record
from tests.helpers.journals import read_journal, read_records

PARTS = [
    encode_record(
        LogRecordKind.EVENT, index, {"type": "frame_missing", "index": index, "reason": "é" * index}, b"S4DR" * index
    )
    for index in range(4)
]
LOG = b"".join(PARTS)
STARTS = [sum(map(len, PARTS[:index])) for index in range(5)]


def whole(data):
    return [found.index for found in read_records(data) if isinstance(found, LogRecord)]


def covered(data):
    """Damage and records lie one behind the other, and nothing is left out."""
    at = 0
    for found in read_records(data):
        if isinstance(found, Damage):
            assert found.start == at
            at = found.end
        else:
            at = STARTS[found.index + 1] - STARTS[found.index] + at
    assert at == len(data)


def test_a_whole_log_comes_back():
    assert [(found.index, found.head["reason"], bytes(found.body)) for found in read_records(LOG)] == [
        (index, "é" * index, b"S4DR" * index) for index in range(4)
    ]


def test_a_cut_at_every_byte_loses_only_what_it_cuts():
    for length in range(len(LOG)):
        found = list(read_records(LOG[:length]))
        expected = [index for index in range(4) if STARTS[index + 1] <= length]
        assert whole(LOG[:length]) == expected
        if length in STARTS:
            assert len(found) == len(expected)
        else:
            assert isinstance(found[-1], Damage)
            assert found[-1].torn
            assert found[-1].start == STARTS[len(expected)]
            assert found[-1].reason


def test_a_flipped_bit_at_every_byte_loses_only_the_record_that_it_is_in():
    for at in range(len(LOG)):
        damaged = bytearray(LOG)
        damaged[at] ^= 1 << (at % 8)
        hit = max(index for index in range(4) if STARTS[index] <= at)
        assert whole(bytes(damaged)) == [index for index in range(4) if index != hit]
        covered(bytes(damaged))


def test_rubbish_between_records_is_stepped_over():
    rng = np.random.default_rng(0)
    for _ in range(50):
        rubbish = rng.integers(0, 256, rng.integers(1, 200), dtype=np.uint8).tobytes() + b"S4DR"
        assert whole(PARTS[0] + rubbish + PARTS[1] + rubbish) == [0, 1]


def test_a_length_that_was_made_up_reads_no_further_than_the_file():
    big = encode_record(LogRecordKind.PICTURES, 5, {}, b"x" * 100)
    assert [type(found) for found in read_records(big[:-50])] == [Damage]


FACTS = [
    FrameAccepted(index=0, time=0.5, identity="ab" * 32, files=("f",)),
    PauseChanged(paused=True),
    FrameMissing(index=1, reason="lost"),
]


def write_journal(path, *events, good=0):
    async def write():
        journal = Journal(path, good)
        await asyncio.gather(*(journal.append(event) for event in events))
        await journal.close()

    asyncio.run(write())


def test_a_journal_comes_back_and_goes_on(tmp_path):
    path = tmp_path / "journal.log"
    write_journal(path, *FACTS)
    read = read_journal(path)
    assert (read.events, read.good, read.damage) == (FACTS, path.stat().st_size, [])
    write_journal(path, FACTS[1], good=read.good)
    assert read_journal(path).events == [*FACTS, FACTS[1]]


@pytest.mark.slow
def test_a_journal_cut_at_every_byte_starts_and_says_what_it_dropped(tmp_path):
    path = tmp_path / "journal.log"
    write_journal(path, *FACTS)
    data = path.read_bytes()
    ends = []
    for length in range(len(data)):
        path.write_bytes(data[:length])
        read = read_journal(path)
        assert read.events == FACTS[: len(read.events)]
        assert bool(read.damage) == (read.good != length)
        ends.append(len(read.events))
        write_journal(path, FrameMissing(index=9, reason=""), good=read.good)
        again = read_journal(path)
        assert again.events == [*FACTS[: len(read.events)], FrameMissing(index=9, reason="")]
        assert again.damage == []
    assert sorted(set(ends)) == [0, 1, 2]


def test_a_log_that_is_read_piece_by_piece_says_the_same(monkeypatch):
    """Wherever a piece ends: of a log that is whole, cut, damaged by flipped bits, or has rubbish in it."""
    rng = np.random.default_rng(0)
    events = [
        encode_record(LogRecordKind.EVENT, index, {"type": "frame_missing", "index": index, "reason": "é" * index})
        for index in range(9)
    ]
    log = b"".join(events)
    logs = [log, log[:-1], log[: len(log) // 2], b"", b"S4DR", events[0] + b"S4DR" * 40 + events[1], bytes(300) + log]
    for at in rng.integers(0, len(log), 40):
        damaged = bytearray(log)
        damaged[at] ^= 1 << int(rng.integers(8))
        logs.append(bytes(damaged))
    monkeypatch.setattr(record_log, "DECIDABLE_BYTES", 400)
    for piece in (1, 7, 64, 10_000):
        monkeypatch.setattr(record_log, "PIECE", piece)
        for data in logs:
            told = [one if isinstance(one, Damage) else (one.index, one.head)
                    for one in record_log.stream_records(io.BytesIO(data))]  # fmt: skip
            assert told == [one if isinstance(one, Damage) else (one.index, one.head) for one in read_records(data)]


def test_a_full_disk_leaves_the_journal_whole(tmp_path, monkeypatch):
    path = tmp_path / "journal.log"

    async def write():
        journal = Journal(path)
        await journal.append(FACTS[0])
        real = os.pwrite

        def half(file, data, at):
            if at == journal._good:
                return real(file, bytes(data)[: len(data) // 2], at)
            raise OSError(errno.ENOSPC, "No space left on device")

        monkeypatch.setattr(os, "pwrite", half)
        with pytest.raises(OSError, match="No space"):
            await journal.append(FACTS[1])
        monkeypatch.setattr(os, "pwrite", real)
        await journal.append(FACTS[2])
        await journal.close()

    asyncio.run(write())
    read = read_journal(path)
    assert (read.events, read.damage) == ([FACTS[0], FACTS[2]], [])


def upload(folder, data=b"picture"):
    head = FrameHead(index=3, files=[FrameFile(camera="c0", size=len(data)), FrameFile(camera="c1", size=2)])
    record = Upload(folder, head, 0.5)
    block = bytearray(record.begin + len(data) + 2)
    block[record.begin :] = data + b"zz"
    record.write(memoryview(block), record.begin)
    hashes = [blake3(data).hexdigest(), blake3(b"zz").hexdigest()]
    record.finish([blake3(data).digest(), blake3(b"zz").digest()])
    return record, hashes


def test_a_record_of_pictures_comes_back(tmp_path):
    record, hashes = upload(tmp_path)
    pictures = read_pictures(tmp_path, record.name)
    assert {name: bytes(data) for name, data in pictures.images.items()} == {"c0": b"picture", "c1": b"zz"}
    assert (pictures.index, pictures.time, pictures.part, pictures.masks) == (3, 0.5, False, {})
    assert [pictures.hashes[name]["image"] for name in ("c0", "c1")] == hashes
    assert list_records(tmp_path) == {record.name: record.size}


def test_every_cut_and_flipped_bit_of_a_record_of_pictures_is_found(tmp_path):
    record, _ = upload(tmp_path)
    file = tmp_path / record.name
    data = file.read_bytes()
    for at in range(len(data)):
        for damaged in (data[:at], data[:at] + bytes([data[at] ^ 16]) + data[at + 1 :]):
            file.write_bytes(damaged)
            with pytest.raises(FrameDamage, match=record.name):
                read_pictures(tmp_path, record.name)
    file.write_bytes(data + b"\0")
    with pytest.raises(FrameDamage):
        read_pictures(tmp_path, record.name)
    with pytest.raises(FrameDamage, match="not the name"):
        read_pictures(tmp_path, "../secret")


def test_a_journal_that_is_closed_writes_nothing(tmp_path):
    """The number of its file may be another file's by then: that of another scene."""

    async def late():
        journal = Journal(tmp_path / "journal.log")
        await journal.append(FACTS[0])
        await journal.close()
        other = os.open(tmp_path / "other", os.O_RDWR | os.O_CREAT)
        try:
            with pytest.raises(Problem) as refused:
                await journal.append(FACTS[1])
            assert refused.value.status_code == 503
            assert os.pread(other, 1, 0) == b""
        finally:
            os.close(other)

    asyncio.run(late())
