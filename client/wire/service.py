"""Wire models of the service: health, errors, tickets, shares and cluster."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from client.wire.base import Model


class Health(Model):
    """Health of the service."""

    status: Literal["live", "ready"]
    version: str
    scenes: int
    process: int | None = None
    """Process id of the service on its machine; only in /live."""
    ready_after: float | None = None
    """Seconds from the start of the service until its kernels were compiled."""
    ingest_ready: bool | None = None
    """Whether the disk has space for frames; null if not checked."""


class Ticket(Model):
    """A single-use ticket that opens one WebSocket from a browser, which cannot send a bearer token."""

    ticket: str
    subprotocol: str
    """Value to offer in Sec-WebSocket-Protocol, in addition to the stream's protocol."""
    seconds: float
    """Lifetime of the ticket in seconds."""


class ProblemDetails(BaseModel):
    """A problem document (RFC 9457) with the extension members `field`, `value` and `remedy`."""

    model_config = ConfigDict(extra="allow")

    type: str = "about:blank"
    title: str
    status: int
    detail: str
    field: str | None = None
    value: str | None = None
    remedy: str | None = None


class ShareRequest(Model):
    """A request for a read-only token."""

    scene: str | None = Field(default=None, max_length=64)
    """The only scene that the token can read; null for all scenes."""
    seconds: int = Field(default=7 * 86_400, ge=1, le=316_224_000)
    """Lifetime of the token in seconds; by default a week."""


class Share(Model):
    """A read-only token, and a viewer URL that contains it."""

    token: str
    """Token for `Authorization: Bearer`."""
    scene: str | None
    ends: str
    """Expiry time in UTC, ISO 8601."""
    address: str
    """Viewer URL, relative to the service address. The part after # is never sent to a server."""


class Node(Model):
    """A machine that runs scene processes."""

    id: str
    host: str
    labels: dict[str, str] = Field(default_factory=dict)
    """Labels given when the node was started, excluding Ray's own labels."""
    alive: bool
    cpus: float
    cpus_reserved: float
    """Estimated CPUs reserved by the processes of all services that respond."""
    gpus: float
    memory_mb: float
    memory_reserved_mb: float
    scenes: list[str]
    """Scenes whose worker runs on this node."""


class WaitingProcess(Model):
    """A process that is waiting for a node with enough resources."""

    scene: str
    role: str
    needs: str
    seconds: float = 0.0
    """How long the process has waited, in seconds. Starting without waiting takes a few seconds."""


class Cluster(Model):
    """The machines of the service, and the processes that are waiting for resources."""

    placement: Literal["local", "ray"]
    nodes: list[Node]
    waiting: list[WaitingProcess]
    head_responds: bool = True
    """Whether the cluster's head node responds; if not, the nodes are those from its last response."""
