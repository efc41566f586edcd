"""Repair of damaged state files in the worker process, from memory, copies or images."""

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


def repair_at_start(history: History) -> list[str]:
    """Rewrites damaged files that every frame needs, and damaged copies of these files.

    Returns:
        One message per rewritten file.
    """
    try:
        mended = history.repair_fixed()
    except OSError as error:  # the states stay readable, so an unwritable disk must not prevent startup
        log.warning("cannot repair a file that every frame needs: %s", error)
        return []
    history.pop_faults()  # these files were just rewritten or are listed in `History.damaged`
    return [f"{reason}; it was restored from its copy" for reason in mended.values()]


def repair_files(
    history: History, reconstruction: Reconstruction | None, message: RepairFiles
) -> Iterator[RepairResult]:
    """Checks each file and, if the file is damaged, rewrites it with identical content if possible.

    Yields one result per file.
    """
    assert history.files is not None
    for name in message.names:
        try:
            outcome, reason = _repair_file(history, history.files, reconstruction, name, message)
        except Exception as error:
            log.exception("cannot repair %s", name)
            outcome, reason = RepairOutcome.NO_ROOM if no_room(error) else RepairOutcome.DAMAGED, message_of(error)
        yield RepairResult(name, outcome, reason)


def _repair_file(
    history: History, files: FrameFiles, reconstruction: Reconstruction | None, name: str, message: RepairFiles
) -> tuple[RepairOutcome, str]:
    index, known = frame_of(name), history.indices
    fault = fault_of(files.directory / name) if index is None else files.fault(index)
    if fault is None:
        return RepairOutcome.WHOLE, ""
    birth = born_of(name)
    if birth is not None and birth not in history.born_at:  # the frame was rolled back
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
        return _rewrite_with_report(history, files, index, message), fault
    checkpoint = checkpoint_of(name)
    if checkpoint not in known[-NEWEST_KEPT:]:
        return RepairOutcome.GONE, ""
    again = checkpoint is not None and reconstruction is not None and reconstruction.write_checkpoint(checkpoint)
    return (RepairOutcome.WRITTEN if again else RepairOutcome.DAMAGED), fault


def _rewrite_with_report(history: History, files: FrameFiles, index: int, message: RepairFiles) -> RepairOutcome:
    """Rewrites the file of a frame whose report or time is damaged, if its state is intact."""
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
    """Returns the report of a frame, or None if it is damaged or missing."""
    try:
        report: dict[str, Any] = json.loads(files.read(index, ("report",))["report"].tobytes())
    except (ValueError, FileNotFoundError):
        return None
    return report


def recompute_state(
    spec: SceneSpec, history: History, message: RecomputeState, decode: Decode
) -> Iterator[RepairResult]:
    """Recomputes a state from its images and yields the results.

    Damage often affects neighbouring files, so the previous state is checked and repaired first. A
    failure does not affect the running scene.
    """
    index = message.frame.index
    assert history.files is not None
    name = history.files.path(index).name
    base = history.files.path(message.base).name
    if (fault := history.files.fault(message.base)) is not None:
        for mended in repair_files(history, None, RepairFiles((base,), {}, {})):
            yield mended
            match mended.outcome:
                case RepairOutcome.WRITTEN | RepairOutcome.WHOLE | RepairOutcome.REPORT_LOST:
                    continue
                case RepairOutcome.DAMAGED:
                    yield RepairResult(name, RepairOutcome.LATER, fault)
                case RepairOutcome.NO_ROOM:
                    yield RepairResult(name, RepairOutcome.NO_ROOM, mended.reason)
                case _:
                    yield RepairResult(name, RepairOutcome.LOST, "the previous state is missing")
            return
    yield _recompute(spec, history, message, decode)


def _recompute(spec: SceneSpec, history: History, message: RecomputeState, decode: Decode) -> RepairResult:
    from scas4d_core.recompute import recompute as recompute_core  # worker only: keeps the service small

    index = message.frame.index
    assert history.files is not None
    name = history.files.path(index).name
    try:
        frame, dropped = decode()
        if len(frame.images) < spec.minimum_cameras:
            reason = f"only {len(frame.images)} cameras have images, but the minimum is {spec.minimum_cameras}"
            return RepairResult(name, RepairOutcome.LOST, reason)
        notes = {"budget": message.frame.budget.model_dump()}
        budget = message.frame.budget.model_dump(exclude={"keep_up_fps"})
        report = recompute_core(
            spec.rig, spec.settings, history, message.base, frame, budget, dropped=dropped, notes=notes
        )
        return RepairResult(name, RepairOutcome.RECOMPUTED, report=report)
    except Exception as error:  # any error is reported as the outcome and must not stop the worker
        log.exception("scene %s: cannot recompute frame %d", spec.folder.name, index)
        return RepairResult(name, RepairOutcome.NO_ROOM if no_room(error) else RepairOutcome.LOST, message_of(error))
