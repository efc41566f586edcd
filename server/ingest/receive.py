"""Receives frames: reads S4DF, checks, hashes and writes the pictures while the next bytes arrive."""

from __future__ import annotations

import asyncio
import mmap
from collections.abc import AsyncIterator, Callable, Coroutine, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from blake3 import blake3

from client.wire import FrameFile, FrameHead, FrameReceipt, FramingError, head_length, parse_head
from client.wire.framing import PREFIX
from server.ingest.acknowledge import Ingest, Received, uncancelled
from server.ingest.pictures import check_files, check_picture
from server.problems import Problem
from server.storage.disk import full_disk, no_room
from server.storage.events import Hashes
from server.storage.frame_store import BLOCK, Upload

T = TypeVar("T")

BATCH = 4_000_000
"""Bytes of files that are checked, hashed and written at once; a larger file is a batch of its own."""
SPARE_BUFFERS = 8
"""Buffers of that size that are kept for the next frames: fresh memory costs as much time as filling it."""

Check = Callable[[FrameFile, memoryview], None]
"""Raises Problem for a file that the scene does not accept."""

_spare: list[mmap.mmap] = []


class Receiving:
    """Receives one record, batch by batch: one is filled while a thread checks, hashes and writes the one before.

    Args:
        folder: of the frame log. head: names the files. seconds: time of the frame, where it is known.
        check: called with each file. keep: False: the files are only hashed, not written.

    Attributes:
        missing: bytes of the files that have not arrived yet.
    """

    def __init__(self, folder: Path, head: FrameHead, seconds: float | None, check: Check, *, keep: bool) -> None:
        self._check = check
        self._hashes: Hashes = {}
        self._digests: list[bytes] = []
        self._upload = Upload(folder, head, seconds) if keep else None
        self._at_work: asyncio.Future[None] | None = None
        self._batches = in_batches(head.files)
        # Memory and file are alike modulo the size of a block: so it can be written without the page cache.
        self._at = self._begin = 0 if self._upload is None else self._upload.begin % BLOCK
        self.missing = sum(map(_bytes, self._batches))
        size = BLOCK + max(map(_bytes, self._batches))
        self._buffers = [_buffer(size) for _ in self._batches[:2]]

    async def take(self, data: memoryview) -> None:
        """Takes the next bytes, not more than are missing; returns when there is room for more.

        Raises:
            Problem, OSError: of files that arrived before.
        """
        while self._batches:
            end = self._begin + _bytes(self._batches[0])
            piece = data[: end - self._at]
            self._buffers[0][self._at : self._at + len(piece)] = piece
            self._at += len(piece)
            self.missing -= len(piece)
            data = data[len(piece) :]
            if self._at < end:
                return
            await self._settle()
            block = memoryview(self._buffers[0])[:end]
            self._start(self._write, self._batches.pop(0), block, self._begin)
            self._buffers.reverse()
            self._at = self._begin = 0 if self._upload is None else end % BLOCK

    def _write(self, files: Sequence[FrameFile], block: memoryview, begin: int) -> None:
        at = begin
        for file in files:
            piece = block[at : at + file.size]
            at += file.size
            self._check(file, piece)
            digest = blake3(piece)
            self._digests.append(digest.digest())
            self._hashes.setdefault(file.camera, {})[file.kind] = digest.hexdigest()
        if self._upload is not None:
            self._upload.write(block, begin)

    async def finish(self) -> Received:
        """Returns once all files are on disk.

        Raises:
            Problem, OSError: they are not.
        """
        await self._settle()
        upload = self._upload
        if upload is not None:
            self._start(upload.finish, self._digests)
            await self._settle()
        self._give_back()
        return Received(self._hashes, None, 0) if upload is None else Received(self._hashes, upload.name, upload.size)

    async def abort(self) -> None:
        """Removes the record, even where the caller is cancelled meanwhile."""
        await asyncio.shield(asyncio.ensure_future(self._abort()))

    async def _abort(self) -> None:
        if self._at_work is not None:
            await asyncio.wait([self._at_work])  # nothing may be closed or used again under a thread that writes
        self._give_back()
        if self._upload is not None:
            await asyncio.to_thread(self._upload.abort)

    def _start(self, function: Callable[..., None], *arguments: object) -> None:
        self._at_work = asyncio.ensure_future(asyncio.to_thread(function, *arguments))

    async def _settle(self) -> None:
        """Waits for the thread, which goes on where the caller is cancelled."""
        if self._at_work is not None:
            try:
                await asyncio.shield(self._at_work)
            except FileNotFoundError:  # its folder is gone
                remedy = "GET /v1/scenes lists the scenes"
                raise Problem(404, "the scene was deleted meanwhile", field="id", remedy=remedy) from None
            self._at_work = None

    def _give_back(self) -> None:
        _spare.extend(buffer for buffer in self._buffers if len(buffer) == _STANDARD)
        del _spare[SPARE_BUFFERS:]
        self._buffers = []


