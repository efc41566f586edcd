"""Peers, the other services of the cluster: which of them has a scene, and which scenes they have."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Sequence
from typing import TypeVar

import httpx
from pydantic import BaseModel, ValidationError

from client.wire import Cluster, SceneList, SceneStatus
from server.http.permissions import ALL, Permission
from server.http.sharing import LONGEST_SECONDS, Sharing
from server.problems import Problem

PASSED = "x-scas4d-passed"
"""Header of what a service asks of another: that one answers for its own scenes alone, and passes nothing on."""
FRESH_S = 3.0
"""A list of the peers is good for so long, and so is the answer that none has a scene."""
LIST_S = 2.0
"""A request waits for the first list for so long; later ones get the list before."""
ASK_S = 5.0
"""A peer has so long to answer a question about its scenes."""
CONNECT_S = 3.0
SILENT_S = 130.0
"""A peer may be silent for so long over a request: longer than it allows a query."""
REMEMBERED_S = 600.0
"""Seconds for which a lost service is awaited: clients of its scenes are asked to try again."""
MOST_KNOWN = 100_000
MOST_UNKNOWN = 1_000
"""Ids that nobody has, remembered for a moment, so that guessed ids do not each reach every peer."""

T = TypeVar("T")
M = TypeVar("M", bound=BaseModel)

log = logging.getLogger("scas4d.server")


class Peers:
    """The other services of the cluster. On the event loop.

    Args:
        listed: returns the addresses of the peers, as `http://10.0.0.2:8000`; it may take long.
        secret: the token, which all services of a cluster share; None: there is none.
        client: of HTTP; by default one of its own.

    Attributes:
        client: passes requests on.
    """

    def __init__(
        self,
        listed: Callable[[], Awaitable[Sequence[str]]],
        secret: str | None,
        client: httpx.AsyncClient | None = None,
    ) -> None:
        self._listed = listed
        self._secret = secret
        limits = httpx.Limits(max_connections=None, max_keepalive_connections=64)
        timeout = httpx.Timeout(SILENT_S, connect=CONNECT_S)
        self.client = client or httpx.AsyncClient(timeout=timeout, limits=limits, trust_env=False)
        self._addresses: Sequence[str] | None = None
        self._asked = -FRESH_S
        self._listing: asyncio.Task[None] | None = None
        self._owners: OrderedDict[str, str] = OrderedDict()
        """Addresses by scene."""
        self._seen: dict[str, float] = {}
        """When an address was last among the peers."""
        self._unknown: OrderedDict[str, float] = OrderedDict()
        self._refusing: set[str] = set()
        """Addresses of those that refuse the token."""
        self._checked: OrderedDict[str, float] = OrderedDict()

    async def close(self) -> None:
        """Ends connections to peers."""
        if self._listing is not None:
            self._listing.cancel()
        await self.client.aclose()

    async def addresses(self) -> Sequence[str]:
        """Addresses of the peers, as they were listed last."""
        if self._listing is None and time.monotonic() - self._asked >= FRESH_S:
            self._listing = asyncio.get_running_loop().create_task(self._list())
        if self._listing is not None:
            await asyncio.wait({self._listing}, timeout=LIST_S if self._addresses is None else 0)
        return self._addresses or ()

    async def _list(self) -> None:
        try:
            before, self._addresses = self._addresses or (), await self._listed()
            now = time.monotonic()
            seen = {address: when for address, when in self._seen.items() if now - when < REMEMBERED_S}
            self._seen = seen | dict.fromkeys((*before, *self._addresses), now)  # those before were there until now
        except Exception:  # the cluster's head does not answer, or in words that nobody expects
            log.exception("peers cannot be listed; those before are asked")
        finally:
            self._asked, self._listing = time.monotonic(), None

    def headers(self, permission: Permission) -> dict[str, str]:
        """Headers with which a peer is asked, for somebody who may do so much."""
        forwarded = {PASSED: "1"}
        if self._secret is not None:
            forwarded["authorization"] = f"Bearer {_bearer(permission, self._secret)}"
        return forwarded

    async def owner(self, scene: str) -> str | None:
        """Returns the address of the peer that has a scene; None: none of them has it.

        Raises:
            Problem: 503, the one that had it, or one that may have it, does not answer.
        """
        peers, now = await self.addresses(), time.monotonic()
        known = self._owners.get(scene)
        if known in peers:
            return known
        if self._addresses is None:  # it is not known yet whom to ask
            raise unreachable(scene)
        if now - self._unknown.get(scene, -FRESH_S) < FRESH_S:
            return None
        answers = await asyncio.gather(*(self._has(address, scene) for address in peers))
        for address, has in zip(peers, answers, strict=True):
            if has:
                _keep(self._owners, scene, address, MOST_KNOWN)
                return address
        if None in answers or (known in self._seen and now - self._seen[known] < REMEMBERED_S):
            raise unreachable(scene, refused=not self._refusing.isdisjoint(peers))
        self.forget(scene)
        _keep(self._unknown, scene, now, MOST_UNKNOWN)
        return None

    def forget(self, scene: str) -> None:
        """Forgets who has a scene: that one says it has it no more."""
        self._owners.pop(scene, None)

    async def check(self, owner: str, scene: str) -> None:
        """Forgets the owner of a scene where it says that it does not have it; asks once in a while."""
        now = time.monotonic()
        if now - self._checked.get(scene, -FRESH_S) >= FRESH_S:
            _keep(self._checked, scene, now, MOST_UNKNOWN)
            if await self._has(owner, scene) is False:
                self.forget(scene)

    async def scenes(self, permission: Permission) -> tuple[list[SceneStatus], list[str]]:
        """Returns the scenes of all peers, and the addresses of those that do not answer."""
        lists, silent = await self._every("/v1/scenes", permission, SceneList)
        return list({status.id: status for listing in lists for status in listing.scenes}.values()), silent

    async def clusters(self) -> tuple[list[Cluster], list[str]]:
        """Returns what the peers' scenes take of nodes, and the addresses of those that do not answer."""
        return await self._every("/v1/cluster", ALL, Cluster)

    async def _every(self, path: str, permission: Permission, model: type[M]) -> tuple[list[M], list[str]]:
        peers = await self.addresses()
        answers = await asyncio.gather(*(self._get(address, path, permission) for address in peers))
        replies, silent = [], []
        for address, answer in zip(peers, answers, strict=True):
            try:
                if answer is None or answer.status_code != 200:
                    raise ValueError(answer)
                replies.append(model.model_validate_json(answer.content))
            except (ValueError, ValidationError):  # a service of another version may have other words
                silent.append(address)
        return replies, silent

    async def _has(self, address: str, scene: str) -> bool | None:
        """Returns whether a peer has a scene; None: it does not say."""
        answer = await self._get(address, f"/v1/scenes/{scene}", ALL)
        if answer is None:
            return None
        if answer.status_code in (200, 404):
            return answer.status_code == 200
        log.warning("service %s does not say whether it has scene %s: %d", address, scene, answer.status_code)
        return None

    async def _get(self, address: str, path: str, permission: Permission) -> httpx.Response | None:
        try:
            answer = await self.client.get(address + path, headers=self.headers(permission), timeout=ASK_S)
        except httpx.HTTPError as error:
            log.warning("service %s does not answer: %s: %s", address, type(error).__name__, error)
            return None
        if answer.status_code != 401:
            self._refusing.discard(address)
        elif address not in self._refusing:
            self._refusing.add(address)
            log.warning("service %s refuses the token; give all services of a cluster the same SCAS4D_TOKEN", address)
        return answer


def unreachable(scene: str, *, refused: bool = False) -> Problem:
    """Makes the answer, 503, where the service that has a scene, or may have it, does not answer.

    Args:
        refused: it answers, and refuses the token of this one.
    """
    fault, remedy = "does not answer", "ask again: what it acknowledged is on disk"
    if refused:
        fault, remedy = "refuses this one's token", "give all services of a cluster the same SCAS4D_TOKEN"
    return Problem(
        503,
        f"the service of the cluster that has this scene, or may have it, {fault}",
        field="id",
        value=scene,
        remedy=remedy,
        headers={"Retry-After": "2"},
    )


def _bearer(permission: Permission, secret: str) -> str:
    if permission == ALL:
        return secret
    return Sharing(secret).issue(permission.scene, permission.end or round(time.time()) + LONGEST_SECONDS)


def _keep(where: OrderedDict[str, T], scene: str, value: T, most: int) -> None:
    where[scene] = value
    where.move_to_end(scene)
    while len(where) > most:
        where.popitem(last=False)
