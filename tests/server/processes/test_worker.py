"""The worker has the kernels compiled in a process beside before it reconstructs or resumes."""

from __future__ import annotations

import time
from multiprocessing import Pipe

import fakes
import numpy as np
import pytest
from running import HEIGHT, WIDTH, make_rig

from client.wire import Budget
from scas4d_core.captures import Frame
from scas4d_core.presets import preset
from server.processes.messages import SceneSpec
from server.processes.worker import Worker
from server.storage.layout import SceneFolder


@pytest.mark.parametrize(("device", "times"), [("cpu", 1), ("cuda", 0)])
def test_kernels_are_compiled_elsewhere_before_a_start_and_a_resume(tmp_path, monkeypatch, device, times):
    asked = []
    monkeypatch.setattr("scas4d_core.warm_up.warm_up_elsewhere", lambda: asked.append(device))
    monkeypatch.setattr("scas4d_core.reconstruction.Reconstruction", fakes.FakeReconstruction)
    spec = SceneSpec(SceneFolder(tmp_path), make_rig(), preset("scas4d", {"device": device}))
    ours, theirs = Pipe()
    with ours, theirs:
        first = Worker(spec, theirs)
        assert first.open()
        assert asked == []  # nothing to reconstruct yet
        images = {name: np.zeros((HEIGHT, WIDTH, 3), np.uint8) for name in spec.rig.names}
        first.reconstruct(Frame(0, 0.0, images, {}), {}, Budget(), time.perf_counter())
        assert len(asked) == times
        assert Worker(spec, theirs).open()
        assert len(asked) == 2 * times
