"""Explicit SIMD for kernels, with sixteen float32 values in one variable.

``Lanes`` corresponds to LLVM's ``<16 x float>``, which occupies one AVX-512, two AVX2 or four NEON
registers. Kernels can add, subtract, multiply, divide and compare ``Lanes`` like numbers. Float32
operands are broadcast. Kernels can also load and store ``Lanes`` at a flat index of a contiguous
array. Results do not depend on the loop vectorizer of the compiler.
"""

from __future__ import annotations

import operator
from functools import wraps
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, lower_cast, models, register_model

from scas4d_core.kernels.jit import LOG2_E, MOST, inline

COUNT = 16
"""Number of lanes in a ``Lanes`` value."""

emitted: Any = intrinsic
"""Decorator for functions that emit LLVM instructions into kernels. Use it if the types depend on those of the
arguments, and ``instruction`` otherwise."""
ARRAY = "array"
"""Type of an argument of an ``instruction`` that is a C-contiguous float32 array of any shape."""

_FLOAT, _BYTE = ir.FloatType(), ir.IntType(8)
_INT, _BIT, _LONG = ir.IntType(32), ir.IntType(1), ir.IntType(64)
_FLOATS, _INTS, _BITS = (ir.VectorType(kind, COUNT) for kind in (_FLOAT, _INT, _BIT))


class LanesType(types.Type):
    """Numba type of sixteen float32 values."""

    def __init__(self) -> None:
        super().__init__(name="lanes")


class LaneMaskType(types.Type):
    """Numba type of sixteen booleans."""

    def __init__(self) -> None:
        super().__init__(name="lane_mask")


lanes_type = LanesType()
mask_type = LaneMaskType()


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, of: Any) -> None:
        super().__init__(manager, of, _FLOATS)


@register_model(LaneMaskType)
class _LaneMaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, of: Any) -> None:
        super().__init__(manager, of, _BITS)


def _filled(builder: Any, scalar: Any) -> Any:
    nothing = ir.Constant(_FLOATS, ir.Undefined)
    first = builder.insert_element(nothing, scalar, _INT(0))
    return builder.shuffle_vector(first, nothing, ir.Constant(_INTS, [0] * COUNT))


def _constant(values: Any) -> Any:
    return ir.Constant(_FLOATS, [float(value) for value in values])


def _call(builder: Any, name: str, result: Any, arguments: Any) -> Any:
    kind = ir.FunctionType(result, [argument.type for argument in arguments])
    insert: Any = cgutils.get_or_insert_function
    return builder.call(insert(builder.module, kind, name), arguments)


@lower_cast(types.float32, LanesType)
def _spread(context: Any, builder: Any, source: Any, target: Any, value: Any) -> Any:
    return _filled(builder, value)


