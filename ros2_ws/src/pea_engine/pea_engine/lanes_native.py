"""`lanes` for numba: the kernel, its types, loads and stores. Imported where one is compiled."""

# mypy: disable-error-code="untyped-decorator"

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from llvmlite import binding, ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.extending import (
    intrinsic,
    overload,
    overload_attribute,
    register_model,
    typeof_impl,
)

from pea_core.signals import TRUTH, between, pack_lane, reference_of_lane
from pea_core.step import loop_step
from pea_engine import lanes
from pea_engine.kernel import compile_kernel, open_sources
from pea_engine.lanes import LANES, SIGNALS
from pea_engine.llvm import (
    BaseContext,
    Intrinsic,
    IRBuilder,
    Signature,
    Type,
    TypingContext,
    Value,
)

if TYPE_CHECKING:
    from pea_core.block import Model
    from pea_engine.cells import Like

# Left to its own estimate, LLVM takes loops of several hundred operations for not worth it; they
# gain twofold and more. Nothing is reordered by that, and what has no vector form stays scalar.
binding.set_option("pea", "-force-target-instruction-cost=1")

i64, f64 = ir.IntType(64), ir.DoubleType()


class Short(Type):
    """A short array in lane l of a block: element i of n is L i numbers further on."""

    def __init__(self, shape: tuple[int, ...], lanes: int) -> None:
        self.shape, self.lanes = shape, lanes
        super().__init__(f"Short({shape}, {lanes})")


class KnownType(Type):
    """A boolean that is known when the kernel is compiled."""

    def __init__(self, value: bool) -> None:
        self.value = value
        super().__init__(f"Known({value})")


class Long(Type):
    """A long array, where it is."""

    def __init__(self, ndim: int) -> None:
        self.ndim = ndim
        super().__init__(f"Long({ndim})")


@register_model(Short)
class _ShortModel(models.PrimitiveModel):
    def __init__(self, manager: models.DataModelManager, kind: Type) -> None:
        super().__init__(manager, kind, f64.as_pointer())


register_model(KnownType)(models.OpaqueModel)


@typeof_impl.register(lanes.Known)
def _typeof_known(value: lanes.Known, context: object) -> KnownType:
    return KnownType(value.value)


@register_model(Long)
class _LongModel(models.StructModel):
    def __init__(self, manager: models.DataModelManager, kind: Long) -> None:
        members = [("data", types.CPointer(types.float64))]
        sides = types.UniTuple(types.int64, kind.ndim)
        members += [("shape", sides), ("strides", sides)]
        super().__init__(manager, kind, members)


def _shape(kind: Any) -> tuple[int, ...] | None:
    """Shape of the short array that a tuple stands for; None where it is a tuple of its own."""
    if not isinstance(kind, types.UniTuple) and kind != types.Tuple(()):
        return None
    if isinstance(kind, types.BaseNamedTuple):
        return None
    if not kind.count:
        return (0,)
    if kind.dtype == types.float64:
        return (kind.count,)
    inner = _shape(kind.dtype)
    return None if inner is None else (kind.count, *inner)


def _taken(kind: Type, lanes: int) -> Type:
    """Type of what `take` gives for a part of the example."""
    shape = _shape(kind)
    if shape is not None:
        return Short(shape, lanes)
    if isinstance(kind, types.Array):
        return Long(kind.ndim)
    if isinstance(kind, types.BaseTuple):
        inner = [_taken(each, lanes) for each in kind.types]
        named = isinstance(kind, types.BaseNamedTuple)
        return types.BaseTuple.from_types(inner, kind.instance_class if named else None)
    return types.boolean if isinstance(kind, KnownType) else types.unliteral(kind)


