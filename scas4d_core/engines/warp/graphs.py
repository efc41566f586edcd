"""Kernel launch sequences that are captured as CUDA graphs and replayed, or launched directly on the CPU device."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import ClassVar

import warp as wp


class Graphs:
    """The captured variants of one launch sequence.

    Args:
        device: Warp device, such as "cpu" or "cuda:0".

    Attributes:
        captures: whether to capture graphs. If None, graphs are captured on GPUs only. Tests and measurements of single
            kernels set another value on the class before they bind an engine.
    """

    captures: ClassVar[bool | None] = None

    def __init__(self, device: str) -> None:
        self._device = device
        self._captures = wp.get_device(device).is_cuda if self.captures is None else self.captures
        self._graphs: dict[Hashable, wp.Graph | None] = {}

    def forget(self) -> None:
        """Discards all graphs. Call this method after a buffer is reallocated."""
        self._graphs = {}

    def run(self, variant: Hashable, launch: Callable[[], None]) -> None:
        """Runs a variant of the launch sequence.

        If graphs are captured, the second run captures the variant, and later runs replay it.

        Args:
            variant: key that identifies the launches.
            launch: function that enqueues the launches. It must neither wait for the device nor allocate memory.
        """
        if not self._captures:
            launch()
        elif variant not in self._graphs:  # the first run compiles kernels, which is not allowed during capture
            launch()
            self._graphs[variant] = None
        else:
            graph = self._graphs[variant]
            if graph is None:
                with wp.ScopedCapture(device=self._device) as capture:
                    launch()
                graph = self._graphs[variant] = capture.graph
            wp.capture_launch(graph)
