"""Scenes with rules of ingest, deleted after the test."""

from __future__ import annotations

import io

import numpy as np
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
        if cameras == 1:  # it begins with points only
            file = io.BytesIO()
            np.savez(file, positions=np.zeros((3, 3)), colours=np.zeros((3, 3), np.float32))
            assert http.put(f"/v1/scenes/{made[-1]}/points", content=file.getvalue()).status_code == 200
        return made[-1]

    yield scene
    for id in made:
        http.delete(f"/v1/scenes/{id}")
