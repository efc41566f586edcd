"""A running service with a fake in place of the core. Its processes import the fakes, so this folder is on the path."""

from __future__ import annotations

import httpx
import pytest
from running import Running, fake_settings, make_rig
from waiting import HANG_S, wait_for

from client.sdk import Client


@pytest.fixture(scope="session")
def service(tmp_path_factory):
    running = Running(fake_settings(tmp_path_factory.mktemp("data")))
    yield running
    running.stop()


@pytest.fixture
def http(service):
    with httpx.Client(base_url=service.url, timeout=HANG_S) as client:
        yield client


@pytest.fixture
def sdk(service):
    with Client(service.url, busy_timeout=HANG_S) as client:
        yield client


@pytest.fixture
def scene(sdk):
    """A scene of two cameras, deleted afterwards."""
    status = sdk.create_scene(make_rig(), frames_per_second=10)
    yield status.id
    sdk.delete_scene(status.id)


@pytest.fixture(scope="module")
def quiet_scene(service):
    """A scene that takes nothing: what is refused must leave it as it is."""
    with Client(service.url) as client:
        status = client.create_scene(make_rig())
        states = service.app.state.settings.data / "scenes" / status.id / "states"
        wait_for(states.exists)  # its worker makes the folder
        yield status.id
        assert client.scene(status.id) == status
        client.delete_scene(status.id)