class _Walk:
    """Goes through the rows of a block in the order of `lanes.numbers`."""

    def __init__(
        self,
        context: BaseContext,
        builder: IRBuilder,
        arguments: Sequence[Value],
        signature: Signature,
    ) -> None:
        self.context, self.builder = context, builder
        _, floats, integers, lane, _ = arguments[:5]
        self.lanes = signature.args[4].literal_value
        self.lane = lane
        data = [
            cgutils.create_struct_proxy(kind)(context, builder, value).data
            for kind, value in zip(signature.args[1:3], (floats, integers), strict=True)
        ]
        self.data = dict(zip((f64, i64), data, strict=True))
        self.row = {f64: 0, i64: 0}

    def place(self, kind: Type, rows: int = 1) -> Value:
        """Pointer to this lane's number in the next row; go on by `rows`."""
        first = i64(self.row[kind] * self.lanes)
        self.row[kind] += rows
        return self.builder.gep(self.data[kind], [self.builder.add(first, self.lane)])

    def number(self, kind: Type) -> Value:
        """Place of a number."""
        return self.place(f64 if isinstance(kind, types.Float) else i64)


def _size(shape: tuple[int, ...]) -> int:
    size = 1
    for n in shape:
        size *= n
    return size


@intrinsic(prefer_literal=True)
def take(
    typing: TypingContext, like: Any, floats: Type, integers: Type, lane: Type, lanes: Type
) -> Intrinsic | None:
    """``take(like, floats, integers, l, L)``: the tuples of lane l of L out of its blocks."""
    if not isinstance(lanes, types.IntegerLiteral):
        return None
    L = lanes.literal_value
    found = _taken(like.kind, L)

    def generate(
        context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]
    ) -> Value:
        walk = _Walk(context, builder, arguments, signature)

        def made(kind: Any, to: Any) -> Value:
            if isinstance(to, Short):
                return walk.place(f64, _size(to.shape))
            if isinstance(to, Long):
                struct = cgutils.create_struct_proxy(to)(context, builder)
                place = builder.load(walk.place(i64))
                struct.data = builder.inttoptr(place, f64.as_pointer())
                for name in ("shape", "strides"):
                    sides = [builder.load(walk.place(i64)) for _ in range(to.ndim)]
                    setattr(struct, name, cgutils.pack_array(builder, sides))
                return struct._getvalue()
            if isinstance(kind, types.BaseTuple):
                inner = [made(*each) for each in zip(kind.types, to.types, strict=True)]
                return context.make_tuple(builder, to, inner)
            if isinstance(kind, KnownType):
                return ir.Constant(ir.IntType(1), kind.value)
            value = builder.load(walk.number(kind))
            if kind == types.boolean:
                return builder.icmp_signed("!=", value, i64(0))
            return value

        return made(like.kind, found)

    return found(like, floats, integers, types.int64, lanes), generate


@intrinsic(prefer_literal=True)
def put(
    typing: TypingContext,
    like: Any,
    floats: Type,
    integers: Type,
    lane: Type,
    lanes: Type,
    value: Type,
) -> Intrinsic | None:
    """``put(like, floats, integers, l, L, value)``: the numbers of tuples into lane l of L.

    Arrays have been written in place.
    """
    if not isinstance(lanes, types.IntegerLiteral):
        return None

    def generate(
        context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]
    ) -> Value:
        walk = _Walk(context, builder, arguments, signature)

        def store(kind: Any, of: Any, given: Value) -> None:
            shape = _shape(kind)
            if shape is not None:
                walk.place(f64, _size(shape))
            elif isinstance(kind, types.Array):
                walk.place(i64, 1 + 2 * kind.ndim)
            elif isinstance(kind, types.BaseTuple):
                for i, each in enumerate(zip(kind.types, of.types, strict=True)):
                    store(*each, builder.extract_value(given, i))
            else:
                place = walk.number(kind)
                given = context.cast(builder, given, of, types.unliteral(kind))
                if kind == types.boolean:
                    given = builder.zext(given, i64)
                builder.store(given, place)

        store(like.kind, signature.args[5], arguments[5])
        return context.get_dummy_value()

    return types.void(like, floats, integers, types.int64, lanes, value), generate


@intrinsic
def _element(typing: TypingContext, array: Short | Long, i: Type) -> Intrinsic:
    def generate(
        context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]
    ) -> Value:
        return builder.load(_at(context, builder, signature, *arguments))

    return types.float64(array, i), generate


