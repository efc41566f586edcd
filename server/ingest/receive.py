"""Receiver of S4DF frames, which checks, hashes and writes images while the next bytes arrive."""

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
from server.background import shielded
from server.ingest.acknowledge import Ingest, ReceivedFiles
from server.ingest.pictures import check_files, check_picture
from server.problems import Problem
from server.storage.disk import full_disk, no_room
from server.storage.events import Hashes
from server.storage.frame_store import BLOCK, Upload

T = TypeVar("T")

BATCH = 4_000_000
"""Maximum total size in bytes of files that are checked, hashed and written together; larger files go alone."""
MAX_SPARE_BUFFERS = 8
"""Maximum number of batch buffers to keep for reuse, because allocating memory takes as long as filling it."""

Check = Callable[[FrameFile, memoryview], None]
"""Function that raises `Problem` if the scene does not accept a file."""

_spare: list[mmap.mmap] = []


class FrameReceiver:
    """Receiver of one record, which processes it in double-buffered batches.

    While one batch is being filled, a thread checks, hashes and writes the previous one.

    Args:
        folder: frame log folder.
        head: frame header, with the names and sizes of the files.
        seconds: time of the frame in seconds, or None if it is not known yet.
        check: function called with each file and its contents.
        keep: whether to write the files; if False, they are only checked and hashed.

    Attributes:
        missing: number of bytes that have not arrived yet.
    """

    def __init__(self, folder: Path, head: FrameHead, seconds: float | None, check: Check, *, keep: bool) -> None:
        self._check = check
        self._hashes: Hashes = {}
        self._digests: list[bytes] = []
        self._upload = Upload(folder, head, seconds) if keep else None
        self._at_work: asyncio.Future[None] | None = None
        self._batches = in_batches(head.files)
        # Offsets in the buffer and the file are equal modulo the block size, as direct I/O requires.
        self._at = self._begin = 0 if self._upload is None else self._upload.begin % BLOCK
        self.missing = sum(map(_bytes, self._batches))
        size = BLOCK + max(map(_bytes, self._batches))
        self._buffers = [_buffer(size) for _ in self._batches[:2]]

    async def take(self, data: memoryview) -> None:
        """Takes the next bytes, at most `missing`, and returns when there is room for more.

        Raises:
            Problem, OSError: an earlier file is invalid or could not be written.
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
            await self._wait_for_thread()
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

    async def finish(self) -> ReceivedFiles:
        """Waits until all files are on disk and returns their digests.

        Raises:
            Problem, OSError: a file is invalid or could not be written.
        """
        await self._wait_for_thread()
        upload = self._upload
        if upload is not None:
            self._start(upload.finish, self._digests)
            await self._wait_for_thread()
        self._return_buffers()
        return (
            ReceivedFiles(self._hashes, None, 0)
            if upload is None
            else ReceivedFiles(self._hashes, upload.name, upload.size)
        )

    @shielded
    async def abort(self) -> None:
        """Removes the record."""
        if self._at_work is not None:
            await asyncio.wait([self._at_work])  # the thread may still use the file and the buffers
        self._return_buffers()
        if self._upload is not None:
            await asyncio.to_thread(self._upload.abort)

    def _start(self, function: Callable[..., None], *arguments: object) -> None:
        self._at_work = asyncio.ensure_future(asyncio.to_thread(function, *arguments))

    async def _wait_for_thread(self) -> None:
        """Waits for the thread, which continues even if the caller is cancelled."""
        if self._at_work is not None:
            try:
                await asyncio.shield(self._at_work)
            except FileNotFoundError:  # the folder no longer exists
                remedy = "list all scenes with GET /v1/scenes"
                raise Problem(404, "the scene was deleted during the request", field="id", remedy=remedy) from None
            self._at_work = None

    def _return_buffers(self) -> None:
        _spare.extend(buffer for buffer in self._buffers if len(buffer) == _STANDARD)
        del _spare[MAX_SPARE_BUFFERS:]
        self._buffers = []


class BodyReader:
    """Reader of a request body that arrives in chunks.

    Args:
        chunks: the body.

    Attributes:
        position: number of bytes read so far.
    """

    def __init__(self, chunks: AsyncIterator[bytes]) -> None:
        self._chunks = chunks
        self._chunk = memoryview(b"")
        self.position = 0

    async def at_end(self) -> bool:
        """Returns whether all bytes of the body have been read; waits for the next chunk if necessary."""
        while not self._chunk:
            try:
                self._chunk = memoryview(await anext(self._chunks))
            except StopAsyncIteration:
                return True
        return False

    async def pieces(self, size: int) -> AsyncIterator[memoryview]:
        """Yields the next `size` bytes piece by piece; fewer if the body ends before."""
        while size and not await self.at_end():
            piece, self._chunk = self._chunk[:size], self._chunk[size:]
            size -= len(piece)
            self.position += len(piece)
            yield piece

    async def read(self, size: int) -> bytes:
        """Returns the next `size` bytes; fewer if the body ends before."""
        return b"".join([bytes(piece) async for piece in self.pieces(size)])

    async def skip(self, size: int) -> None:
        """Discards the next `size` bytes."""
        async for _ in self.pieces(size):
            pass

    async def drain(self) -> None:
        """Discards the rest of a refused body, because a client reads the response only after sending it."""
        self._chunk = memoryview(b"")
        await drain(self._chunks)


async def in_one_piece(data: bytes | bytearray) -> AsyncIterator[bytes]:
    """Yields a body that has already been received."""
    yield bytes(data)


async def read_head(reader: BodyReader) -> FrameHead:
    """Reads the prefix and the header of a frame in the format of `client.wire.framing`.

    Raises:
        Problem: 422 if the body does not continue with a valid header.
    """
    begin = reader.position
    try:
        prefix = await reader.read(PREFIX.size)
        if len(prefix) == PREFIX.size:
            size = head_length(prefix)
            data = await reader.read(size)
            if len(data) == size:
                return parse_head(data)
        length = reader.position - begin
        raise FramingError(f"ends after {length} bytes, before the end of its header", "send the whole frame")
    except FramingError as error:
        raise framing_problem(error) from None


async def read_files(reader: BodyReader, receiving: FrameReceiver, *, ends_body: bool) -> None:
    """Passes the files of a frame to its receiver, which buffers at most two batches.

    The record is removed if the files are refused.

    Args:
        reader: reader of the body, at the first file.
        receiving: receiver of the frame.
        ends_body: whether the body must end with the last file.

    Raises:
        Problem: 422 if the body ends too early or too late, 507 if the disk is full; also any problem raised by the
            receiver's checks.
    """
    try:
        await receiving.take(memoryview(b""))  # files without content are checked, too
        async for piece in reader.pieces(receiving.missing):
            await receiving.take(piece)
        if receiving.missing:
            fault = f"ends {receiving.missing} bytes before the end of its files"
            raise framing_problem(FramingError(fault, "send the whole frame"))
        if ends_body and not await reader.at_end():
            fault = "has extra bytes after its last file"
            raise framing_problem(FramingError(fault, "end the body after the last file"))
    except BaseException as error:
        await receiving.abort()
        if isinstance(error, OSError) and no_room(error):
            raise full_disk(error) from None
        raise


def framing_problem(error: FramingError) -> Problem:
    """Returns the 422 problem for a body that is not a valid frame."""
    return Problem(422, f"the frame {error.fault}", field=error.field, value=error.value, remedy=error.remedy)


def check_length(head: FrameHead, start: int, total: int | None) -> None:
    """Raises `Problem` (422) if the announced length of a body contradicts its header.

    Args:
        head: header of the only frame in the body.
        start: number of bytes before the first file.
        total: announced number of bytes, or None.
    """
    expected = start + files_size(head)
    if total is not None and total != expected:
        fault = f"has {total} bytes, but its header declares {expected}"
        raise framing_problem(FramingError(fault, "send the files that the header lists"))


def files_size(head: FrameHead) -> int:
    """Returns the total size in bytes of the files that a header lists."""
    return _bytes(head.files)


def in_batches(files: Sequence[FrameFile]) -> list[list[FrameFile]]:
    """Groups consecutive files into batches, because handing a small file to a thread takes longer than hashing it."""
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
    """Returns page-aligned memory of at least `size` bytes."""
    if size <= _STANDARD and _spare:
        return _spare.pop()
    return mmap.mmap(-1, max(size, _STANDARD))


async def receive_frame(
    ingest: Ingest, index: int | None, body: AsyncIterator[bytes], length: int | None
) -> FrameReceipt:
    """Receives and acknowledges a complete frame as S4DF.

    Args:
        ingest: the scene's frame ingest.
        index: frame index from the URL, or None if only the header contains it.
        body: request body in chunks.
        length: announced number of bytes, or None.

    Raises:
        Problem: the frame is refused; see `Ingest.accept`.
    """
    reader = BodyReader(body)
    try:
        head = await read_head(reader)
        check_length(head, reader.position, length)
        check_index(head, index)
        return await receive_files(ingest, head, reader, ends_body=True)
    finally:
        await reader.drain()


async def receive_files(ingest: Ingest, head: FrameHead, reader: BodyReader, *, ends_body: bool) -> FrameReceipt:
    """Receives the files of a complete frame and acknowledges the frame.

    Args:
        ingest: the scene's frame ingest.
        head: header of the frame.
        reader: reader of the body, at the first file.
        ends_body: whether the body must end with the last file.

    Raises:
        Problem: the frame is refused; see `Ingest.accept`.
    """
    check_files(ingest.rules.rig, head.files, whole=True)
    keep = ingest.needs_files(head)
    if keep:
        ingest.begin_receiving(head.index)
    try:
        whole = head.model_copy(update={"single_camera": False})  # the URL takes precedence over the header
        receiving = frame_receiver(ingest, whole, ingest.time_of(head.index, head.time), keep=keep)
        await read_files(reader, receiving, ends_body=ends_body)
        return await accept_or_remove(receiving, lambda received: ingest.accept(head, received))
    finally:
        if keep:
            ingest.end_receiving(head.index)


def frame_receiver(ingest: Ingest, head: FrameHead, seconds: float | None, *, keep: bool) -> FrameReceiver:
    """Returns a receiver for a record of the scene's frame log; see `FrameReceiver` for `keep`."""
    return FrameReceiver(ingest.log.pictures.folder, head, seconds, partial(check_picture, ingest.rules.rig), keep=keep)


@shielded
async def accept_or_remove(receiving: FrameReceiver, accept: Callable[[ReceivedFiles], Coroutine[Any, Any, T]]) -> T:
    """Finishes a record and accepts it, or removes it if it is refused.

    This runs to completion even if the request is cancelled, because a record must not be removed once an event
    references it.
    """
    try:
        received = await receiving.finish()
    except BaseException as error:
        await receiving.abort()
        if no_room(error) and isinstance(error, OSError):
            raise full_disk(error) from None
        raise
    try:
        return await accept(received)
    finally:
        if not received.kept:
            await receiving.abort()


async def drain(body: AsyncIterator[bytes]) -> None:
    """Reads and discards the rest of a refused body, because a client reads the response only after sending it."""
    async for _ in body:
        pass


def check_index(head: FrameHead, index: int | None) -> None:
    """Raises `Problem` (422) if the index in the header differs from `index`, the index in the URL, if there is one."""
    if index is not None and head.index != index:
        raise Problem(
            422,
            f"the header contains frame index {head.index}, but the URL contains {index}",
            field="head.index",
            value=head.index,
            remedy="use the same index in both",
        )
