"""The worker has the kernels compiled in processes beside before it reconstructs, updates or resumes, and says so."""

from __future__ import annotations

import time
from multiprocessing import Pipe

import fakes
import numpy as np
import pytest
from running import HEIGHT, WIDTH, make_rig

from client.wire import Budget
from scas4d_core.captures import Frame
from scas4d_core.compilation.manifest import KernelGroup
from scas4d_core.presets import preset
from server.messages import Progressed, SceneSpec
from server.processes.kernels import STAGE
from server.processes.worker import Worker
from server.storage.layout import SceneFolder


@pytest.mark.parametrize("points", [True, False])
@pytest.mark.parametrize("covariance", ["entangled", "separate"])
def test_kernels_are_compiled_before_they_are_called(tmp_path, monkeypatch, points, covariance):
    asked = []

    def elsewhere(wanted, *, then=(), on_progress=None):
        asked.append((set(wanted), set(then)))
        on_progress(1, 2)

    monkeypatch.setattr("scas4d_core.warm_up.compile_in_processes", elsewhere)
    monkeypatch.setattr("scas4d_core.reconstruction.Reconstruction", fakes.FakeReconstruction)
    settings = preset("scas4d", {"update": {"covariance": covariance}})
    spec = SceneSpec(SceneFolder(tmp_path), make_rig(), settings)
    if points:
        spec.folder.points.touch()
        monkeypatch.setattr(Worker, "points", lambda worker: None)
    ours, theirs = Pipe()
    with ours, theirs:
        first = Worker(spec, theirs)
        assert first.resume()
        assert asked == []  # nothing to reconstruct yet
        images = {name: np.zeros((HEIGHT, WIDTH, 3), np.uint8) for name in spec.rig.names}
        for frame in (Frame(0, 0.0, images, {}), Frame(1, 0.1, images, {})):
            for write in first.reconstruct(frame, {}, Budget(), time.perf_counter()).writes:
                write()
        assert Worker(spec, theirs).resume()
        said = []
        while ours.poll():
            said.append(ours.recv())
    waits = [(one.done, one.total) for one in said if isinstance(one, Progressed) and one.stage == STAGE]
    of_updates = {KernelGroup.UPDATE, KernelGroup.SEPARATE if covariance == "separate" else KernelGroup.ENTANGLED}
    of_first = {KernelGroup.FIRST_FRAME} if points else {KernelGroup.FIRST_FRAME, KernelGroup.STEREO}
    assert asked == [
        (of_first, of_updates),  # these while frame 0 is fitted
        ({KernelGroup.FIRST_FRAME} | of_updates, set()),
        ({KernelGroup.FIRST_FRAME} | of_updates, set()),
    ]
    assert waits == [(1, 2)] * 2
