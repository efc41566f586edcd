"""The service with the fake engine, for studies that only ask it."""

from __future__ import annotations

import pytest
from running import Running, fake_settings


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    running = Running(fake_settings(tmp_path_factory.mktemp("data")))
    yield running
    running.stop()
