"""CPU engine, built on float32 Numba kernels whose results do not depend on the number of threads.

``engine`` runs an iteration in the order of algorithm 1. Each stage has its own module. ``deformation`` implements the
cascade, per-Gaussian deltas and neighbour terms. ``renderer`` renders and compares full images, ``changed_pixels`` only
changed pixels. The other modules are ``rasterizer``, ``gloss``, ``colours``, ``floor`` and ``adam``.
"""
