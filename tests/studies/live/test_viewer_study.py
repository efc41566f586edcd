"""The viewer study commits recorded states back and forth, and reports bytes and times."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from histories import filled

from scas4d_core.storage.history import History, run_now
from studies.live.playback import Playback
from studies.live.viewer import ViewerResult, report


def test_recorded_states_are_committed_back_and_forth(tmp_path, monkeypatch):
    recorded = filled(History(tmp_path / "states"), 3)
    monkeypatch.setattr(Playback, "recorded", tmp_path / "states", raising=False)
    history = History()
    playback = Playback.start(None, SimpleNamespace(index=0, time=0.0), None, history=history, defer=run_now)
    for index in range(1, 5):
        playback.step(SimpleNamespace(index=index, time=0.1 * index), defer=run_now)
    for index, source in enumerate([0, 1, 2, 1, 0]):
        true = recorded.gaussians(recorded.indices[source])
        np.testing.assert_array_equal(history.gaussians(index).means, true.means)


def test_the_report_names_bytes_and_times():
    text = report(ViewerResult(70_000.0, [40.0, 60.0, 80.0], [200.0], [(20.0, 40.0)], 3, 4.5), 5.0)
    assert "| 70.0 kB |" in text
    assert "60 / 78 ms (3 frames)" in text
    assert "20 ms / 40 ms" in text
