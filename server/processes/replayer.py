"""Replay process, which repeats a scene's latest updates at low priority with different numbers of iterations."""

from __future__ import annotations

import logging
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

from scas4d_core.errors import message_of
from scas4d_core.storage.history import History
from server.messages import DamageFound, ReplayPoint, ReplaySpec, ReplayUpdated
from server.processes.background_job import run_job
from server.processes.decoder import FrameDecoder, read
from server.processes.placement import use_one_thread

THREADS = 1
"""Number of threads used by a replay; the other cores are left to the worker."""

log = logging.getLogger("scas4d.replayer")


def main(spec: ReplaySpec, connection: Connection[Any, Any]) -> None:
    """Entry point of the process: runs one replay; the service stops the process if the result is no longer needed."""

    def explain(error: Exception) -> str:
        log.exception("scene %s: the replay failed", spec.scene.folder.name)
        return f"{type(error).__name__}: {message_of(error)}"

    run_job(partial(_replay, spec, connection), connection, explain)


def _replay(spec: ReplaySpec, connection: Connection[Any, Any]) -> None:
    scene = spec.scene
    # Read everything first, because the scene's retention may delete records and states during the replay.
    decoder = FrameDecoder(scene.rig, scene.folder.frames)
    frames = [partial(decoder.decode_images, message, read(scene.folder.frames, message)) for message in spec.frames]
    history = History.load(scene.folder.states, only=(spec.first, spec.base))
    try:
        for index in (spec.first, spec.base):
            history.gaussians(index)
    finally:
        if faults := history.pop_faults():
            connection.send(DamageFound(faults))
    from scas4d_core.replay import replay  # imported lazily: the service process does not need the core
    from scas4d_core.warm_up import compile_in_processes

    compile_in_processes()

    use_one_thread()
    for iterations in spec.iterations:
        result = replay(
            scene.rig, scene.settings, history, spec.base, frames, iterations, lambda: connection.send(ReplayUpdated())
        )
        connection.send(ReplayPoint(iterations, result.milliseconds, result.error, result.psnr, result.frames))
