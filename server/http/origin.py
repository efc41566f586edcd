"""Checks of Host and Origin: no page of another site uses the service.

Any web page can send requests to a server on the loopback of the machine that shows it. Two headers, which no page can
forge, show it: `Origin` (and `Sec-Fetch-Site`, where a picture or a form leaves Origin out) names the page that asks;
`Host` is the name under which the service was found, and a name that is not ours was pointed at this machine (DNS
rebinding), which makes the foreign page look like one of the service itself.
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
    """Checks Host and Origin of a request.

    Args:
        scope: of ASGI, http or websocket.
        allowed_hosts: names (`host` or `host:port`) besides the loopback's and the address that was connected to.
        allowed_origins: of other sites, `scheme://host[:port]`.

    Raises:
        Problem: 400 without a Host that can be read, 421 for a Host that is not ours, 403 for a foreign page.
    """
    headers = Headers(scope=scope)
    host = _the_host(headers)
    if not _is_ours(scope, host, allowed_hosts):
        raise Problem(
            421,
            "the service does not go by this name",
            field="Host",
            value=host,
            remedy="address it as 127.0.0.1 or localhost, or add the name to SCAS4D_ALLOWED_HOSTS",
        )
    origin = headers.get("origin")
    if origin is not None:
        if not (_same(origin, host) or origin.lower() in {name.lower() for name in allowed_origins}):
            raise _foreign("Origin", origin)
        return
    site = headers.get("sec-fetch-site", "none")
    opened = headers.get("sec-fetch-mode") == "navigate" and scope.get("method") in ("GET", "HEAD")
    framed = headers.get("sec-fetch-dest", "document") != "document"
    if site not in ("none", "same-origin") and (not opened or framed):
        raise _foreign("Sec-Fetch-Site", site)


def _foreign(field: str, value: str) -> Problem:
    return Problem(
        403,
        "pages of other sites may not use the service",
        field=field,
        value=value,
        remedy="use the service's own page, or add the site to SCAS4D_ALLOWED_ORIGINS",
    )


def _the_host(headers: Headers) -> str:
    hosts = headers.getlist("host")
    if len(hosts) != 1 or split(hosts[0]) is None:
        raise Problem(
            400,
            "a request has one Host header, host or host:port",
            field="Host",
            value=", ".join(hosts),
            remedy="send the address that you connect to",
        )
    return hosts[0]


def split(authority: str) -> tuple[str, int | None] | None:
    """Splits `host[:port]` into host (lower case, IPv6 without brackets, no final dot) and port, if it can."""
    try:
        parts = urlsplit(f"//{authority}")
        host, port = parts.hostname, parts.port
    except ValueError:
        return None
    if not host or parts.netloc != authority or parts.username is not None or parts.path or parts.query:
        return None
    return host.rstrip("."), port


def _is_ours(scope: Scope, authority: str, allowed: Sequence[str]) -> bool:
    origin = split(authority)
    assert origin is not None
    host, port = origin
    if is_loopback(host) or (scope.get("server") and _is_address(host) and host == scope["server"][0]):
        return True
    return any(other is not None and other[0] == host and other[1] in (None, port) for other in map(split, allowed))


def _is_address(host: str) -> bool:
    try:
        return bool(ipaddress.ip_address(host))
    except ValueError:
        return False


def _same(origin: str, authority: str) -> bool:
    """Returns True if the page comes from the request's host and port; a proxy with TLS changes the scheme."""
    scheme, _, rest = origin.partition("://")
    page, asked = split(rest), split(authority)
    default = DEFAULT_PORTS.get(scheme.lower())
    if page is None or asked is None or default is None:
        return False
    return (page[0], page[1] or default) == (asked[0], asked[1] or default)