@intrinsic
def _set(typing: TypingContext, array: Short | Long, i: Type, value: Type) -> Intrinsic:
    def generate(
        context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]
    ) -> Value:
        builder.store(arguments[2], _at(context, builder, signature, *arguments[:2]))
        return context.get_dummy_value()

    return types.void(array, i, types.float64), generate


@intrinsic
def _row(typing: TypingContext, array: Short, i: Type) -> Intrinsic:
    """A row of a short array of several dimensions."""
    row = Short(array.shape[1:], array.lanes)

    def generate(
        context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]
    ) -> Value:
        step = i64(array.lanes * _size(row.shape))
        return builder.gep(arguments[0], [builder.mul(arguments[1], step)])

    return row(array, types.int64), generate


@intrinsic
def _long_row(typing: TypingContext, array: Long, i: Type) -> Intrinsic:
    """A row of a long array of several dimensions."""
    row = Long(array.ndim - 1)

    def generate(
        context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]
    ) -> Value:
        whole = cgutils.create_struct_proxy(array)(context, builder, arguments[0])
        found = cgutils.create_struct_proxy(row)(context, builder)
        step, *strides = cgutils.unpack_tuple(builder, whole.strides)
        found.data = builder.gep(whole.data, [builder.mul(arguments[1], step)])
        found.shape = cgutils.pack_array(builder, cgutils.unpack_tuple(builder, whole.shape)[1:])
        found.strides = cgutils.pack_array(builder, strides)
        return found._getvalue()

    return row(array, types.int64), generate


def _at(
    context: BaseContext, builder: IRBuilder, signature: Signature, value: Value, i: Value
) -> Value:
    """Pointer to the element of an index, or of a tuple of them."""
    array, index = signature.args[:2]
    many = isinstance(index, types.BaseTuple)
    parts = cgutils.unpack_tuple(builder, i) if many else [i]
    kinds = index.types if many else [index]
    each = [context.cast(builder, *part, types.int64) for part in zip(parts, kinds, strict=True)]
    if isinstance(array, Short):
        shape = array.shape if array.shape != (0,) else (0,) * len(each)
        strides = [i64(array.lanes * _size(shape[n + 1 :])) for n in range(len(shape))]
    else:
        proxy = cgutils.create_struct_proxy(array)(context, builder, value)
        value, strides = proxy.data, cgutils.unpack_tuple(builder, proxy.strides)
    for k, stride in zip(each, strides, strict=True):
        value = builder.gep(value, [builder.mul(k, stride)])
    return value


@intrinsic
def _sides(typing: TypingContext, array: Long) -> Intrinsic:
    def generate(
        context: BaseContext, builder: IRBuilder, signature: Signature, arguments: Sequence[Value]
    ) -> Value:
        return cgutils.create_struct_proxy(array)(context, builder, arguments[0]).shape

    return types.UniTuple(types.int64, array.ndim)(array), generate


def _indices(i: Type) -> int:
    """How many integers an index is; 0: it is another."""
    if isinstance(i, types.Integer):
        return 1
    if isinstance(i, types.BaseTuple) and all(isinstance(k, types.Integer) for k in i.types):
        return len(i.types)
    return 0


def _one(array: Type, i: Type) -> bool:
    """Whether an index is of one element.

    An empty array has lost its other dimensions as a tuple; nobody reads it.
    """
    if isinstance(array, Short):
        return _indices(i) == len(array.shape) or (array.shape == (0,) and _indices(i) > 0)
    return isinstance(array, Long) and _indices(i) == array.ndim


@overload(operator.getitem)
def _getitem(array, i):  # type: ignore[no-untyped-def]
    if _one(array, i):
        return lambda array, i: _element(array, i)
    if isinstance(array, Short) and isinstance(i, types.Integer):
        return lambda array, i: _row(array, i)
    if isinstance(array, Long) and isinstance(i, types.Integer):
        return lambda array, i: _long_row(array, i)
    return None


@overload(operator.setitem)
def _setitem(array, i, value):  # type: ignore[no-untyped-def]
    if _one(array, i):
        return lambda array, i, value: _set(array, i, value)
    return None


@overload_attribute(Short, "shape")
def _short_shape(array):  # type: ignore[no-untyped-def]
    shape = array.shape
    return lambda array: shape


