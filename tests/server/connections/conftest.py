"""Raw peers: this folder is on the path."""

from __future__ import annotations

import pytest
from peers import stub


@pytest.fixture(scope="module")
def app():
    with stub() as running:
        yield running
