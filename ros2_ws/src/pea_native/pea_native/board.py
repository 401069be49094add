"""A board with the simulated actuator in it, in real time: the other side of a compiled driver.

The board's C (`examples/board`) keeps time and talks; between two samples the compiled model
steps. Both run in one thread that needs no interpreter. Another one plays faults and notes what
the stage has felt.
"""

from __future__ import annotations

import ctypes
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from pea_core.params import ParameterError, param
from pea_core.units import SECOND
from pea_drivers.emulator import Emulator, Timing
from pea_drivers.faults import Faults, fault
from pea_drivers.stage import WINDOW_NS
from pea_engine import pace
from pea_engine.kernel import compile_kernel, open_sources
from pea_native import build, call, library
from pea_plant.drivers.simulated import Simulated
from pea_plant.model.actuator import steady_state_gain

LOOK = 0.002
"""Seconds between two looks at the faults and at what the stage has felt."""

PLAYED = (
    *("mute", "pull", "truncate", "garbage", "delay", "lose", "babble"),
    *("stuck", "jump", "saturate"),
)
"""Faults that a board has; garbage: one sample is no number, pull: from now on each breaks off."""

LOGGED = 1 << 20
"""Samples whose voltage is kept, a power of two: 52 s at 20 kHz."""

PATIENCE, MEMORY = 2000, 20
"""Samples at most that are caught up, over UDP and in memory; a machine that was halted for longer
skips the others. What is caught up goes by faster than time, which only a counter tells."""

LEAVE, DONE, MISSED, SKIPPED = range(4)
"""Cells of the kernel: whether it shall return, samples done, late ones, those left out."""

SPOILT, JUMP, STUCK, DELAY, HIGHEST, PATIENT = range(6)
"""Floats of the kernel: samples that are no number, error of the sensor (m), whether it stands
still, how late samples are given (ns; -1: never), highest voltage either way (V), samples
that are caught up."""


@dataclass(frozen=True)
class Params(Timing):
    """Emulated board."""

    period_us: float = param(50.0, "us", 10.0, 1e6, help="from one sample to the next")
    voltage_min: float = param(-30.0, "V", -1e4, 1e4, help="lowest voltage of its amplifier")
    voltage_max: float = param(130.0, "V", -1e4, 1e4, help="highest voltage of its amplifier")
    identity: str = param("emulated board", help="how it answers")
    cpu: int = param(-1, "", -1, 4096, help="core that it stays on; -1: any")


class _Setup(ctypes.Structure):
    """``pea_board_setup`` of the header."""

    _fields_ = (
        ("address", ctypes.c_char_p),
        ("identity", ctypes.c_char_p),
        ("period", ctypes.c_int64),
        *((name, ctypes.c_double) for name in ("voltage_min", "voltage_max", "y_min", "y_max")),
    )


def board_kernel(model: Any, compiled: bool = True) -> Callable[..., Any]:
    """Compile a board that has an actuator's model for its stage; it keeps time until it is told.

    `log` gets the voltage that each sample has had, `times` since when (ns).
    """
    output, update = model.output, model.update
    wait, give = call.wait, call.give
    sources = ""
    if compiled:
        pace.native()
        call.native()
        sources = open_sources(output, update)

    def kernel(
        cells: np.ndarray,
        values: np.ndarray,
        waits: int,
        gives: int,
        board: int,
        start: int,
        T_ns: int,
        noise: np.ndarray,
        log: np.ndarray,
        times: np.ndarray,
        c: Any,
        s: Any,
    ) -> int:
        sources  # noqa: B018
        k, u, y = 0, 0.0, 0.0
        mask, far = len(noise) - 1, len(log) - 1
        while pace.look(cells, LEAVE) == 0:
            skipped = (pace.now() - start) // T_ns - k - int(values[PATIENT])
            if skipped > 0:
                for i in range(min(skipped, far)):
                    log[(k + i) & far] = u
                    times[(k + i) & far] = pace.now()
                k += skipped
                cells[SKIPPED, 0] += skipped
            due = start + (k + 1) * T_ns
            command = wait(waits, board, due)
            taken = pace.now()
            measured = output(c, s, noise[k & mask])
            if values[STUCK] == 0.0:
                y = measured.y + values[JUMP]
            told = y
            if values[SPOILT] > 0.0:
                told = math.nan
                values[SPOILT] -= 1.0
            give(gives, board, k + 1, told, u, int(values[DELAY]))
            u = min(max(command, -values[HIGHEST]), values[HIGHEST])
            s = update(c, s, noise[k & mask], measured, u)
            log[k & far] = u
            times[k & far] = taken
            k += 1
            if pace.now() > due + T_ns:
                cells[MISSED, 0] += 1
            pace.tell(cells, DONE, k)
        return k

    return compile_kernel(kernel) if compiled else kernel


