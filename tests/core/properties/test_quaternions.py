"""Axioms of the quaternions, wherever the project has them, and of the rotation parameters (1, r)/|(1, r)|."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from law_cases import doubles, law

from scas4d_core.engines.torch.deformation import (
    material_rotations,
    quaternion_matrices,
    quaternion_product,
    rotation_quaternions,
)
from scas4d_core.gaussians import quaternions_to_matrices
from scas4d_core.update.warm_start import quaternion_products, rotate

TINY = 1e-12
"""A few hundred roundings of float64 at size 1."""

vectors = arrays(np.float64, 3, elements=st.floats(-1e3, 1e3, allow_subnormal=False))
units = arrays(np.float64, 4, elements=st.floats(-1, 1)).filter(lambda q: np.linalg.norm(q) > 0.1)
units = units.map(lambda q: q / np.linalg.norm(q))
ONE = doubles([1, 0, 0, 0])


def close(a: object, b: object, tolerance: float = TINY) -> None:
    np.testing.assert_allclose(np.asarray(a), np.asarray(b), rtol=0, atol=tolerance)


def conjugate(q: torch.Tensor) -> torch.Tensor:
    return q * doubles([1, -1, -1, -1])


@law(60)
@given(units, units, units)
def test_unit_quaternions_are_a_group(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    p, q, r = doubles(a), doubles(b), doubles(c)
    product = quaternion_product(p, q)
    close(product.norm(), 1.0)
    close(quaternion_product(product, r), quaternion_product(p, quaternion_product(q, r)))
    close(quaternion_product(p, ONE), p)
    close(quaternion_product(ONE, p), p)
    close(quaternion_product(p, conjugate(p)), ONE)
    close(conjugate(product), quaternion_product(conjugate(q), conjugate(p)))


@law(60)
@given(units, units)
def test_their_matrices_are_rotations_and_multiply_alike(a: np.ndarray, b: np.ndarray) -> None:
    p, q = doubles(a), doubles(b)
    matrix = quaternion_matrices(p)
    close(matrix @ matrix.T, np.eye(3))
    close(torch.linalg.det(matrix), 1.0)
    close(quaternion_matrices(quaternion_product(p, q)), matrix @ quaternion_matrices(q))
    close(quaternion_matrices(-p), matrix)
    close(quaternion_matrices(conjugate(p)), matrix.T)


@law(60)
@given(units, units)
def test_numpy_and_torch_mean_the_same(a: np.ndarray, b: np.ndarray) -> None:
    close(quaternion_products(a[None], b[None])[0], quaternion_product(doubles(a), doubles(b)))
    close(quaternions_to_matrices(a), quaternion_matrices(doubles(a)))
    once = material_rotations(doubles(a)[None], doubles(b)[None])[0]
    close(once.norm(), 1.0)
    close(once, quaternion_product(doubles(a), doubles(b)))


@law(60)
@given(vectors, vectors)
def test_rotation_parameters_are_axis_times_tangent_of_half_the_angle(r: np.ndarray, v: np.ndarray) -> None:
    q = rotation_quaternions(doubles(r))
    close(q.norm(), 1.0)
    assert q[0] > 0
    length = np.linalg.norm(r)
    close(np.arctan2(np.linalg.norm(q[1:].numpy()), q[0].item()), np.arctan(length))
    matrix = quaternion_matrices(q).numpy()
    close(matrix @ r, r, TINY * max(1, length))
    close(rotate(r[None], v[None])[0], matrix @ v, TINY * max(1, np.linalg.norm(v)))
    close(quaternion_matrices(rotation_quaternions(doubles(-r))), matrix.T)
    close(rotation_quaternions(torch.zeros(3, dtype=torch.float64)), ONE, 0)


@law(30)
@given(units, units)
def test_a_relative_turn_does_not_depend_on_the_sign_of_what_it_turns(a: np.ndarray, b: np.ndarray) -> None:
    """q and −q are one rotation, so material rotations built on either are one."""
    p, q = doubles(a)[None], doubles(b)[None]
    close(quaternion_matrices(material_rotations(p, -q)), quaternion_matrices(material_rotations(p, q)))
