"""Types of the arguments and results of functions that generate machine code for numba.

It imports numba: a module that must load without numba imports it for type checking only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from llvmlite.ir import IRBuilder, Value  # type: ignore[import-untyped]
from numba.core.base import BaseContext
from numba.core.types import Type
from numba.core.typing.context import BaseContext as TypingContext
from numba.core.typing.templates import Signature

__all__ = [
    "BaseContext",
    "IRBuilder",
    "Intrinsic",
    "Signature",
    "Type",
    "TypingContext",
    "Value",
]

Generator = Callable[[BaseContext, IRBuilder, Signature, Sequence[Value]], Value]
"""Writes the instructions of one call."""

Intrinsic = tuple[Signature, Generator]
"""What a function under ``numba.extending.intrinsic`` returns."""
