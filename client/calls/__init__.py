"""API requests as `Call` objects, one module per resource, shared by the sync and async clients.

In the examples, `client` is a `client.sdk.Client`, and `scene` is the id of a scene with frames 0 to 2 committed. `rig`
is its two-camera rig. `open_scene` is the id of a scene that still accepts frames, and `pictures` maps camera names to
PNG files. `calls` is this package, `np` is NumPy, and `time` is the standard library module.
"""
# ruff: noqa: F401

from client.calls.budgets import budget, end_replay, replay, set_budget, tradeoff
from client.calls.call import Call
from client.calls.exports import begin_export, delete_export, export, export_file, exports
from client.calls.frames import (
    NewFrame,
    close_frame,
    declare_missing,
    frame,
    frames,
    picture,
    ply,
    put_camera,
    put_frame,
    put_frames,
    states,
)
from client.calls.parts import joints, parts
from client.calls.scenes import (
    begin_again,
    create_scene,
    delete_scene,
    edit_scene,
    estimate,
    pause,
    put_points,
    put_to_sleep,
    resume,
    rig,
    scene,
    scenes,
)
from client.calls.service import cluster, ingest_ready, live, metrics, ready, share, ticket
from client.calls.tracks import gaussians, tracks, tracks_arrays
from client.calls.views import render, render_arrays, render_file
