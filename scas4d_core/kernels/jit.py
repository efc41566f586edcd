"""How kernels are compiled, in one place."""

from __future__ import annotations

from typing import Any

import llvmlite.binding as llvm
import numba
import numpy as np
from numba import njit

# LLVM unrolls short loops before it vectorizes loops; unrolled, the rows of 16 pixels stay scalar (measured: blending
# 3 times slower). Loops over channels (at most 8) may still be unrolled.
llvm.set_option("scas4d", "-unroll-full-max-count=8")
# Overlap checks hoisted out of the loop over rows compare whole arrays, find overlap, and take the scalar path.
llvm.set_option("scas4d", "-hoist-runtime-checks=false")

# NaN and infinity keep their meaning: fast-math that assumes them away turns 0/0 into a silent identity.
FAST_MATH = {"nsz", "arcp", "contract", "afn", "reassoc"}

kernel: Any = njit(cache=True, fastmath=FAST_MATH, error_model="numpy")
"""A function on one thread, or called from inside a kernel."""

parallel_kernel: Any = njit(cache=True, fastmath=FAST_MATH, error_model="numpy", parallel=True)
"""A function over ``prange`` tasks. Tasks write disjoint places: the result does not depend on the thread count."""

inline: Any = njit(cache=True, fastmath=FAST_MATH, error_model="numpy", inline="always")
"""A few lines shared by kernels."""

ZERO = np.float32(0.0)
HALF = np.float32(0.5)
ONE = np.float32(1.0)
TWO = np.float32(2.0)


def threads() -> int:
    """Threads that kernels use (``NUMBA_NUM_THREADS`` or the cores at hand)."""
    return int(numba.get_num_threads())
