"""The reference engine: torch with autograd in float64, slow and exact.

``engine`` is an iteration; ``parameters`` has what is learnt, ``scene`` the tensors of an attempt. ``deformation`` has
equations (5) to (7), ``losses`` equation (8) and the other terms, ``rasterizer`` the pictures, ``gloss`` colours by
direction. ``renderer`` draws states. No service runs it: the other engines are tested against it.
"""
