"""Registry that lets the services of a cluster find each other.

Each service has an actor that provides its address. Ray ends the actor when the service exits.
"""

from __future__ import annotations

import contextlib
import logging
import socket
from collections.abc import Mapping, Sequence
from typing import Any

import ray
from ray.exceptions import RayError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from server.cluster.nodes import own_machine, own_node
from server.settings import is_loopback

PREFIX = "service."
"""Name prefix of these actors, followed by the identifier of the service."""
ASK_S = 2.0
"""Timeout in seconds for getting the addresses of the other services."""

log = logging.getLogger("scas4d.server")


class ServiceAddress:
    """Actor that reports the address of a service.

    Args:
        url: URL of the service.
        machine: address of the only machine that can reach the service; None if all machines can reach it.
    """

    def __init__(self, url: str, machine: str | None) -> None:
        self._address = url, machine

    def get(self) -> tuple[str, str | None]:
        """Returns the URL of the service and `machine`."""
        return self._address


def register_service(word: str, host: str, port: int) -> Any:
    """Announces this service and returns its actor, which ends with this process. Blocks.

    Args:
        word: identifier of this service.
        host: listening host; a wildcard address is announced as the address of this machine.
        port: listening port.
    """
    machine = own_machine()
    if host in ("0.0.0.0", "::", ""):
        host = machine
    elif is_loopback(host):
        log.warning(
            "other machines in the cluster cannot reach this service at %s; set a reachable address with --host", host
        )
    url = f"http://{_authority(host, port)}"
    made: Any = ray.remote(ServiceAddress)
    here = NodeAffinitySchedulingStrategy(own_node(), soft=True)
    actor = made.options(name=PREFIX + word, num_cpus=0, max_restarts=-1, scheduling_strategy=here)
    return actor.remote(url, machine if is_loopback(host) else None)


def _authority(host: str, port: int) -> str:
    """Returns `host:port` with a numeric address, because services refuse unknown host names."""
    addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    number = str(addresses[0][4][0])
    return f"[{number}]:{port}" if ":" in number else f"{number}:{port}"


def peer_addresses(word: str, known: Mapping[str, str] | None) -> dict[str, str]:
    """Returns the addresses of the other services, keyed by the names of their actors. Blocks.

    For a service that does not respond because it is starting or stopping, the name of its actor is used as a
    placeholder. Requests to a placeholder always fail.

    Args:
        word: identifier of this service.
        known: previous result, which is returned again if Ray does not respond.

    Raises:
        RuntimeError: Ray does not respond, and `known` is None.
    """
    try:
        names = [name for name in ray.util.list_named_actors() if name.startswith(PREFIX) and name != PREFIX + word]
        machine = own_machine()
    except (RayError, RuntimeError, ConnectionError) as error:
        if known is None:
            raise RuntimeError(f"cannot get the list of services from the head node: {error}") from error
        log.warning("cannot get the list of services from the head node: %s", error)
        return dict(known)
    before = {name: url for name, url in (known or {}).items() if name in names and url != name}
    asked = _fetch_addresses([name for name in names if name not in before])
    return before | {name: url for name, (url, only) in asked.items() if only in (None, machine)}


def _fetch_addresses(names: Sequence[str]) -> dict[str, tuple[str, str | None]]:
    """Returns the URL of each service and the only machine that can reach it, keyed by actor name.

    If a service does not respond, the name of its actor replaces the URL.
    """
    addresses: dict[str, tuple[str, str | None]] = {name: (name, None) for name in names}
    asked: dict[Any, str] = {}
    for name in names:
        with contextlib.suppress(ValueError, RayError):  # the actor has ended in the meantime
            actor: Any = ray.get_actor(name)
            asked[actor.get.remote()] = name
    for answer in ray.wait(list(asked), num_returns=len(asked), timeout=ASK_S)[0] if asked else ():
        try:
            addresses[asked[answer]] = ray.get(answer)
        except RayError as error:  # the service is starting or stopping
            log.info("cannot get the address of service %s: %s", asked[answer], error)
    return addresses
