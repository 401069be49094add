"""Calls of a C function by its address, in Python through ctypes, compiled without it.

The address is a number, so a compiled loop that calls is kept on disk like any other.
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

import numpy as np

EXCHANGE = ctypes.CFUNCTYPE(
    ctypes.c_int, ctypes.c_void_p, ctypes.c_double, ctypes.c_uint32, ctypes.c_void_p
)
WAIT = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_void_p, ctypes.c_int64)
GIVE = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.c_uint64, ctypes.c_double, ctypes.c_double, ctypes.c_int64
)


def exchange(function: int, device: int, u: float, flags: int, sample: np.ndarray) -> int:
    """``pea_driver_exchange``; the sample is written into an array of 3 cells of 8 bytes."""
    return int(EXCHANGE(function)(device, u, flags, sample.ctypes.data))


def wait(function: int, board: int, due: int) -> float:
    """``pea_board_wait``."""
    return float(WAIT(function)(board, due))


def give(function: int, board: int, counter: int, y: float, u: float, delay: int) -> None:
    """``pea_board_give``."""
    GIVE(function)(board, counter, y, u, delay)


@cache
def native() -> None:
    """Let numba compile these calls."""
    from llvmlite import ir  # type: ignore[import-untyped]
    from numba import types
    from numba.extending import intrinsic, overload

    i32, i64, real = ir.IntType(32), ir.IntType(64), ir.DoubleType()

    def caller(result: Any, returned: Any, given: tuple[Any, ...], taken: tuple[Any, ...]) -> Any:
        """Intrinsic of a function: what it returns and takes, in C and in the loop."""

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            kind = ir.FunctionType(returned, given)
            function = builder.inttoptr(arguments[0], kind.as_pointer())
            words = [
                builder.trunc(a, k) if a.type == i64 and k == i32 else a
                for a, k in zip(arguments[1:], given)
            ]
            done = builder.call(function, words)
            if isinstance(returned, ir.VoidType):
                return context.get_dummy_value()
            return builder.sext(done, i64) if returned == i32 else done

        def typing(context: Any, *arguments: Any) -> Any:
            return result(types.int64, *taken), generate

        # numba reads the number of arguments from the signature
        if len(taken) == 2:
            return intrinsic(lambda context, f, a, b: typing(context, f, a, b))
        if len(taken) == 4:
            return intrinsic(lambda context, f, a, b, c, d: typing(context, f, a, b, c, d))
        return intrinsic(lambda context, f, a, b, c, d, e: typing(context, f, a, b, c, d, e))

    whole, number = types.int64, types.float64
    c_exchange = caller(whole, i32, (i64, real, i32, i64), (whole, number, whole, whole))
    c_wait = caller(number, real, (i64, i64), (whole, whole))
    c_give = caller(
        types.void,
        ir.VoidType(),
        (i64, i64, real, real, i64),
        (whole, whole, number, number, whole),
    )
    overload(exchange)(
        lambda function, device, u, flags, sample: (
            lambda function, device, u, flags, sample: c_exchange(
                function, device, u, flags, sample.ctypes.data
            )
        )
    )
    overload(wait)(
        lambda function, board, due: lambda function, board, due: c_wait(function, board, due)
    )
    overload(give)(
        lambda function, board, counter, y, u, delay: (
            lambda function, board, counter, y, u, delay: c_give(
                function, board, counter, y, u, delay
            )
        )
    )
