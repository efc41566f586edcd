"""What a connection may take, from the settings of the service."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass

from server.connections.refusals import Refusal
from server.settings import ServerSettings

HEADER_LINES = 100
"""Lines of a header; more get 431. Proxies add some ten to a browser's twenty; WebSockets take 128 at most."""


@dataclass(frozen=True)
class Limits:
    """The settings of connections; seconds, bytes, counts."""

    header_seconds: float
    header_bytes: int
    body_seconds: float
    keep_alive_seconds: float
    unread_seconds: float
    connections: int
    per_peer: int
    proxies: tuple[ipaddress.IPv4Network | ipaddress.IPv6Network, ...]

    @classmethod
    def of(cls, settings: ServerSettings) -> Limits:
        """Those of a service."""
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
        """The limit that a refusal names, in the unit of its setting."""
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
        """Whether the address is one of the trusted proxies."""
        try:
            found = ipaddress.ip_address(address)
        except ValueError:
            return False
        return any(found in network for network in self.proxies)
