"""Routes for the service itself: health, metrics, cluster, tickets, shares, and estimates of scenes."""

from __future__ import annotations

import asyncio
import os
import shutil
import socket
import time
from datetime import UTC, datetime

from fastapi import APIRouter, Request, Response
from fastapi.responses import PlainTextResponse
from prometheus_client import CollectorRegistry
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4, generate_latest

from client import __version__
from client.wire import Cluster, Health, Node, RigModel, SceneCreate, SceneEstimate, Share, ShareRequest, Ticket
from server.counters import registry
from server.health.estimate import estimate, machine_mb
from server.health.metrics import ServiceState
from server.health.readiness import Readiness
from server.http.permissions import ALL, PERMISSION
from server.http.sharing import Sharing
from server.http.tickets import SUBPROTOCOL, TICKET_SECONDS, Tickets
from server.peers.peers import PROXIED_HEADER, Peers, merge_clusters
from server.problems import Problem
from server.processes.placement import Placement
from server.routes.access import AllScenes, TheSettings
from server.routes.scenes import scene_settings
from server.scene.scenes import Scenes
from server.settings import ServerSettings

router = APIRouter(tags=["service"])

ROOM_MB = 64
"""Free disk space in MB below which the service reports that it is not ready for ingest.

A typical frame takes a few MB, and so does its state. Frames are still accepted until the disk is full.
"""


@router.get("/health/live")
async def live(scenes: AllScenes) -> Health:
    """Returns 200 while the process is running."""
    return Health(status="live", version=__version__, scenes=len(scenes), process=os.getpid())


@router.get("/health/ready")
async def ready(request: Request, scenes: AllScenes, settings: TheSettings) -> Health:
    """Returns 200 once scenes are recovered and kernels compiled, else 503; `ready_after` is the startup time in s.

    A full disk affects only `ingest_ready`: views, tracks and exports keep working.
    """
    scenes.recovering.check()
    readiness: Readiness = request.app.state.readiness
    after = readiness.check()
    missing = await asyncio.to_thread(room_missing, settings)
    return Health(
        status="ready", version=__version__, scenes=len(scenes), ready_after=after, ingest_ready=missing is None
    )


@router.get("/health/ingest")
async def ingest(scenes: AllScenes, settings: TheSettings) -> Health:
    """Returns 200 while frames can be accepted, or 503 if scenes are being recovered or the disk is full."""
    scenes.recovering.check()
    if (missing := await asyncio.to_thread(room_missing, settings)) is not None:
        raise Problem(
            503,
            missing,
            field="SCAS4D_DATA",
            remedy="free space in the service's data folder, or shorten the retention of scenes; reading still works",
            headers={"Retry-After": "30"},
        )
    return Health(status="ready", version=__version__, scenes=len(scenes), ingest_ready=True)


def room_missing(settings: ServerSettings) -> str | None:
    """Returns a message if the data folder's disk has less than `ROOM_MB` MB free, otherwise None. Blocking."""
    free = shutil.disk_usage(settings.data).free / 1e6
    return None if free >= ROOM_MB else f"the disk of the data folder has {free:.0f} MB free; {ROOM_MB} MB are required"


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


@router.get("/v1/cluster")
async def get(request: Request, response: Response, scenes: AllScenes, server: TheSettings) -> Cluster:
    """Returns the machines that run scenes, with the estimated resources reserved for each scene.

    On a cluster with several services, the response covers the scenes of all services. The header X-Unreachable names
    services that do not respond.
    """
    placement: Placement = request.app.state.placement
    peers: Peers | None = request.app.state.peers
    cluster_status = await placement.cluster() or _own_machine(scenes, server)
    if peers is not None and PROXIED_HEADER not in request.headers:
        others, silent = await peers.clusters()
        cluster_status = merge_clusters(cluster_status, others)
        if silent:
            response.headers["X-Unreachable"] = ", ".join(silent)
    return cluster_status


def _own_machine(scenes: Scenes, server: ServerSettings) -> Cluster:
    """Returns a cluster that consists of this machine only."""
    awake = sorted(id for id, scene in scenes.awake.items() if scene.has_place)
    made = [scenes[id].spec for id in awake]
    taken = sum(estimate(RigModel.of(spec.rig), spec.settings, server).memory_mb for spec in made)
    here = Node(
        id="local",
        host=socket.gethostname(),
        alive=True,
        cpus=os.cpu_count() or 1,
        cpus_reserved=len(awake),
        gpus=0,
        memory_mb=round(machine_mb(), 1),
        memory_reserved_mb=round(taken, 1),
        scenes=awake,
    )
    return Cluster(placement="local", nodes=[here], waiting=[])


@router.post("/v1/tickets", status_code=201)
async def issue(request: Request) -> Ticket:
    """Issues a short-lived ticket that opens one WebSocket; the request must include the token."""
    tickets: Tickets = request.app.state.tickets
    ticket = tickets.issue(request.scope.get(PERMISSION, ALL))
    return Ticket(ticket=ticket, subprotocol=SUBPROTOCOL + ticket, seconds=TICKET_SECONDS)


@router.post("/v1/shares", status_code=201)
async def share(request: ShareRequest, scenes: AllScenes, settings: TheSettings, asked: Request) -> Share:
    """Creates a read-only token for one scene or all scenes, and a link that opens the viewer with this token.

    The token cannot be revoked: it expires, or becomes invalid when the token of the service changes.
    """
    secret = settings.secret
    if secret is None:
        raise Problem(
            409,
            "the service has no token: anyone who can reach it has full access",
            field="SCAS4D_TOKEN",
            remedy="start it with SCAS4D_TOKEN; others then need a token or a link",
        )
    if request.scene is not None:
        peers: Peers | None = asked.app.state.peers
        if request.scene in scenes or peers is None or await peers.owner(request.scene) is None:
            scenes.status(request.scene)  # 404 if it does not exist
    end = int(time.time() + request.seconds)
    token = Sharing(secret).issue(request.scene, end)
    shown = f"scene={request.scene}&" if request.scene is not None else ""
    return Share(
        token=token,
        scene=request.scene,
        ends=datetime.fromtimestamp(end, UTC).isoformat(),
        address=f"/#{shown}token={token}",
    )


@router.post("/v1/estimate")
async def of_scene(request: SceneCreate, server: TheSettings) -> SceneEstimate:
    """Estimates the memory and disk usage of a scene without creating it.

    Scenes that exceed the service's limit cannot be created.
    """
    return estimate(request.rig, scene_settings(request), server)
