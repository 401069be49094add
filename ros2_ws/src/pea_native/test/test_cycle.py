"""The compiled cycle: its gate is the Python gate, and no library breaks a limit through it."""

import math
import os

import numpy as np
import pytest

from pea_core.loop import LoopFault
from pea_core.params import build
from pea_core.signals import Estimate
from pea_engine.compiled import wanted
from pea_engine.kernel import compile_kernel, open_sources
from pea_engine.wall import WallLoop
from pea_experiment import experiments
from pea_native import cycle
from pea_native.driven import NativeDriven
from pea_plant import gate

SAMPLES = int(os.environ.get("PEA_GATE_SAMPLES", "60000"))
T_s, T_NS = 50e-6, 50_000
LOW, HIGH = -20.0, 110.0
FIELDS = len(gate.State._fields)


def gate_kernel():
    step, keep, kept_in = gate.step, cycle.keep, cycle.kept_in
    open_sources(step, keep, kept_in)

    def kernel(c, kept, u, fresh, y, w, elapsed, apart, states):
        for i in range(len(u)):
            now = step(c, kept_in(kept), u[i], fresh[i], y[i], w[i], elapsed[i], apart[i])
            keep(kept, now)
            for j in range(FIELDS):
                states[i, j] = kept[j]
        return 0

    return compile_kernel(kernel)


@pytest.mark.skipif(not wanted(10**9), reason="needs the compiler")
def test_the_compiled_gate_is_the_gate_to_the_bit():
    run = gate_kernel()
    rng = np.random.default_rng(20)
    done = 0
    while done < SAMPLES:
        n = min(2000, SAMPLES - done)
        params = build(
            gate.Params,
            {
                "slew_rate": float(rng.choice([0.0, 1e3, 2e5])),
                "soft_start_rate": float(rng.choice([0.0, 500.0])),
                "safe_voltage": float(rng.choice([0.0, 3.7])),
                "beyond": float(rng.choice([0.0, 50.0])),
                "slew_samples": int(rng.choice([0, 5])),
                "stale_samples": int(rng.choice([0, 20])),
                "following_error_um": float(rng.choice([0.0, 2.0])),
                "following_samples": int(rng.choice([1, 8])),
                "stuck_samples": int(rng.choice([0, 6])),
                "jump_um": float(rng.choice([0.0, 2.0])),
                "displacement_min_um": -5.0,
                "displacement_max_um": 18.0,
            },
        )
        c = gate.design(params, -20.0, 110.0, T_s)
        u = np.cumsum(rng.normal(0.0, rng.choice([0.01, 1.0, 20.0]), n))
        y = 0.142e-6 * u + rng.normal(0.0, 1e-9, n)
        w = 0.142e-6 * u
        for signal, share in ((u, 2e-3), (y, 1e-3), (w, 1e-3)):
            hit = rng.random(n) < share
            signal[hit] = rng.choice([math.nan, math.inf, -math.inf, 1e9, -1e9, 0.0], hit.sum())
        y[rng.random(n) < 0.1] = 1e-6  # now and then it stands still
        fresh = rng.random(n) < 0.9
        elapsed = rng.lognormal(0.0, rng.choice([1e-3, 0.5]), n)
        elapsed[rng.random(n) < 1e-3] = rng.choice([0.0, -1.0, 1e6, math.nan])
        state = gate.start(int(rng.choice([gate.ACTIVE, gate.INACTIVE])), float(u[0]))
        kept, states = np.zeros(FIELDS), np.zeros((n, FIELDS))
        cycle.keep(kept, state)
        apart = rng.permutation(elapsed)
        run(c, kept, u, fresh, y, w, elapsed, apart, states)
        rows = zip(*(each.tolist() for each in (u, fresh, y, w, elapsed, apart)))
        for i, (a, new, b, d, e, p) in enumerate(rows):
            state = gate.step(c, state, a, new, b, d, e, p)
            assert np.array(state, float).tobytes() == states[i].tobytes(), (done + i, state)
        done += n


MS = 1_000_000


