"""Calls for parts, which are groups of Gaussians that move together, and for the joints between them."""

from __future__ import annotations

from client.calls.call import Call, json_reader, path
from client.wire import JointsModel, PartsModel


def parts(id: str, count: int | None = None) -> Call[PartsModel]:
    """Returns a part label for every Gaussian; if `count` is None, the number of parts is chosen automatically.

    >>> found = client.parts(scene, 2)
    >>> found.count, len(found.labels) == len(found.ids)
    (2, True)
    """
    arguments = {"params": {} if count is None else {"count": count}}
    return Call("GET", path(id, "parts"), json_reader(PartsModel), arguments=arguments)


def joints(id: str, count: int | None = None, frames: tuple[int, int] | None = None) -> Call[JointsModel]:
    """Returns the joints between parts: hinges, sliders and ball joints, with axis, centre and value in each frame.

    Args:
        id: scene id.
        count: number of parts, at most 32; None to choose it automatically.
        frames: first and last frame, inclusive, at most 240; None for all committed frames.

    >>> client.joints(scene, 2).joints  # the sample's boxes do not touch
    []
    """
    arguments = {} if count is None else {"count": count}
    arguments |= {} if frames is None else {"from": frames[0], "to": frames[1]}
    return Call("GET", path(id, "joints"), json_reader(JointsModel), arguments={"params": arguments})
