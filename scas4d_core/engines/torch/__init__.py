"""Reference engine: PyTorch with autograd in float64, slow and exact.

``engine`` runs an iteration, ``parameters`` holds the learned parameters, ``scene`` the tensors of an attempt.
``deformation`` implements equations (5) to (7), ``losses`` equation (8) and the other terms, ``rasterizer`` the
rendering, ``gloss`` view-dependent colours. ``renderer`` renders states. It only serves as the reference in tests.
"""
