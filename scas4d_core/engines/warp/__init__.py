"""GPU engine: NVIDIA Warp kernels in float32. They also run, slowly, on Warp's CPU device for tests.

Rendering: ``layout`` defines the structures shared by kernels and ``lanes`` the warp-level primitives. ``projection``,
``supports``, ``tiles`` and ``blend`` render, ``picture_loss`` compares. ``rasterizer`` and ``pictures`` launch these
kernels, and ``renderer`` renders states.
"""
