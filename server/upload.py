"""Pictures on their way from the wire to disk: each is checked, hashed and written while the next comes in."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from blake3 import blake3

from client.wire import FrameFile, FrameHead, FramingError, head_length, parse_head
from client.wire.framing import PREFIX
from server.disk import full_disk, no_room
from server.facts import Hashes
from server.frame_store import Upload
from server.problems import Problem

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

    async def file(self, file: FrameFile, data: memoryview) -> None:
        """Takes the next file of the head; returns as soon as the one before it is done.

        Raises:
            Problem, OSError: of the file before this one.
        """
        await self._done()
        self._at_work = asyncio.ensure_future(asyncio.to_thread(self._take, file, data))

    def _take(self, file: FrameFile, data: memoryview) -> None:
        self._check(file, data)
        if self._keep:
            if self._upload is None:
                self._upload = Upload(self._folder, self._head, self._seconds)
            value = self._upload.file(data)
        else:
            value = blake3(data).hexdigest()
        self._size += len(data)
        self._hashes.setdefault(file.camera, {})[file.kind] = value

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
    """Reads a frame as `client.wire.framing` writes it, file by file; nothing is held but the files at work.

    Args:
        chunks: the bytes as they come. head_of: told the head once it is here; refuses or begins. total: bytes
            announced, where they are.

    Raises:
        Problem: 422, no frame, or not what its head says; or what `head_of` and the checks raise.
    """
    buffer = bytearray()
    head: FrameHead | None = None
    receiving: Receiving | None = None
    files: Iterable[FrameFile] = iter(())
    file: FrameFile | None = None
    data = bytearray()
    filled = 0
    try:
        async for chunk in chunks:
            if head is None:
                buffer += chunk
                if len(buffer) < PREFIX.size or len(buffer) < PREFIX.size + head_length(buffer):
                    continue
                start = PREFIX.size + head_length(buffer)
                head = parse_head(memoryview(buffer)[PREFIX.size : start])
                _check_length(head, start, total)
                receiving = head_of(head)
                files = iter(head.files)
                file, data, filled = _next(files)
                view = memoryview(bytes(buffer))[start:]
            else:
                view = memoryview(chunk)
            assert receiving is not None
            while True:
                if file is None:
                    if len(view):
                        raise FramingError(f"goes on for {len(view)} bytes and more behind its files; send none there")
                    break
                piece = view[: file.size - filled]
                data[filled : filled + len(piece)] = piece
                filled += len(piece)
                view = view[len(piece) :]
                if filled < file.size:
                    break
                await receiving.file(file, memoryview(data))
                file, data, filled = _next(files)
        if head is None or receiving is None:
            raise FramingError(f"ends after {len(buffer)} bytes, within its head; send the whole frame")
        if file is not None:
            raise FramingError(f"ends within the {file.kind} of camera {file.camera!r}; send the whole frame")
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


def _next(files: Iterable[FrameFile]) -> tuple[FrameFile | None, bytearray, int]:
    file = next(iter(files), None)
    return file, bytearray(0 if file is None else file.size), 0
