"""Reference engine in PyTorch, with autograd in float64: slow but exact, and only used in tests.

``engine`` runs iterations, ``parameters`` defines the learned parameters, and ``scene`` the tensors of an attempt.
``deformation`` implements equations (5) to (7), ``losses`` equation (8) and all other loss terms, ``rasterizer`` the
rasterization, and ``gloss`` view-dependent colours. ``renderer`` renders states.
"""
