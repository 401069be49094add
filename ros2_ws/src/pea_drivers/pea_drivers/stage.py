"""The simulated actuator in wall time, and what it has felt: what an emulated device drives."""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import takewhile
from typing import Any

import numpy as np

from pea_core.block import Model
from pea_core.units import NS, SECOND
from pea_engine.kernel import compile_kernel, open_sources
from pea_plant.drivers.simulated import Simulated
from pea_plant.model.actuator import steady_state_gain

T_M = 50e-6
"""Step of the simulated stage (s)."""

WINDOW_NS = 10_000_000
"""Over which the slew rate is taken (ns): commands come in bursts, a stage feels their mean."""

HISTORY = 500_000
"""Commands kept: some minutes."""

UNSETTLED = 64
"""Commands that are noted without being looked at."""

T_NS = 50_000
PATIENCE, PLAIN = 2000, 400
"""Steps at most that are caught up, in plain Python fewer; a stage that was left alone for longer
is at rest."""

SERVO_GAIN = 0.2
"""Part of the error that the device's own servo takes away in a step of `emulator.TICK`."""

ON_TARGET = 2e-8
"""Distance from its target at which a servo says that it is there (m)."""


class Stepped:
    """The model in plain Python, which steps to the present when it is asked.

    Parameters
    ----------
    model : Simulated
        At rest, with the step `T_M`.
    clock : callable
        Monotonic clock (ns).
    """

    def __init__(self, model: Simulated, clock: Callable[[], int]) -> None:
        self._model = model
        self._clock = clock
        self._start, self._k = clock(), 0
        self.u = self._target = 0.0
        self._step = math.inf

    def drive(self, u: float) -> None:
        """Go to u (V) from now on, and hold it."""
        self._advance()
        self._target = u

    def limit(self, step: float) -> None:
        """Change by so much (V) at most in a step from now on."""
        self._advance()
        self._step = step

    def y(self) -> float:
        """Displacement that the sensor tells now (m)."""
        self._advance()
        return self._model.read().y

    def _advance(self) -> None:
        due = (self._clock() - self._start) // T_NS
        if due - self._k > PLAIN:
            self.u = nearer(self.u, self._target, self._step * (due - self._k - PLAIN))
        for _ in range(min(due - self._k, PLAIN)):
            self.u = nearer(self.u, self._target, self._step)
            self._model.read()
            self._model.update(self.u)
        self._k = due


def nearer(u: float, target: float, step: float) -> float:
    """A voltage a step (V) nearer to its target."""
    left = target - u
    if abs(left) <= step:
        return target
    return u + step if left > 0.0 else u - step


def stepping_kernel(model: Model) -> Callable[..., Any]:
    """Compile what steps a model, its state in a cell, from step k to step `due`."""
    from pea_engine.cells import get, put

    output, update = model.output, model.update
    sources = open_sources(output, update, nearer)

    def kernel(
        known: int,
        like: object,
        kept: int,
        likewise: object,
        values: np.ndarray,
        k: int,
        due: int,
        target: float,
        step: float,
    ) -> None:
        sources  # noqa: B018  part of the key under which the result is kept
        c, noise = get(known, like)
        (s,) = get(kept, likewise)
        mask, u = noise.size - 1, values[0]
        skipped = due - PATIENCE - k
        if skipped > 0:
            u = nearer(u, target, step * skipped)
            k += skipped
        while k < due:
            u = nearer(u, target, step)
            n = noise[k & mask]
            s = update(c, s, n, output(c, s, n), u)
            k += 1
        values[0], values[1] = u, output(c, s, noise[k & mask]).y
        put(kept, (s,))

    return compile_kernel(kernel)


