"""The service itself on the wire: health, errors."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from client.wire.base import Model


class Health(Model):
    """The service answers."""

    status: Literal["live", "ready"]
    version: str
    scenes: int
    ready_after: float | None = Field(
        default=None, description="Seconds from the start of the service until its kernels were warmed up."
    )
    ingest_ready: bool | None = Field(
        default=None, description="The disk has room for frames; null where that was not looked at."
    )


class Ticket(Model):
    """Opens one WebSocket from a browser, which cannot send a bearer token with it."""

    ticket: str
    subprotocol: str = Field(description="To offer in Sec-WebSocket-Protocol, beside that of the stream.")
    seconds: float = Field(description="It lives so long.")


class ProblemDetails(BaseModel):
    """RFC 9457. `field`, `value` and `remedy` are ours: what was wrong, with which value, and what to do."""

    model_config = ConfigDict(extra="allow")

    type: str = "about:blank"
    title: str
    status: int
    detail: str
    field: str | None = None
    value: str | None = None
    remedy: str | None = None


class ShareRequest(Model):
    """A token that may only read."""

    scene: str | None = Field(default=None, max_length=64, description="The only one that it shows; all where null.")
    seconds: int = Field(default=7 * 86_400, ge=1, le=316_224_000, description="So long it holds; a week.")


class Share(Model):
    """A token that may only read, and the page's address that has it."""

    token: str = Field(description="For `Authorization: Bearer`.")
    scene: str | None
    ends: str = Field(description="UTC, ISO 8601.")
    address: str = Field(description="Behind the address of the service. What follows # is sent to no server.")


class Node(Model):
    """A machine on which processes of scenes run."""

    id: str
    host: str
    labels: dict[str, str] = Field(default_factory=dict, description="Those it was started with; none of Ray's own.")
    alive: bool
    cpus: float
    cpus_taken: float = Field(description="By processes of all services that answer, as estimated.")
    gpus: float
    memory_mb: float
    memory_taken_mb: float
    scenes: list[str] = Field(description="Those whose worker is here.")


class Waiting(Model):
    """A process that no node has room for."""

    scene: str
    role: str
    needs: str
    seconds: float = Field(default=0.0, description="So long it has waited; to start takes a few without waiting.")


class Cluster(Model):
    """Machines of the service, and what waits for room on them."""

    placement: Literal["local", "ray"]
    nodes: list[Node]
    waiting: list[Waiting]
    answers: bool = Field(
        default=True, description="The head of the cluster answers; else the nodes are those of its last answer."
    )
