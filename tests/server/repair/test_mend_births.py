"""Files of Gaussians that were born are mended like the others that every frame needs."""

from __future__ import annotations

import numpy as np
import pytest
from histories import state

from scas4d_core.storage.frame_files import FIRST_COPY, FIXED_COPY, born_file
from scas4d_core.storage.history import History
from server.messages import RepairFiles, RepairOutcome
from server.repair.repairs import repair_at_start, repair_files


@pytest.fixture
def history(tmp_path):
    history = History(tmp_path)
    history.append(0, 0.0, state(0))
    history.append(1, 0.1, history.newest.concatenate(state(1, 2)))
    history.append(2, 0.2, history.newest)
    return history


@pytest.mark.parametrize("copy", [False, True])
def test_one_of_both_is_written_from_the_other(history, tmp_path, copy):
    file = tmp_path / born_file(1, copy)
    whole = file.read_bytes()
    for spoilt in (b"", whole[:300]):
        file.write_bytes(spoilt)
        (mended,) = repair_files(History.open(tmp_path), None, RepairFiles((file.name,)))
        assert (mended.outcome, file.name in mended.reason) == (RepairOutcome.WRITTEN, True)
        assert np.array_equal(History.open(tmp_path).ids, history.ids)
        (mended,) = repair_files(History.open(tmp_path), None, RepairFiles((file.name,)))
        assert mended.outcome is RepairOutcome.WHOLE
    file.unlink()
    assert file.name in repair_at_start(History.open(tmp_path))[0]
    assert file.exists()


@pytest.mark.parametrize("name", [FIXED_COPY, FIRST_COPY])
def test_a_copy_that_is_gone_is_written_again_and_named(history, tmp_path, name):
    (tmp_path / name).unlink()
    (sentence,) = repair_at_start(History.open(tmp_path))
    assert sentence.startswith(name)
    assert (tmp_path / name).exists()


def test_both_are_written_from_memory(history, tmp_path):
    names = born_file(1), born_file(1, copy=True)
    for name in names:
        (tmp_path / name).write_bytes(b"")
    assert [mended.outcome for mended in repair_files(history, None, RepairFiles(names))] == [
        RepairOutcome.WRITTEN,
        RepairOutcome.WHOLE,
    ]
    assert len(History.open(tmp_path).newest) == 9


def test_of_a_birth_that_was_taken_back_nothing_is_missed(history, tmp_path):
    history.truncate(0)
    (tmp_path / born_file(1)).write_bytes(b"")
    (mended,) = repair_files(history, None, RepairFiles((born_file(1),)))
    assert mended.outcome is RepairOutcome.GONE
