"""Services of one cluster find one another: each has an actor with its address, which Ray ends with the service."""

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
"""Begins the names of these actors; the service's word follows."""
ASK_S = 2.0

log = logging.getLogger("scas4d.server")


class Address:
    """The actor: it reports where the service listens, and the only machine that can reach it, or None."""

    def __init__(self, url: str, machine: str | None) -> None:
        self._told = url, machine

    def get(self) -> tuple[str, str | None]:
        """Returns both."""
        return self._told


def announced(word: str, host: str, port: int) -> Any:
    """Announces this service; returns the actor, which goes with this process. Blocking.

    Args:
        word: of this service. host, port: it listens there; a wildcard address is announced as this machine's.
    """
    machine = own_machine()
    if host in ("0.0.0.0", "::", ""):
        host = machine
    elif is_loopback(host):
        log.warning("other machines of the cluster cannot reach this service at %s; give it an address: --host", host)
    url = f"http://{_authority(host, port)}"
    made: Any = ray.remote(Address)
    here = NodeAffinitySchedulingStrategy(own_node(), soft=True)
    actor = made.options(name=PREFIX + word, num_cpus=0, max_restarts=-1, scheduling_strategy=here)
    return actor.remote(url, machine if is_loopback(host) else None)


def _authority(host: str, port: int) -> str:
    """The numbers of an address: a service refuses names that it does not know."""
    addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    number = str(addresses[0][4][0])
    return f"[{number}]:{port}" if ":" in number else f"{number}:{port}"


def others(word: str, known: Mapping[str, str] | None) -> dict[str, str]:
    """Returns the addresses of the other services by the names of their actors. Blocking.

    One that does not answer, while it begins or ends, has its name in place of an address, which nobody answers.

    Args:
        word: of this service. known: what was returned before; returned again where Ray does not say.

    Raises:
        RuntimeError: Ray does not say, and nothing is known.
    """
    try:
        names = [name for name in ray.util.list_named_actors() if name.startswith(PREFIX) and name != PREFIX + word]
        machine = own_machine()
    except (RayError, RuntimeError, ConnectionError) as error:
        if known is None:
            raise RuntimeError(f"the head of the cluster does not say which services there are: {error}") from error
        log.warning("the head of the cluster does not say which services there are: %s", error)
        return dict(known)
    before = {name: url for name, url in (known or {}).items() if name in names and url != name}
    asked = _asked([name for name in names if name not in before])
    return before | {name: url for name, (url, only) in asked.items() if only in (None, machine)}


def _asked(names: Sequence[str]) -> dict[str, tuple[str, str | None]]:
    """Asks services for their addresses; one that does not answer has its name as address."""
    addresses: dict[str, tuple[str, str | None]] = {name: (name, None) for name in names}
    asked: dict[Any, str] = {}
    for name in names:
        with contextlib.suppress(ValueError, RayError):  # it has ended meanwhile
            actor: Any = ray.get_actor(name)
            asked[actor.get.remote()] = name
    for answer in ray.wait(list(asked), num_returns=len(asked), timeout=ASK_S)[0] if asked else ():
        try:
            addresses[asked[answer]] = ray.get(answer)
        except RayError as error:  # it ends, or begins
            log.info("service %s does not give its address: %s", asked[answer], error)
    return addresses
