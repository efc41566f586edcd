"""Kernel functions for quaternions (w, x, y, z) stored as ``wp.vec4``. Reference: ``engines.torch.deformation``."""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def vector_of(q: wp.vec4) -> wp.vec3:
    """Returns the vector part (x, y, z)."""
    return wp.vec3(q[1], q[2], q[3])


@wp.func
def conjugate(q: wp.vec4) -> wp.vec4:
    """Returns the conjugate, which is the inverse rotation for a unit quaternion."""
    return wp.vec4(q[0], -q[1], -q[2], -q[3])


@wp.func
def product(a: wp.vec4, b: wp.vec4) -> wp.vec4:
    """Returns the Hamilton product, i.e. rotation b followed by rotation a.

    The product is linear in both factors. If g is the gradient of the product, the gradient of a is g b̄, and the
    gradient of b is ā g.
    """
    u = vector_of(a)
    v = vector_of(b)
    w = a[0] * b[0] - wp.dot(u, v)
    p = a[0] * v + b[0] * u + wp.cross(u, v)
    return wp.vec4(w, p[0], p[1], p[2])


@wp.func
def of_tangent(r: wp.vec3) -> wp.vec4:
    """Returns the unit quaternion (1, r) / |(1, r)|."""
    scale = 1.0 / wp.sqrt(1.0 + wp.dot(r, r))
    return wp.vec4(scale, scale * r[0], scale * r[1], scale * r[2])


@wp.func
def of_tangent_backward(r: wp.vec3, g: wp.vec4) -> wp.vec3:
    """Backpropagates the gradient of ``of_tangent`` to r."""
    q = of_tangent(r)
    along = wp.dot(q, g)
    return q[0] * (vector_of(g) - along * vector_of(q))


@wp.func
def change_of(q: wp.vec4, v: wp.vec3) -> wp.vec3:
    """Returns R v − v for the rotation R of a unit quaternion. The result is exactly 0 for the identity."""
    u = vector_of(q)
    across = wp.cross(u, v)
    return 2.0 * (q[0] * across + wp.cross(u, across))


@wp.func
def matrix_of(q: wp.vec4) -> wp.mat33:
    """Returns the rotation matrix of a unit quaternion."""
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@wp.func
def matrix_backward(q: wp.vec4, g: wp.mat33) -> wp.vec4:
    """Backpropagates the gradient of ``matrix_of`` to q."""
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    a = g[2, 1] - g[1, 2]
    b = g[0, 2] - g[2, 0]
    c = g[1, 0] - g[0, 1]
    d = g[0, 1] + g[1, 0]
    e = g[0, 2] + g[2, 0]
    f = g[1, 2] + g[2, 1]
    return wp.vec4(
        2.0 * (x * a + y * b + z * c),
        2.0 * (w * a + y * d + z * e - 2.0 * x * (g[1, 1] + g[2, 2])),
        2.0 * (w * b + x * d + z * f - 2.0 * y * (g[0, 0] + g[2, 2])),
        2.0 * (w * c + x * e + y * f - 2.0 * z * (g[0, 0] + g[1, 1])),
    )
