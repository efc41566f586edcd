"""Context managers that temporarily change the method's internal constants."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from importlib import import_module
from typing import Any


@contextmanager
def varied(place: str, value: Any) -> Iterator[None]:
    """Temporarily sets a module's constant to another value, in this process.

    A compiled kernel keeps using the value with which it was compiled.

    Args:
        place: dotted name, such as ``"scas4d_core.update.rates.LAYER_STARTS"``.
        value: value of the constant within the block.

    Raises:
        AttributeError: the module has no such constant.

    >>> from studies import machine
    >>> with varied("studies.machine.__doc__", "another text"):
    ...     machine.__doc__
    'another text'
    """
    owner, _, name = place.rpartition(".")
    module = import_module(owner)
    before = getattr(module, name)
    setattr(module, name, value)
    try:
        yield
    finally:
        setattr(module, name, before)


@contextmanager
def all_varied(constants: Iterable[tuple[str, Any]]) -> Iterator[None]:
    """Temporarily sets several constants, given as pairs of dotted name and value; see ``varied``."""
    with ExitStack() as stack:
        for place, value in constants:
            stack.enter_context(varied(place, value))
        yield
