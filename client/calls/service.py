"""Calls for the service itself: health, cluster, metrics, tickets and share links."""

from __future__ import annotations

from client.calls.call import Call, body, json_reader
from client.wire import Cluster, Health, Share, ShareRequest, Ticket


def live() -> Call[Health]:
    """Returns the health of the service process; succeeds as long as the process responds.

    >>> client.live().status
    'live'
    """
    return Call("GET", "/health/live", json_reader(Health))


def ready() -> Call[Health]:
    """Returns the health of the service if it is ready for scenes; otherwise raises an error.

    >>> client.ready().status
    'ready'
    """
    return Call("GET", "/health/ready", json_reader(Health))


def ingest_ready() -> Call[Health]:
    """Returns the health of the service if it accepts frames; raises an error during recovery or if the disk is full.

    >>> client.ingest_ready().ingest_ready
    True
    """
    return Call("GET", "/health/ingest", json_reader(Health))


def cluster() -> Call[Cluster]:
    """Returns the machines on which scenes run, and the scenes waiting for resources.

    >>> [node.alive for node in client.cluster().nodes]
    [True]
    """
    return Call("GET", "/v1/cluster", json_reader(Cluster))


def metrics() -> Call[str]:
    """Returns counters, histograms and gauges in the Prometheus text format.

    >>> client.metrics().startswith("# HELP")
    True
    """
    return Call("GET", "/metrics", lambda response: response.text)


def ticket() -> Call[Ticket]:
    """Returns a ticket for opening one WebSocket from a browser, where the token cannot be sent as a header.

    >>> client.ticket().ticket != client.ticket().ticket
    True
    """
    return Call("POST", "/v1/tickets", json_reader(Ticket))


def share(scene: str | None = None, seconds: int = 7 * 86_400) -> Call[Share]:
    """Returns a read-only token for one scene or for all scenes, and a viewer URL that contains it.

    The service itself must be protected by a token; otherwise, access is unrestricted anyway.

    >>> client.share(scene)  # doctest: +IGNORE_EXCEPTION_DETAIL
    Traceback (most recent call last):
    client.errors.Conflict: 409: the service has no token
    """
    request = ShareRequest(scene=scene, seconds=seconds)
    return Call("POST", "/v1/shares", json_reader(Share), repeatable=False, arguments=body(request))
