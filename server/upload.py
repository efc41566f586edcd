"""Pictures on their way from the wire to disk: each is checked, hashed and written while the next comes in."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from blake3 import blake3

from client.wire import FrameFile, FrameHead, FramingError, head_length, parse_head
from client.wire.framing import PREFIX
from server.disk import full_disk, no_room
from server.facts import Hashes
from server.frame_store import Upload
from server.problems import Problem

BATCH = 4_000_000
"""Bytes of files that are checked, hashed and written at once, where a file is not larger itself."""

Check = Callable[[FrameFile, memoryview], None]
"""Raises Problem for a file that is not what the scene takes."""


@dataclass(eq=False)
class Received:
    """A frame's files, or one camera's, on disk. `file` is None where they were only compared with what is known."""

    hashes: Hashes
    file: str | None
    size: int
    kept: bool = False
    """A fact names the record: it is not debris."""


class Receiving:
    """One record that is being received.

    Args:
        folder: of the frame log. head: what comes. seconds: time of the frame, where it is known.
        check: of each file. keep: whether to write; otherwise the files are only hashed.
    """

    def __init__(self, folder: Path, head: FrameHead, seconds: float | None, check: Check, *, keep: bool) -> None:
        self._folder, self._head, self._seconds, self._check, self._keep = folder, head, seconds, check, keep
        self._hashes: Hashes = {}
        self._upload: Upload | None = None
        self._size = 0
        self._at_work: asyncio.Future[None] | None = None

    async def files(self, files: Sequence[FrameFile], data: memoryview) -> None:
        """Takes the next files of the head, one behind the other in `data`; returns when those before them are done.

        Raises:
            Problem, OSError: of the files before these.
        """
        await self._done()
        self._at_work = asyncio.ensure_future(asyncio.to_thread(self._take, files, data))

    def _take(self, files: Sequence[FrameFile], data: memoryview) -> None:
        at = 0
        for file in files:
            piece = data[at : at + file.size]
            at += file.size
            self._check(file, piece)
            self._hashes.setdefault(file.camera, {})[file.kind] = blake3(piece).hexdigest()
        if self._keep:
            if self._upload is None:
                self._upload = Upload(self._folder, self._head, self._seconds)
            self._upload.write(data)

    async def _done(self) -> None:
        if self._at_work is not None:
            task, self._at_work = self._at_work, None
            await task

    async def finish(self) -> Received:
        """All files are on disk.

        Raises:
            Problem, OSError: they are not.
        """
        await self._done()
        upload = self._upload
        if upload is None:
            return Received(self._hashes, None, 0)
        await asyncio.to_thread(upload.finish)
        return Received(self._hashes, upload.name, upload.size)

    async def abort(self) -> None:
        """Removes what was written."""
        try:
            await self._done()
        except (Problem, OSError):
            pass
        finally:
            if self._upload is not None:
                await asyncio.to_thread(self._upload.abort)


async def receive_framed(
    chunks: AsyncIterator[bytes], head_of: Callable[[FrameHead], Receiving], total: int | None
) -> tuple[FrameHead, Receiving]:
    """Reads a frame as `client.wire.framing` writes it, batch by batch; nothing is held but two batches of them.

    Args:
        chunks: the bytes as they come. head_of: told the head once it is here; refuses or begins. total: bytes
            announced, where they are.

    Raises:
        Problem: 422, no frame, or not what its head says; or what `head_of` and the checks raise.
    """
    start = bytearray()
    head: FrameHead | None = None
    receiving: Receiving | None = None
    batches: Iterator[list[FrameFile]] = iter(())
    batch: list[FrameFile] | None = None
    buffers = (bytearray(), bytearray())
    size = filled = 0
    try:
        async for chunk in chunks:
            view = memoryview(chunk)
            if head is None or receiving is None:
                start += chunk
                if len(start) < PREFIX.size or len(start) < PREFIX.size + head_length(start):
                    continue
                end = PREFIX.size + head_length(start)
                head = parse_head(start[PREFIX.size : end])
                _check_length(head, end, total)
                receiving = head_of(head)
                view = memoryview(bytes(start))[end:]
                planned = in_batches(head.files)
                # Two, in turns: while one is checked and written, the other is filled.
                buffers = tuple(bytearray(max(map(_bytes, planned))) for _ in range(2))  # type: ignore[assignment]
                batches = iter(planned)
                batch = next(batches, None)
                size = _bytes(batch or [])
            while batch is not None:
                piece = view[: size - filled]
                buffers[0][filled : filled + len(piece)] = piece
                filled += len(piece)
                view = view[len(piece) :]
                if filled < size:
                    break
                await receiving.files(batch, memoryview(buffers[0])[:size])
                buffers = buffers[::-1]
                batch, filled = next(batches, None), 0
                size = _bytes(batch or [])
            if batch is None and len(view):
                raise FramingError(f"goes on for {len(view)} bytes and more behind its files; send none there")
        if head is None or receiving is None:
            raise FramingError(f"ends after {len(start)} bytes, within its head; send the whole frame")
        if batch is not None:
            missing = size - filled + sum(map(_bytes, batches))
            raise FramingError(f"ends {missing} bytes before its last file does; send the whole frame")
        return head, receiving
    except BaseException as error:
        if receiving is not None:
            await receiving.abort()
        if isinstance(error, FramingError):
            raise framing_problem(error) from None
        if isinstance(error, OSError) and no_room(error):
            raise full_disk(error) from None
        raise


def framing_problem(error: FramingError) -> Problem:
    """The answer to bytes that are no frame."""
    text = str(error)
    return Problem(422, f"the frame {text}", field="body", value=text, remedy=text.rpartition("; ")[2])


def _check_length(head: FrameHead, start: int, total: int | None) -> None:
    expected = start + sum(file.size for file in head.files)
    if total is not None and total != expected:
        raise FramingError(f"has {total} bytes where its head says {expected}; send what the head says")


def in_batches(files: Sequence[FrameFile]) -> list[list[FrameFile]]:
    """Consecutive files that are given to a thread together: each time costs more than a small file is worth."""
    batches: list[list[FrameFile]] = []
    for file in files:
        if not batches or _bytes(batches[-1]) + file.size > BATCH:
            batches.append([])
        batches[-1].append(file)
    return batches


def _bytes(files: Sequence[FrameFile]) -> int:
    return sum(file.size for file in files)
