"""Decorators that compile kernels with common options, and a float32 exponential function."""

from __future__ import annotations

from typing import Any

import llvmlite.binding as llvm
import numba
import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from scas4d_core.guards import EXPONENT
from scas4d_core.kernels import cache

cache.use(cache.base())

# LLVM unrolls short loops before vectorization. Unrolled rows of 16 pixels remain scalar, which
# makes blending three times slower (measured). Loops over channels (at most 8) may still be
# unrolled.
llvm.set_option("scas4d", "-unroll-full-max-count=8")
# LLVM would otherwise hoist the checks for overlapping memory out of the row loop. The hoisted
# checks compare whole arrays, detect an overlap, and select the scalar path.
llvm.set_option("scas4d", "-hoist-runtime-checks=false")

# No fast math: every operation is rounded according to IEEE 754, in source order, so that results
# are bit-identical on all processors. Approximate reciprocals (`arcp`, `afn`) depend on the
# manufacturer, fused multiply-adds (`contract`) on the instruction set, and reordered sums
# (`reassoc`) on the register width. Long sums use explicit lanes instead. Strict rounding makes
# kernels about 1% slower (docs/tried.md).
STRICT: dict[str, Any] = {"fastmath": False, "error_model": "numpy"}


def _compiler(**more: Any) -> Any:
    """Returns a decorator like ``numba.njit``, with a cache that several processes may share."""
    options = {**STRICT, **more, "cache": True, "no_cfunc_wrapper": True}  # C callbacks are not needed
    decorate: Any = njit(**options)
    return lambda function: cache.shared(decorate(function))


kernel: Any = _compiler()
"""Decorator that compiles a single-threaded kernel, or a function that kernels call."""

parallel_kernel: Any = _compiler(parallel=True)
"""Decorator that compiles a kernel with parallel ``prange`` tasks. Tasks write disjoint data, so
results do not depend on the number of threads."""

inline: Any = _compiler(inline="always")
"""Decorator that compiles a small helper function, which is inlined into kernels."""

ZERO = np.float32(0.0)
HALF = np.float32(0.5)
ONE = np.float32(1.0)
TWO = np.float32(2.0)
LOG2_E = np.float32(1.4426950408889634)
MOST = np.float32(EXPONENT)


def threads() -> int:
    """Returns the number of threads that kernels use.

    By default, the number is ``NUMBA_NUM_THREADS``, or the number of available cores.
    """
    return int(numba.get_num_threads())


@intrinsic
def _float_of_bits(typing_context: Any, bits: Any) -> Any:
    """Reinterprets an int32 as a float32."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(types.int32), generate


@inline
def exp(x):
    """Returns the exponential of x, where x is clamped to ±87, with a relative error of 2e-7.

    Unlike the function of libm, this function vectorizes.
    """
    v = min(max(x * LOG2_E, -MOST), MOST)
    whole = np.floor(v + HALF)
    r = v - whole
    y = np.float32(1.535336188319500e-4)
    y = y * r + np.float32(1.339887440266574e-3)
    y = y * r + np.float32(9.618437357674640e-3)
    y = y * r + np.float32(5.550332471162809e-2)
    y = y * r + np.float32(2.402264791363012e-1)
    y = y * r + np.float32(6.931472028550421e-1)
    y = y * r + ONE
    return y * _float_of_bits(np.int32((np.int32(whole) + np.int32(127)) << np.int32(23)))