class Compiled(Stepped):
    """The same, compiled: what it costs a request is next to nothing.

    Its noise repeats after some seconds.
    """

    def __init__(self, model: Simulated, clock: Callable[[], int]) -> None:
        from pea_engine.cells import Cell

        super().__init__(model, clock)
        self._values = np.zeros(2)
        self._known = Cell((model.c, model.noise(1 << 16)))
        self._kept = Cell((model.s,))
        known, kept = self._known, self._kept
        self._cells = known.address, known.like, kept.address, kept.like, self._values
        kernel: Any = stepping_kernel(model.model)
        kernel.again(*self._cells, 0, 0, 0.0, self._step)  # compiles
        self._kernel = kernel.entry
        self._start = clock()

    def y(self) -> float:
        """Displacement that the sensor tells now (m)."""
        self._advance()
        return float(self._values[1])

    def _advance(self) -> None:
        due = (self._clock() - self._start) // T_NS
        if due > self._k:
            self._kernel(*self._cells, self._k, due, self._target, self._step)
            self.u, self._k = float(self._values[0]), due


class EmulatedStage:
    """The simulated actuator in wall time, between a device's amplifier and its sensor.

    Parameters
    ----------
    plant : pea_plant.plant.Params
        Actuator, load, sensor; the safety gate is in front of the driver, not here.
    voltage_min, voltage_max : float
        What the device's amplifier can give, at the actuator (V).
    update_s : float
        Period in which the sensor is read (s).
    clock : callable
        Monotonic clock (ns).
    compiled : bool
        Compile the model, which takes seconds the first time.

    Attributes
    ----------
    u : float
        Voltage at the actuator (V); a slow amplifier is on its way to it.
    target : float or None
        Displacement (m) that the device's own servo holds; None: the servo is off.
    felt : Felt
        What it went through.
    beside : list of (float, Stage)
        Stages of which its sensor sees a share (m/m), too.
    """

    def __init__(
        self,
        plant: Any,
        voltage_min: float,
        voltage_max: float,
        update_s: float = T_M,
        clock: Callable[[], int] = time.monotonic_ns,
        compiled: bool = False,
    ) -> None:
        bare = replace(
            plant,
            voltage_min=voltage_min,
            voltage_max=voltage_max,
            delay_samples=0,
            safety=type(plant.safety)(),
        )
        self.voltage_min, self.voltage_max = voltage_min, voltage_max
        self.u = 0.0
        self.target: float | None = None
        self._gain = steady_state_gain(plant) * 1e-6
        self.stuck = False
        self.jump = 0.0
        self.saturation = math.inf
        model = Simulated(bare, T_M)
        self.motion = (Compiled if compiled else Stepped)(model, clock)
        self._clock = clock
        self._start = clock()
        self.felt = Felt(self._start)
        self.beside: list[tuple[float, EmulatedStage]] = []
        self._update_ns = round(update_s * SECOND)
        self._read, self._y = 0, model.read().y

    def command(self, u: float, by: str = "commands") -> None:
        """Drive the actuator with u (V), as far as the amplifier goes; `by` is what is counted."""
        u = min(max(u, self.voltage_min, -self.saturation), self.voltage_max, self.saturation)
        self.motion.drive(u)
        self.u = u
        self.felt.command(self._clock(), u, by)

    def slew(self, rate: float) -> None:
        """Let the amplifier change by so much (V/s) at most from now on."""
        self.motion.limit(rate * T_M)

    def servo(self) -> None:
        """One step of the device's own servo, an integral."""
        if self.target is not None:
            error = self.target - self.reading()
            self.command(self.u + SERVO_GAIN * error / self._gain, "steps of the servo")

    @property
    def on_target(self) -> bool:
        """Whether the servo is on, and the sensor within `ON_TARGET` of its target."""
        return self.target is not None and abs(self.target - self.reading()) <= ON_TARGET

    @property
    def at_limit(self) -> bool:
        """Whether the servo is on, and its voltage at an end of the range."""
        ends = (self.voltage_min, self.voltage_max)
        return self.target is not None and self.u in ends

    def reading(self) -> float:
        """Displacement (m) that the sensor has read last."""
        read = (self._clock() - self._start) // self._update_ns
        if read != self._read and not self.stuck:
            seen = sum(share * other.motion.y() for share, other in self.beside)
            self._read, self._y = read, self.motion.y() + seen
        return self._y + self.jump


