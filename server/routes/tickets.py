"""Route that issues tickets for WebSocket connections from browsers."""

from __future__ import annotations

from fastapi import APIRouter, Request

from client.wire import Ticket
from server.http.permissions import ALL, PERMISSION
from server.http.tickets import SUBPROTOCOL, TICKET_SECONDS, Tickets

router = APIRouter(prefix="/v1/tickets", tags=["service"])


@router.post("", status_code=201)
async def issue(request: Request) -> Ticket:
    """Issues a short-lived ticket that opens one WebSocket; the request must include the token."""
    tickets: Tickets = request.app.state.tickets
    ticket = tickets.issue(request.scope.get(PERMISSION, ALL))
    return Ticket(ticket=ticket, subprotocol=SUBPROTOCOL + ticket, seconds=TICKET_SECONDS)
