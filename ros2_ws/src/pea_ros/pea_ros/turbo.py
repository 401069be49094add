"""The hop compiled: take, step the block, publish, through librcl and without the interpreter.

rclpy hands out the addresses of its entities (``handle.pointer``); the compiled loop calls
librcl's own functions on them. What it meets that is not the plain next sample (another layout,
another stamp, a command that is no number) it leaves untouched in the buffer and returns: the
node handles that one message in Python, then comes back.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from rclpy.impl.implementation_singleton import rclpy_implementation

from pea_core import pace
from pea_core.compiled import Kernel, compile_kernel, open_sources, previewed
from pea_core.signals import Estimate, Measurement, Reference
from pea_ros.convert import JointStateCodec

_WORD = ctypes.c_size_t
_OK, _NOTHING = 0, 401
"""Return codes of librcl: fine; there is no message."""

_CAPACITY = 4096
"""Bytes that a message may have before librcl has to make its buffer larger."""

DUE, ODD, BROKEN = range(3)
"""Why a kernel has returned: its time is up or it is done, a message that is not the plain next
sample, librcl has refused."""

_LOG = 2048
"""Messages that a kernel may send before it returns."""


_FIELDS = ("position", "velocity", "effort")


class _Rcl(NamedTuple):
    """Addresses of librcl's functions."""

    take: int
    publish: int
    clear: int
    add: int
    wait: int


def _library(name: str) -> ctypes.CDLL:
    """The library that rclpy itself has loaded."""
    with open("/proc/self/maps") as maps:
        for line in maps:
            path = line.split()[-1]
            if f"/{name}.so" in path:
                return ctypes.CDLL(path)
    raise OSError(f"{name} is not loaded")


@cache
def _rcl() -> _Rcl:
    library = _library("librcl")
    return _Rcl(
        *(
            ctypes.cast(getattr(library, f"rcl_{name}"), ctypes.c_void_p).value or 0
            for name in (
                "take_serialized_message",
                "publish_serialized_message",
                "wait_set_clear",
                "wait_set_add_subscription",
                "wait",
            )
        )
    )


def _call(address: int, *arguments: int) -> int:
    kinds = [_WORD] * len(arguments)
    return int(ctypes.CFUNCTYPE(ctypes.c_int32, *kinds)(address)(*arguments))


class _Allocator(ctypes.Structure):
    _fields_ = [("words", _WORD * 5)]


class Buffer:
    """An ``rcl_serialized_message_t``: address, length, capacity, allocator.

    Raises
    ------
    OSError
        rcutils lays it out otherwise than this module thinks.
    """

    def __init__(self) -> None:
        self.words = np.zeros(8, np.int64)
        self.address = self.words.ctypes.data
        rcutils = _library("librcutils")
        default = rcutils.rcutils_get_default_allocator
        default.restype = _Allocator
        allocator = default()
        self._end = rcutils.rcutils_uint8_array_fini
        self._end.argtypes = [_WORD]
        begin = rcutils.rcutils_uint8_array_init
        begin.argtypes = [_WORD, _WORD, _WORD]
        status = begin(self.address, _CAPACITY, ctypes.addressof(allocator))
        if (
            status
            or self.words[0] == 0
            or tuple(self.words[1:3]) != (0, _CAPACITY)
            or tuple(self.words[3:]) != tuple(allocator.words)
        ):
            raise OSError(f"rcutils_uint8_array_t is not laid out as expected: {self.words}")

    @property
    def bytes(self) -> bytes:
        """What it holds."""
        return ctypes.string_at(int(self.words[0]), int(self.words[1]))

    def __del__(self) -> None:
        if self.words[0]:
            self._end(self.address)


def by_librcl(outbox: Any, inbox: Any, data: bytes) -> bytes:
    """The exchange of ``turbo``, for `pea_ros.transport.probe`."""
    rcl, out, come = _rcl(), Buffer(), Buffer()
    ctypes.memmove(int(out.words[0]), data, len(data))
    out.words[1] = len(data)
    handle, waits = inbox.handle.pointer, inbox.waits.pointer
    for status in (
        _call(rcl.publish, outbox.publisher.handle.pointer, out.address, 0),
        _call(rcl.clear, waits),
        _call(rcl.add, waits, handle, 0),
        _call(rcl.wait, waits, 2_000_000_000),
        _call(rcl.take, handle, come.address, 0, 0),
    ):
        if status != _OK:
            raise rclpy_implementation.RCLError(f"librcl answers {status}")
    return come.bytes


