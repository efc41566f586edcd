"""What the tests of the page look at."""

from __future__ import annotations

from drawn import colours, make_rig, positions
from running import picture

from scas4d_core.captures import InitialPoints

FRAMES = 7


def start_scene(sdk, name="ring"):
    """A scene of the ring of cameras around the spiral."""
    status = sdk.create_scene(make_rig(), name=name, frames_per_second=10)
    sdk.put_points(status.id, InitialPoints(positions(), colours().astype("float32"), None))
    return status.id


def push(sdk, id, index, red=0):
    """One frame; `red` tells the fake engine what to do."""
    sdk.put_frame(id, index, {name: picture(red, (32, 24)) for name in make_rig().names})
