import math
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest

from pea_core.block import Block, Signal
from pea_core.loop import PREVIEW_MAX, Loop, LoopFault, blocks_of
from pea_core.signals import Estimate, Measurement, Reference
from pea_engine import pace
from pea_engine.kernels import empty_kernel
from pea_engine.wall import WallLoop

T_NS = 50_000
T_s = 50e-6


class Clock:
    """A clock that goes on by 1 us each time it is read, and through sleeps at once."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.t = 1_000_000
        self.slept: list[int] = []
        self.on_sleep: Callable[[], None] = lambda: None
        monkeypatch.setattr(pace, "now", self.now)
        monkeypatch.setattr(pace, "sleep_until", self.sleep_until)

    def now(self) -> int:
        self.t += 1000
        return self.t

    def sleep_until(self, t: int) -> None:
        self.slept.append(t)
        self.t = max(self.t, t)
        self.on_sleep()


@pytest.fixture
def clock(monkeypatch):
    return Clock(monkeypatch)


# Waiting


def test_most_is_slept_and_the_rest_is_spun(clock):
    due = clock.t + 40_000
    assert pace.wait_until(due, 15_000) == due
    assert clock.slept == [due - 15_000]


def test_what_is_short_is_not_slept(clock):
    due = clock.t + 10_000
    assert pace.wait_until(due, 15_000) == due
    assert clock.slept == []


def test_a_deadline_that_is_over_is_not_waited_for(clock):
    at = clock.t
    assert pace.wait_until(at - 5000, 15_000) == at + 1000
    assert clock.slept == []


# Compiled


@pytest.fixture(scope="module")
def native():
    numba = pytest.importorskip("numba")
    pace.native()
    return SimpleNamespace(
        now=numba.njit(lambda: pace.now()),
        sleep_until=numba.njit(lambda t: pace.sleep_until(t)),
        look=numba.njit(lambda cells, i: pace.look(cells, i)),
        tell=numba.njit(lambda cells, i, value: pace.tell(cells, i, value)),
    )


def test_compiled_code_reads_the_same_clock(native):
    native.now()
    before = time.monotonic_ns()
    between = native.now()
    assert before <= between <= time.monotonic_ns()


def test_compiled_code_does_not_wake_too_early(native):
    until = time.monotonic_ns() + 3_000_000
    native.sleep_until(until)
    assert time.monotonic_ns() >= until


def test_compiled_code_and_python_share_cells(native):
    cells = pace.cells(3)
    native.tell(cells, 1, 2**40)
    assert [pace.look(cells, i) for i in range(3)] == [0, 2**40, 0]
    pace.tell(cells, 2, 7)
    assert [native.look(cells, i) for i in range(3)] == [0, 2**40, 7]


def test_no_two_cells_share_a_cache_line():
    assert pace.cells(2).strides[0] == 64


@pytest.mark.parametrize("compiled", [False, True])
def test_an_empty_loop_begins_no_sample_before_its_deadline(compiled):
    if compiled:
        pytest.importorskip("numba")
    times = np.full((50, 2), -1)
    begun = time.monotonic_ns()
    empty_kernel(compiled)(begun + T_NS, T_NS, 15_000, times)
    assert time.monotonic_ns() - begun >= 50 * T_NS
    assert (times >= 0).all()
    assert (times[:, 1] >= times[:, 0]).all()


# The system


def test_what_a_loop_waits_for_goes_before_others_and_what_it_starts_does_not():
    usual = os.sched_getscheduler(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except OSError:
        pytest.skip("real-time priority is not permitted")
    os.sched_setscheduler(0, usual, os.sched_param(0))
    with pace.prompt(), ThreadPoolExecutor(1) as pool:
        assert os.sched_getscheduler(0) == os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        assert pool.submit(os.sched_getscheduler, 0).result() == os.SCHED_OTHER
    assert os.sched_getscheduler(0) == usual


def test_what_is_worked_out_beside_a_loop_has_its_priority():
    usual, param = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, pace.QUICKLY, os.sched_param(1))
    except OSError:
        pytest.skip("real-time priority is not permitted")
    try:
        with ThreadPoolExecutor(1, initializer=pace.like_this_thread()) as pool:
            assert pool.submit(os.sched_getscheduler, 0).result() == pace.QUICKLY
    finally:
        os.sched_setscheduler(0, usual, param)


def test_another_core_leaves_one_core_alone():
    usual = os.sched_getaffinity(0)
    cpu = max(usual)
    with pace.apart(cpu):
        assert os.sched_getaffinity(0) == (usual - {cpu} or usual)
    assert os.sched_getaffinity(0) == usual


def test_a_thread_that_was_there_before_leaves_it_alone_too():
    usual = os.sched_getaffinity(0)
    if len(usual) == 1:
        pytest.skip("one core")
    cpu = max(usual)
    with ThreadPoolExecutor(1) as pool:
        there = lambda: pool.submit(os.sched_getaffinity, 0).result()  # noqa: E731
        assert there() == usual
        with pace.apart(cpu):
            assert there() == usual - {cpu}
        assert there() == usual


def test_no_core_is_left_alone_where_none_is_named():
    usual = os.sched_getaffinity(0)
    with pace.apart(None):
        assert os.sched_getaffinity(0) == usual


# The loop


class Gain(NamedTuple):
    K: float


class Sum(NamedTuple):
    x: float


class Params(NamedTuple):
    K: float = 0.25
    preview: float = 0.0


PLANT = SimpleNamespace(
    design=lambda params, T_s: Gain(params.K),
    start=lambda c: Sum(0.0),
    output=lambda c, s, noise: Measurement(s.x + 0.01 * noise, math.nan, s.x),
    update=lambda c, s, noise, measured, u: Sum(s.x + c.K * (u - s.x)),
)
OBSERVER = SimpleNamespace(
    design=lambda params, T_s: Gain(params.K),
    start=lambda c: Sum(0.0),
    output=lambda c, s, measured: Estimate(measured.y, measured.y - s.x, 0.0),
    update=lambda c, s, measured, estimate: Sum(measured.y),
)
CONTROLLER = SimpleNamespace(
    design=lambda params, T_s: Gain(params.K),
    start=lambda c: Sum(0.0),
    output=lambda c, s, W, W_ff, x: s.x + c.K * (W_ff.w - x.x1),
    update=lambda c, s, W, W_ff, x, u: Sum(s.x + 0.1 * (W.w - x.x1)),
)
REFERENCE = SimpleNamespace(
    design=lambda params, T_s: Gain(params.K),
    output=lambda c, k: Reference(c.K * math.sin(0.1 * k), 0.1 * k, -c.K),
)


class Plant(Block):
    """The plant with its noise, for both kinds of loop."""

    __slots__ = ("_k",)

    def __init__(self):
        super().__init__(PLANT, Params(), T_s)
        self._k = 0

    def noise(self, n):
        self._k += n
        return np.cos(np.arange(self._k - n, self._k))

    def read(self):
        return self.output(self.noise(1)[0])

    def write(self, u):
        if not math.isfinite(u):
            raise LoopFault("voltage")
        self.update(u)


def blocks(preview=0.0):
    return (
        Plant(),
        Block(OBSERVER, Params(), T_s),
        Block(CONTROLLER, Params(preview=preview), T_s),
        Signal(REFERENCE, Params(), T_s),
    )


def drained(clock, samples, preview=0.0, capacity=16, at=None):
    """Run a loop whose other side is served in each of its sleeps."""
    loop = WallLoop(*blocks(preview), T_NS, samples, compiled=False, capacity=capacity)
    pieces = []

    def serve():
        pieces.append(loop.take())
        loop.feed()
        if at is not None:
            at(loop, pieces[-1].k + len(pieces[-1].rows))

    clock.on_sleep = serve
    loop.start()
    while loop.alive:
        pass
    pieces.append(loop.take())
    return loop, pieces


def rows_of(pieces):
    return np.concatenate([piece.rows for piece in pieces])


@pytest.mark.parametrize("preview", [0.0, 2.0, 1.25])
def test_loop_in_wall_time_has_the_bits_of_the_other_loop(clock, preview):
    loop, pieces = drained(clock, 100, preview)
    assert loop.fault is None
    other = Loop(*blocks(preview), T_s)
    assert rows_of(pieces).tobytes() == other.run(100).tobytes()


def test_pieces_follow_each_other(clock):
    _, pieces = drained(clock, 100)
    ends = [piece.k + len(piece.rows) for piece in pieces]
    assert [piece.k for piece in pieces] == [0, *ends[:-1]]
    assert ends[-1] == 100
    assert all(len(piece.times) == len(piece.rows) for piece in pieces)


def test_samples_can_be_left_in_the_ring(clock):
    loop = WallLoop(*blocks(), T_NS, 10, compiled=False, capacity=32)
    loop.start()
    while loop.alive:
        pass
    assert [len(loop.take(leave).rows) for leave in (4, 4, 1, 0, 1)] == [6, 0, 3, 1, 0]


def test_a_late_sample_is_told_and_the_next_ones_catch_up(clock):
    def delay(loop, k):
        if k == 20:
            clock.t += 4 * T_NS

    _, pieces = drained(clock, 60, at=delay)
    times = np.concatenate([piece.times for piece in pieces])
    late = np.flatnonzero(times[:, 0] > 1000)
    assert late[0] == 20
    assert list(late) == list(range(20, 20 + len(late)))
    assert times[20, 0] == pytest.approx(4 * T_NS, abs=20_000)
    assert (np.diff(times[late, 0]) < 0).all()
    assert len(times) == 60


def test_a_loop_that_is_not_fed_ends_and_says_where(clock):
    loop = WallLoop(*blocks(), T_NS, 100, compiled=False, capacity=16)
    clock.on_sleep = lambda: loop.take()
    loop.start()
    while loop.alive:
        pass
    assert isinstance(loop.fault, LoopFault)
    assert "prepared up to sample 15 only" in str(loop.fault)


def test_a_loop_that_is_not_recorded_ends_and_loses_nothing(clock):
    loop = WallLoop(*blocks(), T_NS, 100, compiled=False, capacity=16)
    clock.on_sleep = loop.feed
    loop.start()
    while loop.alive:
        pass
    assert "sample 16" in str(loop.fault)
    assert "recording does not keep up" in str(loop.fault)
    assert loop.take().rows.tobytes() == Loop(*blocks(), T_s).run(16).tobytes()


def test_a_command_that_is_no_number_ends_the_loop(clock):
    loop = WallLoop(*blocks(), T_NS, 100, compiled=False)
    loop.controller.s = Sum(math.inf)
    loop.start()
    while loop.alive:
        pass
    assert str(loop.fault) == "voltage at sample 0 is inf: a command must be a finite number"


@pytest.mark.parametrize("name", ["plant", "observer", "controller"])
def test_a_change_has_the_bits_of_a_change_between_two_samples(clock, name):
    def change(loop, k):
        if k == 30:
            loop.change(name, Params(K=0.5))

    loop, pieces = drained(clock, 80, at=change)
    (made,) = loop.changes()
    assert (made.name, made.old, made.new) == (name, Params(), Params(K=0.5))
    assert made.k == 30
    other = Loop(*blocks(), T_s)
    before = other.run(made.k)
    dict(zip(loop.blocks, (other.plant, other.observer, other.controller)))[name].retune(
        Params(K=0.5)
    )
    after = other.run(80 - made.k)
    assert rows_of(pieces).tobytes() == np.concatenate([before, after]).tobytes()
    assert loop.changes() == []


def test_a_new_preview_counts_from_its_sample_on(clock):
    def change(loop, k):
        if k == 30:
            loop.change("controller", Params(preview=1.5))

    _, pieces = drained(clock, 80, at=change)
    other = Loop(*blocks(), T_s)
    before = other.run(30)
    other.controller.retune(Params(preview=1.5))
    assert rows_of(pieces).tobytes() == np.concatenate([before, other.run(50)]).tobytes()


def test_a_new_reference_counts_from_where_no_preview_has_looked(clock):
    def change(loop, k):
        if k == 30:
            loop.change("reference", Params(K=2.0))

    loop, pieces = drained(clock, 180, at=change)
    old, new = (Signal(REFERENCE, params, T_s) for params in (Params(), Params(K=2.0)))
    expected = [(old if k < 30 + PREVIEW_MAX else new).at(k).w for k in range(180)]
    assert rows_of(pieces)["w"].tolist() == expected
    assert loop.ahead()[:, 0].tolist() == [new.at(k).w for k in range(180, 181 + PREVIEW_MAX)]


def test_stopped_loop_ends_between_two_samples(clock):
    loop = WallLoop(*blocks(), T_NS, 10**9, compiled=False, capacity=64)
    pieces = []

    def serve():
        pieces.append(loop.take())
        loop.feed()

    clock.on_sleep = serve
    loop.start()
    loop.stop()
    assert not loop.alive
    assert loop.fault is None
    serve()
    rows = rows_of(pieces)
    other = Loop(*blocks(), T_s)
    expected = np.concatenate([other.run(n) for n in blocks_of(len(rows))] or [rows])
    assert rows.tobytes() == expected.tobytes()


def test_a_loop_that_never_started_can_be_stopped(clock):
    loop = WallLoop(*blocks(), T_NS, 80, compiled=False, capacity=16)
    loop.stop()
    assert not loop.alive


def test_a_thread_of_real_time_priority_has_none_for_a_while():
    def policies() -> list[int]:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        with pace.ordinary():
            inside = os.sched_getscheduler(0)
        return [inside, os.sched_getscheduler(0)]

    with ThreadPoolExecutor(1) as thread:
        try:
            seen = thread.submit(policies).result()
        except PermissionError:
            pytest.skip("no real-time priority is permitted here")
    assert seen == [os.SCHED_OTHER, os.SCHED_FIFO]