class Frame(NamedTuple):
    """A message of fixed layout in memory: its constant part and where its numbers are.

    Attributes
    ----------
    bytes, doubles, words : arrays on the same memory
        As uint8; as float64 and uint32 from behind the encapsulation on, where CDR counts from.
    template : (size,) array of uint8
    constant : array of int64
        Places of the bytes that are always the same.
    at : (3,) array of int64
        Places of position, velocity and effort among `doubles`; -1 where they are left out.
    """

    bytes: np.ndarray
    doubles: np.ndarray
    words: np.ndarray
    template: np.ndarray
    constant: np.ndarray
    at: np.ndarray

    @classmethod
    def of(cls, codec: JointStateCodec) -> Frame:
        """Room for one message of `codec`, filled with what is constant."""
        fields: Any = codec.dtype.fields or {}
        room = np.zeros(codec.size + 24, np.uint8)
        lead = -(room.ctypes.data + 4) % 8
        whole = room[lead : lead + codec.size]
        template = np.frombuffer(codec.encode(0, *[0.0] * sum(codec.carries)), np.uint8).copy()
        whole[:] = template
        varies = np.zeros(codec.size, bool)
        varies[4:12] = True
        at = np.full(3, -1)
        for i, field in enumerate(_FIELDS):
            if field in fields:
                place = int(fields[field][1])
                varies[place : place + 8] = True
                at[i] = (place - 4) // 8
            if f"pad_{field}" in fields:
                kind, place = fields[f"pad_{field}"][:2]
                varies[place : place + kind.itemsize] = True
        body = room[lead + 4 : lead + 4 + (codec.size - 4) // 8 * 8]
        return cls(
            whole,
            body.view(np.float64),
            body.view(np.uint32),
            template,
            np.flatnonzero(~varies),
            at,
        )


def call(address: int, a: int, b: int, c: int, d: int) -> int:
    """Call the C function of integers at an address; surplus ones do no harm."""
    return _call(address, a, b, c, d)


@cache
def _native() -> None:
    """Let numba compile `call`."""
    from llvmlite import ir  # type: ignore[import-untyped]
    from numba import types
    from numba.extending import intrinsic, overload

    def generic(typing: Any, address: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            kind = ir.FunctionType(ir.IntType(32), [ir.IntType(64)] * 4)
            function = builder.inttoptr(arguments[0], kind.as_pointer())
            return builder.call(function, arguments[1:])

        return types.int32(*[types.int64] * 5), generate

    native = intrinsic(generic)
    overload(call)(
        lambda address, a, b, c, d: lambda address, a, b, c, d: native(address, a, b, c, d)
    )


def hop_kernel(head: Callable[..., Any], tail: Callable[..., Any], lead: int) -> Kernel:
    """Compile the hot path of a node.

    Parameters
    ----------
    head : callable
        ``head(c, s, m, extra, k, position, velocity, effort) -> fine, s, m, position, velocity,
        effort``: what to send for sample k. Where it is not fine, nothing may have changed.
    tail : callable
        ``tail(c, s, m) -> s``: commits the sample that was sent; `m` is what head has left.
    lead : int
        Samples by which the message sent is ahead of the one taken.
    """
    pace.native()
    _native()
    sources = open_sources(head, tail)

    def kernel(
        entities: np.ndarray,
        inbound: np.ndarray,
        come: np.ndarray,
        outbound: int,
        until: int,
        T_ns: int,
        k: int,
        end: int,
        taken: Frame,
        sent: Frame,
        log: np.ndarray,
        c: Any,
        s: Any,
        m: Any,
        extra: Any,
    ) -> Any:
        sources  # noqa: B018  part of the key under which the result is kept
        take, publish, clear, add, wait = entities[:5]
        sub, pub, waits = entities[5:]
        address, size = inbound.ctypes.data, taken.bytes.size
        n, why, status = 0, DUE, 0
        while k < end and n < len(log):
            status = call(take, sub, address, 0, 0)
            if status == _NOTHING:
                left = until + 2 * T_ns - pace.now()  # after a sample is a better time to return
                if left <= 0:
                    break
                call(clear, waits, 0, 0, 0)
                call(add, waits, sub, 0, 0)
                call(wait, waits, left, 0, 0)
                continue
            if status != _OK:
                why = BROKEN
                break
            if inbound[0] != come.ctypes.data or inbound[1] != size:
                why = ODD
                break
            for i in range(size):
                taken.bytes[i] = come[i]
            for i in taken.constant:
                if come[i] != taken.template[i]:
                    why = ODD
            stamp = np.int64(taken.words[0]) * 1_000_000_000 + np.int64(taken.words[1])
            if why == ODD or stamp != k * T_ns:
                why = ODD
                break
            a, b, d = taken.at
            fine, s, m, position, velocity, effort = head(
                c,
                s,
                m,
                extra,
                k,
                taken.doubles[a] if a >= 0 else math.nan,
                taken.doubles[b] if b >= 0 else math.nan,
                taken.doubles[d] if d >= 0 else math.nan,
            )
            if not fine:
                why = ODD
                break
            due = (k + lead) * T_ns
            sent.words[0] = due // 1_000_000_000
            sent.words[1] = due % 1_000_000_000
            a, b, d = sent.at
            if a >= 0:
                sent.doubles[a] = position
            if b >= 0:
                sent.doubles[b] = velocity
            if d >= 0:
                sent.doubles[d] = effort
            status = call(publish, pub, outbound, 0, 0)
            if status != _OK:
                why = BROKEN
                break
            s = tail(c, s, m)
            for i in range(sent.bytes.size):
                log[n, i] = sent.bytes[i]
            n += 1
            k += 1
            if pace.now() >= until:
                break
        return why, status, n, s, m

    return compile_kernel(kernel)


# Each role's part: what its head, its tail and its lead are, and an `m` before the first sample.


def plant_hop(model: Any) -> Any:
    """Parts of a simulated plant's hop; `extra` is the noise from sample k_0 on, and k_0."""
    output, update = model.output, model.update

    def head(
        c: Any, s: Any, m: Any, extra: Any, k: int, position: float, velocity: float, effort: float
    ) -> Any:
        (noise,), measured = m
        if not math.isfinite(effort):
            return False, s, m, 0.0, 0.0, 0.0
        s = update(c, s, noise, measured, effort)
        noise = extra[0][k + 1 - extra[1]]
        y = output(c, s, noise)
        return True, s, ((noise,), y), y.y, y.y_dot, y.u_applied

    def tail(c: Any, s: Any, m: Any) -> Any:
        return s

    return head, tail, 1, ((0.0,), Measurement(0.0, 0.0, 0.0))


def observer_hop(model: Any) -> Any:
    """Parts of an observer's hop; there is nothing `extra`."""
    output, update = model.output, model.update

    def head(
        c: Any, s: Any, m: Any, extra: Any, k: int, position: float, velocity: float, effort: float
    ) -> Any:
        measured = Measurement(position, velocity, effort)
        estimate = output(c, s, measured)
        return True, s, ((measured,), estimate), estimate.x1, estimate.x2, estimate.eps

    def tail(c: Any, s: Any, m: Any) -> Any:
        (measured,), estimate = m
        return update(c, s, measured, estimate)

    return head, tail, 0, ((Measurement(0.0, 0.0, 0.0),), Estimate(0.0, 0.0, 0.0))


def controller_hop(model: Any) -> Any:
    """Parts of a law's hop; `extra`: the reference in a ring, the preview, T_s."""
    output, update = model.output, model.update

    def head(
        c: Any, s: Any, m: Any, extra: Any, k: int, position: float, velocity: float, effort: float
    ) -> Any:
        points, preview, T_s = extra
        mask = len(points) - 1
        ahead = int(preview)
        i, j, after = k & mask, (k + ahead) & mask, (k + ahead + 1) & mask
        W = Reference(points[i, 0], points[i, 1], points[i, 2])
        W_ff = previewed(points, j, after, preview - ahead, T_s)
        estimate = Estimate(position, velocity, effort)
        u = output(c, s, W, W_ff, estimate)
        return True, s, ((W, W_ff, estimate), u), 0.0, 0.0, u

    def tail(c: Any, s: Any, m: Any) -> Any:
        (W, W_ff, estimate), u = m
        return update(c, s, W, W_ff, estimate, u)

    W = Reference(0.0, 0.0, 0.0)
    return head, tail, 0, ((W, W, Estimate(0.0, 0.0, 0.0)), 0.0)


class Hop:
    """The compiled hot path of a node, between its inbox and its outbox.

    Parameters
    ----------
    block : Block
        What is stepped; its state, signals and output are kept up to date.
    make : callable
        `plant_hop`, `observer_hop` or `controller_hop`.
    inbox, outbox : Inbox, SampledOutbox
    takes : tuple of JointStateCodec
        Layouts that may come; the first is expected.
    sends : JointStateCodec
        Layout that is sent.
    T_ns : int
        Sample period (ns).
    extra : Any
        The like of what `run` will get.
    """

    def __init__(
        self,
        block: Any,
        make: Callable[[Any], Any],
        inbox: Any,
        outbox: Any,
        takes: tuple[JointStateCodec, ...],
        sends: JointStateCodec,
        T_ns: int,
        extra: Any,
    ) -> None:
        self.block = block
        self.outbox = outbox
        self.T_ns = T_ns
        self._model = block.model
        *parts, self._blank = make(block.model)
        self._kernel = hop_kernel(*parts)
        self._in, self._out = Buffer(), np.zeros(8, np.int64)
        self._come = self._view(self._in)
        self._frames = {codec.size: Frame.of(codec) for codec in takes}
        self._taken = self._frames[takes[0].size]
        self._sent = Frame.of(sends)
        self._out[:3] = self._sent.bytes.ctypes.data, sends.size, sends.size
        self._out[3:] = self._in.words[3:]
        self._log = np.zeros((_LOG, sends.size), np.uint8)
        self._inbox = inbox
        self._entities = np.array([*_rcl(), 0, 0, 0], np.int64)
        self.used = False
        self._call(0, 0, 0, extra)  # compiles, or fetches from disk

    @staticmethod
    def _view(buffer: Buffer) -> np.ndarray:
        room = (ctypes.c_uint8 * int(buffer.words[2])).from_address(int(buffer.words[0]))
        return np.ctypeslib.as_array(room)

    def _call(self, k: int, end: int, until: int, extra: Any) -> Any:
        block = self.block
        m = self._blank if block.signals is None else (block.signals, block.out)
        return self._kernel.again(
            self._entities,
            self._in.words,
            self._come,
            self._out.ctypes.data,
            until,
            self.T_ns,
            k,
            end,
            self._taken,
            self._sent,
            self._log,
            block.c,
            block.s,
            m,
            extra,
        )

    def serves(self) -> bool:
        """Whether the block still has the model that was compiled, and is not being changed."""
        return self.block.model is self._model and self.block.coming is None

    def run(self, k: int, end: int, until: int, extra: Any) -> tuple[int, bytes | None]:
        """Serve samples k to `end`, as they come.

        Parameters
        ----------
        until : int
            Monotonic clock (ns) at which to return at the latest.
        extra : Any
            What the hop's head asks for.

        Returns
        -------
        int
            The next sample.
        bytes or None
            A message that was taken and that Python has to handle.

        Raises
        ------
        RCLError
            librcl refuses.
        """
        if not self._entities[-1]:
            self._entities[5:] = (
                self._inbox.handle.pointer,
                self.outbox.publisher.handle.pointer,
                self._inbox.waits.pointer,
            )
        self._inbox.armed = False  # its wait set is used here, too
        block = self.block
        why, status, n, block.s, (block.signals, block.out) = self._call(k, end, until, extra)
        if n:
            self.outbox.sent(self._log[:n].tobytes())
        if why == BROKEN:
            raise rclpy_implementation.RCLError(f"librcl answers {status}")
        if why != ODD:
            return k + n, None
        data = self._in.bytes
        self._taken = self._frames.get(len(data), self._taken)
        self._come = self._view(self._in)
        return k + n, data
