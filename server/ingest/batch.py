"""Batches: several frames in one request or message, each accepted or refused on its own.

A frame that is refused because of its content (for example, a damaged image) does not stop the batch. If frames carry
their own indices, the refused frame is declared missing as soon as a later frame of the batch arrives, because frames
must arrive without gaps. With ``OnRefusal.STOP``, it stops the batch instead, so that its sender can send it again
without the damaged image. A refusal that applies to every frame, such as a full queue, always stops the batch. Later
frames then get the same answer without being read.
"""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator, Awaitable, Callable
from enum import StrEnum
from functools import partial

from fastapi import Request
from starlette.datastructures import UploadFile

from client.wire import FrameHead, FrameReceipt, IngestAnswer
from server.ingest.camera_files import FormFields, contents, form_frame, form_limits
from server.ingest.open_frames import OpenFrames
from server.ingest.receive import BodyReader, files_size, read_head, receive_files
from server.problems import Problem, internal_error

log = logging.getLogger("scas4d.server")

MOST_FORM_FRAMES = 100
"""Maximum number of frames in a multipart form, which is parsed completely before its first frame is accepted."""
STOPPING = (429, 503, 507)
"""Status codes of refusals that apply to every frame: no room in the queue, on the node or on the disk."""
REFUSED_CONTENT = (413, 422)
"""Status codes of frames that are refused because of their content."""
LONGEST_REASON = 500
"""Maximum length of the reason for a missing frame."""


class Numbering(StrEnum):
    """How the frames of a batch are numbered: by their own indices, or with the next free ones."""

    GIVEN = "given"
    NEXT = "next"


class OnRefusal(StrEnum):
    """What a frame that is refused because of its content does to the rest of its batch."""

    SKIP = "skip"
    STOP = "stop"


class Batch:
    """Acceptance of the frames of one batch, in order.

    Args:
        frames: the scene's frames.
        numbering: how the frames are numbered.
        on_refusal: whether a frame that is refused because of its content stops the batch.

    Attributes:
        answers: answer to each frame so far.
        stopped: refusal that applies to all further frames, or None.
    """

    def __init__(self, frames: OpenFrames, numbering: Numbering, on_refusal: OnRefusal) -> None:
        self._frames = frames
        self._ingest = frames.ingest
        self._numbering = numbering
        self._stopping = STOPPING if on_refusal is OnRefusal.SKIP else (*STOPPING, *REFUSED_CONTENT)
        self.answers: list[IngestAnswer] = []
        self.stopped: Problem | None = None

    async def receive_frames(self, reader: BodyReader) -> None:
        """Receives consecutive S4DF frames until the body ends."""
        while not await reader.at_end():
            try:
                head = await read_head(reader)
            except Problem as problem:  # the sizes of the files are unknown, so the next frame cannot be found
                self.refuse(None, problem)
                break
            end = reader.position + files_size(head)
            await self.accept(head, lambda numbered: receive_files(self._ingest, numbered, reader, ends_body=False))
            await reader.skip(end - reader.position)

    async def receive_form(self, request: Request) -> None:
        """Receives a form whose field names are those of a single frame, prefixed with the frame index and a slash.

        Raises:
            Problem: 422 if a field name has no index.
        """
        rig = self._ingest.rules.rig
        async with request.form(**form_limits(rig, MOST_FORM_FRAMES)) as form:
            by_index: dict[int, FormFields] = {}
            for name, value in form.multi_items():
                index, slash, field = name.partition("/")
                if not (slash and index.isascii() and index.isdigit() and len(index) <= 10):
                    raise Problem(
                        422,
                        f"the field name {name!r} contains no frame index",
                        field=name,
                        value=name,
                        remedy="put the frame index before the camera name, as in 0/north, 0/mask.north or 0/time",
                    )
                by_index.setdefault(int(index), []).append((field, value))
            for given, fields in sorted(by_index.items()):
                try:
                    head, uploads = form_frame(rig, given, fields)
                except Problem as problem:
                    self.refuse(given, problem)
                    continue
                await self.accept(head, partial(self._receive_uploads, uploads))

    async def _receive_uploads(self, uploads: list[UploadFile], head: FrameHead) -> FrameReceipt:
        return await receive_files(self._ingest, head, BodyReader(contents(uploads)), ends_body=False)

    async def accept(self, head: FrameHead, receive: Callable[[FrameHead], Awaitable[FrameReceipt]]) -> None:
        """Accepts or refuses the next frame and appends its answer.

        Args:
            head: header of the frame, with the index that its sender gave it.
            receive: receives the frame's files under the index in the header that it is given.
        """
        if self.stopped is not None:
            self.answers.append(refusal(head.index, self.stopped))
            return
        try:
            if self._numbering is Numbering.NEXT:
                head = head.model_copy(update={"index": self._ingest.index_at(head.time)})
            else:
                await self._skip_refused(head.index)
            receipt = await receive(head)
        except Problem as problem:
            if self._numbering is Numbering.NEXT and head.index < self._ingest.ledger.next_frame:
                problem = _known_time_problem(head, problem)
            self.refuse(head.index, problem)
        except Exception as error:
            log.exception("scene %s: receiving a frame of a batch failed", self._ingest.ledger.scene)
            self.stopped = internal_error(error)
            self.answers.append(refusal(head.index, self.stopped))
        else:
            self.answers.append(IngestAnswer(index=head.index, status=202, receipt=receipt))

    def refuse(self, index: int | None, problem: Problem) -> None:
        """Appends the answer for a refused frame; stops the batch if the refusal does so."""
        if problem.status_code in self._stopping:
            self.stopped = problem
        self.answers.append(refusal(index, problem))

    async def _skip_refused(self, index: int) -> None:
        """Declares the previous frame missing if it was refused because of its content and blocks frame `index`."""
        before = self.answers[-1] if self.answers else None
        if before is None or before.problem is None or before.status not in REFUSED_CONTENT:
            return
        if before.index == index - 1 == self._ingest.ledger.next_frame:
            self._ingest.refuse_if_stopped()  # a scene that cannot start refuses every frame
            reason = f"refused in a batch: {before.problem.detail}"[:LONGEST_REASON]
            await self._frames.declare_missing(before.index, reason)
            self.answers[-1] = before.model_copy(update={"missing": True})


