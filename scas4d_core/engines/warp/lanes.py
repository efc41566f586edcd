"""Functions of kernels in which the lanes of a warp work together.

A warp has 32 lanes on a GPU and one on Warp's CPU device; with these functions, a kernel is written once for both. All
lanes of a warp must call those that exchange something. Code that Warp hands to the compiler as it is has a
branch for each of the two devices.
"""

from __future__ import annotations

import warp as wp

wp.config.log_level = wp.LOG_WARNING  # it would write what it compiles among the output of commands
wp.set_module_options({"enable_backward": False})


def lanes_of(device: str) -> int:
    """The number of lanes of a warp on a device."""
    return 32 if wp.get_device(device).is_cuda else 1


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return threadIdx.x & 31;
#else
return 0;
#endif
""")
def lane() -> wp.int32:
    """The number of this lane in its warp."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return 32;
#else
return 1;
#endif
""")
def lane_count() -> wp.int32:
    """The number of lanes of a warp."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return __ballot_sync(0xffffffffu, flag);
#else
return flag != 0 ? 1u : 0u;
#endif
""")
def ballot(flag: wp.int32) -> wp.uint32:
    """The lanes whose flag is not 0, as bits."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return bits ? __ffs(bits) - 1 : 0;
#else
return 0;
#endif
""")
def lowest(bits: wp.uint32) -> wp.int32:
    """The first lane among some, by their bits; 0 where there is none."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return __shfl_sync(0xffffffffu, value, source);
#else
return value;
#endif
""")
def broadcast(value: wp.int32, source: wp.int32) -> wp.int32:
    """The value that one of the lanes has."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
__syncwarp();
#endif
""")
def sync_lanes() -> None:
    """Waits for the lanes of the warp; what they have written can be read by each other."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
for (int k = 16; k > 0; k >>= 1) value += __shfl_xor_sync(0xffffffffu, value, k);
#endif
return value;
""")
def sum_over_lanes(value: wp.float32) -> wp.float32:
    """The sum of the lanes' values."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return __expf(x);
#else
return ::expf(x);
#endif
""")
def fast_exp(x: wp.float32) -> wp.float32:
    """The exponential, to about 1e-6 relative."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return __fdividef(a, b);
#else
return a / b;
#endif
""")
def fast_divide(a: wp.float32, b: wp.float32) -> wp.float32:
    """The quotient, to about 1e-7 relative; 0 where the divisor is beyond 2^126."""
    ...


@wp.func_native("""
union { float number; unsigned bits; } either;
either.number = x;
return either.bits;
""")
def bits_of(x: wp.float32) -> wp.uint32:
    """The bits of a number; those of positive numbers sort as the numbers do."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
const float4 v = *reinterpret_cast<const float4*>(rows.data + row);
return wp::vec_t<4, wp::float32>(v.x, v.y, v.z, v.w);
#else
return rows.data[row];
#endif
""")
def load(rows: wp.array[wp.vec4], row: wp.int32) -> wp.vec4:
    """A row, in one instruction of 16 bytes."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
*reinterpret_cast<float4*>(rows.data + row) = make_float4(value[0], value[1], value[2], value[3]);
#else
rows.data[row] = value;
#endif
""")
def store(rows: wp.array[wp.vec4], row: wp.int32, value: wp.vec4) -> None:
    """Sets a row, in one instruction of 16 bytes."""
    ...
