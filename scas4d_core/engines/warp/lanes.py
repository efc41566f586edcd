"""Warp-level primitives for kernels.

A warp has 32 lanes on a GPU and one lane on Warp's CPU device. Kernels that use these functions run on both devices.
Functions that exchange data must be called by all lanes of a warp. Native code snippets have one branch per device
type.
"""

from __future__ import annotations

import warp as wp

wp.config.log_level = wp.LOG_WARNING  # compilation messages would clutter the output of commands
wp.set_module_options({"enable_backward": False})


def lanes_of(device: str) -> int:
    """Returns the number of lanes per warp on a device."""
    return 32 if wp.get_device(device).is_cuda else 1


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return threadIdx.x & 31;
#else
return 0;
#endif
""")
def lane() -> wp.int32:
    """Returns the index of this lane in its warp."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return 32;
#else
return 1;
#endif
""")
def lane_count() -> wp.int32:
    """Returns the number of lanes per warp."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return __ballot_sync(0xffffffffu, flag);
#else
return flag != 0 ? 1u : 0u;
#endif
""")
def ballot(flag: wp.int32) -> wp.uint32:
    """Returns a bitmask of the lanes whose flag is not 0."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return bits ? __ffs(bits) - 1 : 0;
#else
return 0;
#endif
""")
def lowest(bits: wp.uint32) -> wp.int32:
    """Returns the index of the lowest set bit, or 0 if there is none."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return __shfl_sync(0xffffffffu, value, source);
#else
return value;
#endif
""")
def broadcast(value: wp.int32, source: wp.int32) -> wp.int32:
    """Returns the value from lane ``source``, in all lanes."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
__syncwarp();
#endif
""")
def sync_lanes() -> None:
    """Synchronizes the lanes of a warp, and makes their memory writes visible to each other."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
for (int k = 16; k > 0; k >>= 1) value += __shfl_xor_sync(0xffffffffu, value, k);
#endif
return value;
""")
def sum_over_lanes(value: wp.float32) -> wp.float32:
    """Returns the sum of a value over all lanes of a warp."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return __expf(x);
#else
return ::expf(x);
#endif
""")
def fast_exp(x: wp.float32) -> wp.float32:
    """Returns exp(x) with a relative error of about 1e-6."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return __fdividef(a, b);
#else
return a / b;
#endif
""")
def fast_divide(a: wp.float32, b: wp.float32) -> wp.float32:
    """Returns a / b with a relative error of about 1e-7, or 0 if b exceeds 2^126."""
    ...


@wp.func_native("""
union { float number; unsigned bits; } either;
either.number = x;
return either.bits;
""")
def bits_of(x: wp.float32) -> wp.uint32:
    """Returns a number's bit pattern. Patterns of positive numbers sort in the same order as the numbers."""
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
    """Loads a row with one 16-byte instruction."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
*reinterpret_cast<float4*>(rows.data + row) = make_float4(value[0], value[1], value[2], value[3]);
#else
rows.data[row] = value;
#endif
""")
def store(rows: wp.array[wp.vec4], row: wp.int32, value: wp.vec4) -> None:
    """Stores a row with one 16-byte instruction."""
    ...
