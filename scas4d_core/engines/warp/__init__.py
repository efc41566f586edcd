"""The engine of a GPU: kernels in NVIDIA Warp, float32; they run on Warp's CPU device too, slowly, for tests.

Pictures: ``layout`` has the structures that kernels share, ``lanes`` the lanes of a warp; ``projection``, ``supports``,
``tiles`` and ``blend`` draw, ``picture_loss`` compares. ``rasterizer`` and ``pictures`` launch them; ``renderer`` draws
states.
"""
