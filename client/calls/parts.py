"""Calls for parts, which are groups of Gaussians that move together."""

from __future__ import annotations

from client.calls.call import Call, json_reader, path
from client.wire import PartsModel


def parts(id: str, count: int | None = None) -> Call[PartsModel]:
    """Returns a part label for every Gaussian; if `count` is None, the number of parts is chosen automatically.

    >>> found = client.parts(scene, 2)
    >>> found.count, len(found.labels) == len(found.ids)
    (2, True)
    """
    arguments = {"params": {} if count is None else {"count": count}}
    return Call("GET", path(id, "parts"), json_reader(PartsModel), arguments=arguments)
