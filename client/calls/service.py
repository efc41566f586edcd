"""The service itself: is it there?"""

from __future__ import annotations

from client.calls.call import Call, reads
from client.wire import Health, Ticket


def live() -> Call[Health]:
    """Does the process answer?

    >>> client.live().status
    'live'
    """
    return Call("GET", "/health/live", reads(Health))


def ready() -> Call[Health]:
    """Does the service take scenes?

    >>> client.ready().status
    'ready'
    """
    return Call("GET", "/health/ready", reads(Health))


def metrics() -> Call[str]:
    """Counters and gauges in the text format of Prometheus.

    >>> client.metrics().startswith("# HELP")
    True
    """
    return Call("GET", "/metrics", lambda response: response.text)


def ticket() -> Call[Ticket]:
    """A ticket that opens one WebSocket from a browser, which cannot send the token. Each call makes another.

    >>> client.ticket().ticket != client.ticket().ticket
    True
    """
    return Call("POST", "/v1/tickets", reads(Ticket))
