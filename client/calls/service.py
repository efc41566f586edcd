"""Calls on the service itself: health, metrics, tickets."""

from __future__ import annotations

from client.calls.call import Call, body, json_reader
from client.wire import Cluster, Health, Share, ShareRequest, Ticket


def live() -> Call[Health]:
    """Reads whether the process answers.

    >>> client.live().status
    'live'
    """
    return Call("GET", "/health/live", json_reader(Health))


def ready() -> Call[Health]:
    """Reads whether the service takes scenes; an error while it does not.

    >>> client.ready().status
    'ready'
    """
    return Call("GET", "/health/ready", json_reader(Health))


def ingest_ready() -> Call[Health]:
    """Reads whether frames can be taken; an error while scenes are recovered or the disk has no room.

    >>> client.ingest_ready().ingest_ready
    True
    """
    return Call("GET", "/health/ingest", json_reader(Health))


def cluster() -> Call[Cluster]:
    """Reads on which machines scenes run, and what waits for room.

    >>> [node.alive for node in client.cluster().nodes]
    [True]
    """
    return Call("GET", "/v1/cluster", json_reader(Cluster))


def metrics() -> Call[str]:
    """Reads counters and gauges in the text format of Prometheus.

    >>> client.metrics().startswith("# HELP")
    True
    """
    return Call("GET", "/metrics", lambda response: response.text)


def ticket() -> Call[Ticket]:
    """Makes a ticket that opens one WebSocket from a browser, which cannot send the token.

    >>> client.ticket().ticket != client.ticket().ticket
    True
    """
    return Call("POST", "/v1/tickets", json_reader(Ticket))


def share(scene: str | None = None, seconds: int = 7 * 86_400) -> Call[Share]:
    """Makes a token that may only read one scene, or all, and the page's address that has it.

    The service has to have a token itself, else everybody may do everything.

    >>> client.share(scene)  # doctest: +IGNORE_EXCEPTION_DETAIL
    Traceback (most recent call last):
    client.errors.Conflict: 409: the service has no token
    """
    request = ShareRequest(scene=scene, seconds=seconds)
    return Call("POST", "/v1/shares", json_reader(Share), repeatable=False, arguments=body(request))