async def read_framed(
    chunks: AsyncIterator[bytes], begin: Callable[[FrameHead], Receiving], total: int | None
) -> tuple[FrameHead, Receiving]:
    """Reads a frame as `client.wire.framing` writes it; holds two batches of its bytes at most.

    Args:
        chunks: the bytes as they arrive. begin: called with the head; refuses it or begins to receive.
        total: bytes announced, if any.

    Raises:
        Problem: 422, no frame, or not as its head says; and all that `begin` and the checks raise.
    """
    start = bytearray()
    head: FrameHead | None = None
    receiving: Receiving | None = None
    try:
        async for chunk in chunks:
            view = memoryview(chunk)
            if head is None or receiving is None:
                view = _fill(start, view, PREFIX.size)
                if len(start) < PREFIX.size:
                    continue
                end = PREFIX.size + head_length(start)
                view = _fill(start, view, end)
                if len(start) < end:
                    continue
                head = parse_head(start[PREFIX.size :])
                _check_length(head, end, total)
                receiving = begin(head)
            if len(view) > receiving.missing:
                over = len(view) - receiving.missing
                raise FramingError(f"goes on for {over} bytes and more behind its files", "send none there")
            await receiving.take(view)
        if head is None or receiving is None:
            raise FramingError(f"ends after {len(start)} bytes, within its head", "send the whole frame")
        if receiving.missing:
            raise FramingError(f"ends {receiving.missing} bytes before its last file does", "send the whole frame")
        return head, receiving
    except BaseException as error:
        if receiving is not None:
            await receiving.abort()
        if isinstance(error, FramingError):
            raise framing_problem(error) from None
        if isinstance(error, OSError) and no_room(error):
            raise full_disk(error) from None
        raise


def _fill(start: bytearray, view: memoryview, size: int) -> memoryview:
    """Moves bytes from `view` until `start` has `size`; returns the rest of `view`."""
    missing = max(0, size - len(start))
    start += view[:missing]
    return view[missing:]


def framing_problem(error: FramingError) -> Problem:
    """Makes the answer to bytes that are no frame."""
    return Problem(422, f"the frame {error.fault}", field="body", value=error.fault, remedy=error.remedy)


def _check_length(head: FrameHead, start: int, total: int | None) -> None:
    expected = start + sum(file.size for file in head.files)
    if total is not None and total != expected:
        raise FramingError(f"has {total} bytes where its head says {expected}", "send what the head says")


def in_batches(files: Sequence[FrameFile]) -> list[list[FrameFile]]:
    """Groups consecutive files for a thread: handing over a small file costs more than hashing it."""
    batches: list[list[FrameFile]] = []
    for file in files:
        if not batches or _bytes(batches[-1]) + file.size > BATCH:
            batches.append([])
        batches[-1].append(file)
    return batches


def _bytes(files: Sequence[FrameFile]) -> int:
    return sum(file.size for file in files)


_STANDARD = -(-(BATCH + BLOCK) // mmap.PAGESIZE) * mmap.PAGESIZE


def _buffer(size: int) -> mmap.mmap:
    """Returns memory that begins at a page."""
    if size <= _STANDARD and _spare:
        return _spare.pop()
    return mmap.mmap(-1, max(size, _STANDARD))


async def receive_frame(
    ingest: Ingest, index: int | None, body: AsyncIterator[bytes], length: int | None
) -> FrameReceipt:
    """Receives and acknowledges a whole frame as S4DF.

    Args:
        ingest: of the scene. index: as the address gives it; None where the head alone does.
        body: its bytes. length: their number, where it is announced.

    Raises:
        Problem: the frame is refused; see `Ingest.accept`.
    """
    begun: list[int] = []

    def begin(head: FrameHead) -> Receiving:
        check_index(head, index)
        check_files(ingest.rules.rig, head.files, whole=True)
        keep = ingest.expects(head)
        if keep:
            ingest.coming(head.index)
            begun.append(head.index)
        whole = head.model_copy(update={"part": False})  # the address says so, whatever the head does
        return receiving_of(ingest, whole, ingest.time_of(head.index, head.time), keep=keep)

    try:
        head, receiving = await read_framed(body, begin, length)
        return await accepted_or_removed(receiving, lambda received: ingest.accept(head, received))
    finally:
        for number in begun:
            ingest.came(number)
        await drain(body)


def receiving_of(ingest: Ingest, head: FrameHead, seconds: float | None, *, keep: bool) -> Receiving:
    """Begins to receive a record of the scene's frame log; `keep`: see `Receiving`."""
    return Receiving(ingest.log.pictures.folder, head, seconds, partial(check_picture, ingest.rules.rig), keep=keep)


async def accepted_or_removed(receiving: Receiving, accept: Callable[[Received], Coroutine[Any, Any, T]]) -> T:
    """Completes even where the request is cancelled: a record that an event names, or will, must not be removed."""

    async def finish() -> T:
        received = await _finished(receiving)
        try:
            return await accept(received)
        finally:
            if not received.kept:
                await receiving.abort()

    return await uncancelled(finish())


async def _finished(receiving: Receiving) -> Received:
    try:
        return await receiving.finish()
    except BaseException as error:
        await receiving.abort()
        if no_room(error) and isinstance(error, OSError):
            raise full_disk(error) from None
        raise


async def drain(body: AsyncIterator[bytes]) -> None:
    """Reads the rest of a body that is refused: a sender that is still sending would not see the answer."""
    async for _ in body:
        pass


def check_index(head: FrameHead, index: int | None) -> None:
    """Refuses a head with another index than the address (None: the address has none)."""
    if index is not None and head.index != index:
        raise Problem(
            422,
            f"the head says frame {head.index}, the address frame {index}",
            field="head.index",
            value=head.index,
            remedy="send both alike",
        )
