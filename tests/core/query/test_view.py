"""Views that a GPU renders, and what happens when it fails."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from histories import state

from scas4d_core.cameras import Camera, WorldFrame
from scas4d_core.engines.choose import WARP_DEVICE
from scas4d_core.query.committed import CommittedScene
from scas4d_core.query.view import View, ViewRenderer
from scas4d_core.storage.history import History

CAMERA = Camera("front", [[60, 0, 24], [0, 60, 20], [0, 0, 1]], np.eye(4), 48, 40)
WORLD = WorldFrame(np.array([0.1, 0, -1.5]), 0.5)


@pytest.fixture(autouse=True)
def _kernels_of_the_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("warp", reason="NVIDIA Warp is not installed: pip install warp-lang")
    monkeypatch.setenv(WARP_DEVICE, os.environ.get(WARP_DEVICE, "cpu"))


def rendered(renderer: ViewRenderer) -> View:
    shown = state(0, 60)
    return renderer.render(shown, CAMERA, (0.2, 0, 0.4), labels=np.arange(60) % 7 - 1)


def same(mine: View, true: View) -> None:
    np.testing.assert_allclose(mine.colour, true.colour, atol=1e-4)
    np.testing.assert_allclose(mine.alpha, true.alpha, atol=1e-4)
    both = np.isfinite(mine.depth) & np.isfinite(true.depth)
    assert both.sum() > 50
    np.testing.assert_allclose(mine.depth[both], true.depth[both], rtol=1e-4)
    assert mine.parts is not None
    assert np.mean(mine.parts == true.parts) > 0.99


def test_a_view_on_a_gpu_is_that_of_the_cpu() -> None:
    on_gpu = ViewRenderer(WORLD, device="gpu")
    true = rendered(ViewRenderer(WORLD))
    assert true.alpha.max() > 0.5
    same(rendered(on_gpu), true)
    assert on_gpu.device == "gpu"


def test_the_cpu_renders_after_a_gpu_has_failed(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    from scas4d_core.engines.warp.renderer import WarpRenderer

    def full(*given: object, **named: object) -> None:
        raise RuntimeError("Failed to allocate 123 bytes on device 'cuda:0'")

    renderer = ViewRenderer(WORLD, device="gpu")
    monkeypatch.setattr(WarpRenderer, "render", full)
    same(rendered(renderer), rendered(ViewRenderer(WORLD)))
    assert renderer.device == "cpu"
    assert "Failed to allocate 123 bytes" in caplog.text


def test_the_cpu_renders_if_no_renderer_can_be_created_on_the_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    from scas4d_core.engines.warp.renderer import WarpRenderer

    def full(*given: object, **named: object) -> None:
        raise RuntimeError("Failed to allocate 123 bytes on device 'cuda:0'")

    monkeypatch.setattr(WarpRenderer, "__init__", full)
    renderer = ViewRenderer(WORLD, device="gpu")
    same(rendered(renderer), rendered(ViewRenderer(WORLD)))
    assert renderer.device == "cpu"


def test_the_state_of_a_view_is_uploaded_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import warp as wp

    history = History(tmp_path / "states")
    history.append(0, 0.0, state(0, 60))
    history.append(1, 0.1, history.newest.retire([7]))
    scene = CommittedScene(History.load(tmp_path / "states"), WORLD, device="gpu")
    views = [scene.render(CAMERA, 1)]
    uploads: list[np.ndarray] = []
    construct = wp.array.__init__

    def constructed(self: wp.array, data: object = None, *given: object, **named: object) -> None:
        if isinstance(data, np.ndarray) and data.ndim:
            uploads.append(data)
        construct(self, data, *given, **named)

    monkeypatch.setattr(wp.array, "__init__", constructed)
    views.append(scene.render(CAMERA, 1))
    assert np.array_equal(views[0].colour, views[1].colour)
    assert views[0].alpha.max() > 0.5
    # opacities, which a history computes anew for each state with retired Gaussians
    assert sum(array.nbytes for array in uploads if len(array) == 60) <= 4 * 60


def test_a_fault_of_the_caller_does_not_change_the_device() -> None:
    renderer = ViewRenderer(WORLD, device="gpu")
    with pytest.raises(ValueError, match="labels"):
        renderer.render(state(0, 60), CAMERA, labels=np.zeros(3, np.int64))
    assert renderer.device == "gpu"
