"""Parameters of an address: one that no route knows is refused, so that a misspelt one is noticed."""

from __future__ import annotations

import difflib
from urllib.parse import parse_qsl

from fastapi import params
from fastapi.dependencies.utils import get_flat_params
from fastapi.routing import APIRoute
from starlette.requests import HTTPConnection

from server.problems import Problem


def known(route: APIRoute) -> list[str]:
    """The names that a route takes behind the question mark, in its own order."""
    fields = get_flat_params(route.dependant)
    return list(dict.fromkeys(field.alias for field in fields if isinstance(field.field_info, params.Query)))


def only_known(connection: HTTPConnection) -> None:
    """A dependency of every route.

    Raises:
        Problem: 422, names the parameter and those that there are.
    """
    route = connection.scope.get("route")
    if not isinstance(route, APIRoute):  # a WebSocket
        return
    names = known(route)
    query = connection.scope.get("query_string", b"").decode("latin-1")
    for name, value in parse_qsl(query, keep_blank_values=True):
        if name in names:
            continue
        near = difflib.get_close_matches(name, names, 1)
        meant = f"it may be {near[0]!r} that is meant; " if near else ""
        there = f"the parameters here are {', '.join(names)}" if names else "this address takes no parameters"
        raise Problem(422, f"there is no parameter {name!r} here", field=name, value=value, remedy=meant + there)
