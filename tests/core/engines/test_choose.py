"""Which engine a scene gets for the setting ``device``."""

from __future__ import annotations

import ctypes
import importlib.util
from collections.abc import Iterator

import pytest

from scas4d_core.engines import choose
from scas4d_core.engines.choose import DeviceError, engine_of, resolve_device
from scas4d_core.engines.cpu.engine import CpuEngine

WARP = importlib.util.find_spec("warp") is not None


@pytest.fixture(autouse=True)
def forget(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Lets each test determine anew whether there is a GPU."""
    monkeypatch.delenv(choose.WARP_DEVICE, raising=False)
    choose._hardware_fault.cache_clear()
    yield
    choose._hardware_fault.cache_clear()


def no_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    real = ctypes.CDLL

    def load(name: str, *given: object, **named: object) -> object:
        if "cuda" in name:
            raise OSError(name)
        return real(name, *given, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(ctypes, "CDLL", load)


def test_without_warp_auto_is_the_cpu_and_gpu_is_refused_with_the_extra(monkeypatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert resolve_device("auto") == resolve_device("cpu") == "cpu"
    with pytest.raises(DeviceError, match=r"NVIDIA Warp is not installed \(extra gpu\); see docs/gpu.md"):
        resolve_device("gpu")


def test_without_a_driver_auto_is_the_cpu_and_warp_is_not_imported(monkeypatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    no_driver(monkeypatch)
    assert resolve_device("auto") == "cpu"
    with pytest.raises(DeviceError, match="no NVIDIA driver is installed"):
        resolve_device("gpu")


@pytest.mark.skipif(not WARP, reason="NVIDIA Warp is not installed: pip install warp-lang")
@pytest.mark.parametrize("devices", [0, 1])
def test_with_a_driver_the_number_of_gpus_decides(devices: int, monkeypatch) -> None:
    import warp

    monkeypatch.setattr(ctypes, "CDLL", lambda name: None)
    monkeypatch.setattr(warp, "get_cuda_device_count", lambda: devices)
    monkeypatch.setattr(warp, "get_device", lambda name: name)
    assert resolve_device("auto") == ("gpu" if devices else "cpu")
    if not devices:
        with pytest.raises(DeviceError, match="no NVIDIA GPU can be used"):
            resolve_device("gpu")


@pytest.mark.skipif(not WARP, reason="NVIDIA Warp is not installed: pip install warp-lang")
def test_the_kernels_run_without_a_gpu_only_on_request(monkeypatch) -> None:
    monkeypatch.setenv(choose.WARP_DEVICE, "cpu")
    assert resolve_device("auto") == "cpu"
    assert resolve_device("gpu") == "gpu"
    assert engine_of("gpu").name == "warp"
    assert isinstance(engine_of("cpu"), CpuEngine)
    monkeypatch.delenv(choose.WARP_DEVICE)
    no_driver(monkeypatch)
    assert resolve_device("auto") == "cpu"  # what was found for one is not kept for the other


@pytest.mark.skipif(not WARP, reason="NVIDIA Warp is not installed: pip install warp-lang")
def test_a_device_that_does_not_exist_is_named(monkeypatch) -> None:
    import warp

    monkeypatch.setenv(choose.WARP_DEVICE, "cuda:7")
    monkeypatch.setattr(ctypes, "CDLL", lambda name: None)
    monkeypatch.setattr(warp, "get_cuda_device_count", lambda: 1)
    with pytest.raises(DeviceError, match="NVIDIA Warp cannot use 'cuda:7'"):
        resolve_device("gpu")
    assert resolve_device("auto") == "cpu"