@overload_attribute(Long, "shape")
def _long_shape(array):  # type: ignore[no-untyped-def]
    return lambda array: _sides(array)


@overload_attribute(Short, "size")
def _short_size(array):  # type: ignore[no-untyped-def]
    size = _size(array.shape)
    return lambda array: size


@overload_attribute(Long, "size")
def _long_size(array):  # type: ignore[no-untyped-def]
    def size(array):  # type: ignore[no-untyped-def]
        n = 1
        for side in array.shape:
            n *= side
        return n

    return size


@overload(len)
def _len(array):  # type: ignore[no-untyped-def]
    if isinstance(array, Short | Long):
        return lambda array: array.shape[0]
    return None


_X1, _X2, _EPS = (SIGNALS.index(name) for name in TRUTH.names or ())
"""Columns of a lane that hold the truth."""


def lanes_kernel(
    plant: Model, observer: Model, controller: Model, score: Model, each: bool, traced: bool
) -> Callable[..., None]:
    """Compile the tick of `Loop` for three models, over samples and, within each, over lanes.

    Parameters
    ----------
    plant, observer, controller : module
        Models (`pea_core.block`), the plant's with ``truth``.
    score : module
        Offers ``update(c, s, counts, W, truth, measured, estimate, u)``: `pea_experiment.score`.
    each : bool
        Whether every lane has a reference of its own.
    traced : bool
        Whether every sample is told.

    Returns
    -------
    callable
        ``kernel(like_c, like_s, c floats, c integers, s floats, s integers, bad, k, points,
        ahead, theta, T_s, noise, counts, rows)`` takes the lanes n = len(noise) samples further.
        `points` (n and the preview, 3, lanes or 1), `noise` (n, lanes), `counts` (n, lanes or 1),
        `rows` (n, len(SIGNALS), lanes). `bad` (lanes) gets the first sample, counted from k, at
        which a command was no number; that lane goes on with 0 V.
    """
    compute, commit = loop_step(plant, observer, controller)
    truth, score_update, lumped = plant.truth, score.update, score.lumped
    sources = open_sources(
        *(compute, commit, truth, score_update, lumped, between, reference_of_lane, pack_lane)
    )

    def kernel(
        like_c: Like,
        like_s: Like,
        c_floats: np.ndarray,
        c_integers: np.ndarray,
        s_floats: np.ndarray,
        s_integers: np.ndarray,
        bad: np.ndarray,
        k: int,
        points: np.ndarray,
        ahead: int,
        theta: float,
        T_s: float,
        noise: np.ndarray,
        counts: np.ndarray,
        rows: np.ndarray,
    ) -> None:
        sources  # noqa: B018  part of the key under which the result is kept
        for i in range(len(noise)):
            j = i + ahead
            for lane in range(LANES):
                c = take(like_c, c_floats, c_integers, lane, LANES)
                s = take(like_s, s_floats, s_integers, lane, LANES)
                r = lane if each else 0
                W = reference_of_lane(points, i, r)
                W_ff = reference_of_lane(points, j, r)
                if theta != 0.0:
                    W_after = reference_of_lane(points, j + 1, r)
                    W_ff = between(W_ff, W_after, theta, T_s)
                measured, estimate, u = compute(c, s, noise[i, lane], W, W_ff)
                if not math.isfinite(u):
                    bad[lane] = min(bad[lane], k + i)
                    u = 0.0
                true = truth(c[0], s[0])
                s_m = score_update(c[3], s[3], counts[i, r], W, true, measured, estimate, u)
                if traced:
                    pack_lane(rows, i, lane, W, measured, estimate, u)
                    rows[i, _X1, lane], rows[i, _X2, lane] = true.x1, true.x2
                    rows[i, _EPS, lane] = lumped(c[3], true, measured.u_applied)
                s_p, s_o, s_c = commit(c, s, noise[i, lane], W, W_ff, measured, estimate, u)
                put(like_s, s_floats, s_integers, lane, LANES, (s_p, s_o, s_c, s_m))

    return compile_kernel(kernel, error_model="numpy")
