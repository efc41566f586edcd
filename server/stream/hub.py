"""Who listens to which scene. Publishing puts an event before every listener and waits for none of them."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, TypeVar

from client.wire import FrameReportModel, SceneStatus
from server.problems import Problem
from server.stream.shared_queries import Ask, Desk

log = logging.getLogger("scas4d.server")


@dataclass(frozen=True)
class SceneChanged:
    """The scene's state, progress or queue is another."""


@dataclass(frozen=True)
class FrameFinished:
    """A frame was committed, or ended without a state of its own."""

    report: FrameReportModel

    @cached_property
    def text(self) -> str:
        """The report as JSON, written once for all who listen."""
        return self.report.model_dump_json()


Event = SceneChanged | FrameFinished


class Listener(Protocol):
    """A subscriber, as the hub sees it. Both methods return at once."""

    def told(self, event: Event) -> None:
        """Something happened in the scene."""

    def gone(self, reason: str) -> None:
        """The scene is no more."""


L = TypeVar("L", bound=Listener)


class Room:
    """The listeners of one scene, and the desk that asks its reader for them."""

    def __init__(self, ask: Ask) -> None:
        self.listeners: list[Listener] = []
        self.desk = Desk(ask)
        self._status: str | None = None

    def changed(self) -> None:
        """The status is another."""
        self._status = None

    def status(self, read: Callable[[], SceneStatus]) -> str:
        """The scene's status as JSON, written once for all who listen."""
        if self._status is None:
            self._status = read().model_dump_json()
        return self._status


class Hub:
    """The rooms of all scenes, by scene id.

    Args:
        max_listeners: of one scene.
    """

    def __init__(self, max_listeners: int) -> None:
        self.max_listeners = max_listeners
        self._rooms: dict[str, Room] = {}

    def join(self, scene: str, ask: Ask, make: Callable[[Room], L]) -> L:
        """Lets a listener in.

        Raises:
            Problem: 429, as many listen as may.
        """
        room = self._rooms.get(scene) or Room(ask)
        if len(room.listeners) >= self.max_listeners:
            raise Problem(
                429,
                f"this scene has all the subscribers that it may have: {len(room.listeners)}",
                field="SCAS4D_MAX_SUBSCRIBERS",
                value=self.max_listeners,
                remedy="close another subscriber of the scene, or raise the limit",
                headers={"Retry-After": "5"},
            )
        self._rooms[scene] = room
        listener = make(room)
        room.listeners.append(listener)
        return listener

    def leave(self, scene: str, listener: Listener) -> None:
        """Lets a listener go; an empty room is given up."""
        room = self._rooms.get(scene)
        if room is None or listener not in room.listeners:
            return
        room.listeners.remove(listener)
        if not room.listeners:
            del self._rooms[scene]

    def count(self, scene: str | None = None) -> int:
        """How many listen, to one scene or to all."""
        rooms = self._rooms.values() if scene is None else filter(None, [self._rooms.get(scene)])
        return sum(len(room.listeners) for room in rooms)

    def publish(self, scene: str, event: Event) -> None:
        """Tells every listener of a scene. Never blocks, never raises: the scene's own work comes first."""
        room = self._rooms.get(scene)
        if room is None:
            return
        room.changed()
        for listener in tuple(room.listeners):
            try:
                listener.told(event)
            except Exception:
                log.exception("scene %s: a subscriber could not be told of %s", scene, type(event).__name__)

    def close(self, scene: str, reason: str) -> None:
        """The scene is gone: every listener is told so and let go."""
        room = self._rooms.pop(scene, None)
        for listener in () if room is None else room.listeners:
            listener.gone(reason)
