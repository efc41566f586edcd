"""Raw peers: this folder is on the path."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parent))

from peers import stub


@pytest.fixture(scope="module")
def app():
    with stub() as running:
        yield running
