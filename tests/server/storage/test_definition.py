"""The definition of a scene: what was written is read, and another format is refused by name and left as it is."""

from __future__ import annotations

import json
from datetime import UTC, datetime

import pytest
from blake3 import blake3
from running import make_rig

from client.wire import RigModel, SceneCreate
from scas4d_core.settings import Settings
from server.storage.definition import FORMAT, Definition, DefinitionError, read_definition, write_definition
from server.storage.events import SceneCreated
from server.storage.journal import write_journal
from server.storage.layout import SceneFolder


@pytest.fixture
def definition():
    return Definition("a-scene", datetime.now(UTC), SceneCreate(rig=RigModel.of(make_rig(2))), Settings())


@pytest.fixture
def stored(definition):
    return definition.as_json()


def write(folder, scene):
    """Writes `scene.json` with a checksum that agrees, whatever the scene says."""
    text = json.dumps(scene, indent=1)
    digest = blake3(text.encode()).hexdigest()
    folder.definition.write_text(json.dumps({"blake3": digest, "scene": scene}, indent=1))


def test_what_was_written_is_read(tmp_path, definition):
    folder = SceneFolder(tmp_path)
    write_definition(folder, definition)
    assert read_definition(folder) == (definition, None)


def test_labels_of_nodes_are_kept(stored):
    assert Definition.from_json(stored).request.nodes == {}
    stored["request"]["nodes"] = {"rig": "stage-a"}
    assert Definition.from_json(Definition.from_json(stored).as_json()).request.nodes == {"rig": "stage-a"}


@pytest.mark.parametrize("other", [FORMAT - 1, FORMAT + 1])
def test_another_format_is_refused_by_name(stored, other):
    with pytest.raises(DefinitionError, match=rf"format {other}.*reads format {FORMAT}.*version that wrote it"):
        Definition.from_json({**stored, "format": other})


def test_what_the_file_has_is_not_replaced_by_what_the_journal_has(tmp_path, stored):
    folder = SceneFolder(tmp_path)
    write(folder, {**stored, "format": FORMAT + 1})
    write_journal(folder.journal, iter([SceneCreated(definition=stored)]))
    with pytest.raises(DefinitionError, match=f"format {FORMAT + 1}"):
        read_definition(folder)


@pytest.mark.parametrize("value", [10**9, "many"])
def test_settings_that_are_refused_are_named(stored, value):
    stored["settings"]["update"]["iterations"] = value
    with pytest.raises(DefinitionError, match="iterations"):
        Definition.from_json(stored)
