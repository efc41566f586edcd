"""CPU engine: Numba kernels in float32 whose results are bit-identical for any number of threads.

``engine`` runs an iteration in the order of algorithm 1. Each stage has its own module: ``deformation`` (cascade,
per-Gaussian deltas, neighbour terms), ``renderer`` and ``changed_pixels`` (render and compare full pictures or only
changed pixels), ``rasterizer``, ``gloss``, ``colours``, ``floor``, ``gains``, ``adam``.
"""