class Board(Emulator):
    """A board, or a card, in real time.

    Parameters
    ----------
    plant : pea_plant.plant.Params
        Actuator, load, sensor; the safety gate is in front of the driver, not here.
    params : Params
    address : str
        Where it listens, or the file of its registers.
    compiled : bool
        Compile the model; else it is plain Python, and keeps no deadline.

    Raises
    ------
    ParameterError
        The address cannot be had, or there is no compiler.
    """

    def __init__(self, plant: Any, params: Params, address: str, compiled: bool = True) -> None:
        self.faults = Faults(time.monotonic_ns)
        self.lock = threading.Lock()
        self._threads: list[threading.Thread] = []
        self._closing = threading.Event()
        self._control = self._listener = None
        self.stage: Any = SimpleNamespace(felt=self)
        self.T_ns = round(params.period_us * 1e3)
        self._cells = pace.cells(4)
        patience = PATIENCE if address.startswith("udp://") else MEMORY
        self._values = np.array([0.0, 0.0, 0.0, 0.0, math.inf, patience])
        self._log, self._times = np.zeros(LOGGED), np.zeros(LOGGED, np.int64)
        self._seen = self._commands = 0
        self._most = dict.fromkeys(("max_voltage", "min_voltage", "step", "slew"), (0.0, 0))
        bare = replace(
            plant,
            voltage_min=params.voltage_min,
            voltage_max=params.voltage_max,
            delay_samples=0,
            safety=type(plant.safety)(),
        )
        model = Simulated(bare, self.T_ns / SECOND)
        sources = [build.BOARD / f"{name}.c" for name in ("board", "board_udp", "board_registers")]
        self._library = ctypes.CDLL(str(build.made(sources, "pea_board")))
        kernel = board_kernel(model.model, compiled)
        noise = model.noise(1 << 16)
        rings = noise, self._log, self._times
        pace.tell(self._cells, LEAVE, 1)
        kernel(self._cells, self._values, 0, 0, 0, 0, self.T_ns, *rings, model.c, model.s)
        pace.tell(self._cells, LEAVE, 0)
        self._board, self.address = self._open(params, address, steady_state_gain(plant) * 1e-6)
        self.start = pace.now()

        def run() -> None:
            pace.settle(None if params.cpu < 0 else params.cpu)
            places = (_place(self._library.pea_board_wait), _place(self._library.pea_board_give))
            timing = (self._board, self.start, self.T_ns)
            kernel(self._cells, self._values, *places, *timing, *rings, model.c, model.s)

        self._runs = threading.Thread(target=run, name="board", daemon=True)
        self._runs.start()
        self._start(self._watch)

    def _open(self, params: Params, address: str, gain: float) -> tuple[int, str]:
        """Open the board; its address in memory, and that of its line."""
        functions, text = self._library, ctypes.create_string_buffer(library.SIZE)
        functions.pea_board_open.restype = ctypes.c_void_p
        for name in ("port", "commands", "close"):
            getattr(functions, f"pea_board_{name}").argtypes = (ctypes.c_void_p,)
        functions.pea_board_spoil.argtypes = (ctypes.c_void_p, *[ctypes.c_int] * 3)
        functions.pea_board_commands.restype = ctypes.c_int64
        ends = sorted((gain * params.voltage_min, gain * params.voltage_max))
        setup = _Setup(
            address.encode(),
            params.identity.encode(),
            self.T_ns,
            params.voltage_min,
            params.voltage_max,
            2.0 * ends[0],
            2.0 * ends[1],
        )
        board = functions.pea_board_open(ctypes.byref(setup), text, library.SIZE)
        if not board:
            raise ParameterError(f"{text.value.decode()}; give another address, or end who has it")
        if port := functions.pea_board_port(board):
            address = f"{address.rpartition(':')[0]}:{port}"
        return int(board), address

    def inject(self, text: str) -> None:
        """Put a fault in force: ``NAME[=VALUE][@SECONDS]``."""
        which = fault(text)
        if which.name not in PLAYED:
            raise ParameterError(f"fault {text!r}: a board has {', '.join(PLAYED)}")
        self.faults.set(which)

    def _watch(self) -> None:
        while not self._closing.wait(LOOK):
            commands = self._library.pea_board_commands(self._board)
            if commands != self._commands:
                self._commands = commands
                self.faults.commanded()
            self._play()
            with self.lock:
                self._feel()

    def _play(self) -> None:
        get, values = self.faults.get, self._values
        if self.faults.take("garbage") is not None:
            values[SPOILT] = 1.0
        values[JUMP] = (get("jump") or 0.0) * 1e-6
        values[STUCK] = get("stuck") is not None
        late, lost = get("delay"), get("lose")
        torn = get("pull") is not None or self.faults.take("truncate") is not None
        babbles = get("babble") is not None
        self._library.pea_board_spoil(self._board, round(10.0 * (lost or 0.0)), babbles, torn)
        values[DELAY] = -1.0 if get("mute") is not None else (late or 0.0) * SECOND
        saturation = get("saturate")
        values[HIGHEST] = math.inf if saturation is None else saturation

    def _feel(self) -> None:
        """Take note of the voltages since the last time."""
        end = pace.look(self._cells, DONE)
        window = max(WINDOW_NS // self.T_ns, 1)
        begin = max(self._seen, end - LOGGED // 2)
        if end == begin:
            return
        first = max(begin - window, 0)
        u = self._log[np.arange(first, end) & (LOGGED - 1)]
        new = u[begin - first :]
        before = u[begin - first - 1 :] if begin > first else np.concatenate(([0.0], u))
        steps = np.abs(np.diff(before))
        rise = np.abs(u[window:] - u[:-window]) / (window * self.T_ns / SECOND)
        for name, values, at in (
            ("max_voltage", new, begin),
            ("min_voltage", -new, begin),
            ("step", steps, end - len(steps)),
            ("slew", rise, end - len(rise)),
        ):
            if len(values):
                i = int(values.argmax())
                if values[i] > self._most[name][0]:
                    self._most[name] = (float(values[i]), at + i)
        self._seen = end

    def told(self) -> dict[str, Any]:
        """What the stage has felt, as JSON."""
        with self.lock:
            self._feel()
            most, k = dict(self._most), self._seen

        def extreme(name: str, sign: float = 1.0) -> dict[str, float]:
            value, at = most[name]
            return {"value": sign * value, "at_s": at * self.T_ns / SECOND}

        last = float(self._log[(k - 1) & (LOGGED - 1)])
        return {
            "address": self.address,
            "start_monotonic_ns": self.start,
            "max_voltage_V": extreme("max_voltage"),
            "min_voltage_V": extreme("min_voltage", -1.0),
            "max_step_V": extreme("step"),
            "max_slew_V_s": extreme("slew"),
            "last_voltage_V": {"value": last, "at_s": k * self.T_ns / SECOND},
            "counts": {
                "commands": self._commands,
                "samples": k,
                "missed": int(self._cells[MISSED, 0]),
                "skipped": int(self._cells[SKIPPED, 0]),
            },
        }

    def since(self, t: int) -> list[tuple[int, float]]:
        """Voltages from the time t (ns) on, where they change: monotonic clock (ns), V."""
        end = pace.look(self._cells, DONE)
        patient = (t - self.start) // self.T_ns - PATIENCE  # it may be late by so many
        begin = max(patient, end - LOGGED // 2, 0)
        ks = np.arange(begin, end)
        u = self._log[ks & (LOGGED - 1)]
        changes = np.flatnonzero(np.diff(u, prepend=np.nan))
        times = self._times[ks & (LOGGED - 1)]
        return [(int(times[i]), float(u[i])) for i in changes if times[i] >= t]

    def close(self) -> None:
        """End the board and every thread."""
        self._closing.set()
        pace.tell(self._cells, LEAVE, 1)
        if self._control is not None:
            super_close(self._control)
        for thread in (self._runs, *self._threads):
            thread.join(5.0)
        self._library.pea_board_close(self._board)


def super_close(listener: Any) -> None:
    """End a listening socket, and who waits at it."""
    import contextlib
    import socket

    with contextlib.suppress(OSError):
        listener.shutdown(socket.SHUT_RDWR)
    listener.close()


def _place(function: Any) -> int:
    return int(ctypes.cast(function, ctypes.c_void_p).value or 0)
