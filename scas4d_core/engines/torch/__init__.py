"""Reference engine in PyTorch, with autograd in float64: slow but exact, and only used in tests.

``engine`` runs iterations. ``parameters`` defines the learned parameters, and ``scene`` holds the tensors of an
attempt. ``deformation`` implements equations (5) to (7), and ``losses`` implements equation (8) and all other loss
terms. ``rasterizer`` rasterizes Gaussians, ``gloss`` computes view-dependent colours, and ``renderer`` renders states.
"""
