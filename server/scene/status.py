"""Where a scene is, and what it says of itself."""

from __future__ import annotations

from typing import TYPE_CHECKING

from client.wire import FrameState, SceneState, SceneStatus

if TYPE_CHECKING:
    from server.scene.scene import Scene


def state_of(scene: Scene) -> SceneState:
    """Where the scene is; see `SceneStatus`."""
    if scene.ledger.fatal is not None:
        return SceneState.FAILED
    if scene.at_work:
        started = scene.committed or scene.ledger.states_deleted
        return SceneState.UPDATING if started else SceneState.INITIALISING
    if scene.ledger.paused:
        return SceneState.PAUSED
    if scene.error is not None:
        return SceneState.DEGRADED
    if not scene.ledger.frames and not scene.ledger.open:
        return SceneState.AWAITING
    return SceneState.READY


def status_of(scene: Scene) -> SceneStatus:
    """The scene as it is now."""
    ledger = scene.ledger
    return SceneStatus(
        id=scene.id,
        name=scene.request.name,
        state=scene.state,
        error=scene.error,
        progress=scene.progress,
        cameras=list(scene.rig.names),
        has_points=scene.points_sha256 is not None,
        next_frame=ledger.next_frame,
        queued=ledger.unfinished,
        queue_limit=scene.queue_limit,
        committed=len(ledger.committed),
        first_committed=ledger.committed[0] if ledger.committed else None,
        last_committed=ledger.committed[-1] if ledger.committed else None,
        gaussians=scene.gaussians,
        paused=ledger.paused,
        degraded=scene.error is not None and ledger.fatal is None,
        open_frames=sorted(ledger.open),
        set_aside=ledger.counts[FrameState.SET_ASIDE],
        missing=ledger.counts[FrameState.MISSING],
        skipped=ledger.counts[FrameState.SKIPPED],
        worker_deaths=scene.supervision.deaths,
        frames_held=len(scene.held),
        frame_bytes=scene.held.bytes,
        states_deleted=ledger.states_deleted,
        damage=scene.damage.sentences,
        created=scene.created.isoformat(),
        ingest=scene.rules,
        settings=scene.spec.settings.model_dump(mode="json"),
        budget=ledger.budgets[-1][1],
    )