@pytest.mark.parametrize(
    ("paced", "arrivals", "apart"),
    [
        # (counter, y, when it came): a sample each period
        (True, [(7, 1.0, MS), (8, 2.0, MS + T_NS)], 1.0),
        (True, [(7, 1.0, MS), (47, 2.0, MS + 40 * T_NS)], 40.0),  # lost
        # the computer was halted: two samples have waited, others have found no room
        (True, [(7, 1.0, MS), (8, 2.0, 3 * MS)], 1.0),
        (True, [(7, 1.0, MS), (8, 2.0, 3 * MS), (47, 3.0, 3 * MS + 500)], 39.0),
        (True, [(7, 1.0, MS), (10**9, 2.0, MS + 2 * T_NS)], 3.0),  # a counter that is wrong
        (False, [(7, 1.0, MS), (8, 2.0, MS + T_NS)], 1.0),
        (False, [(7, 1.0, MS), (9, 2.0, MS + 30 * T_NS)], 30.0),
        (False, [(7, 1.0, MS), (7, 1.0, MS + 20 * T_NS), (9, 2.0, MS + 30 * T_NS)], 30.0),
        (False, [(7, 1.0, MS), (7, 1.0, MS + 20 * T_NS)], 0.0),  # the card stands still
        (False, [(0, 1.0, MS), (0, 2.0, MS + T_NS), (0, 3.0, MS + 2 * T_NS)], 1.0),  # no counter
        (False, [(7, 1.0, MS), (8, 1.0, MS + T_NS), (9, 1.0, MS + 2 * T_NS)], 1.0),
    ],
)
def test_periods_between_two_measurements(paced, arrivals, apart):
    counts, values = np.zeros((cycle.CELLS, 1), np.int64), np.full(cycle.VALUES, math.nan)
    c = cycle.Coefficients(None, T_NS, paced, -20.0, 110.0)
    s = cycle.State(0, 0, counts, values, *[None] * 6)
    found = math.nan
    for counter, y, came in arrivals:
        found = cycle.apart(c, s, y, counter, came)
        values[cycle.Y] = y
        if paced:
            cycle.paced_by(counts, T_NS, counter, came)
    assert found == pytest.approx(apart, abs=0.02)


def test_our_clock_begins_anew_after_a_halt(monkeypatch):
    n, clock = np.zeros((cycle.CELLS, 1), np.int64), [MS]

    def wait_until(due, spin):
        clock[0] = due
        return due

    monkeypatch.setattr(cycle.pace, "wait_until", wait_until)

    def sample(after):
        clock[0] += after
        begun = cycle.on_time(n, T_NS, clock[0])
        assert begun == clock[0] == n[cycle.BEGUN, 0]
        return begun - n[cycle.DUE, 0], n[cycle.LOST, 0]

    assert sample(0) == (0, 0)
    assert sample(T_NS + 700) == (700, 0)
    assert sample(3 * T_NS - 700) == (2 * T_NS, 0)  # late: the next ones come sooner
    assert sample(500) == (T_NS + 500, 0)
    assert sample(500) == (1000, 0)
    assert sample(100 * T_NS) == (99 * T_NS + 1000, 99)  # halted: those are left out
    assert sample(0) == (0, 99)  # it waits a whole period
    assert clock[0] == MS + 4 * T_NS + 1000 + 101 * T_NS


@pytest.mark.parametrize(
    ("periods", "paced", "fresh"),
    [
        (1.0, True, False),
        (2.9, True, False),
        (3.1, True, True),
        (2000.0, True, True),
        (2000.0, False, False),
    ],
)
def test_a_loop_that_was_halted_goes_on_with_the_next_sample(monkeypatch, periods, paced, fresh):
    counts, values = np.zeros((cycle.CELLS, 1), np.int64), np.zeros(cycle.VALUES)
    told, sample = np.zeros((cycle.STATE + 1, 1), np.int64), np.zeros(3)
    told[cycle.STATE] = cycle.WATCHING
    c = cycle.Coefficients(gate.design(gate.Params(), LOW, HIGH, T_s), T_NS, paced, LOW, HIGH)
    rings = sample, sample.view(np.int64), told, told.view(np.float64), np.zeros(8, np.int64)
    s = cycle.State(0, 0, counts, values, np.zeros(FIELDS), *rings)
    cycle.keep(s.gate, gate.start(gate.ACTIVE, 0.0))
    flags = []
    clock = [MS]
    monkeypatch.setattr(cycle.pace, "now", lambda: clock[0])
    monkeypatch.setattr(cycle.call, "exchange", lambda f, d, u, flag, x: flags.append(flag) or 0)
    cycle.cycle(c, s)
    counts[cycle.K] = 1
    clock[0] += round(periods * T_NS)
    cycle.cycle(c, s)
    assert flags == [cycle.FRESH, cycle.FRESH * fresh]


