"""Wall time: read the clock, sleep, spin, and ask the system to leave a thread in peace.

`now`, `sleep_until`, `tell` and `look` are plain Python here; once `native` was called, numba
compiles them to calls of libc and to atomic loads and stores, so that a compiled loop keeps time
without the interpreter. `wait_until` is one text for both.

Deadlines are absolute, t_0 + k T_s on the monotonic clock: a late sample delays no other. Most
of a period is slept, the rest is spun, because a sleep ends some microseconds late.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import struct
import sys
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import AbstractContextManager
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pea_core.units import SECOND

if TYPE_CHECKING:
    from llvmlite import ir  # type: ignore[import-untyped]

    from pea_engine.llvm import (
        BaseContext,
        Intrinsic,
        IRBuilder,
        Signature,
        Type,
        TypingContext,
        Value,
    )

SPIN_NS = 15_000
"""How long before a deadline the sleep ends (ns); at most half of the period."""

PRIORITY = 80
"""Real-time priority of a paced thread, above the kernel's threaded interrupts (50)."""

NEIGHBOUR = 10
"""Real-time priority of what a paced thread waits for."""

QUICKLY = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
"""Real-time scheduling that child processes, a compiler for example, do not inherit."""

BESIDE = 20
"""Real-time priority of the thread that records beside a paced one, above the nodes."""

CALM = 5e-4
"""Shortest period (s) at which nodes may have a real-time priority: others still get time."""

LINE = 8
"""Cells (int64) of a cache line: two threads must not write to one line."""


def now() -> int:
    """Monotonic clock (ns)."""
    return time.clock_gettime_ns(time.CLOCK_MONOTONIC)


def sleep_until(t: int) -> None:
    """Sleep until the monotonic clock shows t (ns), or a little longer."""
    time.sleep(max(t - now(), 0) / SECOND)


def look(cells: np.ndarray, i: int) -> int:
    """Read cell i of another thread, with everything that the thread wrote before (acquire)."""
    return int(cells[i, 0])


def tell(cells: np.ndarray, i: int, value: int) -> None:
    """Set cell i for another thread, after everything written so far."""
    cells[i, 0] = value


NATIVE = (now, sleep_until, look, tell)
"""Functions that `native` replaces by machine code."""


def cells(n: int) -> np.ndarray:
    """Integers that two threads share, each in a cache line of its own: (n, `LINE`) array."""
    return np.zeros((n, LINE), np.int64)


def wait_until(due: int, spin: int) -> int:
    """Wait for a deadline.

    Parameters
    ----------
    due : int
        Monotonic clock (ns).
    spin : int
        Last part of the wait (ns), spent spinning instead of sleeping.

    Returns
    -------
    int
        Monotonic clock (ns) at the end: `due` or later.
    """
    t = now()
    if due - t > spin:
        sleep_until(due - spin)
        t = now()
    while t < due:
        t = now()
    return t


@cache
def native() -> None:
    """Let numba compile `now`, `sleep_until`, `look` and `tell`."""
    _native_clock()
    _native_cells()