def couple(stages: Sequence[EmulatedStage], shares: Sequence[float]) -> None:
    """Let the sensor of each stage see shares (m/m) of the others: row by row, n x n."""
    n = len(stages)
    for i, stage in enumerate(stages):
        row = shares[n * i : n * (i + 1)]
        stage.beside = [(row[j], stages[j]) for j in range(n) if j != i and row[j]]


class Felt:
    """What a device has felt.

    Parameters
    ----------
    start : int
        Monotonic clock (ns); times are told from there.
    """

    def __init__(self, start: int) -> None:
        self.start = start
        self.history: deque[tuple[int, float]] = deque(maxlen=HISTORY)
        self.counts: Counter[str] = Counter()
        self._noted: list[tuple[int, float]] = []
        self._window = deque([(start, 0.0)])
        self._extremes: dict[str, dict[str, float]] = {}

    def count(self, what: str) -> None:
        """Note that something has happened once more."""
        self.counts[what] += 1

    def command(self, t: int, u: float, by: str = "commands") -> None:
        """Note the voltage u (V) at the time t (ns), and count what has commanded it."""
        self.counts[by] += 1
        self._noted.append((t, u))
        if len(self._noted) > UNSETTLED:
            self.settle()

    def settle(self) -> None:
        """Look at what was noted: after the answer, for which a driver waits."""
        noted, self._noted = self._noted, []
        for t, u in noted:
            self._look(t, u)

    def _look(self, t: int, u: float) -> None:
        last, before = self.history[-1] if self.history else (self.start, 0.0)
        self.history.append((t, u))
        step = abs(u - before)
        slew = self._slew(max(last, t - WINDOW_NS), before, t, u)
        self._extreme("max", "voltage_V", u, u)
        self._extreme("min", "voltage_V", u, -u)
        self._extreme("max", "step_V", step, step)
        self._extreme("max", "slew_V_s", slew, slew)

    def _slew(self, s: int, v: float, t: int, u: float) -> float:
        """Fastest slew (V/s) over the window that ends at t, after a step from v at s to u at t.

        A step counts as a ramp since the command before it: steps of a ramp show its slew.
        """
        window = self._window
        if window[-1][0] != s:
            window.append((s, v))
        window.append((t, u))
        since = t - WINDOW_NS
        while window[1][0] <= since:
            window.popleft()
        (s, v), (t_1, u_1) = window[0], window[1]
        if s < since:
            window[0] = (since, v + (u_1 - v) * (since - s) / (t_1 - s))
        return max(abs(u - v) for _, v in window) / (WINDOW_NS * NS)

    def _extreme(self, which: str, name: str, value: float, rank: float) -> None:
        known = self._extremes.get(f"{which}_{name}")
        if known is None or rank > known["rank"]:
            t = (self.history[-1][0] - self.start) * NS
            self._extremes[f"{which}_{name}"] = {"value": value, "at_s": t, "rank": rank}

    def told(self) -> dict[str, Any]:
        """As JSON: extremes with their times (s), the last voltage, counts."""
        self.settle()
        extremes = {
            name: {"value": one["value"], "at_s": one["at_s"]}
            for name, one in self._extremes.items()
        }
        last = None
        if self.history:
            t, u = self.history[-1]
            last = {"value": u, "at_s": (t - self.start) * NS}
        return {
            "start_monotonic_ns": self.start,
            **extremes,
            "last_voltage_V": last,
            "counts": dict(self.counts),
        }

    def since(self, t: int) -> list[tuple[int, float]]:
        """Commands from the time t (ns) on: monotonic clock (ns) and voltage (V)."""
        self.settle()
        late = list(takewhile(lambda entry: entry[0] >= t, reversed(self.history)))
        return late[::-1]
