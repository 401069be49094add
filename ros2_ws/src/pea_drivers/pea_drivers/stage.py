"""The simulated actuator in wall time, and what it has felt: what an emulated device drives."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import takewhile
from typing import Any

import numpy as np

from pea_core.block import Model
from pea_core.units import NS, SECOND
from pea_engine import pace
from pea_engine.compiled import compile_kernel, open_sources
from pea_plant.drivers.simulated import Simulated
from pea_plant.model.actuator import steady_state_gain

T_M = 50e-6
"""Step of the simulated stage (s)."""

WINDOW_NS = 10_000_000
"""Over which the slew rate is taken (ns): commands come in bursts, a stage feels their mean."""

HISTORY = 500_000
"""Commands kept: some minutes."""

T_NS = 50_000
PATIENCE, PLAIN = 2000, 400
"""Steps at most that are caught up, in plain Python fewer; a stage that was left alone for longer
is at rest."""

QUIET, IDLE, LAG = 10_000, 10, 20
"""Looks without a command after which it steps so many at a time; steps it may lag behind."""

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

    def close(self) -> None:
        """Nothing runs."""

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


TOLD, DONE, LEAVE = range(3)
"""Cells that `running_kernel` shares: commands told, steps done, whether it shall return."""


def running_kernel(model: Model) -> Callable[..., Any]:
    """Compile a model that keeps up with the clock until it is told to leave."""
    output, update = model.output, model.update
    pace.native()
    sources = open_sources(output, update, pace.wait_until, nearer)

    def kernel(
        cells: np.ndarray, values: np.ndarray, noise: np.ndarray, start: int, c: object, s: object
    ) -> int:
        sources  # noqa: B018  part of the key under which the result is kept
        mask = noise.size - 1
        k, told, quiet, u = 0, 0, 0, 0.0
        while pace.look(cells, LEAVE) == 0:
            now_told = pace.look(cells, TOLD)
            quiet = quiet + 1 if now_told == told else 0
            told = now_told
            target, step = values[0], values[2]
            due = (pace.now() - start) // T_NS
            skipped = due - PATIENCE - k
            if skipped > 0:
                u = nearer(u, target, step * skipped)
                k += skipped
            while k < due:
                u = nearer(u, target, step)
                n = noise[k & mask]
                s = update(c, s, n, output(c, s, n), u)
                k += 1
            values[1] = output(c, s, noise[k & mask]).y
            pace.tell(cells, DONE, k)
            pace.wait_until(start + (k + (1 if quiet < QUIET else IDLE)) * T_NS, 0)
        return k

    return compile_kernel(kernel)


class Running:
    """The same, compiled, in a thread of its own: what it costs a request is next to nothing.

    Parameters
    ----------
    model : Simulated
        At rest, with the step `T_M`. Its noise repeats after some seconds.
    """

    def __init__(self, model: Simulated) -> None:
        self._cells = pace.cells(3)
        self._values = np.array([0.0, 0.0, math.inf])
        self._told = 0
        kernel = running_kernel(model.model)
        noise = model.noise(1 << 16)
        pace.tell(self._cells, LEAVE, 1)
        kernel(self._cells, self._values, noise, 0, model.c, model.s)  # compiles
        pace.tell(self._cells, LEAVE, 0)
        self._start = pace.now()
        arguments = (self._cells, self._values, noise, self._start, model.c, model.s)
        self._thread = threading.Thread(target=kernel, args=arguments, daemon=True)
        self._thread.start()

    def drive(self, u: float) -> None:
        """Go to u (V) from now on, and hold it."""
        self._values[0] = u
        self._told += 1
        pace.tell(self._cells, TOLD, self._told)

    def limit(self, step: float) -> None:
        """Change by so much (V) at most in a step from now on."""
        self._values[2] = step

    def y(self) -> float:
        """Displacement that the sensor tells now (m), at most `LAG` steps old."""
        due = (pace.now() - self._start) // T_NS - LAG
        while pace.look(self._cells, DONE) < due and self._thread.is_alive():
            time.sleep(1e-4)
        return float(self._values[1])

    def close(self) -> None:
        """End the thread."""
        pace.tell(self._cells, LEAVE, 1)
        self._thread.join()


class Stage:
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
        Compile the model, which takes seconds the first time, and let it run by itself.

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
        self.motion = Running(model) if compiled else Stepped(model, clock)
        self._clock = clock
        self._start = clock()
        self.felt = Felt(self._start)
        self.beside: list[tuple[float, Stage]] = []
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

    def close(self) -> None:
        """End what runs."""
        self.motion.close()


def couple(stages: Sequence[Stage], shares: Sequence[float]) -> None:
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
        self._window = deque([(start, 0.0)])
        self._extremes: dict[str, dict[str, float]] = {}

    def count(self, what: str) -> None:
        """Note that something has happened once more."""
        self.counts[what] += 1

    def command(self, t: int, u: float, by: str = "commands") -> None:
        """Note the voltage u (V) at the time t (ns), and count what has commanded it."""
        self.counts[by] += 1
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
        late = list(takewhile(lambda entry: entry[0] >= t, reversed(self.history)))
        return late[::-1]
