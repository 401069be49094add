"""Memory in which compiled code keeps nested values from one call to the next.

To hand the coefficients and the state of a block to compiled code, and the state back, costs more
than a sample of it. What is put into a cell stays there: a call hands over an address and a `Like`.

Imported where something is compiled.
"""

# mypy: disable-error-code="untyped-decorator"

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import typeof, types
from numba.core.datamodel import models
from numba.core.registry import cpu_target
from numba.extending import NativeValue, intrinsic, register_model, typeof_impl, unbox

from pea_engine.kernel import compile_kernel
from pea_engine.llvm import (
    BaseContext,
    Intrinsic,
    IRBuilder,
    Signature,
    Type,
    TypingContext,
    Value,
)


class Like:
    """An example of a value, of which compiled code gets the kind and nothing else."""

    def __init__(self, value: object) -> None:
        self.value = value

    @cached_property
    def kind(self) -> LikeType:
        """Numba's type of it."""
        return LikeType(typeof(self.value))


class LikeType(Type):
    """Numba's type of a `Like`; `kind` is the value's."""

    def __init__(self, kind: Type) -> None:
        self.kind = kind
        super().__init__(f"Like({kind})")

    @property
    def key(self) -> Type:
        """What makes two of them one type: the kind itself, since NamedTuples share names."""
        return self.kind


register_model(LikeType)(models.OpaqueModel)


@typeof_impl.register(Like)
def _typeof_like(value: Like, context: object) -> LikeType:
    return value.kind


@unbox(LikeType)
def _unbox_like(kind: LikeType, value: object, unboxing: Any) -> NativeValue:
    return NativeValue(unboxing.context.get_dummy_value())


@intrinsic
def put(typing: TypingContext, address: Type, value: Type) -> Intrinsic:
    """Put a value into the cell at an address."""

    def generate(
        context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]
    ) -> Value:
        place, inner = arguments
        builder.store(inner, builder.inttoptr(place, inner.type.as_pointer()), align=8)
        return context.get_dummy_value()

    return types.void(types.int64, value), generate


@intrinsic
def get(typing: TypingContext, address: Type, like: LikeType) -> Intrinsic:
    """Value of the cell at an address, which holds the like of `like`."""

    def generate(
        context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]
    ) -> Value:
        kind: ir.Type = context.get_value_type(like.kind)
        return builder.load(builder.inttoptr(arguments[0], kind.as_pointer()), align=8)

    return like.kind(types.int64, like), generate


class Cell:
    """Room for one value.

    Parameters
    ----------
    value : tuple
        An example: nested tuples of numbers and arrays. The arrays stay where they are, and must
        live as long as the cell is used.

    Attributes
    ----------
    address : int
    like : Like
        What `get` is told, with the address.
    """

    def __init__(self, value: object) -> None:
        self.like = Like(value)
        context = cpu_target.target_context
        size = context.get_abi_sizeof(context.get_value_type(self.like.kind.kind))
        self._room = np.zeros(size // 8 + 1, np.int64)
        self.address = self._room.ctypes.data

        def fill(address: int, value: object) -> None:
            put(address, value)

        def read(address: int, like: Like) -> object:
            return get(address, like)

        self._fill, self._read = compile_kernel(fill), compile_kernel(read)
        self.value = value  # compiles, or fetches from disk

    @property
    def value(self) -> Any:
        """What it holds, of the same types always."""
        return self._read.again(self.address, self.like)

    @value.setter
    def value(self, value: object) -> None:
        self._fill.again(self.address, value)
