"""Scenes with rules of ingest, deleted after the test."""

from __future__ import annotations

import pytest
from running import make_rig

from client.wire import RigModel


@pytest.fixture
def make(http):
    """Makes scenes with rules of ingest; deletes them."""
    made = []

    def scene(cameras=2, **ingest):
        body = {"rig": RigModel.of(make_rig(cameras)).model_dump(mode="json"), "ingest": ingest}
        answer = http.post("/v1/scenes", json={**body, "frames_per_second": 10})
        assert answer.status_code == 201, answer.text
        made.append(answer.json()["id"])
        return made[-1]

    yield scene
    for id in made:
        http.delete(f"/v1/scenes/{id}")
