"""Compilation of a kernel of the manifest, for its argument types, into the cache."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from scas4d_core.compilation.manifest import Kernel


def types_of(arguments: str) -> tuple[Any, ...]:
    """Converts argument types from the notation of ``Kernel`` to Numba types.

    >>> types_of("f i*2 none s2")
    (float32, UniTuple(int64, 2), none, Array(int32, 2, 'C', False, aligned=True))
    """
    return tuple(_type_of(word) for word in arguments.split())


def _type_of(word: str) -> Any:
    from numba import types

    scalars = {
        "f": types.float32, "d": types.float64, "i": types.int64, "s": types.int32, "u": types.uint32,
        "w": types.uint64, "y": types.uint8, "b": types.boolean,
    }  # fmt: skip
    if word == "none":
        return types.none
    scalar, more = scalars[word[0]], word[1:]
    if not more:
        return scalar
    made: Any = types.UniTuple if more[0] == "*" else types.Array
    return made(scalar, int(more[1:])) if more[0] == "*" else made(scalar, int(more), "C")


def compile_kernel(kernel: Kernel) -> None:
    """Compiles a kernel into the cache, or loads the kernel if it is already cached.

    Raises:
        Exception: if the function does not exist, or Numba cannot compile it for these types.
    """
    function = getattr(import_module(f"scas4d_core.{kernel.module}"), kernel.name)
    function.compile(types_of(kernel.arguments))
