"""Guard of the service's connections, which closes connections that exceed a limit.

There are limits on times, on the number of connections, and on unread responses. Connections need
no timers of their own, because a sweep checks all of them about once per second.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass

from server.connections.open_connection import KINDS, PROGRESS_BYTES, Handler, OpenConnection, Peer, Phase
from server.connections.process_limits import unread_bytes
from server.connections.refusals import Refusal
from server.counters import CONNECTIONS_REFUSED
from server.settings import ServerSettings

HEADER_LINES = 100
"""Maximum number of header lines; requests with more get 431.

Browsers send about twenty, proxies add about ten, and WebSockets accept at most 128.
"""

SWEEP_S = 1.0
"""Maximum interval in seconds between sweeps."""
LINGER_S = 5.0
"""Time limit in seconds for each `PROGRESS_BYTES` of a body that is being discarded."""
LINGER_LONGEST_S = 60.0
"""Maximum time in seconds to read and discard a body."""
LINGER_BYTES = 64 << 20
"""Maximum number of bytes of a body to read and discard after the response.

Closing the connection immediately would reset it, and the sender would lose the response.
"""
REFUSED_S = 2.0
"""Time in seconds for which data from a refused connection is read and discarded."""
REFUSED_AT_ONCE = 64
"""Maximum number of refused connections that wait for their peer to read the response; the oldest are aborted."""
CLOSING_SOCKET_S = 5.0
"""Time in seconds after which a closing WebSocket is aborted if its peer does not read."""
QUIET_S = 2.0
"""Time in seconds without data after which an upload may be closed to make room for a new connection."""
SUMMARY_S = 10.0
"""Minimum interval in seconds between log lines about refused connections; one line per refusal would flood the log."""

log = logging.getLogger("scas4d.server")

for refusal in Refusal:  # exports reasons that have not occurred yet as 0
    CONNECTIONS_REFUSED.labels(refusal.value)


@dataclass(frozen=True)
class ConnectionLimits:
    """Limits on connections.

    Attributes:
        header_seconds: time limit in seconds for sending a header.
        header_bytes: maximum size of a header in bytes.
        body_seconds: time limit in seconds for each `PROGRESS_BYTES` of a body.
        keep_alive_seconds: time in seconds until an idle connection is closed.
        unread_seconds: time limit in seconds for a peer to read `PROGRESS_BYTES`.
        connections: maximum number of connections in total.
        per_peer: maximum number of connections per peer.
        proxies: networks of the trusted proxies.
    """

    header_seconds: float
    header_bytes: int
    body_seconds: float
    keep_alive_seconds: float
    unread_seconds: float
    connections: int
    per_peer: int
    proxies: tuple[ipaddress.IPv4Network | ipaddress.IPv6Network, ...]

    @classmethod
    def of(cls, settings: ServerSettings) -> ConnectionLimits:
        """Returns the limits defined by the service settings."""
        return cls(
            header_seconds=settings.header_seconds,
            header_bytes=settings.header_kb << 10,
            body_seconds=settings.body_seconds,
            keep_alive_seconds=settings.keep_alive_seconds,
            unread_seconds=settings.unread_seconds,
            connections=settings.max_connections,
            per_peer=settings.max_connections_per_peer,
            proxies=tuple(map(ipaddress.ip_network, settings.trusted_proxies)),
        )

    def of_refusal(self, refusal: Refusal) -> float:
        """Returns the limit that caused a refusal, in the unit of its setting; 0 if there is none."""
        return {
            Refusal.HEAD_SIZE: self.header_bytes / 1024,
            Refusal.URL_SIZE: self.header_bytes / 1024,
            Refusal.HEAD_LINES: HEADER_LINES,
            Refusal.HEAD_TIME: self.header_seconds,
            Refusal.BODY_TIME: self.body_seconds,
            Refusal.PEER_CONNECTIONS: self.per_peer,
            Refusal.CLIENT_REQUESTS: self.per_peer,
            Refusal.CONNECTIONS: self.connections,
        }.get(refusal, 0)

    def is_proxy(self, address: str) -> bool:
        """Returns whether the address belongs to a trusted proxy."""
        try:
            parsed = ipaddress.ip_address(address)
        except ValueError:
            return False
        return any(parsed in network for network in self.proxies)


def peer_key(address: str) -> str:
    """Returns the key used to count a peer's connections.

    For an IPv6 address, this is its /64 network, which typically belongs to one customer.
    """
    try:
        parsed = ipaddress.ip_address(address)
    except ValueError:
        return address
    if isinstance(parsed, ipaddress.IPv4Address):
        return address
    if parsed.ipv4_mapped is not None:
        return str(parsed.ipv4_mapped)
    return f"{ipaddress.IPv6Address(int(parsed) >> 64 << 64)}/64"


class ConnectionGuard:
    """Registry of a service's open connections, with the sweep that enforces their limits."""

    def __init__(self, limits: ConnectionLimits) -> None:
        self.limits = limits
        self._records: dict[asyncio.BaseTransport, OpenConnection] = {}
        self._peers: dict[str, Peer] = {}
        self._counted = self._bodies = 0
        self._refused: dict[OpenConnection, None] = {}
        self._pending: Counter[str] = Counter()
        self._logged = float("-inf")
        self._timer: asyncio.TimerHandle | None = None
        self._swept = 0.0
        shortest = min(limits.header_seconds, limits.body_seconds, limits.keep_alive_seconds, limits.unread_seconds)
        self._every = min(SWEEP_S, shortest / 4)

    def admit(
        self, handler: Handler, transport: asyncio.Transport, loop: asyncio.AbstractEventLoop, address: str
    ) -> tuple[OpenConnection, Refusal | None]:
        """Registers a new connection.

        If a limit is reached, the new connection replaces an inactive one, so that an idle peer
        does not block a peer with a request. A connection is inactive if it has not sent a complete
        header, is idle, or has stopped sending its body. At the limit on all connections, the
        connection of any peer may be replaced, because an attacker with many addresses has few
        connections per address.

        Returns:
            The record of the connection, and the reason if the connection must be refused.
        """
        now = loop.time()
        proxy = self.limits.is_proxy(address)
        key = address if proxy else peer_key(address)  # other addresses in the network of a proxy are not proxies
        peer = self._peers.get(key)
        if peer is None:
            peer = self._peers[key] = Peer(key, proxy)
        refusal = None
        if not proxy and peer.count >= self.limits.per_peer and not self._evict([peer], now):
            refusal = Refusal.PEER_CONNECTIONS
        elif self._counted >= self.limits.connections and not self._evict(self._peers.values(), now):
            refusal = Refusal.CONNECTIONS
        record = self._records[transport] = OpenConnection(handler, transport, peer, now, now)
        self._peers[key] = peer  # it was removed if its last connection was evicted
        peer.count += 1
        self._counted += 1
        self.set_phase(record, Phase.NEW, now)
        if self._timer is None:
            self._swept = now
            self._timer = loop.call_later(self._every, self._sweep, loop)
        return record, refusal

    def set_phase(self, record: OpenConnection, phase: Phase, now: float) -> None:
        """Sets the phase of a connection, which begins at `now` (loop time)."""
        if record.closed:
            return
        record.phase, record.since, record.entered, record.body, record.dropped = phase, now, now, 0, 0
        queue = None
        if phase in (Phase.NEW, Phase.HEAD, Phase.IDLE):
            queue = record.peer.idle if record.served else record.peer.strangers
        elif phase in (Phase.BODY, Phase.LINGER):
            queue = record.peer.bodies
        if queue is not record.queue:
            self._unqueue(record)
            if queue is not None:
                queue[record] = None
                self._bodies += queue is record.peer.bodies
            record.queue = queue
        if phase is Phase.BODY:
            record.moved = False
            self._make_room_for_headers(record)
        elif phase is Phase.REFUSED:
            self._stop_counting(record)
            self._refused[record] = None
            if len(self._refused) > REFUSED_AT_ONCE:
                oldest = next(iter(self._refused))
                del self._refused[oldest]
                oldest.transport.abort()

    def upgrade(self, transport: asyncio.BaseTransport, handler: Handler, now: float) -> OpenConnection:
        """Marks a connection as a WebSocket and returns its record."""
        record = self._records[transport]
        record.handler = handler
        self.set_phase(record, Phase.SOCKET, now)
        return record

    def remove(self, record: OpenConnection) -> None:
        """Removes the record of a closed connection."""
        record.closed = True
        self._records.pop(record.transport, None)
        self._unqueue(record)
        self._refused.pop(record, None)
        self._stop_counting(record)

    def count_refusal(self, refusal: Refusal) -> None:
        """Counts a refusal, which the sweep includes in its log message."""
        CONNECTIONS_REFUSED.labels(refusal.value).inc()
        self._pending[refusal.value] += 1

    def counts(self) -> dict[str, int]:
        """Returns the number of open connections of each kind."""
        totals = dict.fromkeys(KINDS.values(), 0)
        for record in self._records.values():
            totals[KINDS[record.phase]] += 1
        return totals

    def _unqueue(self, record: OpenConnection) -> None:
        if record.queue is not None:
            del record.queue[record]
            self._bodies -= record.queue is record.peer.bodies
            record.queue = None

    def _make_room_for_headers(self, new: OpenConnection) -> None:
        """Closes the oldest upload without progress if uploads occupy more than half of a limit.

        Stalled uploads cannot be distinguished immediately from new ones. Uploads without progress
        are therefore limited to about half of the limit. The other half consists of connections
        that can be replaced immediately, so a client with a request can connect at any time.
        """
        peers: Iterable[Peer] = [new.peer]
        if new.peer.proxy or 2 * len(new.peer.bodies) <= self.limits.per_peer:
            if 2 * self._bodies <= self.limits.connections:
                return
            peers = self._peers.values()
        begun = (
            [
                other
                for other in peer.bodies
                if other is not new and other.is_begun and not other.handler.waiting_for_service
            ]
            for peer in peers
        )
        most = max(begun, key=len, default=[])
        if most:
            self._end(most[0], new.since)

    def _end(self, record: OpenConnection, now: float) -> None:
        """Aborts a connection without a response, to make room for another."""
        self.count_refusal(Refusal.DISPLACED)
        self.set_phase(record, Phase.REFUSED, now)
        record.transport.abort()

    def _stop_counting(self, record: OpenConnection) -> None:
        """Stops counting a connection towards the limits, because it was refused or closed."""
        if not record.counted:
            return
        record.counted = False
        self._counted -= 1
        peer = record.peer
        peer.count -= 1
        if peer.count == 0:
            self._peers.pop(peer.address, None)

    def _evict(self, peers: Collection[Peer], now: float) -> bool:
        """Closes the least important connection of these peers.

        Returns:
            False if all connections are needed, otherwise True.
        """
        for queues in ([peer.strangers for peer in peers], [peer.idle for peer in peers]):
            oldest = [(len(queue), next(iter(queue))) for queue in queues if queue]
            if oldest:
                # Among peers with equally many connections, the longest wait decides, since a new client has a request.
                _, record = max(oldest, key=lambda one: (one[0], -one[1].since))
                self._end(record, now)
                return True
        quiet = [
            record
            for peer in peers
            for record in peer.bodies
            if record.received == 0 and now - record.last_bytes_at > QUIET_S and not record.handler.waiting_for_service
        ]
        if not quiet:
            return False
        self._end(min(quiet, key=lambda record: record.last_bytes_at), now)
        return True

    def _sweep(self, loop: asyncio.AbstractEventLoop) -> None:
        now = loop.time()
        passed, self._swept = now - self._swept, now
        for record in list(self._records.values()):
            if record.received:
                record.received, record.quiet_since = 0, now
            if not self._check_unread(record, now):
                self._check_deadline(record, now, passed)
        if self._pending and now - self._logged >= SUMMARY_S:
            reasons = ", ".join(f"{count} {reason}" for reason, count in self._pending.most_common())
            log.warning("refused connections: %s (see `reason` in docs/operations.md)", reasons)
            self._pending.clear()
            self._logged = now
        go_on = bool(self._records or self._pending)
        self._timer = loop.call_later(self._every, self._sweep, loop) if go_on else None

    def _check_deadline(self, record: OpenConnection, now: float, passed: float) -> None:
        """Closes a connection that has exceeded the deadline of its phase."""
        limits, phase = self.limits, record.phase
        if phase is Phase.REFUSED:
            if now - record.since > REFUSED_S:
                record.transport.abort()
            return
        if phase in (Phase.ANSWER, Phase.SOCKET) or record.transport.is_closing():
            return
        if record.handler.waiting_for_service:
            record.since += passed
            return
        waited = now - record.since
        match phase:
            case Phase.NEW if waited > limits.header_seconds:
                record.transport.close()
            case Phase.IDLE if waited > limits.keep_alive_seconds:
                record.transport.close()
            case Phase.HEAD if waited > limits.header_seconds:
                record.handler.refuse(Refusal.HEAD_TIME)
            case Phase.LINGER if now - record.entered > LINGER_LONGEST_S or record.body > LINGER_BYTES:
                record.transport.close()
            case Phase.LINGER if record.body - record.dropped >= PROGRESS_BYTES:
                record.since, record.dropped = now, record.body
            case Phase.LINGER if waited > LINGER_S:
                record.transport.close()
            case Phase.BODY if record.body >= PROGRESS_BYTES:
                record.since, record.body = now, 0
            case Phase.BODY if waited > limits.body_seconds:
                record.handler.refuse(Refusal.BODY_TIME)

    def _check_unread(self, record: OpenConnection, now: float) -> bool:
        """Aborts a connection whose peer does not read the response; returns whether it was aborted.

        Only connections that are closing or whose writing is paused are checked. Nothing is being written to them, so
        a decrease in unread bytes means that the peer has read them.
        """
        closing = record.transport.is_closing()
        size = unread_bytes(record.transport) if closing or record.write_paused else 0
        if size == 0:
            record.unsent = 0
            return False
        if record.unsent == 0:
            record.unsent, record.unsent_since, record.sent = size, now, 0
            return False
        record.sent += max(0, record.unsent - size)
        record.unsent = size
        if record.sent >= PROGRESS_BYTES:
            record.unsent_since, record.sent = now, 0
        limit = self.limits.unread_seconds
        if closing and record.phase is Phase.SOCKET:
            limit = min(limit, CLOSING_SOCKET_S)
        if now - record.unsent_since <= limit:
            return False
        self.count_refusal(Refusal.UNREAD)
        record.transport.abort()
        return True