def _operator(function: Any, result: Any, operands: tuple[Any, ...], method: str, *how: str) -> None:
    """Registers an operator. A float32 can replace one of two operands that are ``Lanes``.

    Args:
        function: function of the module ``operator``.
        result: type of the result.
        operands: one or two equal types.
        method: name of the method of LLVM's IR builder that emits the instruction.
        how: arguments of the method that precede the operands.
    """
    own = operands[0]
    accepted = (own, types.float32) if own == lanes_type else (own,)

    class Template(AbstractTemplate):
        key = function

        def generic(self, arguments: Any, keywords: Any) -> Any:
            if len(arguments) == len(operands) and own in arguments and all(a in accepted for a in arguments):
                return signature(result, *operands)
            return None

    infer_global(function)(Template)

    @lower_builtin(function, *operands)
    def lower(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return getattr(builder, method)(*how, *arguments)


_TWO = (lanes_type, lanes_type)
for _names, _method in (
    (("add", "iadd"), "fadd"),
    (("sub", "isub"), "fsub"),
    (("mul",), "fmul"),
    (("truediv",), "fdiv"),
):
    for _name in _names:
        _operator(getattr(operator, _name), lanes_type, _TWO, _method)
for _name, _sign in (("lt", "<"), ("le", "<="), ("gt", ">"), ("ge", ">=")):
    _operator(getattr(operator, _name), mask_type, _TWO, "fcmp_ordered", _sign)
_operator(operator.ne, mask_type, _TWO, "fcmp_unordered", "!=")  # NaN is not equal to any number
_operator(operator.neg, lanes_type, (lanes_type,), "fneg")
_operator(operator.and_, mask_type, (mask_type, mask_type), "and_")


def _data(context: Any, builder: Any, array_type: Any, array: Any) -> Any:
    """Returns a pointer to the first value of an array."""
    if not (isinstance(array_type, types.Array) and array_type.dtype == types.float32 and array_type.layout == "C"):
        raise TypeError(f"Lanes can only be loaded from and stored to C-contiguous float32 arrays, not {array_type}")
    return cgutils.create_struct_proxy(array_type)(context, builder, value=array).data


def instruction(result: Any, *arguments: Any) -> Any:
    """Returns a decorator for functions that emit LLVM instructions into kernels.

    The decorated function receives LLVM's IR builder, followed by the LLVM value of each argument. For an
    ``ARRAY``, this value is a pointer to the first element.

    Args:
        result: Numba type of the result.
        arguments: Numba types of the arguments.
    """

    def decorate(emit: Any) -> Any:
        @wraps(emit)  # Numba takes the names of the arguments from the function's signature
        def typed(typing_context: Any, *given: Any) -> Any:
            def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
                values = [
                    _data(context, builder, kind, value) if wanted == ARRAY else value
                    for wanted, kind, value in zip(arguments, given, values, strict=True)
                ]
                made = emit(builder, *values)
                return context.get_dummy_value() if result == types.void else made

            kinds = [kind if wanted == ARRAY else wanted for wanted, kind in zip(arguments, given, strict=True)]
            return result(*kinds), generate

        return intrinsic(typed)

    return decorate


@instruction(lanes_type, mask_type, lanes_type, lanes_type)
def choose(builder: Any, mask: Any, yes: Any, no: Any) -> Any:
    """Selects ``yes`` in lanes where the mask is set, and ``no`` in all others."""
    return builder.select(mask, yes, no)


@instruction(types.boolean, mask_type)
def any_of(builder: Any, mask: Any) -> Any:
    """Returns whether the mask is set in any lane."""
    return builder.icmp_unsigned("!=", builder.bitcast(mask, ir.IntType(COUNT)), ir.IntType(COUNT)(0))


@instruction(lanes_type, lanes_type, lanes_type)
def minimum(builder: Any, x: Any, y: Any) -> Any:
    """Returns the smaller value in each lane; y if one of them is NaN."""
    return builder.select(builder.fcmp_ordered("<", x, y), x, y)


@instruction(lanes_type, lanes_type, lanes_type)
def maximum(builder: Any, x: Any, y: Any) -> Any:
    """Returns the larger value in each lane; y if one of them is NaN."""
    return builder.select(builder.fcmp_ordered(">", x, y), x, y)


def _unary(name: str) -> Any:
    return instruction(lanes_type, lanes_type)(
        lambda builder, x: _call(builder, f"llvm.{name}.v{COUNT}f32", _FLOATS, [x])
    )


floor = _unary("floor")
nearest = _unary("rint")
square_root = _unary("sqrt")
magnitude = _unary("fabs")


def _fixed(values: Any) -> Any:
    return instruction(lanes_type)(lambda builder: _constant(values))


ACROSS = 4
"""Side length of a block in pixels. The pixels of a block form one ``Lanes`` in row-major order."""

block_columns = _fixed([k % ACROSS for k in range(COUNT)])
block_rows = _fixed([k // ACROSS for k in range(COUNT)])

_eight_columns = _fixed([ACROSS * (k % 8) for k in range(COUNT)])
ends = _fixed([-1.0] * 8 + [1.0] * 8)
"""Returns -1 in the first eight lanes and 1 in the others."""


@inline
def ramp(start):
    """Returns the eight values ``start``, ``start`` + 4, …, ``start`` + 28, repeated twice."""
    return _eight_columns() + start


@instruction(lanes_type, types.float32)
def fill(builder: Any, value: Any) -> Any:
    """Broadcasts a float32 to all lanes."""
    return _filled(builder, value)


def _place(builder: Any, array: Any, index: Any) -> Any:
    return builder.bitcast(builder.gep(array, [index]), _FLOATS.as_pointer())


def _places(builder: Any, array: Any, index: Any, stride: Any) -> list[Any]:
    return [builder.gep(array, [builder.add(index, builder.mul(stride, _LONG(k)))]) for k in range(COUNT)]


@instruction(lanes_type, ARRAY, types.int64)
def load(builder: Any, array: Any, index: Any) -> Any:
    """Loads sixteen values of a float32 array, starting at a flat index.

    The address need not be aligned. Bounds are not checked.
    """
    return builder.load(_place(builder, array, index), align=4)


@instruction(types.void, ARRAY, types.int64, lanes_type)
def store(builder: Any, array: Any, index: Any, value: Any) -> Any:
    """Stores the lanes in an array, starting at a flat index."""
    builder.store(value, _place(builder, array, index), align=4)


def _first(builder: Any, count: Any) -> Any:
    """Returns a mask of the first ``count`` lanes."""
    most = builder.select(builder.icmp_signed("<", count, _LONG(COUNT)), count, _LONG(COUNT))
    nothing = ir.Constant(_INTS, ir.Undefined)
    whole = builder.insert_element(nothing, builder.trunc(most, _INT), _INT(0))
    whole = builder.shuffle_vector(whole, nothing, ir.Constant(_INTS, [0] * COUNT))
    return builder.icmp_signed("<", ir.Constant(_INTS, list(range(COUNT))), whole)


@instruction(lanes_type, ARRAY, types.int64, types.int64)
def load_first(builder: Any, array: Any, index: Any, count: Any) -> Any:
    """Loads the first ``count`` values of sixteen, or all values if ``count`` is 16 or more.

    The other lanes are 0, and their values are not read.
    """
    given = [_place(builder, array, index), _INT(4), _first(builder, count), _constant([0] * COUNT)]
    return _call(builder, f"llvm.masked.load.v{COUNT}f32.p0", _FLOATS, given)


@instruction(types.void, ARRAY, types.int64, types.int64, lanes_type)
def store_first(builder: Any, array: Any, index: Any, count: Any, value: Any) -> Any:
    """Stores the first ``count`` lanes, or all lanes if ``count`` is 16 or more."""
    given = [value, _place(builder, array, index), _INT(4), _first(builder, count)]
    _call(builder, f"llvm.masked.store.v{COUNT}f32.p0", ir.VoidType(), given)


@instruction(lanes_type, lanes_type, types.int64)
def only_first(builder: Any, value: Any, count: Any) -> Any:
    """Keeps the first ``count`` lanes and sets the others to 0.

    If ``count`` is 16 or more, all lanes are kept.
    """
    return builder.select(_first(builder, count), value, _constant([0] * COUNT))


@inline
def count_of(mask):
    """Returns the number of lanes in which the mask is set."""
    return np.int64(sum_of(choose(mask, fill(np.float32(1.0)), fill(np.float32(0.0)))))


@inline
def aligned(array):
    """Returns the first flat index in a float32 array that is aligned to 64 bytes, the size of a ``Lanes``."""
    return -(array.ctypes.data // 4) & (COUNT - 1)


@instruction(lanes_type, ARRAY, types.int64, types.int64)
def gather(builder: Any, array: Any, index: Any, stride: Any) -> Any:
    """Loads sixteen values of a float32 array with a stride, starting at a flat index.

    With the number of columns as the stride, the values are a column of sixteen rows.
    """
    value = ir.Constant(_FLOATS, ir.Undefined)
    for lane, place in enumerate(_places(builder, array, index, stride)):
        value = builder.insert_element(value, builder.load(place), _INT(lane))
    return value


@instruction(types.void, ARRAY, types.int64, types.int64, lanes_type)
def scatter(builder: Any, array: Any, index: Any, stride: Any, value: Any) -> Any:
    """Stores the lanes in an array with a stride, starting at a flat index."""
    for lane, place in enumerate(_places(builder, array, index, stride)):
        builder.store(builder.extract_element(value, _INT(lane)), place)


def _places_of_rows(context: Any, builder: Any, types_of: Any, values: Any) -> list[Any]:
    """Returns pointers to ``array[rows[place + lane], column]`` for each lane."""
    (array_type, rows_type), (array, rows, place, columns, column) = types_of, values
    if not (isinstance(rows_type, types.Array) and rows_type.dtype == types.int64 and rows_type.layout == "C"):
        raise TypeError(f"rows must be a C-contiguous int64 array, not {rows_type}")
    data = _data(context, builder, array_type, array)
    first = builder.gep(cgutils.create_struct_proxy(rows_type)(context, builder, value=rows).data, [place])
    rows_of = [builder.load(builder.gep(first, [_LONG(k)])) for k in range(COUNT)]
    return [builder.gep(data, [builder.add(builder.mul(row, columns), column)]) for row in rows_of]


@emitted
def gather_column(typing_context: Any, array: Any, rows: Any, place: Any, columns: Any, column: Any) -> Any:
    """Loads a column of sixteen rows of a float32 array [n, columns]. The row indices are ``rows[place:]`` (int64)."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        value = ir.Constant(_FLOATS, ir.Undefined)
        for lane, place in enumerate(_places_of_rows(context, builder, signature.args[:2], arguments)):
            value = builder.insert_element(value, builder.load(place), _INT(lane))
        return value

    return lanes_type(array, rows, types.int64, types.int64, types.int64), generate


@emitted
def scatter_column(
    typing_context: Any, array: Any, rows: Any, place: Any, columns: Any, column: Any, value: Any
) -> Any:
    """Stores the lanes in the elements that ``gather_column`` would load.

    If several lanes have the same row, the value of the last lane is stored.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        for lane, place in enumerate(_places_of_rows(context, builder, signature.args[:2], arguments[:5])):
            builder.store(builder.extract_element(arguments[5], _INT(lane)), place)
        return context.get_dummy_value()

    return types.void(array, rows, types.int64, types.int64, types.int64, lanes_type), generate


@emitted
def gather_rows(typing_context: Any, array: Any, rows: Any, place: Any) -> Any:
    """Loads sixteen rows of a float32 array [n, 16]. The row indices are ``rows[place:]`` (int64)."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        given = [arguments[0], arguments[1], arguments[2], _LONG(COUNT), _LONG(0)]
        places = _places_of_rows(context, builder, signature.args[:2], given)
        loaded = [builder.load(builder.bitcast(place, _FLOATS.as_pointer()), align=4) for place in places]
        return context.make_tuple(builder, signature.return_type, loaded)

    return types.UniTuple(lanes_type, COUNT)(array, rows, types.int64), generate


@emitted
def add_halves(typing_context: Any, array: Any, rows: Any, place: Any, columns: Any) -> Any:
    """Adds sixteen rows to rows of a float32 array [n, 8].

    The rows are given as a tuple of eight ``Lanes``, one per column. The row indices are
    ``rows[place:]`` (int64). Rows are added one after another, so duplicate rows accumulate.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        given = [arguments[0], arguments[1], arguments[2], _LONG(COUNT // 2), _LONG(0)]
        places = _places_of_rows(context, builder, signature.args[:2], given)
        values = [builder.extract_value(arguments[3], k) for k in range(COUNT // 2)]
        eight = ir.VectorType(_FLOAT, COUNT // 2)

        def shuffled(a: Any, b: Any, picked: list[int]) -> Any:
            return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_INT, len(picked)), picked))

        # Interleave groups of two, four and finally eight columns, so that the columns of each row become adjacent.
        width = 1
        groups = [[value] for value in values]  # each group contains rows 0–15 of ``width`` columns, in order
        while len(groups) > 1:
            merged = []
            for left, right in zip(groups[::2], groups[1::2], strict=True):
                vectors = []
                for a, b in zip(left, right, strict=True):
                    for half in range(2):
                        picked = []
                        for row in range(half * COUNT // (2 * width), (half + 1) * COUNT // (2 * width)):
                            picked += [row * width + k for k in range(width)]
                            picked += [COUNT + row * width + k for k in range(width)]
                        vectors.append(shuffled(a, b, picked))
                merged.append(vectors)
            groups, width = merged, 2 * width
        for lane, place in enumerate(places):
            of_row = shuffled(groups[0][lane // 2], groups[0][lane // 2], [8 * (lane % 2) + k for k in range(8)])
            target = builder.bitcast(place, eight.as_pointer())
            builder.store(builder.fadd(builder.load(target, align=4), of_row), target, align=4)
        return context.get_dummy_value()

    return types.void(array, rows, types.int64, columns), generate


@emitted
def prefetch_row(typing_context: Any, array: Any, row: Any) -> Any:
    """Prefetches the first cache line of a row into the L1 cache. The row may be out of bounds.

    Rows are the entries along the first axis of an array.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        struct = cgutils.create_struct_proxy(signature.args[0])(context, builder, value=arguments[0])
        stride = builder.extract_value(struct.strides, 0)
        place = builder.gep(builder.bitcast(struct.data, _BYTE.as_pointer()), [builder.mul(arguments[1], stride)])
        _call(builder, "llvm.prefetch.p0", ir.VoidType(), [place, _INT(0), _INT(3), _INT(1)])
        return context.get_dummy_value()

    return types.void(array, types.int64), generate


@instruction(lanes_type, lanes_type, lanes_type)
def _times_power_of_two(builder: Any, value: Any, whole: Any) -> Any:
    """Returns ``value`` · 2^``whole``, computed by integer addition to the exponent bits."""
    steps = builder.shl(builder.fptosi(whole, _INTS), ir.Constant(_INTS, [23] * COUNT))
    return builder.bitcast(builder.add(builder.bitcast(value, _INTS), steps), _FLOATS)


@inline
def exp2(x):
    """Returns 2^x for x in [-126, 126] with a relative error of 3e-7, using a polynomial on [-1/2, 1/2]."""
    whole = nearest(x)
    part = x - whole
    y = part * np.float32(1.3276470119986325e-3) + np.float32(9.675541319518366e-3)
    y = y * part + np.float32(5.550713279290593e-2)
    y = y * part + np.float32(2.4022119724211827e-1)
    y = y * part + np.float32(6.931469670612127e-1)
    y = y * part + np.float32(1.0)
    return _times_power_of_two(y, whole)


@inline
def exp(x):
    """Returns the exponential of x clamped to ±87, with a relative error of 2e-7. NaN is preserved."""
    v = minimum(fill(MOST), maximum(fill(-MOST), x * LOG2_E))
    whole = nearest(v)
    r = v - whole
    y = r * np.float32(1.535336188319500e-4) + np.float32(1.339887440266574e-3)
    y = y * r + np.float32(9.618437357674640e-3)
    y = y * r + np.float32(5.550332471162809e-2)
    y = y * r + np.float32(2.402264791363012e-1)
    y = y * r + np.float32(6.931472028550421e-1)
    y = y * r + np.float32(1.0)
    return _times_power_of_two(y, whole)


@emitted
def _exponent_and_mantissa(typing_context: Any, x: Any) -> Any:
    """Decomposes positive numbers x into e and m such that x = m 2^e, with m in [1/√2, √2)."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def all_of(value: int) -> Any:
            return ir.Constant(_INTS, [value] * COUNT)

        bits = builder.sub(builder.bitcast(arguments[0], _INTS), all_of(0x3F3504F3))  # bits of 1/√2
        exponent = builder.sitofp(builder.ashr(bits, all_of(23)), _FLOATS)
        mantissa = builder.bitcast(builder.add(builder.and_(bits, all_of(0x7FFFFF)), all_of(0x3F3504F3)), _FLOATS)
        return context.make_tuple(builder, signature.return_type, (exponent, mantissa))

    return types.UniTuple(lanes_type, 2)(lanes_type), generate


@inline
def log2(x):
    """Returns log2 of positive normal numbers, with an error of 2e-7: absolute near 1, relative elsewhere."""
    exponent, mantissa = _exponent_and_mantissa(x)
    t = (mantissa - np.float32(1.0)) / (mantissa + np.float32(1.0))
    square = t * t
    y = square * np.float32(2.8853900817779268 / 7) + np.float32(2.8853900817779268 / 5)
    y = y * square + np.float32(2.8853900817779268 / 3)
    y = y * square + np.float32(2.8853900817779268)
    return y * t + exponent


@instruction(types.uint64, lanes_type)
def column_bits(builder: Any, ends: Any) -> Any:
    """Converts ranges of pixel rows to a 64-bit block mask, with a byte per block column and a bit per block row.

    Block column k (of 8) covers the pixel rows from the value of lane k to the value of lane k + 8.
    The values are integers. If the first row exceeds the last row, the column is empty. Rows
    outside 0…31 are ignored.
    """
    eight = ir.VectorType(_INT, 8)
    nothing = ir.Constant(_INTS, ir.Undefined)

    def all_of(value: int) -> Any:
        return ir.Constant(eight, [value] * 8)

    whole = builder.fptosi(ends, _INTS)
    first = builder.shuffle_vector(whole, nothing, ir.Constant(eight, list(range(8))))
    last = builder.shuffle_vector(whole, nothing, ir.Constant(eight, list(range(8, 16))))
    first = builder.select(builder.icmp_signed(">", first, all_of(0)), first, all_of(0))
    last = builder.select(builder.icmp_signed("<", last, all_of(31)), last, all_of(31))
    some = builder.icmp_signed("<=", first, last)
    two = all_of(2)
    ones = builder.sub(builder.shl(two, builder.ashr(last, two)), builder.shl(all_of(1), builder.ashr(first, two)))
    kept = builder.select(some, ones, all_of(0))
    return builder.bitcast(builder.trunc(kept, ir.VectorType(ir.IntType(8), 8)), _LONG)


@instruction(types.int64, types.uint64)
def lowest_bit(builder: Any, bits: Any) -> Any:
    """Returns the index of the lowest set bit. The argument must not be 0."""
    return builder.cttz(bits, _BIT(1))


@instruction(types.float32, lanes_type)
def sum_of(builder: Any, value: Any) -> Any:
    """Returns the sum over the lanes."""
    for length in (8, 4, 2, 1):
        swapped = [k ^ length for k in range(COUNT)]
        value = builder.fadd(value, builder.shuffle_vector(value, value, ir.Constant(_INTS, swapped)))
    return builder.extract_element(value, _INT(0))


@emitted
def sums_of(typing_context: Any, values: Any) -> Any:
    """Returns the sums over the lanes of up to sixteen ``Lanes``, which are given as a tuple.

    Lane k of the result is the sum over the lanes of value k. Unused lanes are 0.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        given = [builder.extract_value(arguments[0], k) for k in range(len(values))]
        # Each step combines pairs of values by adding their halves. After four steps, each lane contains one sum.
        length = COUNT
        while length > 1:
            half = length // 2
            segments = [(value, start) for value in (0, COUNT) for start in range(0, COUNT, length)]
            left = [value + start + k for value, start in segments for k in range(half)]
            right = [value + start + half + k for value, start in segments for k in range(half)]
            if len(given) % 2:
                given.append(_constant([0] * COUNT))
            given = [
                builder.fadd(
                    builder.shuffle_vector(a, b, ir.Constant(_INTS, left)),
                    builder.shuffle_vector(a, b, ir.Constant(_INTS, right)),
                )
                for a, b in zip(given[::2], given[1::2], strict=True)
            ]
            length = half
        return given[0]

    return lanes_type(values), generate


@emitted
def transposed(typing_context: Any, values: Any) -> Any:
    """Transposes a 16×16 matrix, given as a tuple of sixteen ``Lanes``."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        rows = [builder.extract_value(arguments[0], k) for k in range(COUNT)]
        length = COUNT
        while length > 1:
            half = length // 2
            # Swap the off-diagonal quadrants of each submatrix with ``length`` rows and columns.
            low = [k if k % length < half else COUNT + k - half for k in range(COUNT)]
            high = [k + half if k % length < half else COUNT + k for k in range(COUNT)]
            for k in range(COUNT):
                if k % length < half:
                    a, b = rows[k], rows[k + half]
                    rows[k] = builder.shuffle_vector(a, b, ir.Constant(_INTS, low))
                    rows[k + half] = builder.shuffle_vector(a, b, ir.Constant(_INTS, high))
            length = half
        return context.make_tuple(builder, signature.return_type, rows)

    return values(values), generate
