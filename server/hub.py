"""Publishes what happens in the scenes. Publishing hands an event to every listener of a scene and waits for none."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, TypeVar

from client.wire import FrameReportModel, FrameState, SceneStatus
from server import counters
from server.problems import Problem
from server.processes.shared_queries import AskReaders, SharedQueries

log = logging.getLogger("scas4d.server")


@dataclass(frozen=True)
class SceneChanged:
    """The scene's state, progress or queue has changed."""


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
    """A subscriber, as the hub sees it. All methods return at once."""

    def on_event(self, event: Event) -> None:
        """Something happened in the scene."""

    def on_close(self, reason: str) -> None:
        """The scene is no more."""

    def on_restart(self) -> None:
        """The scene is another one from here on: the listener may join it anew."""


L = TypeVar("L", bound=Listener)


class Channel:
    """The listeners of one scene, and the queries that they share."""

    def __init__(self, ask: AskReaders) -> None:
        self.listeners: list[Listener] = []
        self.queries = SharedQueries(ask)
        self._status: str | None = None

    def changed(self) -> None:
        """Notes that the status has changed."""
        self._status = None

    def status(self, read: Callable[[], SceneStatus]) -> str:
        """The scene's status as JSON, written once for all who listen."""
        if self._status is None:
            self._status = read().model_dump_json()
        return self._status


class Hub:
    """The channels of all scenes, by scene id.

    Args:
        max_listeners: of one scene.
    """

    def __init__(self, max_listeners: int) -> None:
        self.max_listeners = max_listeners
        self._channels: dict[str, Channel] = {}

    def join(self, scene: str, ask: AskReaders, make: Callable[[Channel], L]) -> L:
        """Adds a listener to a scene's channel and returns it.

        Raises:
            Problem: 429, as many listen as may.
        """
        channel = self._channels.get(scene) or Channel(ask)
        if len(channel.listeners) >= self.max_listeners:
            raise Problem(
                429,
                f"this scene has its maximum of subscribers: {len(channel.listeners)}",
                field="SCAS4D_MAX_SUBSCRIBERS",
                value=self.max_listeners,
                remedy="close another subscriber of the scene, or raise the limit",
                headers={"Retry-After": "5"},
            )
        self._channels[scene] = channel
        listener = make(channel)
        channel.listeners.append(listener)
        return listener

    def leave(self, scene: str, listener: Listener) -> None:
        """Removes a listener; an empty channel is given up."""
        channel = self._channels.get(scene)
        if channel is None or listener not in channel.listeners:
            return
        channel.listeners.remove(listener)
        if not channel.listeners:
            del self._channels[scene]

    def count(self, scene: str | None = None) -> int:
        """Counts the listeners of one scene, or of all."""
        channels = self._channels.values() if scene is None else filter(None, [self._channels.get(scene)])
        return sum(len(channel.listeners) for channel in channels)

    def publish(self, scene: str, event: Event) -> None:
        """Notifies every listener of a scene. Never blocks, never raises: the scene's own work comes first."""
        channel = self._channels.get(scene)
        if channel is None:
            return
        channel.changed()
        for listener in tuple(channel.listeners):
            try:
                listener.on_event(event)
            except Exception:
                log.exception("scene %s: a subscriber could not take the event %s", scene, type(event).__name__)

    def close(self, scene: str, reason: str) -> None:
        """Closes the channel of a scene that is gone, and notifies its listeners."""
        for listener in self._give_up(scene):
            listener.on_close(reason)

    def restart(self, scene: str) -> None:
        """Closes the channel of a scene that begins anew; its listeners join again by themselves."""
        for listener in self._give_up(scene):
            listener.on_restart()

    def _give_up(self, scene: str) -> list[Listener]:
        channel = self._channels.pop(scene, None)
        return [] if channel is None else channel.listeners


class Publisher:
    """Publishes the events of one scene, and counts its finished frames in the metrics.

    Args:
        hub: of the service. scene: id of the scene.
    """

    def __init__(self, hub: Hub, scene: str) -> None:
        self._hub = hub
        self._scene = scene

    @property
    def listeners(self) -> int:
        """Number of listeners of the scene."""
        return self._hub.count(self._scene)

    def changed(self) -> None:
        """Publishes that the status of the scene has changed; to be called at every change."""
        self._hub.publish(self._scene, SceneChanged())

    def finished(self, report: FrameReportModel) -> None:
        """Counts and publishes a finished frame; to be called once a frame."""
        counters.FRAMES.labels(report.state.value).inc()
        if report.state == FrameState.COMMITTED:
            counters.LEFT_OUT.inc(len(report.dropped_cameras))
            for alarm in report.alarms:
                counters.ALARMS.labels(alarm.what.value).inc()
            if report.outcome is not None and report.outcome.degraded:
                counters.DEGRADED.labels("rejected" if report.outcome.rejected else "in_part").inc()
        for stage, seconds in report.seconds.items():
            counters.UPDATE_SECONDS.labels(stage).observe(seconds)
        self._hub.publish(self._scene, FrameFinished(report))
