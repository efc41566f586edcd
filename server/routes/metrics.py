"""Route for the Prometheus metrics."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.responses import PlainTextResponse, Response
from prometheus_client import CollectorRegistry
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4, generate_latest

from server.counters import registry
from server.health.metrics import ServiceState
from server.health.readiness import Readiness
from server.routes.access import AllScenes, TheSettings

router = APIRouter(tags=["service"])


@router.get("/metrics", response_class=PlainTextResponse)
async def metrics(request: Request, scenes: AllScenes, settings: TheSettings) -> Response:
    """Returns counters, histograms and gauges in the Prometheus text format."""
    readiness: Readiness = request.app.state.readiness
    gauges = CollectorRegistry()
    state, guard = request.app.state, request.app.state.guard
    cluster = await scenes.placement.cluster()
    service_state = ServiceState(
        settings, scenes.statuses(), state.hub.count(), readiness.after, guard.counts(), cluster
    )
    gauges.register(service_state)
    text = generate_latest(registry) + generate_latest(gauges)
    return Response(text, media_type=CONTENT_TYPE_PLAIN_0_0_4)