def blocks():
    """New blocks for a loop on a device."""
    sets = ("observer.preset=measured", "controller.preset=pid")
    return experiments.load("fig9_hysteresis_10hz", sets, 1.0).loop()


def loop_of(params, samples, compiled=True, made=None):
    made = made or blocks()
    device = NativeDriven(params, T_s, lambda k: math.nan)
    loop = WallLoop(
        device, made.observer, made.controller, made.reference, T_NS, samples, compiled=compiled
    )
    return device, loop


def run(params, samples, compiled=True):
    """Run a loop on a device; what it said and what was recorded."""
    device, loop = loop_of(params, samples, compiled)
    device.connect()
    rows = []
    try:
        loop.start()
        while True:
            ended = not loop.alive
            rows.append(loop.take().rows)
            loop.feed()
            device.look()
            if ended:
                break
        return device, loop, np.concatenate(rows)
    finally:
        loop.stop()
        device.close()


def broken(given, params):
    """How far range and slew limit are broken (V): by which command, 0 where none does."""
    volts = np.array(given())
    low, high = params.voltage_min, params.voltage_max
    outside = max(volts.max() - high, low - volts.min(), 0.0)
    steps = np.abs(np.diff(volts, prepend=0.0))
    return outside, max(steps.max() - params.safety.slew_rate * T_s, 0.0)


@pytest.mark.parametrize("compiled", [True, False], ids=["compiled", "python"])
def test_a_loop_drives_the_library_once_a_sample(plant, given, compiled):
    params = plant("good")
    device, loop, rows = run(params, 4000, compiled)
    assert loop.fault is None
    assert len(rows) == 4000
    volts = given()
    assert rows["u_applied"][1:].tolist() == volts[: len(rows) - 1]
    assert max(broken(given, params)) < 1e-9
    assert volts[-1] == 0.0  # at rest in the end
    assert device.took(0, 0).size == 0


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_no_library_breaks_a_limit(plant, given, seed):
    params = plant(f"random={seed}", **{"safety.jump_um": 1e6, "safety.stuck_samples": 10**6})
    _, loop, _ = run(params, 20_000)
    assert isinstance(loop.fault, LoopFault)
    assert max(broken(given, params)) < 1e-9


@pytest.mark.parametrize(
    ("address", "says"),
    [
        ("fails later", "driver: fails later: no answer within timeout_s"),
        ("nan later", "sensor_not_finite: nan later: y is no finite number"),
        ("wide later", "driver: wide later: u_applied = nan V"),
    ],
)
def test_a_failure_ends_the_run_with_its_reason(plant, given, address, says):
    params = plant(address)
    device, loop, rows = run(params, 20_000)
    assert says in str(loop.fault)
    assert 100 < len(rows) < 1000
    assert max(broken(given, params)) < 1e-9
    assert device.rig.gate.s.u == 0.0 or device.rig.gate.state == "unconfigured"


def test_a_stop_is_answered_by_what_it_did(plant, given):
    params = plant("good")
    device, loop = loop_of(params, 10**6)
    device.connect()
    try:
        loop.start()
        while len(given()) < 1000:
            loop.take()
            loop.feed()
        told = device.stop("asked")
        assert told.safe
        assert "emergency_stop: asked" in told.text
        while loop.alive:
            loop.take()
            loop.feed()
        assert "emergency_stop: asked" in str(loop.fault)
        assert max(broken(given, params)) < 1e-9
    finally:
        loop.stop()
        device.close()
    assert given()[-1] == 0.0


def test_a_nan_command_is_no_command(plant, given, monkeypatch):
    params = plant("good")
    made, calls = blocks(), []

    def output(c, s, W, W_ff, x: Estimate) -> float:
        calls.append(1)
        return math.nan if len(calls) > 50 else 1.0

    monkeypatch.setattr(made.controller.model, "output", output)
    device, loop = loop_of(params, 10**6, compiled=False, made=made)
    device.connect()
    try:
        loop.start()
        while loop.alive:
            loop.take()
    finally:
        loop.stop()
        device.close()
    assert "is nan: a command must be a finite number" in str(loop.fault)
    assert max(broken(given, params)) < 1e-9
