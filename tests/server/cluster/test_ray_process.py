"""A process on a cluster whose actor fails in every way: the scene always learns of it, and never stands still."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from waiting import HANG_S, wait_for_soon

ray_placement = pytest.importorskip(
    "server.cluster.ray_placement", reason="Ray is not installed: pip install 'scas4d[ray]'"
)

from ray.exceptions import RayActorError, RayError  # noqa: E402

from server.cluster.nodes import is_lost, own_node_is_lost  # noqa: E402
from server.cluster.process_host import StartResult, UnexpectedExit  # noqa: E402
from server.cluster.ray_calls import RayCalls  # noqa: E402
from server.cluster.resource_needs import ResourceNeeds  # noqa: E402
from server.processes.placement import ProcessExit  # noqa: E402
from server.settings import ServerSettings  # noqa: E402
from tests.server.cluster.others import others_have_called  # noqa: E402

pytestmark = pytest.mark.filterwarnings("default")
NEEDS = ResourceNeeds("worker", "scene", 1, 1)


class Remote:
    """A method of an actor."""

    def __init__(self, call: Callable[..., Awaitable[Any]]) -> None:
        self.remote = call


class FakeActor:
    def __init__(self) -> None:
        self.said: asyncio.Queue[Any] = asyncio.Queue()
        self.posted: list[tuple[int, Any]] = []
        self.begins = asyncio.Event()
        self.begins.set()
        self.refuses: BaseException | None = None
        self.start, self.post = Remote(self._start), Remote(self._post)
        self.receive, self.stop = Remote(self._take), Remote(self._stop)

    async def _start(self, entry: Any, spec: Any) -> StartResult:
        await self.begins.wait()
        if self.refuses is not None:
            raise self.refuses
        return StartResult("node-1", 4711)

    async def _post(self, number: int, message: Any) -> None:
        self.posted.append((number, message))

    async def _take(self) -> list[Any]:
        found = await self.said.get()
        if isinstance(found, BaseException):
            raise found
        return [found]

    async def _stop(self, seconds: float) -> None:
        pass


class FakePlacement:
    def __init__(self) -> None:
        self.placed: dict[str, Any] = {}
        self.actor = FakeActor()
        self.may_make, self.makes = threading.Event(), threading.Event()
        self.may_make.set()

    def call_ray(self, function: Callable[..., Any], *arguments: Any) -> asyncio.Future[Any]:
        return asyncio.get_running_loop().run_in_executor(None, function, *arguments)

    def create_actor(self, name: str, needs: ResourceNeeds) -> FakeActor:
        self.makes.set()
        self.may_make.wait(HANG_S)
        return self.actor


class Running:
    """A process, and what the service was told of it."""

    def __init__(self, placement: FakePlacement) -> None:
        self.placement, self.actor = placement, placement.actor
        self.messages: list[Any] = []
        self.ends: list[ProcessExit] = []
        self.raises: Exception | None = None
        runs = (lambda: None, None)
        made = ray_placement.RayProcess
        self.process = made(placement, "scene.worker.0", NEEDS, runs, self._received, self.ends.append)

    def _received(self, message: Any) -> None:
        self.messages.append(message)
        if self.raises is not None:
            raise self.raises


@pytest.fixture
def killed(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    found: list[Any] = []
    monkeypatch.setattr(ray_placement.ray, "kill", found.append)
    return found


def run(test: Callable[[FakePlacement], Awaitable[None]]) -> None:
    async def all_of() -> None:
        await test(FakePlacement())

    asyncio.run(all_of())


def dies(words: str = "The actor died.\nmore") -> RayActorError:
    return RayActorError(error_msg=words)


def test_a_node_at_whose_address_nobody_listens_is_lost_before_ray_finds_it_dead(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Else the frame at work is held to blame: Ray takes seconds to find a node dead, its actor is missed at once."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        node = {"NodeID": "a", "Alive": True, "NodeManagerAddress": "127.0.0.1", "NodeManagerPort": port}
        monkeypatch.setattr("server.cluster.nodes.all_nodes", lambda: [node])
        monkeypatch.setattr("server.cluster.nodes.own_node", lambda: "a")
        assert not is_lost("a")
        assert is_lost("b")
    assert is_lost("a")


def test_all_nodes_are_lost_to_a_service_whose_own_is(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        node = {"NodeID": "a", "Alive": True, "NodeManagerAddress": "127.0.0.1", "NodeManagerPort": port}
        monkeypatch.setattr("server.cluster.nodes.all_nodes", lambda: [node, {"NodeID": "own", "Alive": False}])
        monkeypatch.setattr("server.cluster.nodes.own_node", lambda: "own")
        assert is_lost("a")
        assert own_node_is_lost()
        monkeypatch.setattr("server.cluster.nodes.own_node", lambda: "a")
        assert not is_lost("a")
        assert not own_node_is_lost()


@pytest.mark.parametrize(("alive", "lost"), [(False, True), (True, False)])
def test_a_node_is_lost_only_if_ray_says_so(
    killed: list[Any], monkeypatch: pytest.MonkeyPatch, *, alive: bool, lost: bool
) -> None:
    """An actor that was killed for want of memory is no lost node: its frame may be to blame."""
    monkeypatch.setattr(ray_placement, "is_lost", lambda id: not alive)

    async def test(placement: FakePlacement) -> None:
        running = Running(placement)
        await wait_for_soon(lambda: running.process.pid)
        placement.actor.said.put_nowait(dies())
        await wait_for_soon(lambda: running.ends)
        (end,) = running.ends
        assert end.lost is lost
        assert "\n" not in end
        await wait_for_soon(lambda: killed == [placement.actor])

    run(test)


def test_one_that_is_lost_with_its_cluster_is_told_and_not_asked_again(killed: list[Any]) -> None:
    async def test(placement: FakePlacement) -> None:
        running = Running(placement)
        await wait_for_soon(lambda: running.process.pid)
        running.process.mark_lost()
        (end,) = running.ends
        assert end.lost
        await running.process.stop(0.05)
        running.process.mark_lost()
        assert running.ends == [end]
        assert placement.placed == {}
        assert killed == []

    run(test)


def test_one_that_waits_to_begin_when_it_is_lost_is_not_made(killed: list[Any]) -> None:
    """It would be made on the cluster that the service joins next, and nobody would end it."""
    made: list[str] = []

    async def test(placement: FakePlacement) -> None:
        calls = RayCalls()
        placement.call_ray = calls.call  # type: ignore[method-assign]
        placement.create_actor = lambda name, needs: made.append(name)  # type: ignore[method-assign,assignment,return-value]
        calls.suspend()
        running = Running(placement)
        await wait_for_soon(lambda: calls._enabled._waiters)
        running.process.mark_lost()
        await running.process.detach()
        calls.resume()
        await others_have_called()
        assert made == []
        assert running.ends[0].lost

    run(test)


def test_one_that_is_let_go_asks_nothing_more(killed: list[Any]) -> None:
    async def test(placement: FakePlacement) -> None:
        running = Running(placement)
        await wait_for_soon(lambda: running.process.pid)
        await running.process.detach()
        running.process.send("a")
        placement.actor.said.put_nowait("b")
        await running.process.stop(0.05)
        assert (placement.actor.posted, running.messages, running.ends, killed) == ([], [], [], [])

    run(test)


def test_one_that_is_stopped_when_the_cluster_is_lost_is_not_waited_for(killed: list[Any]) -> None:
    async def test(placement: FakePlacement) -> None:
        stops = asyncio.Event()

        async def stands_still(seconds: float) -> None:
            stops.set()
            await asyncio.Event().wait()

        placement.actor.stop = Remote(stands_still)
        running = Running(placement)
        await wait_for_soon(lambda: running.process.pid)
        stopping = asyncio.ensure_future(running.process.stop(100))
        await stops.wait()
        running.process.mark_lost()
        await running.process.detach()
        await asyncio.wait_for(stopping, HANG_S)
        assert running.ends == []
        assert killed == []

    run(test)


def test_an_actor_that_cannot_be_made_is_no_lost_node(killed: list[Any]) -> None:
    async def test(placement: FakePlacement) -> None:
        placement.actor.refuses = dies("no such environment")
        running = Running(placement)
        await wait_for_soon(lambda: running.ends)
        (end,) = running.ends
        assert not end.lost
        assert placement.placed == {}

    run(test)


@pytest.mark.parametrize("fault", [RayError("the head does not answer"), KeyError("a fault of the service's own")])
def test_whatever_ends_the_messages_is_told(killed: list[Any], fault: Exception) -> None:
    async def test(placement: FakePlacement) -> None:
        running = Running(placement)
        placement.actor.said.put_nowait(fault)
        await wait_for_soon(lambda: running.ends)
        assert not running.ends[0].lost

    run(test)


def test_a_message_that_cannot_be_taken_in_does_not_end_the_others(killed: list[Any]) -> None:
    async def test(placement: FakePlacement) -> None:
        running = Running(placement)
        running.raises = KeyError("x")
        for message in ("a", "b", UnexpectedExit(3)):
            placement.actor.said.put_nowait(message)
        await wait_for_soon(lambda: running.ends)
        assert running.messages == ["a", "b"]
        assert running.ends[0].exit_code == 3

    run(test)


def test_one_that_is_given_up_before_it_has_begun_is_not_listed(killed: list[Any]) -> None:
    async def test(placement: FakePlacement) -> None:
        placement.actor.begins.clear()

        async def refused(number: int, message: Any) -> None:
            raise RayError("no")

        placement.actor.post = Remote(refused)
        running = Running(placement)
        running.process.send("a")
        await wait_for_soon(lambda: running.ends)
        placement.actor.begins.set()
        await wait_for_soon(lambda: running.process.pid)
        assert not placement.placed

    run(test)


def test_one_that_is_stopped_while_the_head_is_silent_is_killed_later(
    killed: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ray_placement, "STOPPED_S", 0.05)

    async def test(placement: FakePlacement) -> None:
        placement.may_make.clear()
        running = Running(placement)
        await running.process.stop(0.05)
        assert not killed
        placement.may_make.set()
        await wait_for_soon(lambda: killed == [placement.actor])

    run(test)


def test_nodes_are_not_asked_for_in_another_loop_than_they_are_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    """`open` runs in a loop of its own: an answer that came after its end was waited for without end."""
    for name in ("check_folder", "write_marker"):
        monkeypatch.setattr(ray_placement, name, lambda *arguments: None)
    node = {"NodeID": "a", "NodeManagerHostname": "host", "Alive": True}
    monkeypatch.setattr(ray_placement, "all_nodes", lambda: [node])
    monkeypatch.setattr(ray_placement.ray, "is_initialized", lambda: False)
    monkeypatch.setattr("server.cluster.membership.ray.init", lambda **options: None)
    placement = ray_placement.RayPlacement(None, None, ServerSettings(data=Path("data")))
    asyncio.run(placement.open())
    assert placement._watch._answer is None
    assert placement._watch._asked < 0
    assert list(placement._watch.nodes) == [node]  # one that is lost before anybody looks is known


def test_messages_before_the_actor_is_made_are_posted_in_order_and_nothing_waits(killed: list[Any]) -> None:
    """Making a named actor takes as long as the head of the cluster takes to answer."""

    async def test(placement: FakePlacement) -> None:
        placement.may_make.clear()
        running = Running(placement)
        for message in ("a", "b"):
            running.process.send(message)
        await wait_for_soon(placement.makes.is_set)
        await others_have_called()
        assert placement.actor.posted == []
        placement.may_make.set()
        await wait_for_soon(lambda: running.process.pid)
        running.process.send("c")
        await wait_for_soon(lambda: len(placement.actor.posted) == 3)
        assert placement.actor.posted == [(0, "a"), (1, "b"), (2, "c")]

    run(test)


def test_one_that_is_stopped_before_it_is_made_is_killed_once_it_is(
    killed: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    async def test(placement: FakePlacement) -> None:
        placement.may_make.clear()
        running = Running(placement)
        stopping = asyncio.ensure_future(running.process.stop(1))
        await wait_for_soon(placement.makes.is_set)
        await others_have_called()
        assert killed == []
        placement.may_make.set()
        await stopping
        assert killed == [placement.actor]
        assert running.ends == []
        assert placement.actor.posted == []

    run(test)
