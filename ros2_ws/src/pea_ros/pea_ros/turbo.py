"""The hop of ``turbo``: take, step the block, publish, through librcl, without the interpreter.

rclpy hands out the addresses of its entities (``handle.pointer``); the compiled loop calls
librcl's own functions on them.
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from rclpy.impl.implementation_singleton import rclpy_implementation

from pea_engine import pace
from pea_engine.kernel import Kernel, compile_kernel, open_sources
from pea_ros.hop import FixedMessage, Hop, answering

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

_INFO, _NUMBER = 16, 2
"""Words of room for an ``rmw_message_info_t``, and which of them is the publisher's number of the
message."""

_UNNUMBERED = -1
"""That number where the middleware has none."""


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
    """The exchange of ``turbo``, for `pea_ros.path_choice.probe`."""
    rcl, out, come = _rcl(), Buffer(), Buffer()
    ctypes.memmove(int(out.words[0]), data, len(data))
    out.words[1] = len(data)
    handle, waits = inbox.handle.pointer, inbox.waits.pointer
    info = np.zeros(_INFO, np.int64)
    for status in (
        _call(rcl.publish, outbox.publisher.handle.pointer, out.address, 0),
        _call(rcl.clear, waits),
        _call(rcl.add, waits, handle, 0),
        _call(rcl.wait, waits, 2_000_000_000),
        _call(rcl.take, handle, come.address, info.ctypes.data, 0),
    ):
        if status != _OK:
            raise rclpy_implementation.RCLError(f"librcl answers {status}")
    if info[_NUMBER] not in (1, _UNNUMBERED):
        raise OSError(f"rmw_message_info_t is not laid out as expected: {info}")
    return come.bytes


def call(address: int, a: int, b: int, c: int, d: int) -> int:
    """Call the C function of integers at an address; surplus ones do no harm."""
    return _call(address, a, b, c, d)


@cache
def _native() -> None:
    """Let numba compile `call`."""
    from llvmlite import ir  # type: ignore[import-untyped]
    from numba import types
    from numba.extending import intrinsic, overload

    def generic(typing: object, address: object, a: object, b: object, c: object, d: object) -> Any:
        def generate(context: object, builder: Any, signature: object, arguments: Any) -> Any:
            kind = ir.FunctionType(ir.IntType(32), [ir.IntType(64)] * 4)
            function = builder.inttoptr(arguments[0], kind.as_pointer())
            return builder.call(function, arguments[1:])

        return types.int32(*[types.int64] * 5), generate

    native = intrinsic(generic)
    overload(call)(
        lambda address, a, b, c, d: lambda address, a, b, c, d: native(address, a, b, c, d)
    )


class TurboHop(Hop):
    """Takes and publishes by librcl."""

    def prepare(self, extra: object) -> None:
        """Compile, or fetch from disk."""
        self._in, self._out = Buffer(), np.zeros(8, np.int64)
        self._come = self._view(self._in)
        size = self.sent.bytes.size
        self._out[:3] = self.sent.bytes.ctypes.data, size, size
        self._out[3:] = self._in.words[3:]
        self._log = np.zeros((_LOG, size), np.uint8)
        self._info = np.zeros(_INFO, np.int64)
        self._entities = np.array([*_rcl(), 0, 0, 0], np.int64)
        self._kernel = self._compiled()
        self._call(0, 0, 0, extra)

    def _compiled(self) -> Kernel:
        pace.native()
        _native()
        answer, sources = answering(self.head, self.lead, self.axes)
        tail, sources = self.tail, sources + open_sources(self.tail)

        def kernel(
            entities: np.ndarray,
            inbound: np.ndarray,
            come: np.ndarray,
            info: np.ndarray,
            number: int,
            outbound: int,
            until: int,
            T_ns: int,
            k: int,
            end: int,
            taken: FixedMessage,
            sent: FixedMessage,
            log: np.ndarray,
            c: object,
            s: object,
            m: object,
            extra: object,
        ) -> Any:
            sources  # noqa: B018  part of the key under which the result is kept
            take, publish, clear, add, wait = entities[:5]
            sub, pub, waits = entities[5:]
            address, size = inbound.ctypes.data, taken.bytes.size
            n, why, status = 0, DUE, 0
            while k < end and n < len(log):
                status = call(take, sub, address, info.ctypes.data, 0)
                if status == _NOTHING:
                    left = (
                        until + 2 * T_ns - pace.now()
                    )  # after a sample is a better time to return
                    if left <= 0:
                        break
                    call(clear, waits, 0, 0, 0)
                    call(add, waits, sub, 0, 0)
                    call(wait, waits, left, 0, 0)
                    continue
                if status != _OK:
                    why = BROKEN
                    break
                if info[_NUMBER] != number + n and info[_NUMBER] != _UNNUMBERED:
                    why = ODD
                    break
                if inbound[0] != come.ctypes.data or inbound[1] != size:
                    why = ODD
                    break
                for i in range(size):
                    taken.bytes[i] = come[i]
                fine, s, m = answer(k, T_ns, taken, sent, c, s, m, extra)
                if not fine:
                    why = ODD
                    break
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

    @staticmethod
    def _view(buffer: Buffer) -> np.ndarray:
        room = (ctypes.c_uint8 * int(buffer.words[2])).from_address(int(buffer.words[0]))
        return np.ctypeslib.as_array(room)

    def _call(self, k: int, end: int, until: int, extra: Any) -> Any:
        return self._kernel.again(
            self._entities,
            self._in.words,
            self._come,
            self._info,
            self.inbox.due or 0,
            self._out.ctypes.data,
            until,
            self.T_ns,
            k,
            end,
            self.taken,
            self.sent,
            self._log,
            self.block.c,
            *self.memory,
            extra,
        )

    def run(self, k: int, end: int, until: int, extra: Any) -> tuple[int, bytes | None]:
        """Serve samples k to `end`, as they come."""
        if not self._entities[-1]:
            self._entities[5:] = (
                self.inbox.handle.pointer,
                self.outbox.publisher.handle.pointer,
                self.inbox.waits.pointer,
            )
        self.inbox.armed = False  # its wait set is used here, too
        why, status, n, *memory = self._call(k, end, until, extra)
        self.memory = tuple(memory)
        inbox, number = self.inbox, int(self._info[_NUMBER])
        if n:
            self.outbox.sent(self._log[:n].tobytes())
            if inbox.due is not None:
                inbox.due += n
        if why == BROKEN:
            raise rclpy_implementation.RCLError(f"librcl answers {status}")
        if why != ODD:
            return k + n, None
        data = self._in.bytes
        self._come = self._view(self._in)
        if number == inbox.due:
            inbox.due = number + 1
        elif not inbox.admit(None if number == _UNNUMBERED else number):
            return k + n, None
        return k + n, self.odd(data)
