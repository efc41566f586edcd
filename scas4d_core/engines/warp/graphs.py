"""Sequences of launches that are captured once and replayed: CUDA graphs, or plain launches on the CPU device."""

from __future__ import annotations

from collections.abc import Callable, Hashable

import warp as wp


class Graphs:
    """The captured variants of one sequence of launches.

    Args:
        device: Warp device, such as "cpu" or "cuda:0".
    """

    def __init__(self, device: str) -> None:
        self._device = device
        self._captures = wp.get_device(device).is_cuda
        self._graphs: dict[Hashable, wp.Graph | None] = {}

    def forget(self) -> None:
        """Discards all graphs; call it after a buffer was replaced."""
        self._graphs = {}

    def run(self, variant: Hashable, launch: Callable[[], None]) -> None:
        """Runs a variant.

        Args:
            variant: identifies the launches. launch: enqueues them; it must neither wait for the device nor allocate.
        """
        if not self._captures:
            launch()
        elif variant not in self._graphs:  # the first run compiles kernels, which a capture does not allow
            launch()
            self._graphs[variant] = None
        else:
            graph = self._graphs[variant]
            if graph is None:
                with wp.ScopedCapture(device=self._device) as capture:
                    launch()
                graph = self._graphs[variant] = capture.graph
            wp.capture_launch(graph)