def _native_clock() -> None:
    """`now` and `sleep_until` as calls of libc."""
    from llvmlite import ir
    from numba import types
    from numba.core import cgutils
    from numba.extending import intrinsic, overload

    i32, i64 = ir.IntType(32), ir.IntType(64)
    timespec = ir.ArrayType(i64, 2)
    address = timespec.as_pointer()

    def libc(builder: IRBuilder, name: str, *kinds: ir.Type) -> Value:
        return cgutils.get_or_insert_function(builder.module, ir.FunctionType(i32, kinds), name)

    def field(builder: IRBuilder, spec: Value, i: int) -> Value:
        return builder.gep(spec, [i32(0), i32(i)])

    def gettime(typing: TypingContext) -> Intrinsic:
        def generate(
            context: BaseContext,
            builder: IRBuilder,
            signature: Signature,
            arguments: Sequence[Value],
        ) -> Value:
            spec = cgutils.alloca_once(builder, timespec)
            call = libc(builder, "clock_gettime", i32, address)
            builder.call(call, [i32(time.CLOCK_MONOTONIC), spec])
            seconds, rest = (builder.load(field(builder, spec, i)) for i in (0, 1))
            return builder.add(builder.mul(seconds, i64(SECOND)), rest)

        return types.int64(), generate

    def nanosleep(typing: TypingContext, t: Type) -> Intrinsic:
        def generate(
            context: BaseContext,
            builder: IRBuilder,
            signature: Signature,
            arguments: Sequence[Value],
        ) -> Value:
            spec = cgutils.alloca_once(builder, timespec)
            builder.store(builder.sdiv(arguments[0], i64(SECOND)), field(builder, spec, 0))
            builder.store(builder.srem(arguments[0], i64(SECOND)), field(builder, spec, 1))
            call = libc(builder, "clock_nanosleep", i32, i32, address, address)
            clock, absolute = i32(time.CLOCK_MONOTONIC), i32(1)
            return builder.call(call, [clock, absolute, spec, address(None)])

        return types.int32(types.int64), generate

    clock_gettime, clock_nanosleep = intrinsic(gettime), intrinsic(nanosleep)
    overload(now)(lambda: lambda: clock_gettime())
    overload(sleep_until)(lambda t: lambda t: clock_nanosleep(t))


def _native_cells() -> None:
    """`look` and `tell` as an atomic load and an atomic store."""
    from llvmlite import ir
    from numba import types
    from numba.extending import intrinsic, overload

    i64 = ir.IntType(64)

    def cell(builder: IRBuilder, place: Value) -> Value:
        return builder.inttoptr(place, i64.as_pointer())

    def acquire(typing: TypingContext, place: Type) -> Intrinsic:
        def generate(
            context: BaseContext,
            builder: IRBuilder,
            signature: Signature,
            arguments: Sequence[Value],
        ) -> Value:
            return builder.load_atomic(cell(builder, arguments[0]), "acquire", 8)

        return types.int64(types.int64), generate

    def release(typing: TypingContext, place: Type, value: Type) -> Intrinsic:
        def generate(
            context: BaseContext,
            builder: IRBuilder,
            signature: Signature,
            arguments: Sequence[Value],
        ) -> Value:
            builder.store_atomic(arguments[1], cell(builder, arguments[0]), "release", 8)
            return context.get_dummy_value()

        return types.void(types.int64, types.int64), generate

    load, store = intrinsic(acquire), intrinsic(release)
    overload(look)(lambda cells, i: lambda cells, i: load(cells.ctypes.data + i * cells.strides[0]))
    overload(tell)(
        lambda cells, i, value: (
            lambda cells, i, value: store(cells.ctypes.data + i * cells.strides[0], value)
        )
    )


_LIBC = ctypes.CDLL(None, use_errno=True)
_PR_SET_TIMERSLACK, _PR_GET_TIMERSLACK = 29, 30
_CURRENT, _FUTURE, _ON_FAULT = 1, 2, 4
_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3
_KEEP = {_TRIM_THRESHOLD: 1 << 30, _TOP_PAD: 1 << 26, _MMAP_THRESHOLD: 1 << 25}
"""Settings of malloc (bytes): it keeps what is freed, and takes memory in large pieces."""

_LATENCY = "/dev/cpu_dma_latency"


class Standing(NamedTuple):
    """What the system has granted a thread.

    Attributes
    ----------
    sched_fifo : bool
        Real-time scheduling.
    timer_slack_ns : int
        How late the system may let it wake to save power.
    """

    sched_fifo: bool
    timer_slack_ns: int


def settle(cpu: int | None = None) -> Standing:
    """Prepare this thread for keeping time: its core, its priority, no slack in its timers.

    Parameters
    ----------
    cpu : int, optional
        Core to stay on.

    Raises
    ------
    OSError
        There is no such core for this process.
    """
    if cpu is not None:
        os.sched_setaffinity(0, {cpu})
    _LIBC.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    fifo = True
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except OSError:
        fifo = False
    return Standing(fifo, timer_slack())


