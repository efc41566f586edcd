"""Views that a GPU renders, and what happens when it fails."""

from __future__ import annotations

import os

import numpy as np
import pytest
from histories import state

from scas4d_core.cameras import Camera, WorldFrame
from scas4d_core.engines.choose import WARP_DEVICE
from scas4d_core.query.view import View, ViewRenderer

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


def test_a_fault_of_the_caller_does_not_change_the_device() -> None:
    renderer = ViewRenderer(WORLD, device="gpu")
    with pytest.raises(ValueError, match="labels"):
        renderer.render(state(0, 60), CAMERA, labels=np.zeros(3, np.int64))
    assert renderer.device == "gpu"
