"""Repairs damaged files of the states in the worker process: from memory, from copies, or from pictures."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from scas4d_core.captures import Frame
from scas4d_core.errors import message_of
from scas4d_core.gaussians import PER_FRAME, WHOLES
from scas4d_core.storage.frame_files import (
    FIRST_COPY,
    FIXED_COPY,
    FIXED_FILE,
    FrameFiles,
    born_of,
    checkpoint_of,
    fault_of,
    frame_of,
)
from scas4d_core.storage.history import NEWEST_KEPT, History
from server.messages import RecomputeState, RepairFiles, RepairOutcome, RepairResult, SceneSpec
from server.storage.disk import no_room

if TYPE_CHECKING:
    from scas4d_core.reconstruction import Reconstruction

Decode = Callable[[], tuple[Frame, dict[str, str]]]

log = logging.getLogger("scas4d.worker")


def mend_at_start(history: History) -> list[str]:
    """What every frame needs, and its copies, written again where they are damaged; a sentence for each."""
    try:
        mended = history.repair_fixed()
    except OSError as error:  # states can be read all the same: a disk that takes nothing must not keep them away
        log.warning("what every frame needs cannot be mended: %s", error)
        return []
    history.pop_faults()  # of files that were just written again, or that `History.damaged` names
    return [f"{reason}; it was written again from its copy" for reason in mended.values()]


def mend(history: History, reconstruction: Reconstruction | None, message: RepairFiles) -> Iterator[RepairResult]:
    """Looks at each file and writes it again where it can be, the same bits."""
    assert history.files is not None
    for name in message.names:
        try:
            outcome, reason = _mend(history, history.files, reconstruction, name, message)
        except Exception as error:
            log.exception("%s cannot be mended", name)
            outcome, reason = RepairOutcome.NO_ROOM if no_room(error) else RepairOutcome.DAMAGED, message_of(error)
        yield RepairResult(name, outcome, reason)


def _mend(
    history: History, files: FrameFiles, reconstruction: Reconstruction | None, name: str, message: RepairFiles
) -> tuple[RepairOutcome, str]:
    index, known = frame_of(name), history.indices
    fault = fault_of(files.directory / name) if index is None else files.fault(index)
    if fault is None:
        return RepairOutcome.WHOLE, ""
    birth = born_of(name)
    if birth is not None and birth not in history.born_at:  # of a frame that was taken back
        return RepairOutcome.GONE, ""
    if birth is not None or name in (FIXED_FILE, FIXED_COPY, FIRST_COPY) or (known and index == known[0]):
        if name in history.repair_fixed():
            return RepairOutcome.WRITTEN, fault
        return (RepairOutcome.DAMAGED, fault) if known else (RepairOutcome.GONE, "")
    if index is not None:
        if index not in known and index not in history.damaged:
            return RepairOutcome.GONE, ""
        if history.rewrite(index):
            return RepairOutcome.WRITTEN, fault
        return _written_in_part(history, files, index, message), fault
    checkpoint = checkpoint_of(name)
    if checkpoint not in known[-NEWEST_KEPT:]:
        return RepairOutcome.GONE, ""
    again = checkpoint is not None and reconstruction is not None and reconstruction.write_checkpoint(checkpoint)
    return (RepairOutcome.WRITTEN if again else RepairOutcome.DAMAGED), fault


def _written_in_part(history: History, files: FrameFiles, index: int, message: RepairFiles) -> RepairOutcome:
    """Writes a file again of which only the report or the time is damaged: the state is whole in it."""
    try:
        arrays = files.read(index, PER_FRAME, WHOLES)
        report = message.reports.get(index)
        time = message.times[index] if index in message.times else files.time(index)
    except (ValueError, FileNotFoundError):
        return RepairOutcome.DAMAGED
    if index >= max(history.indices, default=-1):
        return RepairOutcome.DAMAGED
    if report is None:
        report = _report_of(files, index)
    history.replace(index, time, arrays, report or {}, history.effects(index) if index in history else {})
    return RepairOutcome.REPORT_LOST if report is None else RepairOutcome.WRITTEN


def _report_of(files: FrameFiles, index: int) -> dict[str, Any] | None:
    """The report of a frame, where that is what is whole."""
    try:
        report: dict[str, Any] = json.loads(files.read(index, ("report",))["report"].tobytes())
    except (ValueError, FileNotFoundError):
        return None
    return report


def recompute(spec: SceneSpec, history: History, message: RecomputeState, decode: Decode) -> Iterator[RepairResult]:
    """Makes a state again from its pictures; whatever comes of it, the scene goes on as before.

    Damage often has neighbours: where the state before it is damaged too, and nobody has noticed, that comes first.
    """
    index = message.frame.index
    assert history.files is not None
    name = history.files.path(index).name
    base = history.files.path(message.base).name
    if (fault := history.files.fault(message.base)) is not None:
        for mended in mend(history, None, RepairFiles((base,), {}, {})):
            yield mended
            match mended.outcome:
                case RepairOutcome.WRITTEN | RepairOutcome.WHOLE | RepairOutcome.REPORT_LOST:
                    continue
                case RepairOutcome.DAMAGED:
                    yield RepairResult(name, RepairOutcome.LATER, fault)
                case RepairOutcome.NO_ROOM:
                    yield RepairResult(name, RepairOutcome.NO_ROOM, mended.reason)
                case _:
                    yield RepairResult(name, RepairOutcome.LOST, "the state before it is gone")
            return
    yield _remade(spec, history, message, decode)


def _remade(spec: SceneSpec, history: History, message: RecomputeState, decode: Decode) -> RepairResult:
    from scas4d_core.recompute import recompute as remake_state  # in the worker only: the service stays light

    index = message.frame.index
    assert history.files is not None
    name = history.files.path(index).name
    try:
        frame, dropped = decode()
        if len(frame.images) < spec.minimum_cameras:
            reason = f"{len(frame.images)} cameras' pictures are left, the scene's minimum is {spec.minimum_cameras}"
            return RepairResult(name, RepairOutcome.LOST, reason)
        budget = message.frame.budget.model_dump()
        notes = {"budget": budget}
        report = remake_state(
            spec.rig, spec.settings, history, message.base, frame, budget, dropped=dropped, notes=notes
        )
        return RepairResult(name, RepairOutcome.RECOMPUTED, report=report)
    except Exception as error:  # whatever the core raises, the service goes on and says so
        log.exception("scene %s, frame %d cannot be made again", spec.folder.name, index)
        return RepairResult(name, RepairOutcome.NO_ROOM if no_room(error) else RepairOutcome.LOST, message_of(error))
