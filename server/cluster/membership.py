"""The service's membership of a Ray cluster: it parents by the node of its machine, and again once that is lost."""

from __future__ import annotations

import asyncio
import logging
import os
import socket
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import ray
from ray.exceptions import RayError

from server.cluster.nodes import own_node_is_lost

NAMESPACE = "scas4d"
REACH_S = 5.0
"""The head of the cluster answers within so long."""
SILENT_S = 3.0
"""A head that has not answered for this long is reported."""
JOIN_S = 60.0
"""A try to join takes so long at most; without a node on this machine it fails after some 10 s."""
LEAVE_S = 10.0
"""A service leaves within so long; the head may be silent just then."""
EVERY_S = 2.0
"""Between two looks at whether the node of this machine is there, and between two tries to join again."""

log = logging.getLogger("scas4d.server")


class Membership:
    """Joins, and stays.

    A node that goes takes all actors with it that a service has started by it, wherever they run. The head's does each
    time that its supervisor starts it again.

    Args:
        address: of the cluster's head, or None: that which runs on this machine, or that of RAY_ADDRESS.
    """

    def __init__(self, address: str | None) -> None:
        self._address = address
        self._silent = False
        self._said = ""
        self._thread = ThreadPoolExecutor(1, "membership")
        """Of its own: it waits for the head of the cluster as long as that takes."""

    def join(self) -> None:
        """Joins, unless this process has. Blocking.

        Raises:
            RuntimeError: there is no cluster, or this machine has no node of it.
        """
        if not ray.is_initialized():
            try:
                if self._address is not None:
                    _reach(self._address)  # Ray would end this process where nobody listens
            except (OSError, ValueError) as error:
                raise _no_cluster(f"at {self._address}", error) from None
            try:
                ray.init(
                    address=self._address or "auto", namespace=NAMESPACE, log_to_driver=True, configure_logging=False
                )
            except (OSError, ValueError, RuntimeError, RayError) as error:
                if self._address is None:
                    raise _no_cluster("on this machine", error) from None
                raise RuntimeError(
                    f"the Ray cluster at {self._address} cannot be joined ({error}); this machine needs a node of it "
                    "(`ray start --address`), and, where it asks for a token, RAY_AUTH_MODE=token and that token"
                ) from None

    async def keep(self, on_loss: Callable[[], Awaitable[None]], on_return: Callable[[], Awaitable[None]]) -> None:
        """Looks after the node of this machine, for ever.

        Args:
            on_loss: called once the node, and so every actor of this service, is lost. When it has ended, nothing in
                this process may ask Ray, or drop a handle or an answer of Ray's, until `on_return` is called.
            on_return: called once the service is a member again; tried again where it fails.
        """
        announced = True
        while True:
            await asyncio.sleep(EVERY_S)
            if await self._is_lost():
                log.error("the Ray node of this machine is lost, and all processes of scenes with it; joining again")
                await _or_end(on_loss())
                while not await self._is_done(self._join_or_end):
                    await asyncio.sleep(EVERY_S)
                log.info("the service has joined the cluster again")
                announced = False
            if not announced:  # the node may be lost again before it is
                announced = await self._is_done(on_return)

    def leave(self) -> None:
        """Leaves, once a try to join has ended; actors that are left end. Blocking.

        Where Ray does not let it leave, this process ends at once: the interpreter would wait for Ray's threads.
        """
        leaving = self._thread.submit(ray.shutdown)
        self._thread.shutdown(wait=False)
        try:
            leaving.result(LEAVE_S)
        except TimeoutError:
            log.error("Ray did not let the service leave within %g s; it ends as it is", LEAVE_S)
            os._exit(1)

    async def _is_lost(self) -> bool:
        """Asks the head, and logs when it is silent and when it answers again."""
        answer = self._asked(own_node_is_lost)
        done, _ = await asyncio.wait({answer}, timeout=SILENT_S)
        if not done or answer.exception() is not None:
            if not self._silent:
                self._silent = True
                log.warning(
                    "the head of the Ray cluster is silent: frames go on, and nothing is placed; if Redis does not "
                    "keep what it knew, Ray ends this process after a minute"
                )
            await asyncio.wait({answer})  # one question at a time
        if answer.exception() is not None:
            return False
        if self._silent:
            self._silent = False
            log.info("the head of the Ray cluster answers again")
        return bool(answer.result())

    async def _join_or_end(self) -> None:
        """Joins again. Where Ray stands still, as it once did, this process ends: its supervisor starts another."""
        joining = self._asked(self._join_again)
        if not (await asyncio.wait({joining}, timeout=JOIN_S))[0]:
            log.critical("Ray did not let the service join again within %g s; the service ends, start it again", JOIN_S)
            os._exit(1)  # what was acknowledged is on disk; an end in order would wait for Ray
        joining.result()

    def _join_again(self) -> None:
        ray.shutdown()
        self.join()

    def _asked(self, function: Callable[[], Any]) -> asyncio.Future[Any]:
        return asyncio.get_running_loop().run_in_executor(self._thread, function)

    async def _is_done(self, call: Callable[[], Awaitable[None]]) -> bool:
        try:
            await call()
        except Exception as error:  # whatever Ray raises: the service must not stand still
            if str(error) != self._said:
                self._said = str(error)
                log.warning("not a member of the cluster yet: %s", error)
            return False
        self._said = ""
        return True


async def _or_end(losing: Awaitable[None]) -> None:
    """A service that cannot give up what it has lost would stand still: its supervisor starts another."""
    try:
        await losing
    except Exception:
        log.critical("what ran on the cluster cannot be given up; the service ends, start it again", exc_info=True)
        os._exit(1)


def _no_cluster(where: str, error: Exception) -> RuntimeError:
    return RuntimeError(
        f"there is no Ray cluster {where} ({error}); start one with `ray start --head`, or name its address: "
        "--placement ray=HOST:6379"
    )


def _reach(address: str) -> None:
    """Connects to the cluster's head and goes; an OSError where nobody answers."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    with socket.create_connection((host, int(port)), timeout=REACH_S):
        pass
