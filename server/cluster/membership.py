"""Membership of the service in a Ray cluster.

The service joins through the Ray node on its machine, and rejoins if that node is lost.
"""

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
CONNECT_S = 5.0
"""Timeout in seconds for connecting to the head node."""
SILENT_S = 3.0
"""Time in seconds after which an unresponsive head node is logged."""
JOIN_S = 60.0
"""Timeout in seconds for an attempt to rejoin; without a node on this machine, the attempt fails after about 10 s."""
LEAVE_S = 10.0
"""Timeout in seconds for leaving the cluster, since the head node may not respond."""
CHECK_S = 2.0
"""Interval in seconds between checks of this machine's node, and between attempts to rejoin."""

log = logging.getLogger("scas4d.server")


class Membership:
    """Membership in a Ray cluster that is restored after a loss.

    When a node is lost, all actors that a service started through this node are lost too, even
    those on other nodes. The head node counts as lost each time its supervisor restarts it.

    Args:
        address: address of the head node; None selects the cluster on this machine or the one in RAY_ADDRESS.
    """

    def __init__(self, address: str | None) -> None:
        self._address = address
        self._silent = False
        self._said = ""
        self._thread = ThreadPoolExecutor(1, "membership")
        """Dedicated thread for calls to the head node that may block indefinitely."""

    def join(self) -> None:
        """Joins the cluster unless this process is already a member. Blocks.

        Raises:
            RuntimeError: there is no cluster, or this machine has no node in the cluster.
        """
        if not ray.is_initialized():
            try:
                if self._address is not None:
                    _check_head(self._address)  # if nothing listened there, Ray would end this process
            except (OSError, ValueError) as error:
                raise _no_cluster_error(f"at {self._address}", error) from None
            try:
                ray.init(
                    address=self._address or "auto", namespace=NAMESPACE, log_to_driver=True, configure_logging=False
                )
            except (OSError, ValueError, RuntimeError, RayError) as error:
                if self._address is None:
                    raise _no_cluster_error("on this machine", error) from None
                raise RuntimeError(
                    f"cannot join the Ray cluster at {self._address} ({error}); start a Ray node on this machine "
                    "(`ray start --address`) and, if the cluster uses a token, set RAY_AUTH_MODE=token"
                ) from None

    async def watch(self, on_loss: Callable[[], Awaitable[None]], on_return: Callable[[], Awaitable[None]]) -> None:
        """Monitors the node of this machine until cancelled, and rejoins the cluster if the node is lost.

        Args:
            on_loss: called when the node, and thus every actor of this service, is lost. After it returns, nothing in
                this process may call Ray or release a Ray handle or result until `on_return` is called.
            on_return: called when the service has rejoined; retried if it fails.
        """
        announced = True
        while True:
            await asyncio.sleep(CHECK_S)
            if await self._is_lost():
                log.error("lost this machine's Ray node and all scene processes; rejoining the cluster")
                await _exit_on_failure(on_loss())
                while not await self._is_done(self._rejoin_or_exit):
                    await asyncio.sleep(CHECK_S)
                log.info("rejoined the Ray cluster")
                announced = False
            if not announced:  # the node may be lost again before `on_return` succeeds
                announced = await self._is_done(on_return)

    def leave(self) -> None:
        """Leaves the cluster, which ends the remaining actors. Blocks.

        A pending attempt to join finishes first. If Ray does not shut down in time, this process
        exits immediately, because the interpreter would otherwise wait for Ray's threads.
        """
        leaving = self._thread.submit(ray.shutdown)
        self._thread.shutdown(wait=False)
        try:
            leaving.result(LEAVE_S)
        except TimeoutError:
            log.error("failed to leave the Ray cluster within %g s; exiting anyway", LEAVE_S)
            os._exit(1)

    async def _is_lost(self) -> bool:
        """Asks the head node whether this machine's node is lost.

        Also logs when the head node stops responding and when it responds again.
        """
        answer = self._call(own_node_is_lost)
        done, _ = await asyncio.wait({answer}, timeout=SILENT_S)
        if not done or answer.exception() is not None:
            if not self._silent:
                self._silent = True
                log.warning(
                    "the Ray head node does not respond; updates continue, but no processes can be started; "
                    "without Redis, Ray will terminate this process after a minute"
                )
            await asyncio.wait({answer})  # at most one pending request
        if answer.exception() is not None:
            return False
        if self._silent:
            self._silent = False
            log.info("the Ray head node is responding again")
        return bool(answer.result())

    async def _rejoin_or_exit(self) -> None:
        """Rejoins the cluster; if Ray hangs, exits this process so that its supervisor restarts it."""
        joining = self._call(self._rejoin)
        if not (await asyncio.wait({joining}, timeout=JOIN_S))[0]:
            log.critical("failed to rejoin the Ray cluster within %g s; exiting (restart the service)", JOIN_S)
            os._exit(1)  # acknowledged frames are on disk, and a clean shutdown would wait for Ray
        joining.result()

    def _rejoin(self) -> None:
        ray.shutdown()
        self.join()

    def _call(self, function: Callable[[], Any]) -> asyncio.Future[Any]:
        return asyncio.get_running_loop().run_in_executor(self._thread, function)

    async def _is_done(self, call: Callable[[], Awaitable[None]]) -> bool:
        try:
            await call()
        except Exception as error:  # Ray may raise any exception, but the service must not hang
            if str(error) != self._said:
                self._said = str(error)
                log.warning("could not rejoin the Ray cluster yet; retrying: %s", error)
            return False
        self._said = ""
        return True


async def _exit_on_failure(losing: Awaitable[None]) -> None:
    """Awaits `losing`; if it fails, exits this process so that its supervisor restarts it."""
    try:
        await losing
    except Exception:
        log.critical("cleanup after losing the Ray cluster failed; exiting (restart the service)", exc_info=True)
        os._exit(1)


def _no_cluster_error(where: str, error: Exception) -> RuntimeError:
    return RuntimeError(
        f"no Ray cluster found {where} ({error}); start one with `ray start --head`, or specify its address with "
        "--placement ray=HOST:6379"
    )


def _check_head(address: str) -> None:
    """Checks that the head node accepts a connection.

    Raises:
        OSError: nothing accepts a connection at the address.
        ValueError: the port is not a number.
    """
    host, _, port = address.removeprefix("ray://").rpartition(":")
    with socket.create_connection((host, int(port)), timeout=CONNECT_S):
        pass
