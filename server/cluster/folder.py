"""Checks that the data folder is the same one on every node, and keeps what the service relies on."""

from __future__ import annotations

import contextlib
import os
import secrets
import socket
from pathlib import Path
from typing import Any

import ray
from ray.exceptions import RayError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from scas4d_core.storage.npz import open_atomically
from server.cluster.marks import appears
from server.cluster.nodes import living_nodes
from server.storage.fencing import PART

PROBE = ".probe"
PATIENCE_S = 180.0
"""Seconds that a node may take to answer: its first task starts a Python process, slow on a node with other work."""


def check_folder(data: Path) -> None:
    """Has every node read what this process wrote, write a file, sync it, rename and link it; reads it back.

    Raises:
        RuntimeError: a node does not see the folder, or its file system does not do.
    """
    data.mkdir(parents=True, exist_ok=True)
    word = secrets.token_hex(8)
    probe = data / f"{PROBE}-{word}"
    probe.write_text(word)
    nodes = {node["NodeID"]: node for node in living_nodes()}
    try:
        asked = {
            id: _look.options(scheduling_strategy=NodeAffinitySchedulingStrategy(id, soft=False)).remote(
                str(data), word, id
            )
            for id in nodes
        }
        for id, answer in asked.items():
            name = f"node {nodes[id]['NodeManagerHostname']} ({id[:8]})"
            try:
                fault = ray.get(answer, timeout=PATIENCE_S)
            except RayError as error:
                raise RuntimeError(f"{name} does not answer: {error}") from None
            if fault is not None:
                raise RuntimeError(f"{name} {fault}; mount the data folder {data} there, at the same path")
            if not appears(data / f"{PROBE}-{word}-{id[:8]}", word):
                raise RuntimeError(f"what {name} writes to {data} does not appear here; is it the same folder?")
    finally:
        for path in data.glob(f"{PROBE}-{word}*"):  # what a node left that did not get to its end, too
            path.unlink(missing_ok=True)


def probe_here(data: Path, word: str, id: str) -> str | None:
    """Tries the folder on this node; returns what is wrong, after the node's name. Blocking."""
    try:
        if not appears(data / f"{PROBE}-{word}", word):
            return f"does not see what the service writes to {data}"
        beside, path = (data / f"{PROBE}-{word}-{id[:8]}{end}" for end in (PART, ""))
        with open_atomically(path, beside) as file:
            file.write(word.encode())
        link, symbolic = path.with_suffix(".link"), path.with_suffix(".symbolic")
        with contextlib.suppress(OSError):  # states are copied then
            os.link(path, link)
        symbolic.symlink_to(path.name)
        symbolic.replace(link)
        link.unlink()
    except OSError as error:
        return f"({socket.gethostname()}) cannot write to {data}: {error.strerror}"
    return None


@ray.remote(num_cpus=0)
def _look(data: str, word: str, id: str) -> Any:
    return probe_here(Path(data), word, id)
