"""Checks of the Host and Origin headers, which prevent pages of other sites from using the service.

Any web page can send requests to a server on the loopback interface of the machine that displays
the page. Headers that no page can forge reveal such requests. `Origin` is the site of the
requesting page; `Sec-Fetch-Site` serves the same purpose for images and forms, whose requests omit
Origin. `Host` is the name by which the client addresses the service. An unknown name indicates DNS
rebinding, which makes another site's page appear to belong to the service.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.types import Scope

from server.problems import Problem
from server.settings import is_loopback

DEFAULT_PORTS = {"http": 80, "https": 443, "ws": 80, "wss": 443}


def check_origin(scope: Scope, allowed_hosts: Sequence[str], allowed_origins: Sequence[str]) -> None:
    """Checks the Host and Origin headers of a request.

    Args:
        scope: ASGI scope of type http or websocket.
        allowed_hosts: host names (`host` or `host:port`) allowed in addition to loopback names and the server address
            of the connection.
        allowed_origins: origins of other sites that are allowed, as `scheme://host[:port]`.

    Raises:
        Problem: 400 for a missing or invalid Host; 421 for an unknown Host; 403 for a page of another site.
    """
    headers = Headers(scope=scope)
    host = _host(headers)
    if not _is_allowed_host(scope, host, allowed_hosts):
        raise Problem(
            421,
            "the service does not accept this host name",
            field="Host",
            value=host,
            remedy="use 127.0.0.1 or localhost, or add the name to SCAS4D_ALLOWED_HOSTS",
        )
    origin = headers.get("origin")
    if origin is not None:
        if not (_is_same_origin(origin, host) or origin.lower() in {name.lower() for name in allowed_origins}):
            raise _foreign_problem("Origin", origin)
        return
    site = headers.get("sec-fetch-site", "none")
    opened = headers.get("sec-fetch-mode") == "navigate" and scope.get("method") in ("GET", "HEAD")
    framed = headers.get("sec-fetch-dest", "document") != "document"
    if site not in ("none", "same-origin") and (not opened or framed):
        raise _foreign_problem("Sec-Fetch-Site", site)


def _foreign_problem(field: str, value: str) -> Problem:
    return Problem(
        403,
        "requests from pages of other sites are not allowed",
        field=field,
        value=value,
        remedy="use the service's own page, or add the site to SCAS4D_ALLOWED_ORIGINS",
    )


def _host(headers: Headers) -> str:
    hosts = headers.getlist("host")
    if len(hosts) != 1 or split_authority(hosts[0]) is None:
        raise Problem(
            400,
            "a request must have exactly one Host header of the form host or host:port",
            field="Host",
            value=", ".join(hosts),
            remedy="set Host to the address of the service",
        )
    return hosts[0]


def split_authority(authority: str) -> tuple[str, int | None] | None:
    """Splits `host[:port]` into host and port; returns None if it is invalid.

    The host is in lower case, without the brackets of an IPv6 address and without a trailing dot.
    """
    try:
        parts = urlsplit(f"//{authority}")
        host, port = parts.hostname, parts.port
    except ValueError:
        return None
    if not host or parts.netloc != authority or parts.username is not None or parts.path or parts.query:
        return None
    return host.rstrip("."), port


def _is_allowed_host(scope: Scope, authority: str, allowed: Sequence[str]) -> bool:
    origin = split_authority(authority)
    assert origin is not None
    host, port = origin
    if is_loopback(host) or (scope.get("server") and _is_address(host) and host == scope["server"][0]):
        return True
    return any(
        other is not None and other[0] == host and other[1] in (None, port) for other in map(split_authority, allowed)
    )


def _is_address(host: str) -> bool:
    try:
        return bool(ipaddress.ip_address(host))
    except ValueError:
        return False


def _is_same_origin(origin: str, authority: str) -> bool:
    """Returns whether the page has the same host and port as the request.

    The scheme is not compared, because a proxy that terminates TLS changes it.
    """
    scheme, _, rest = origin.partition("://")
    page, asked = split_authority(rest), split_authority(authority)
    default = DEFAULT_PORTS.get(scheme.lower())
    if page is None or asked is None or default is None:
        return False
    return (page[0], page[1] or default) == (asked[0], asked[1] or default)
