"""Ends connections that break the limits: deadlines, caps, and answers that the peer does not read.

A connection costs no timer of its own: one sweep, about once a second, looks at all of them while there are any.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass

from server.connections.process import unread_bytes
from server.connections.record import KINDS, PROGRESS_BYTES, Handler, OpenConnection, Peer, Phase
from server.connections.refusals import Refusal
from server.counters import CONNECTIONS_REFUSED
from server.settings import ServerSettings

HEADER_LINES = 100
"""Lines of a header; more get 431. Proxies add some ten to a browser's twenty; WebSockets take 128 at most."""

SWEEP_S = 1.0
LINGER_S = 5.0
LINGER_LONGEST_S = 60.0
LINGER_BYTES = 64 << 20
"""A body that goes on after its answer is read and dropped while `PROGRESS_BYTES` come in `LINGER_S`, so long in all,
so far: closed at once, the connection would be reset, and the sender would lose the answer."""
REFUSED_S = 2.0
"""A connection that was refused is read and dropped for so long."""
REFUSED_AT_ONCE = 64
"""Refused connections that wait for their peers to read why; the oldest go first."""
CLOSING_SOCKET_S = 5.0
"""A WebSocket that is closed and whose peer reads nothing."""
QUIET_S = 2.0
"""An upload that brought nothing for so long gives way where a cap is reached."""
SUMMARY_S = 10.0
"""Between two lines of the log about refused connections: a line each would be another flood."""

log = logging.getLogger("scas4d.server")

for refusal in Refusal:  # those that never happened count too: as 0
    CONNECTIONS_REFUSED.labels(refusal.value)


@dataclass(frozen=True)
class ConnectionLimits:
    """The limits of connections: seconds, bytes, counts."""

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
        """Takes the limits from the settings of a service."""
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
        """Returns the limit that a refusal names, in the unit of its setting."""
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
        """Returns True if the address is one of the trusted proxies."""
        try:
            parsed = ipaddress.ip_address(address)
        except ValueError:
            return False
        return any(parsed in network for network in self.proxies)


