"""The definition of a scene that an earlier version wrote is read, also where a limit came after it."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest
from running import make_rig

from client.wire import RigModel, SceneCreate
from scas4d_core.settings import Settings
from server.storage.definition import Definition, DefinitionError


@pytest.fixture
def stored():
    request = SceneCreate(rig=RigModel.of(make_rig(2)))
    return Definition("a-scene", datetime.now(UTC), request, Settings()).as_json()


def test_what_was_written_is_read(stored):
    assert Definition.of_json(stored).settings == Settings()


def test_labels_of_nodes_are_kept_and_older_scenes_have_none(stored):
    assert Definition.of_json(stored).request.nodes == {}
    older = {**stored, "request": {name: value for name, value in stored["request"].items() if name != "nodes"}}
    assert Definition.of_json(older).request.nodes == {}
    stored["request"]["nodes"] = {"rig": "stage-a"}
    assert Definition.of_json(Definition.of_json(stored).as_json()).request.nodes == {"rig": "stage-a"}


def test_numbers_beyond_a_later_limit_are_brought_to_it(stored):
    stored["settings"]["update"]["iterations"] = 10**9
    found = Definition.of_json(stored).settings.update.iterations
    assert 10_000 <= found < 10**9
    assert stored["settings"]["update"]["iterations"] == 10**9  # what is stored stays


def test_other_faults_are_still_faults(stored):
    stored["settings"]["update"]["iterations"] = "many"
    with pytest.raises(DefinitionError, match="iterations"):
        Definition.of_json(stored)
