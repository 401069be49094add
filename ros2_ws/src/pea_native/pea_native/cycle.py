"""The cycle of one sample of a compiled driver: clock, watchdog, gate, exchange.

The same rules as `pea_plant.rig.Rig.step`, as functions that compile into the loop's kernel. The
gate is `pea_plant.gate.step` itself. What outlives a sample stands in arrays, which other threads
may look at.

As a plant's model: `output` commands the voltage of the sample before and returns the new
measurement (once a sample), `update` keeps the command.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pea_core.signals import Measurement, Reference
from pea_engine import pace
from pea_native import call
from pea_native.library import FRESH
from pea_plant import gate
from pea_plant.gate import step, tripped  # by name: a kernel reaches what is named
from pea_watchdog.watchdog import STATE, TOLD, VOLTAGE, WATCHING

LATE = 2.0
"""Periods between two samples from which on a ramp is left to the watchdog."""

DRIFT = 5000
"""A device's clock may be slow by one part in so many: its samples are due so much later."""

BEHIND = 2
"""Periods by which a sample is too late: a loop that was halted and then went through all of them
at once would act on the past, and its law wind up on commands that never act. It goes on with the
device's next sample, or its clock begins anew; what is left out is counted as lost."""

(
    K,
    DONE,
    STEPPED,
    WHY,
    CODE,
    COUNTER,
    LOST,
    DUE,
    BEGUN,
    TOOK,
    REQUEST,
    TRIPPED,
    WRITES,
    STARTED,
    ARRIVED,
    NEXT,
) = range(16)
"""Whole numbers of a `State`: the sample, the last one that was exchanged, when that began (ns),
why no more are (see below), what the exchange returned, the device's counter, samples of it that
never came, when a sample was due and has come (ns), how long the exchange took (ns), a reason to
trip that another thread has, the sample of a trip, stores into `State.gate`, when the exchange
under way began (ns), 0 where none is, when the newest measurement has come (ns), and the next
deadline of our clock (ns)."""

CELLS = 16

GOES_ON, RESTED, FAILED, TAKEN_OVER, OVERDUE, NO_NUMBER, UNFIT = range(7)
"""Why it does not go on: at rest after a trip, the exchange failed, the watchdog has the device, a
trip so late that the ramp is the watchdog's, the sensor says no number, the voltage that the
device holds is none of its own."""

W, ASKED, Y, U, APART, TRIP_U, TRIP_Y, TRIP_ELAPSED = range(8)
"""Floats of a `State`: desired displacement (m), command (V), what the device said last (m, V),
periods from the measurement before to that one, and at the trip: command, displacement, periods."""

VALUES = 8


class Coefficients(NamedTuple):
    """gate : of the gate.  T_ns : period (ns).  paced : whether the device sets the pace.

    low, high (V): what the device can hold.
    """

    gate: gate.Coefficients
    T_ns: int
    paced: bool
    low: float
    high: float


class State(NamedTuple):
    """function, device : addresses.  counts, values, gate : see above.

    sample, counter : of the last exchange, the same memory as floats and as whole numbers.
    told, volts : the memory shared with the watchdog, likewise.  took : how long each exchange
    took (ns), a ring.
    """

    function: int
    device: int
    counts: np.ndarray
    values: np.ndarray
    gate: np.ndarray
    sample: np.ndarray
    counter: np.ndarray
    told: np.ndarray
    volts: np.ndarray
    took: np.ndarray


def keep(kept: np.ndarray, s: gate.State) -> None:
    """Write the gate's state into an array of floats."""
    kept[0], kept[1], kept[2] = s.state, s.reason, s.since
    kept[3], kept[4], kept[5], kept[6] = s.u, s.asked, s.soft, s.age
    kept[7], kept[8], kept[9], kept[10], kept[11] = s.slewing, s.astray, s.y, s.still, s.u_still


def kept_in(kept: np.ndarray) -> gate.State:
    """The gate's state that an array holds."""
    return gate.State(
        int(kept[0]),
        int(kept[1]),
        int(kept[2]),
        kept[3],
        kept[4],
        kept[5],
        kept[6],
        int(kept[7]),
        int(kept[8]),
        kept[9],
        int(kept[10]),
        kept[11],
    )


def guard(c: Coefficients, s: State, now: int) -> float:
    """One step of the gate; the voltage (V) that the device may have."""
    n, f = s.counts, s.values
    elapsed = 1.0
    if n[STEPPED, 0] > 0:
        elapsed = (now - n[STEPPED, 0]) / c.T_ns
    n[STEPPED, 0] = now
    before = kept_in(s.gate)
    request = pace.look(n, REQUEST)
    if request != gate.NONE and before.state == gate.ACTIVE:
        before = tripped(before, request)
        n[TRIPPED, 0] = n[K, 0]
    after = step(c.gate, before, f[ASKED], n[K, 0] > 0, f[Y], f[W], elapsed, f[APART])
    if before.state == gate.ACTIVE and after.state == gate.FAULT:
        n[TRIPPED, 0] = n[K, 0]
        f[TRIP_U], f[TRIP_Y], f[TRIP_ELAPSED] = f[ASKED], f[Y], elapsed
        if elapsed > LATE:
            n[WHY, 0] = OVERDUE
    writes = n[WRITES, 0]
    pace.tell(n, WRITES, writes + 1)
    keep(s.gate, after)
    pace.tell(n, WRITES, writes + 2)
    return after.u


