"""Routes for a scene's trade-off between accuracy and update time on its machine."""

from __future__ import annotations

from fastapi import APIRouter

from client.wire import ReplayRequest, TradeoffModel
from server.routes.access import TheRecord, TheScene
from server.scene import tradeoff
from server.scene.scene import Scene

router = APIRouter(prefix="/v1/scenes", tags=["budget"])


@router.get("/{id}/tradeoff")
async def get(scene: TheRecord) -> TradeoffModel:
    """Returns pairs of accuracy and time: measured in the newest 64 frames, replayed, or with extrapolated times."""
    return await answer(scene)


@router.post("/{id}/tradeoff", status_code=202)
async def replay(scene: TheScene, request: ReplayRequest | None = None) -> TradeoffModel:
    """Measures other iteration counts by replaying the updates of the newest frames in the background, in memory.

    A scene runs one replay at a time, on one low-priority thread. The scene's own iteration count is also measured, so
    that ratios are comparable. The field `replay` reports the progress.
    """
    scene.replays.start(request or ReplayRequest())
    return await answer(scene)


@router.delete("/{id}/tradeoff")
async def end(scene: TheScene) -> TradeoffModel:
    """Stops a running replay, if any; its measurements are kept."""
    await scene.replays.end()
    return await answer(scene)


async def answer(scene: Scene) -> TradeoffModel:
    """Returns all trade-off points known so far."""
    newest = scene.committed[-tradeoff.NEWEST :]
    frame_reports = [await scene.report(index) for index in newest]
    first = scene.committed[0] if newest else 0
    reports = tradeoff.usable_reports([report for report in frame_reports if report is not None], first)
    write = tradeoff.commit_milliseconds(reports)
    replayed = [
        point.model_copy(update={"milliseconds": point.milliseconds + write})
        for _, point in sorted(scene.replays.points.items())
    ]
    points = [*tradeoff.measured_points(reports), *replayed]
    model = tradeoff.time_model(reports)
    threads = reports[-1].threads if reports else None
    return TradeoffModel(
        scene=scene.id,
        points=[*points, *tradeoff.extrapolated_points(model, points, threads)],
        curve=tradeoff.mean_curves(reports),
        model=model,
        budget=scene.budget().effective,
        replay=scene.replays.status,
    )
