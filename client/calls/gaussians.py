"""Calls for the lifetimes of Gaussians."""

from __future__ import annotations

from collections.abc import Sequence

from client.calls.call import Call, json_reader, path
from client.wire import GaussiansModel


def gaussians(id: str, ids: Sequence[int]) -> Call[GaussiansModel]:
    """Returns the lifetime of each requested Gaussian: the frames in which it was created, retired and revived.

    >>> found = client.gaussians(scene, [1, 0])
    >>> [(one.id, one.born, one.retired) for one in found.gaussians]
    [(1, 0, []), (0, 0, [])]
    """
    arguments = {"params": {"ids": ",".join(str(int(value)) for value in ids)}}
    return Call("GET", path(id, "gaussians"), json_reader(GaussiansModel), arguments=arguments)