def apart(c: Coefficients, s: State, y: float, counter: int, came: int) -> float:
    """Periods from the measurement before to y, which has come now.

    Samples that wait come at once, so a device that sets the pace says how many are between them,
    yet not more than time has passed. Else a card that stands still gives its last sample again.
    """
    n = s.counts
    if c.paced:
        if n[DUE, 0] == 0:
            return math.inf  # whatever was before the loop is long ago
        return min(counter - n[COUNTER, 0], (came - n[DUE, 0]) / c.T_ns + 1.0)
    if counter == n[COUNTER, 0] and y == s.values[Y]:
        return 0.0
    before = n[ARRIVED, 0]
    n[ARRIVED, 0] = came
    n[COUNTER, 0] = counter
    return (came - before) / c.T_ns


def paced_by(n: np.ndarray, T_ns: int, counter: int, came: int) -> None:
    """Count a sample of a device that sets the pace: what was lost, when it was due.

    The earliest samples show when the others are due.
    """
    if n[DUE, 0] == 0:
        n[DUE, 0] = came
    else:
        new = counter - n[COUNTER, 0]
        n[LOST, 0] += max(new - 1, 0)
        n[DUE, 0] = min(n[DUE, 0] + new * (T_ns + T_ns // DRIFT), came)
    n[BEGUN, 0] = came
    n[COUNTER, 0] = counter


def on_time(n: np.ndarray, T_ns: int, now: int) -> int:
    """Time of a sample by our clock (ns), which begins anew after a halt; waits until it is due."""
    due = n[NEXT, 0]
    if due == 0:
        due = now
    elif now < due:  # the loop, whose clock has gone on, does not wait
        now = pace.wait_until(due, min(pace.SPIN_NS, T_ns // 2))
    n[DUE, 0], n[BEGUN, 0] = due, now
    if now - due > BEHIND * T_ns:
        n[LOST, 0] += (now - due) // T_ns
        due = now
    n[NEXT, 0] = due + T_ns
    return now


def cycle(c: Coefficients, s: State) -> None:
    """Exchange the command of the sample before for a measurement."""
    n, f = s.counts, s.values
    if n[WHY, 0] != GOES_ON:
        return
    if pace.look(s.told, STATE) != WATCHING:
        n[WHY, 0] = TAKEN_OVER
        return
    now = pace.now()
    if not c.paced:
        now = on_time(n, c.T_ns, now)
    u = guard(c, s, now)
    if n[WHY, 0] != GOES_ON:
        return
    s.volts[VOLTAGE, 0] = u
    pace.tell(s.told, TOLD, now)
    pace.tell(n, STARTED, now)
    flags = FRESH if n[K, 0] == 0 else 0  # what came before the loop is old
    if c.paced and n[DUE, 0] > 0 and now > n[DUE, 0] + (1 + BEHIND) * c.T_ns:
        flags = FRESH
    code = call.exchange(s.function, s.device, u, flags, s.sample)
    came = pace.now()
    pace.tell(n, STARTED, 0)
    n[TOOK, 0] = came - now
    s.took[n[K, 0] & (len(s.took) - 1)] = came - now
    if code != 0:
        n[CODE, 0] = code
        n[WHY, 0] = FAILED
        return
    y, held, counter = s.sample[0], s.sample[1], s.counter[2]
    if not c.low <= held <= c.high:
        f[U] = held
        n[WHY, 0] = UNFIT
        return
    if not math.isfinite(y):
        n[WHY, 0] = NO_NUMBER
        return
    f[APART] = apart(c, s, y, counter, came)
    f[Y], f[U] = y, held
    if c.paced:
        paced_by(n, c.T_ns, counter, came)
    if s.gate[0] == gate.FAULT and s.gate[3] == c.gate.safe:
        n[WHY, 0] = RESTED


def output(c: Coefficients, s: State, noise: float) -> Measurement:
    """The measurement of this sample."""
    n, f = s.counts, s.values
    if n[DONE, 0] != n[K, 0]:
        cycle(c, s)
        n[DONE, 0] = n[K, 0]
    return Measurement(f[Y], math.nan, f[U])


def update(c: Coefficients, s: State, noise: float, measured: Measurement, u: float) -> State:
    """Keep the command for the next sample."""
    s.values[ASKED] = u
    s.counts[K, 0] += 1
    return s


def aim(c: Coefficients, s: State, point: Reference) -> None:
    """See `pea_engine.kernels.aim`."""
    s.values[W] = point.w


def halted(c: Coefficients, s: State) -> bool:
    """See `pea_engine.kernels.halted`."""
    return s.counts[WHY, 0] != GOES_ON


def timed(c: Coefficients, s: State, due: int, begun: int) -> tuple[int, int]:
    """See `pea_engine.kernels.timed`."""
    return s.counts[DUE, 0], s.counts[BEGUN, 0]
