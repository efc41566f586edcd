"""Wire models of the service: health, errors, tickets, shares, cluster."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from client.wire.base import Model


class Health(Model):
    """Health of the service."""

    status: Literal["live", "ready"]
    version: str
    scenes: int
    ready_after: float | None = Field(
        default=None, description="Seconds from the start of the service until its kernels were compiled."
    )
    ingest_ready: bool | None = Field(
        default=None, description="The disk has room for frames; null if it was not checked."
    )


class Ticket(Model):
    """A single-use ticket that opens one WebSocket from a browser, which cannot send a bearer token."""

    ticket: str
    subprotocol: str = Field(description="Offer it in Sec-WebSocket-Protocol, in addition to the stream's protocol.")
    seconds: float = Field(description="Lifetime of the ticket.")


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

    scene: str | None = Field(
        default=None, max_length=64, description="The only scene that the token can read; null: all scenes."
    )
    seconds: int = Field(
        default=7 * 86_400, ge=1, le=316_224_000, description="Lifetime of the token; by default a week."
    )


class Share(Model):
    """A read-only token and the URL of the viewer that contains it."""

    token: str = Field(description="For `Authorization: Bearer`.")
    scene: str | None
    ends: str = Field(description="End of its validity, UTC, ISO 8601.")
    address: str = Field(
        description=("Address of the page, relative to the service. The part after # is never sent to a server.")
    )


class Node(Model):
    """A machine that runs processes of scenes."""

    id: str
    host: str
    labels: dict[str, str] = Field(
        default_factory=dict, description="Labels given when the node started, without Ray's own."
    )
    alive: bool
    cpus: float
    cpus_reserved: float = Field(
        description="CPUs reserved by the processes of all services that respond, by estimate."
    )
    gpus: float
    memory_mb: float
    memory_reserved_mb: float
    scenes: list[str] = Field(description="Scenes whose worker runs here.")


class WaitingProcess(Model):
    """A process that waits for a node with enough resources."""

    scene: str
    role: str
    needs: str
    seconds: float = Field(
        default=0.0, description="Seconds that it has waited. A start without waiting takes a few seconds."
    )


class Cluster(Model):
    """The machines of the service and the processes that wait for resources."""

    placement: Literal["local", "ray"]
    nodes: list[Node]
    waiting: list[WaitingProcess]
    head_responds: bool = Field(
        default=True, description="The head of the cluster responds; otherwise the nodes are from its last answer."
    )
