"""The CPU engine: Numba kernels in float32, with the same bits for any number of threads.

``engine`` has an iteration in the order of algorithm 1; each stage is a file: ``deformation`` (cascade, own deltas,
neighbour terms), ``renderer`` and ``changed_pixels`` (render and compare, whole pictures or only changed pixels),
``rasterizer``, ``gloss``, ``colours``, ``floor``, ``gains``, ``adam``.
"""
