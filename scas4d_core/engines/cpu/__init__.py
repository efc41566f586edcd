"""CPU engine, built on float32 Numba kernels whose results do not depend on the number of threads.

``engine`` runs the steps of each iteration in the order given by algorithm 1. Each stage has its own module.
``deformation`` implements the cascade, per-Gaussian deltas and neighbour terms. ``renderer`` renders and compares full
images, and ``changed_pixels`` processes only the changed pixels. The other modules are ``rasterizer``, ``gloss``,
``colours``, ``floor`` and ``adam``.
"""
