"""Differentiable rasterization of Gaussians: ``cpu`` (Numba), ``twin`` (torch, float64), ``cuda`` (gsplat)."""