def _known_time_problem(head: FrameHead, problem: Problem) -> Problem:
    """Returns the problem for a frame whose time is that of a known frame, but whose content is not."""
    if problem.status_code != 409:
        return problem
    return Problem(
        409,
        f"{problem.detail}; it was sent with the same time, which identifies repeated frames",
        field="time",
        value=head.time,
        remedy="give every frame its own time, or send the frames with their indices (numbering=given)",
    )


def refusal(index: int | None, problem: Problem) -> IngestAnswer:
    """Returns the answer that refuses a frame; `retry_after` corresponds to the Retry-After header of HTTP."""
    seconds = (problem.headers or {}).get("Retry-After")
    wait = None if seconds is None else int(seconds)
    return IngestAnswer(index=index, status=problem.status_code, retry_after=wait, problem=problem.document)


async def receive_batch(
    frames: OpenFrames, numbering: Numbering, on_refusal: OnRefusal, body: AsyncIterator[bytes]
) -> Batch:
    """Receives a batch of S4DF frames, one after another without separators.

    Raises:
        Problem: 422 if the body is empty.
    """
    reader, batch = BodyReader(body), Batch(frames, numbering, on_refusal)
    try:
        await batch.receive_frames(reader)
    finally:
        await reader.drain()
    return _with_frames(batch)


async def receive_form_batch(
    frames: OpenFrames, numbering: Numbering, on_refusal: OnRefusal, request: Request
) -> Batch:
    """Receives a batch of frames as multipart/form-data.

    Raises:
        Problem: 422 if the form is empty or has a field without a frame index.
    """
    batch = Batch(frames, numbering, on_refusal)
    await batch.receive_form(request)
    return _with_frames(batch)


def _with_frames(batch: Batch) -> Batch:
    if not batch.answers:
        remedy = "send at least one frame, as described in docs/api.md"
        raise Problem(422, "the body contains no frames", field="body", value="nothing", remedy=remedy)
    return batch
