"""Check at startup that all nodes share the data folder and that it supports the necessary file operations."""

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
from server.cluster.folder_marker import wait_for_content
from server.cluster.nodes import living_nodes
from server.storage.fencing import PART

PROBE_NAME = ".probe"
TIMEOUT_S = 180.0
"""Timeout in seconds for a node's response; its first task starts a Python process, which is slow on a busy node."""


def check_folder(data: Path) -> None:
    """Checks that this process and every node can read files that the other has written to the data folder.

    Each node also syncs, renames and links its file.

    Raises:
        RuntimeError: a node does not see the folder, or its file system does not support these operations.
    """
    data.mkdir(parents=True, exist_ok=True)
    word = secrets.token_hex(8)
    probe = data / f"{PROBE_NAME}-{word}"
    probe.write_text(word)
    nodes = {node["NodeID"]: node for node in living_nodes()}
    try:
        asked = {
            id: _probe.options(scheduling_strategy=NodeAffinitySchedulingStrategy(id, soft=False)).remote(
                str(data), word, id
            )
            for id in nodes
        }
        for id, answer in asked.items():
            name = f"node {nodes[id]['NodeManagerHostname']} ({id[:8]})"
            try:
                fault = ray.get(answer, timeout=TIMEOUT_S)
            except RayError as error:
                raise RuntimeError(f"{name} does not respond: {error}") from None
            if fault is not None:
                raise RuntimeError(f"{name} {fault}; mount the data folder {data} on this node at the same path")
            if not wait_for_content(data / f"{PROBE_NAME}-{word}-{id[:8]}", word):
                raise RuntimeError(
                    f"files written to {data} by {name} are not visible here; mount the same folder there"
                )
    finally:
        for path in data.glob(f"{PROBE_NAME}-{word}*"):  # including those of nodes that failed midway
            path.unlink(missing_ok=True)


def probe_from_node(data: Path, word: str, id: str) -> str | None:
    """Checks the folder on this node; returns None, or a fault description to append to the node's name.

    Blocks.
    """
    try:
        if not wait_for_content(data / f"{PROBE_NAME}-{word}", word):
            return f"cannot see files that the service writes to {data}"
        beside, path = (data / f"{PROBE_NAME}-{word}-{id[:8]}{end}" for end in (PART, ""))
        with open_atomically(path, beside) as file:
            file.write(word.encode())
        link, symbolic = path.with_suffix(".link"), path.with_suffix(".symbolic")
        with contextlib.suppress(OSError):  # without hard links, states are copied
            os.link(path, link)
        symbolic.symlink_to(path.name)
        symbolic.replace(link)
        link.unlink()
    except OSError as error:
        return f"({socket.gethostname()}) cannot write to {data}: {error.strerror}"
    return None


@ray.remote(num_cpus=0)
def _probe(data: str, word: str, id: str) -> Any:
    return probe_from_node(Path(data), word, id)
