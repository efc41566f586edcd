"""Labels of nodes: the request takes those that Ray takes, and every process of the scene asks for them."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import ValidationError
from running import make_rig

from client.wire import RigModel, SceneCreate
from scas4d_core.settings import Settings
from server.cluster.resource_needs import resource_needs
from server.messages import ExportSpec, ReplaySpec, SceneSpec
from server.processes import exporter, reader_process, replayer, worker
from server.settings import ServerSettings
from server.storage.layout import SceneFolder

RIG = RigModel.of(make_rig())
GOOD = [
    {"rig": "stage-a"},
    {"studio.example/rig": "A.1_b"},
    {"ray.io/accelerator-type": "A100"},
    {"a" * 63: "b" * 63},
    {str(number): "x" for number in range(16)},
]
BAD = [
    {"": "a"},
    {"rig": ""},
    {"rig name": "a"},
    {"-rig": "a"},
    {"a/b/c": "a"},
    {"rig": "stage a"},
    {"rig": "!stage-a"},
    {"rig": "in(a,b)"},
    {"rig": "a\n"},
    {"rig": "é"},
    {"a" * 64: "b"},
    {"a": "b" * 64},
]


def spec(tmp_path: Path, labels: dict[str, str]) -> SceneSpec:
    return SceneSpec(SceneFolder(tmp_path / "scene"), make_rig(), Settings(), nodes=labels)


@pytest.mark.parametrize("labels", GOOD)
def test_ray_takes_what_the_request_takes(labels: dict[str, str]) -> None:
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'scas4d[ray]'")
    from ray._private.label_utils import validate_label_selector

    assert SceneCreate(rig=RIG, nodes=labels).nodes == labels
    assert validate_label_selector(labels) is None


@pytest.mark.parametrize("labels", BAD)
def test_what_no_node_can_have_is_refused_with_the_rule(labels: dict[str, str]) -> None:
    with pytest.raises(ValidationError, match=r"for a node label.*use names and values of 1 to 63 letters"):
        SceneCreate(rig=RIG, nodes=labels)


def test_the_number_of_labels_is_bounded() -> None:
    with pytest.raises(ValidationError, match="at most 16"):
        SceneCreate(rig=RIG, nodes={str(number): "x" for number in range(17)})


def test_every_process_of_the_scene_asks_for_them(tmp_path: Path) -> None:
    scene = spec(tmp_path, {"rig": "stage-a", "disk": "fast"})
    export = ExportSpec(scene, tmp_path / "x.ply", "ply", 0, (0,))
    replay = ReplaySpec(scene, 0, 0, (), (5,))
    runs = [(worker.main, scene), (reader_process.run_view_reader, scene), (reader_process.run_bulk_reader, scene)]
    for entry, given in [*runs, (exporter.main, export), (replayer.main, replay)]:
        needs = resource_needs(entry, given, ServerSettings())
        assert needs is not None
        assert needs.actor_options()["label_selector"] == {"rig": "stage-a", "disk": "fast"}
        assert needs.describe().endswith(" GB of memory on a node with rig=stage-a, disk=fast")


def test_a_scene_without_labels_runs_on_any_node(tmp_path: Path) -> None:
    needs = resource_needs(worker.main, spec(tmp_path, {}), ServerSettings())
    assert needs is not None
    assert "label_selector" not in needs.actor_options()
    assert needs.describe().endswith("GB of memory")
