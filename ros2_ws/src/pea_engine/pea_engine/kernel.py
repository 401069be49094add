"""A compiled function, made from the text of the models that it calls."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any

from pea_core.interrupt import INTERRUPT
from pea_engine import pace

_opened: set[Any] = set(pace.NATIVE)


def reach(function: FunctionType, found: dict[FunctionType, None]) -> None:
    """Collect every Python function that `function` can call, itself included."""
    if function in found:
        return
    found[function] = None
    enclosed = [cell.cell_contents for cell in function.__closure__ or ()]
    named = [function.__globals__.get(name) for name in function.__code__.co_names]
    for inner in enclosed + named:
        if isinstance(inner, FunctionType):
            reach(inner, found)


@cache
def _source(path: str) -> bytes:
    return Path(path).read_bytes()


def open_sources(*functions: Callable[..., object]) -> str:
    """Let compiled code call `functions`, and what they call; return a digest of their sources.

    They are laid into the kernel that calls them, whatever their size: a call hands over all
    coefficients and states, which costs more than the sample.
    """
    from numba.extending import register_jitable

    from pea_engine.callee import options

    found: dict[FunctionType, None] = {}
    for function in functions:
        assert isinstance(function, FunctionType)
        reach(function, found)
    laid_in = register_jitable(**options())
    for function in found:
        if function not in _opened:
            _opened.add(function)
            laid_in(function)
    paths = sorted({function.__code__.co_filename for function in found})
    return hashlib.sha256(b"".join(map(_source, paths))).hexdigest()


class Kernel:
    """A compiled function, which may allocate nothing.

    Without numba's allocator no references to arrays are counted: for the coefficients and states
    of three blocks that costs five times the sample.

    Parameters
    ----------
    function : callable
    **options
        Of ``numba.njit``.

    Attributes
    ----------
    entry : callable or None
        What `again` calls, for who calls it every sample; None before the first time.
    """

    def __init__(self, function: Callable[..., object], **options: object) -> None:
        import numba

        from pea_engine.kept import keeping

        self.compiled: Any = numba.njit(function, nogil=True, _nrt=False, **options)
        self.compiled._cache = keeping(function)
        self.entry: Any = None

    def __call__(self, *arguments: object) -> Any:
        """Call it with arguments of any types; new ones are compiled first."""
        if not self.compiled.signatures:  # takes seconds, and may be interrupted
            self.compiled.compile(tuple(map(self.compiled.typeof_pyval, arguments)))
        with INTERRUPT.held():
            return self.compiled(*arguments)

    def again(self, *arguments: object) -> Any:
        """Call it with arguments of the same types each time.

        To find out the types of nested named tuples takes milliseconds: it is left out from the
        second time on.
        """
        if self.entry is None:
            returned = self(*arguments)
            (compiled,) = self.compiled.overloads.values()
            self.entry = compiled.entry_point
            return returned
        with INTERRUPT.held():
            return self.entry(*arguments)


def compile_kernel(function: Callable[..., object], **options: object) -> Kernel:
    """Compile a kernel without the interpreter's lock, kept on disk."""
    return Kernel(function, **options)