def peer_key(address: str) -> str:
    """Returns the key of a peer's connections: of an IPv6 address its /64, which belongs to one customer."""
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
    """The open connections of one service, its limits, and the sweep that enforces them."""

    def __init__(self, limits: ConnectionLimits) -> None:
        self.limits = limits
        self._records: dict[asyncio.BaseTransport, OpenConnection] = {}
        self._peers: dict[str, Peer] = {}
        self._counted = self._bodies = 0
        self._refused: dict[OpenConnection, None] = {}
        self._pending: Counter[str] = Counter()
        self._told = float("-inf")
        self._timer: asyncio.TimerHandle | None = None
        self._swept = 0.0
        shortest = min(limits.header_seconds, limits.body_seconds, limits.keep_alive_seconds, limits.unread_seconds)
        self._every = min(SWEEP_S, shortest / 4)

    def admit(
        self, handler: Handler, transport: asyncio.Transport, loop: asyncio.AbstractEventLoop, address: str
    ) -> tuple[OpenConnection, Refusal | None]:
        """Takes a new connection: returns its record, and the refusal if it has to be refused.

        Where a cap is reached it takes the place of the oldest connection that has not sent a whole header, is idle, or
        has stopped sending its body: an idle peer must not keep out one that has a request. Where all places are
        taken, any peer's may give way: a peer with many addresses has few connections from each.
        """
        now = loop.time()
        proxy = self.limits.is_proxy(address)
        key = address if proxy else peer_key(address)  # a proxy's neighbours are no proxies
        peer = self._peers.get(key)
        if peer is None:
            peer = self._peers[key] = Peer(key, proxy)
        refusal = None
        if not proxy and peer.count >= self.limits.per_peer and not self._displace([peer], now):
            refusal = Refusal.PEER_CONNECTIONS
        elif self._counted >= self.limits.connections and not self._displace(self._peers.values(), now):
            refusal = Refusal.CONNECTIONS
        record = self._records[transport] = OpenConnection(handler, transport, peer, now, now)
        self._peers[key] = peer  # it went where its last connection gave way
        peer.count += 1
        self._counted += 1
        self.enter(record, Phase.NEW, now)
        if self._timer is None:
            self._swept = now
            self._timer = loop.call_later(self._every, self._sweep, loop)
        return record, refusal

    def enter(self, record: OpenConnection, phase: Phase, now: float) -> None:
        """Notes that a connection is in another phase, from `now` (loop time) on."""
        if record.gone:
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
            self._release(record)
            self._refused[record] = None
            if len(self._refused) > REFUSED_AT_ONCE:
                oldest = next(iter(self._refused))
                del self._refused[oldest]
                oldest.transport.abort()

    def hand_over(self, transport: asyncio.BaseTransport, handler: Handler, now: float) -> OpenConnection:
        """Returns the record of a connection that is a WebSocket from now on."""
        record = self._records[transport]
        record.handler = handler
        self.enter(record, Phase.SOCKET, now)
        return record

    def leave(self, record: OpenConnection) -> None:
        """Forgets a connection that is gone."""
        record.gone = True
        self._records.pop(record.transport, None)
        self._unqueue(record)
        self._refused.pop(record, None)
        self._release(record)

    def refused(self, refusal: Refusal) -> None:
        """Counts a refusal; the sweep logs a summary."""
        CONNECTIONS_REFUSED.labels(refusal.value).inc()
        self._pending[refusal.value] += 1

    def counts(self) -> dict[str, int]:
        """Counts the open connections by kind."""
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
        """Keeps uploads that have brought next to nothing to half of a cap, the oldest go.

        The other half is then of connections that give way at once: who has a request finds a place at any moment, and
        not only when uploads that hang are old enough to be distinguished from those that have just begun.
        """
        peers: Iterable[Peer] = [new.peer]
        if new.peer.proxy or 2 * len(new.peer.bodies) <= self.limits.per_peer:
            if 2 * self._bodies <= self.limits.connections:
                return
            peers = self._peers.values()
        begun = (
            [other for other in peer.bodies if other is not new and other.is_begun and not other.handler.waits_for_us]
            for peer in peers
        )
        most = max(begun, key=len, default=[])
        if most:
            self._end(most[0], new.since)

    def _end(self, record: OpenConnection, now: float) -> None:
        """Ends a connection that gives way, without an answer."""
        self.refused(Refusal.DISPLACED)
        self.enter(record, Phase.REFUSED, now)
        record.transport.abort()

    def _release(self, record: OpenConnection) -> None:
        """Makes room: a connection that is refused or gone does not count."""
        if not record.counted:
            return
        record.counted = False
        self._counted -= 1
        peer = record.peer
        peer.count -= 1
        if peer.count == 0:
            self._peers.pop(peer.address, None)

    def _displace(self, peers: Collection[Peer], now: float) -> bool:
        """Ends the connection of these peers that can be spared best; False where none can."""
        for queues in ([peer.strangers for peer in peers], [peer.idle for peer in peers]):
            oldest = [(len(queue), next(iter(queue))) for queue in queues if queue]
            if oldest:
                # Of many peers with as many it is the one that has waited longest: who has just come has a request.
                _, record = max(oldest, key=lambda one: (one[0], -one[1].since))
                self._end(record, now)
                return True
        quiet = [
            record
            for peer in peers
            for record in peer.bodies
            if record.received == 0 and now - record.last_bytes_at > QUIET_S and not record.handler.waits_for_us
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
            if not self._unread(record, now):
                self._overdue(record, now, passed)
        if self._pending and now - self._told >= SUMMARY_S:
            reasons = ", ".join(f"{count} {reason}" for reason, count in self._pending.most_common())
            log.warning("refused connections: %s (docs/operations.md, `reason`)", reasons)
            self._pending.clear()
            self._told = now
        go_on = bool(self._records or self._pending)
        self._timer = loop.call_later(self._every, self._sweep, loop) if go_on else None

    def _overdue(self, record: OpenConnection, now: float, passed: float) -> None:
        """Ends a connection whose phase has taken too long."""
        limits, phase = self.limits, record.phase
        if phase is Phase.REFUSED:
            if now - record.since > REFUSED_S:
                record.transport.abort()
            return
        if phase in (Phase.ANSWER, Phase.SOCKET) or record.transport.is_closing():
            return
        if record.handler.waits_for_us:
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

    def _unread(self, record: OpenConnection, now: float) -> bool:
        """Ends a connection whose peer does not read what it asked for.

        Only where nothing is written meanwhile, so that what is unread less than before was read: the application
        waits for room, or the connection is being closed.
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
        self.refused(Refusal.UNREAD)
        record.transport.abort()
        return True
