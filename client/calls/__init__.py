"""The requests of the service as values, one file a noun: the sync and the async client send the same ones."""

from client.calls.call import Call
from client.calls.frames import frame, ply, put_frame
from client.calls.parts import parts
from client.calls.scenes import create_scene, delete_scene, put_points, scene, scenes
from client.calls.service import live, metrics, ready
from client.calls.tracks import tracks, tracks_arrays
from client.calls.views import render, render_arrays, render_file

__all__ = [
    "Call",
    "create_scene",
    "delete_scene",
    "frame",
    "live",
    "metrics",
    "parts",
    "ply",
    "put_frame",
    "put_points",
    "ready",
    "render",
    "render_arrays",
    "render_file",
    "scene",
    "scenes",
    "tracks",
    "tracks_arrays",
]
