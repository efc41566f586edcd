"""The examples in the client's docstrings, run against the service with the fake engine; every method has one."""

from __future__ import annotations

import asyncio
import doctest
import importlib
import inspect
import time

import numpy as np
import pytest
from running import make_rig, pictures
from source_tree import MODULES, within
from waiting import HANG_S

from client import calls, ingest, sdk, stream
from client.rig import push
from client.sdk import Client

NAMES = [name for name in MODULES if within(name, ("client",)) and ">>> " in MODULES[name].read_text()]


def examples() -> list[doctest.DocTest]:
    finder = doctest.DocTestFinder()
    found = [test for name in NAMES for test in finder.find(importlib.import_module(name), name)]
    return [test for test in found if test.examples]


@pytest.fixture(scope="module")
def scenes(service):
    """A scene whose frames 0 to 2 are committed, and one that takes further frames."""
    with Client(service.url, busy_timeout=HANG_S) as client:
        made = [client.create_scene(make_rig()).id for _ in range(2)]
        for id, count in zip(made, (3, 1), strict=True):
            for index in range(count):
                client.put_frame(id, index, pictures(index))
                client.wait(id, index, every=0.05)
        yield made
        for id in made:
            client.delete_scene(id)


@pytest.mark.parametrize("example", examples(), ids=lambda test: test.name)
def test_an_example_gives_what_it_says(example, service, scenes, capture_folder, tmp_path):
    with Client(service.url, busy_timeout=HANG_S) as client:
        given = {"client": client, "url": service.url, "rig": make_rig(), "pictures": pictures()}
        given |= {"folder": capture_folder, "out": tmp_path / "out", "np": np, "asyncio": asyncio, "time": time}
        given |= {"scene": scenes[0], "open_scene": scenes[1]}
        given |= {"Stream": stream.Stream, "calls": calls}
        example.globs.update(given)
        said: list[str] = []
        failed = doctest.DocTestRunner().run(example, out=said.append).failed
        assert not failed, "".join(said)


def test_every_call_class_and_method_has_an_example():
    own = {name: getattr(sdk.Client, name) for name in dir(sdk.Client) if not name.startswith("_")}
    own |= {
        name: getattr(stream, name)
        for name in ("scene_changes", "finished_frames", "live_states", "view", "tracks", "parts")
    }
    own |= {kind.__name__: kind for kind in (sdk.Client, sdk.AsyncClient, stream.Stream, stream.AsyncStream)}
    own |= {"IngestSocket": ingest.IngestSocket, "push": push}
    assert len(own) > sum(map(inspect.isfunction, vars(calls).values()))
    assert [name for name, value in own.items() if ">>> " not in (value.__doc__ or "")] == []
