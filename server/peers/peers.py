"""Peers of this service: the other services of the cluster and the scenes that they own."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Iterable, Sequence
from typing import TypeVar

import httpx
from pydantic import BaseModel, ValidationError

from client.wire import Cluster, Node, SceneList, SceneStatus
from server.http.permissions import ALL, Permission
from server.http.sharing import LONGEST_SECONDS, Sharing
from server.problems import Problem

PROXIED_HEADER = "x-scas4d-proxied"
"""Header of a request from one service to another, which must handle the request itself instead of forwarding it."""
FRESH_S = 3.0
"""Time in seconds for which the list of peers, or the fact that no peer owns a scene, is cached."""
LIST_S = 2.0
"""Maximum time in seconds that a request waits for the first list of peers; later requests use the previous list."""
ASK_S = 5.0
"""Timeout in seconds of a request to a peer about its scenes."""
CONNECT_S = 3.0
"""Timeout in seconds of a connection attempt to a peer."""
SILENT_S = 130.0
"""Read timeout in seconds of a forwarded request, longer than the time limit of a query."""
REMEMBERED_S = 600.0
"""Time in seconds within which a lost service is expected to return; clients of its scenes are asked to retry."""
MOST_KNOWN = 100_000
"""Maximum number of scenes whose owner is cached."""
MOST_UNKNOWN = 1_000
"""Maximum number of unknown scene ids that are cached, so that repeated requests for them do not reach every peer."""

T = TypeVar("T")
M = TypeVar("M", bound=BaseModel)

log = logging.getLogger("scas4d.server")


class Peers:
    """Other services of the cluster and the scenes that they own. Use it only on the event loop.

    Args:
        listed: function, possibly slow, that returns the addresses of the peers, such as `http://10.0.0.2:8000`.
        secret: token shared by all services in the cluster; None if there is no token.
        client: HTTP client; None creates one.

    Attributes:
        client: HTTP client that forwards requests.
    """

    def __init__(
        self,
        listed: Callable[[], Awaitable[Sequence[str]]],
        secret: str | None,
        client: httpx.AsyncClient | None = None,
    ) -> None:
        self._list_addresses = listed
        self._secret = secret
        limits = httpx.Limits(max_connections=None, max_keepalive_connections=64)
        timeout = httpx.Timeout(SILENT_S, connect=CONNECT_S)
        self.client = client or httpx.AsyncClient(timeout=timeout, limits=limits, trust_env=False)
        self._addresses: Sequence[str] | None = None
        self._asked = -FRESH_S
        self._listing: asyncio.Task[None] | None = None
        self._owners: OrderedDict[str, str] = OrderedDict()
        """Address of the owner of each known scene, keyed by scene id."""
        self._seen: dict[str, float] = {}
        """Time at which each address was last in the list of peers."""
        self._unknown: OrderedDict[str, float] = OrderedDict()
        self._refusing: set[str] = set()
        """Addresses of peers that reject the token."""
        self._checked: OrderedDict[str, float] = OrderedDict()

    async def close(self) -> None:
        """Closes the connections to peers."""
        if self._listing is not None:
            self._listing.cancel()
        await self.client.aclose()

    async def addresses(self) -> Sequence[str]:
        """Returns the latest known addresses of the peers.

        Outdated addresses are refreshed in the background. If no addresses are known yet, the
        method waits for them, up to `LIST_S`.
        """
        if self._listing is None and time.monotonic() - self._asked >= FRESH_S:
            self._listing = asyncio.get_running_loop().create_task(self._list())
        if self._listing is not None:
            await asyncio.wait({self._listing}, timeout=LIST_S if self._addresses is None else 0)
        return self._addresses or ()

    async def _list(self) -> None:
        try:
            before, self._addresses = self._addresses or (), await self._list_addresses()
            now = time.monotonic()
            seen = {address: when for address, when in self._seen.items() if now - when < REMEMBERED_S}
            self._seen = seen | dict.fromkeys((*before, *self._addresses), now)  # previous ones were listed until now
        except Exception:  # the head node does not respond, or its response is unexpected
            log.exception("cannot list the peers; using the previous list")
        finally:
            self._asked, self._listing = time.monotonic(), None

    def headers(self, permission: Permission) -> dict[str, str]:
        """Returns the headers of a request to a peer on behalf of a client with this permission."""
        forwarded = {PROXIED_HEADER: "1"}
        if self._secret is not None:
            forwarded["authorization"] = f"Bearer {_bearer(permission, self._secret)}"
        return forwarded

    async def owner(self, scene: str) -> str | None:
        """Returns the address of the peer that owns a scene, or None if no peer owns it.

        Raises:
            Problem: 503 if the previous owner, or a peer that may be the owner, does not respond.
        """
        peers, now = await self.addresses(), time.monotonic()
        known = self._owners.get(scene)
        if known in peers:
            return known
        if self._addresses is None:  # the peers have not been listed yet
            raise unreachable_problem(scene)
        if now - self._unknown.get(scene, -FRESH_S) < FRESH_S:
            return None
        answers = await asyncio.gather(*(self._has(address, scene) for address in peers))
        for address, has in zip(peers, answers, strict=True):
            if has:
                _remember(self._owners, scene, address, MOST_KNOWN)
                return address
        if None in answers or (known in self._seen and now - self._seen[known] < REMEMBERED_S):
            raise unreachable_problem(scene, refused=not self._refusing.isdisjoint(peers))
        self.forget(scene)
        _remember(self._unknown, scene, now, MOST_UNKNOWN)
        return None

    def forget(self, scene: str) -> None:
        """Forgets the recorded owner of a scene, because that peer no longer owns the scene."""
        self._owners.pop(scene, None)

    async def check(self, owner: str, scene: str) -> None:
        """Asks the owner of a scene whether it still owns the scene, and forgets the owner if it does not.

        The owner is asked at most once per `FRESH_S`.
        """
        now = time.monotonic()
        if now - self._checked.get(scene, -FRESH_S) >= FRESH_S:
            _remember(self._checked, scene, now, MOST_UNKNOWN)
            if await self._has(owner, scene) is False:
                self.forget(scene)

    async def scenes(self, permission: Permission) -> tuple[list[SceneStatus], list[str]]:
        """Returns the scenes of all peers, and the addresses of the peers that do not respond."""
        lists, silent = await self._ask_all("/v1/scenes", permission, SceneList)
        return list({status.id: status for listing in lists for status in listing.scenes}.values()), silent

    async def clusters(self) -> tuple[list[Cluster], list[str]]:
        """Returns the cluster descriptions of all peers, and the addresses of the peers that do not respond."""
        return await self._ask_all("/v1/cluster", ALL, Cluster)

    async def _ask_all(self, path: str, permission: Permission, model: type[M]) -> tuple[list[M], list[str]]:
        peers = await self.addresses()
        answers = await asyncio.gather(*(self._get(address, path, permission) for address in peers))
        replies, silent = [], []
        for address, answer in zip(peers, answers, strict=True):
            try:
                if answer is None or answer.status_code != 200:
                    raise ValueError(answer)
                replies.append(model.model_validate_json(answer.content))
            except (ValueError, ValidationError):  # a service of another version may use another schema
                silent.append(address)
        return replies, silent

    async def _has(self, address: str, scene: str) -> bool | None:
        """Returns whether a peer owns a scene, or None if the peer gives no valid response."""
        answer = await self._get(address, f"/v1/scenes/{scene}", ALL)
        if answer is None:
            return None
        if answer.status_code in (200, 404):
            return answer.status_code == 200
        log.warning(
            "cannot determine whether service %s owns scene %s: HTTP status %d", address, scene, answer.status_code
        )
        return None

    async def _get(self, address: str, path: str, permission: Permission) -> httpx.Response | None:
        try:
            answer = await self.client.get(address + path, headers=self.headers(permission), timeout=ASK_S)
        except httpx.HTTPError as error:
            log.warning("service %s does not respond: %s: %s", address, type(error).__name__, error)
            return None
        if answer.status_code != 401:
            self._refusing.discard(address)
        elif address not in self._refusing:
            self._refusing.add(address)
            log.warning(
                "service %s rejects the token; set the same SCAS4D_TOKEN on all services in the cluster", address
            )
        return answer


def merge_clusters(own: Cluster, others: Iterable[Cluster]) -> Cluster:
    """Returns the cluster as this service sees it, with the reservations of all services added.

    The waiting processes of all services are also included.
    """
    nodes, waiting = {node.id: node for node in own.nodes}, list(own.waiting)
    for other in others:
        waiting += other.waiting
        for node in other.nodes:
            nodes[node.id] = _merge_node(nodes[node.id], node) if node.id in nodes else node
    return own.model_copy(update={"nodes": list(nodes.values()), "waiting": waiting})


def _merge_node(node: Node, more: Node) -> Node:
    return node.model_copy(
        update={
            "cpus_reserved": round(node.cpus_reserved + more.cpus_reserved, 3),
            "memory_reserved_mb": round(node.memory_reserved_mb + more.memory_reserved_mb, 1),
            "scenes": sorted({*node.scenes, *more.scenes}),
        }
    )


def unreachable_problem(scene: str, *, refused: bool = False) -> Problem:
    """Returns the 503 problem for a scene whose owner, or possible owner, does not respond.

    Args:
        scene: scene id.
        refused: whether the peer responds but rejects this service's token.
    """
    fault, remedy = "does not respond", "try again later; all acknowledged frames are on disk"
    if refused:
        fault, remedy = "rejects this service's token", "set the same SCAS4D_TOKEN on all services in the cluster"
    return Problem(
        503,
        f"the service that owns, or may own, this scene {fault}",
        field="id",
        value=scene,
        remedy=remedy,
        headers={"Retry-After": "2"},
    )


def _bearer(permission: Permission, secret: str) -> str:
    if permission == ALL:
        return secret
    return Sharing(secret).issue(permission.scene, permission.end or round(time.time()) + LONGEST_SECONDS)


def _remember(where: OrderedDict[str, T], scene: str, value: T, most: int) -> None:
    where[scene] = value
    where.move_to_end(scene)
    while len(where) > most:
        where.popitem(last=False)