def hurry() -> None:
    """Raise the priority of all existing threads above background work, where permitted."""
    for thread in os.listdir("/proc/self/task"):
        with contextlib.suppress(OSError):
            os.sched_setscheduler(int(thread), QUICKLY, os.sched_param(NEIGHBOUR))


def like_this_thread() -> Callable[[], None]:
    """Give another thread, which calls this, the priority of this one.

    Both share the interpreter's lock: a thread that holds it and waits for a processor behind
    other programs would keep the loop waiting with it.
    """
    policy, param = os.sched_getscheduler(0), os.sched_getparam(0)

    def adopt() -> None:
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, policy, param)

    return adopt


def timer_slack() -> int:
    """How late the system may let this thread wake (ns)."""
    return int(_LIBC.prctl(_PR_GET_TIMERSLACK, 0, 0, 0, 0))


@contextlib.contextmanager
def memory_locked() -> Iterator[bool]:
    """Keep this process in memory, pages from their first use on, and what it has freed.

    Where locking is limited nothing is locked: the limit would fail allocations later on. Memory
    that a thread gives back to the system interrupts every core of the process, the loop's too.

    Yields
    ------
    bool
        Whether it is.
    """
    unlimited = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
    permitted = unlimited or os.geteuid() == 0
    locked = permitted and _LIBC.mlockall(_CURRENT | _FUTURE | _ON_FAULT) == 0
    for parameter, value in _KEEP.items():
        _LIBC.mallopt(parameter, value)
    try:
        yield locked
    finally:
        if locked:
            _LIBC.munlockall()


@contextlib.contextmanager
def awake() -> Iterator[bool]:
    """Keep the cores from idle states that take long to leave, where permitted.

    Yields
    ------
    bool
        Whether they are.
    """
    try:
        file = os.open(_LATENCY, os.O_WRONLY)
    except OSError:
        yield False
        return
    try:
        try:
            granted = os.write(file, struct.pack("i", 0)) == 4
        except OSError:
            granted = False
        yield granted
    finally:
        os.close(file)


@contextlib.contextmanager
def brisk() -> Iterator[None]:
    """Hand the interpreter to a waiting thread within 0.1 ms instead of 5."""
    usual = sys.getswitchinterval()
    sys.setswitchinterval(1e-4)
    try:
        yield
    finally:
        sys.setswitchinterval(usual)


@contextlib.contextmanager
def _scheduled(policy: int, priority: int) -> Iterator[None]:
    """Give this thread a policy and a priority for a while, where permitted."""
    usual = os.sched_getscheduler(0), os.sched_getparam(0)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, policy, os.sched_param(priority))
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, *usual)


def prompt() -> AbstractContextManager[None]:
    """Raise this thread above background work, where permitted; not those that it starts."""
    return _scheduled(QUICKLY, BESIDE)


def ordinary() -> AbstractContextManager[None]:
    """Drop the real-time priority of this thread for a while.

    Fast DDS ends by asking again and again whether its callbacks are done, under the lock that
    they need to be done. A thread of real-time priority that asks never lets them have it.
    """
    return _scheduled(os.SCHED_OTHER, 0)


@contextlib.contextmanager
def apart(cpu: int | None) -> Iterator[None]:
    """Leave a core to a paced thread: all other threads, now and later, stay off it."""
    usual = os.sched_getaffinity(0)
    rest = usual - {cpu}
    if not rest or rest == usual:
        yield
        return
    _keep_to(rest)
    try:
        yield
    finally:
        _keep_to(usual)


def _keep_to(cores: Collection[int]) -> None:
    """Keep every thread of this process to some cores."""
    for thread in os.listdir("/proc/self/task"):
        with contextlib.suppress(OSError):  # that thread has ended meanwhile
            os.sched_setaffinity(int(thread), cores)
