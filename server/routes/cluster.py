"""Route for the cluster: machines, their scenes, and scenes that wait for resources."""

from __future__ import annotations

import os
import socket

from fastapi import APIRouter, Request, Response

from client.wire import Cluster, Node, RigModel
from server.health.estimate import estimate, machine_mb
from server.peers.clusters import merge_clusters
from server.peers.peers import PROXIED_HEADER, Peers
from server.processes.placement import Placement
from server.routes.access import AllScenes, TheSettings
from server.scene.scenes import Scenes
from server.settings import ServerSettings

router = APIRouter(prefix="/v1/cluster", tags=["service"])


@router.get("")
async def get(request: Request, response: Response, scenes: AllScenes, server: TheSettings) -> Cluster:
    """Returns the machines that run scenes, with the estimated resources reserved for each scene.

    On a cluster with several services, the response covers the scenes of all services. The header X-Unreachable names
    services that do not respond.
    """
    placement: Placement = request.app.state.placement
    peers: Peers | None = request.app.state.peers
    cluster_status = await placement.cluster() or _alone(scenes, server)
    if peers is not None and PROXIED_HEADER not in request.headers:
        others, silent = await peers.clusters()
        cluster_status = merge_clusters(cluster_status, others)
        if silent:
            response.headers["X-Unreachable"] = ", ".join(silent)
    return cluster_status


def _alone(scenes: Scenes, server: ServerSettings) -> Cluster:
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
