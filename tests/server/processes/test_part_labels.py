"""Parts keep their labels over commits and over the life of the process that finds them."""

from __future__ import annotations

import fakes
import numpy as np
import pytest

from client.wire import part_colour, parts_model
from scas4d_core.storage.history import History
from server.processes.part_labels import PartLabels

COUNT = 40


class Reader:
    """Numbers three parts by whatever is the largest now, unless it is told what they were called before."""

    def __init__(self, history):
        self.history = history
        self.asked = []

    def parts(self, count, previous=None):
        self.asked.append(None if previous is None else previous.tolist())
        if previous is not None:
            return previous
        return (np.arange(COUNT) + len(self.history)) % 3


@pytest.fixture
def scene(tmp_path):
    history = History(tmp_path / "states")
    points = np.random.default_rng(0).normal(size=(COUNT, 3))
    history.append(0, 0.0, fakes.state(points, 0))
    return tmp_path, history, points


def test_labels_go_on_over_commits_and_processes(scene):
    folder, history, points = scene
    reader = Reader(history)
    labels = PartLabels(folder / "parts")
    first = labels.of(reader, history, 3)
    assert labels.of(reader, history, 3) is first
    assert len(reader.asked) == 1
    history.append(1, 0.1, fakes.state(points, 1))
    assert np.array_equal(labels.of(reader, history, 3), first)
    assert reader.asked[1] == first.tolist()
    another = PartLabels(folder / "parts")  # the process was started anew
    assert np.array_equal(another.of(reader, history, 3), first)
    assert len(reader.asked) == 2
    history.append(2, 0.2, fakes.state(points, 2))
    assert np.array_equal(PartLabels(folder / "parts").of(reader, history, 3), first)


def test_each_count_has_its_own(scene):
    folder, history, _ = scene
    reader = Reader(history)
    labels = PartLabels(folder / "parts")
    for count in (3, None, 5):
        labels.of(reader, history, count)
    assert reader.asked == [None, None, None]
    assert sorted(file.name for file in (folder / "parts").iterdir()) == ["3.npz", "5.npz", "chosen.npz"]


@pytest.mark.parametrize("damage", [b"", b"PK not a zip", None])
def test_a_damaged_file_costs_the_numbering_only(scene, damage):
    folder, history, points = scene
    reader = Reader(history)
    PartLabels(folder / "parts").of(reader, history, 3)
    file = folder / "parts" / "3.npz"
    file.write_bytes(file.read_bytes()[:60] if damage is None else damage)
    history.append(1, 0.1, fakes.state(points, 1))
    found = PartLabels(folder / "parts").of(reader, history, 3)
    assert reader.asked == [None, None]
    assert np.array_equal(PartLabels(folder / "parts").of(reader, history, 3), found)


def test_labels_of_other_gaussians_are_not_gone_on_from(scene):
    folder, history, _ = scene
    (folder / "parts").mkdir()
    np.savez(folder / "parts" / "3.npz", labels=np.zeros(7, np.int16), frame=np.int64(-1))
    reader = Reader(history)
    PartLabels(folder / "parts").of(reader, history, 3)
    assert reader.asked == [None]


def test_what_cannot_be_written_does_not_cost_the_answer(scene):
    folder, history, _ = scene
    (folder / "parts").write_text("a file where the folder would be")
    assert len(PartLabels(folder / "parts").of(Reader(history), history, 3)) == COUNT


def test_a_label_has_one_colour_and_near_labels_differ():
    model = parts_model(np.array([2, 0, -1, 2]), np.array([5, 6, 7, 8]), 9)
    assert (model.count, model.frame, model.labels) == (2, 9, [2, 0, -1, 2])
    assert model.colours == [part_colour(0), part_colour(1), part_colour(2)]
    colours = np.array([part_colour(label) for label in range(12)], float)
    apart = np.linalg.norm(colours[:, None] - colours[None], axis=-1)[np.triu_indices(12, 1)]
    assert apart.min() > 40
