"""A device without hardware: the simulated actuator in wall time behind a real protocol.

The submodule ``emulator`` of a driver offers ``Params``, an extension of `Timing`, and
``make(plant, params, port, compiled)``, which returns an extension of `Emulator` that says how
the device talks. The base listens on the loopback interface or on a pty, keeps the device's
timing, plays faults, and notes what a device would have felt.

Faults are ``NAME[=VALUE][@SECONDS]``: at once, or so long after the emulator has started.

=============== ===================================================================
refuse          new connections are closed at once
drop            all connections are closed, once; a pty for good
mute            silence both ways: the cable is out
pull            the next answer breaks off in the middle, then mute
truncate        the next answer breaks off in the middle, once
garbage         the next answer is noise, once
delay=S         every answer comes so much later (s)
error=CODE      the next command fails with this code, once
stuck           the sensor stays where it is
jump=UM         the sensor says so much more (um)
saturate=V      the amplifier reaches no more than so much, either sign (V)
=============== ===================================================================
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import random
import select
import socket
import threading
import time
import tty
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from pea_core import pace
from pea_core.compiled import compile_kernel, open_sources
from pea_core.params import ParameterError, nearest, param
from pea_plant.drivers.simulated import Simulated

FAULTS = {
    "refuse": False,
    "drop": False,
    "mute": False,
    "pull": False,
    "truncate": False,
    "garbage": False,
    "delay": True,
    "error": True,
    "stuck": False,
    "jump": True,
    "saturate": True,
}
"""Faults, and whether they take a value."""

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

SPIN = 1e-4
"""End of a latency that is not slept (s): a sleep ends late by about as much."""

SIZE = 4096
LOOPBACK = "127.0.0.1"


@dataclass(frozen=True)
class Timing:
    """Emulated device."""

    latency_s: float = param(0.0, "s", 0.0, 10.0, help="from a request to its answer")
    update_s: float = param(T_M, "s", 1e-6, 10.0, help="period in which the sensor is read")


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
        self._u = 0.0

    def drive(self, u: float) -> None:
        """Hold u (V) from now on."""
        self._advance()
        self._u = u

    def y(self) -> float:
        """Displacement that the sensor tells now (m)."""
        self._advance()
        return self._model.read().y

    def close(self) -> None:
        """Nothing runs."""

    def _advance(self) -> None:
        due = (self._clock() - self._start) // T_NS
        for _ in range(min(due - self._k, PLAIN)):
            self._model.read()
            self._model.update(self._u)
        self._k = due


TOLD, DONE, LEAVE = range(3)
"""Cells that `running_kernel` shares: commands told, steps done, whether it shall return."""


def running_kernel(model: Any) -> Callable[..., Any]:
    """Compile a model that keeps up with the clock until it is told to leave."""
    output, update = model.output, model.update
    pace.native()
    sources = open_sources(output, update, pace.wait_until)

    def kernel(
        cells: np.ndarray, values: np.ndarray, noise: np.ndarray, start: int, c: Any, s: Any
    ) -> int:
        sources  # noqa: B018  part of the key under which the result is kept
        mask = noise.size - 1
        k, told, quiet = 0, 0, 0
        while pace.look(cells, LEAVE) == 0:
            now_told = pace.look(cells, TOLD)
            quiet = quiet + 1 if now_told == told else 0
            told = now_told
            u = values[0]
            due = (pace.now() - start) // T_NS
            k = max(k, due - PATIENCE)
            while k < due:
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
        self._values = np.zeros(2)
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
        """Hold u (V) from now on."""
        self._values[0] = u
        self._told += 1
        pace.tell(self._cells, TOLD, self._told)

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
        Voltage at the actuator (V).
    felt : Felt
        What it went through.
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
        self.stuck = False
        self.jump = 0.0
        self.saturation = math.inf
        model = Simulated(bare, T_M)
        self._motion = Running(model) if compiled else Stepped(model, clock)
        self._clock = clock
        self._start = clock()
        self.felt = Felt(self._start)
        self._update_ns = round(update_s * 1e9)
        self._read, self._y = 0, model.read().y

    def command(self, u: float) -> None:
        """Drive the actuator with u (V), as far as the amplifier goes."""
        u = min(max(u, self.voltage_min, -self.saturation), self.voltage_max, self.saturation)
        self._motion.drive(u)
        self.u = u
        self.felt.command(self._clock(), u)

    def reading(self) -> float:
        """Displacement (m) that the sensor has read last."""
        read = (self._clock() - self._start) // self._update_ns
        if read != self._read and not self.stuck:
            self._read, self._y = read, self._motion.y()
        return self._y + self.jump

    def close(self) -> None:
        """End what runs."""
        self._motion.close()


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

    def command(self, t: int, u: float) -> None:
        """Note the voltage u (V) at the time t (ns)."""
        self.counts["commands"] += 1
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
        return max(abs(u - v) for _, v in window) / (WINDOW_NS * 1e-9)

    def _extreme(self, which: str, name: str, value: float, rank: float) -> None:
        known = self._extremes.get(f"{which}_{name}")
        if known is None or rank > known["rank"]:
            t = (self.history[-1][0] - self.start) * 1e-9
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
            last = {"value": u, "at_s": (t - self.start) * 1e-9}
        return {
            "start_monotonic_ns": self.start,
            **extremes,
            "last_voltage_V": last,
            "counts": dict(self.counts),
        }

    def since(self, t: int) -> list[tuple[int, float]]:
        """Commands from the time t (ns) on: monotonic clock (ns) and voltage (V)."""
        return [entry for entry in list(self.history) if entry[0] >= t]


class Fault(NamedTuple):
    """A fault: its name, its value (NaN where it takes none), when it starts (s)."""

    name: str
    value: float
    after: float


def fault(text: str) -> Fault:
    """Read ``NAME[=VALUE][@SECONDS]``.

    Raises
    ------
    ParameterError
        No such fault, a value missing or too many, no number.
    """
    rest, at, after = text.partition("@")
    name, equals, value = rest.partition("=")
    if name not in FAULTS:
        raise ParameterError(f"fault {text!r}: unknown name {name!r}: {nearest(name, FAULTS)}")
    if bool(equals) != FAULTS[name]:
        form = f"{name}=VALUE" if FAULTS[name] else name
        raise ParameterError(f"fault {text!r}: write {form}[@SECONDS]")
    numbers = []
    for given, number in ((at, after), (equals, value)):
        try:
            numbers.append(float(number) if given else math.nan)
        except ValueError:
            raise ParameterError(f"fault {text!r}: {number!r} is no number") from None
    return Fault(name, numbers[1], numbers[0] if at else 0.0)


class Faults:
    """The faults in force, for every thread of an emulator.

    Parameters
    ----------
    clock : callable
        Monotonic clock (ns).
    """

    def __init__(self, clock: Callable[[], int]) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._due: dict[str, tuple[int, float]] = {}

    def set(self, which: Fault) -> None:
        """Put a fault in force, now or later."""
        with self._lock:
            self._due[which.name] = (self._clock() + round(which.after * 1e9), which.value)

    def clear(self, name: str = "") -> None:
        """End a fault, or all of them."""
        with self._lock:
            if name:
                self._due.pop(name, None)
            else:
                self._due.clear()

    def get(self, name: str) -> float | None:
        """Value of a fault in force (NaN where it has none); None where it is not."""
        if not self._due:
            return None
        due = self._due.get(name)
        return due[1] if due is not None and due[0] <= self._clock() else None

    def take(self, name: str) -> float | None:
        """As `get`; the fault has passed then."""
        if not self._due:
            return None
        with self._lock:
            value = self.get(name)
            if value is not None:
                del self._due[name]
            return value


class Session(Protocol):
    """The protocol on one connection."""

    def feed(self, data: bytes) -> bytes:
        """Take in what came, in any pieces; the answers to it, none or several in one."""


class Emulator:
    """Listens, answers with the device's timing, plays faults; extended by each device.

    Parameters
    ----------
    stage : Stage
        What is behind the amplifier.
    timing : Timing
        The device's.
    port : int
        TCP port on the loopback interface, 0 for any; None for a pty.

    Attributes
    ----------
    address : str
        As a driver takes it.
    faults : Faults
    """

    def __init__(self, stage: Stage, timing: Timing, port: int | None = 0) -> None:
        self.stage = stage
        self.timing = timing
        self.faults = Faults(time.monotonic_ns)
        self.lock = threading.Lock()
        self._noise = random.Random(1)
        self._ways: set[_Way] = set()
        self._threads: list[threading.Thread] = []
        self._closing = threading.Event()
        self._control: socket.socket | None = None
        self._listener: socket.socket | None = None
        if port is None:
            master, self._slave = os.openpty()
            tty.setraw(self._slave)
            self.address = f"serial:{os.ttyname(self._slave)}"
            self._start(self._serve, _Way(master))
        else:
            self._listener = _listen(port)
            self.address = f"tcp://{LOOPBACK}:{self._listener.getsockname()[1]}"
            self._start(self._accept)

    def session(self) -> Session:
        """A new connection's side of the protocol; called with `lock` held, as its `feed`."""
        raise NotImplementedError

    def inject(self, text: str) -> None:
        """Put a fault in force: ``NAME[=VALUE][@SECONDS]``."""
        self.faults.set(fault(text))

    def clear(self, name: str = "") -> None:
        """End a fault, or all of them."""
        self.faults.clear(name)

    def told(self) -> dict[str, Any]:
        """What the device has felt, as JSON."""
        with self.lock:
            return {"address": self.address, **self.stage.felt.told()}

    def control(self) -> str:
        """Open the control channel; its address, for `Control`."""
        self._control = _listen(0)
        self._start(self._accept_control, self._control)
        return f"tcp://{LOOPBACK}:{self._control.getsockname()[1]}"

    def close(self) -> None:
        """End every connection and every thread."""
        self._closing.set()
        for listener in (self._listener, self._control):
            if listener is not None:
                with contextlib.suppress(OSError):
                    listener.shutdown(socket.SHUT_RDWR)
                listener.close()
        self._drop()
        for thread in self._threads:
            thread.join(5.0)
        self.stage.close()
        if self._listener is None:
            with contextlib.suppress(OSError):
                os.close(self._slave)

    def __enter__(self) -> Emulator:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _start(self, target: Callable[..., None], *arguments: Any) -> None:
        thread = threading.Thread(target=target, args=arguments, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _drop(self) -> None:
        for way in list(self._ways):
            way.end()

    def _accept(self) -> None:
        assert self._listener is not None
        for connection in _connections(self._listener):
            if self.faults.get("refuse") is not None:
                self.stage.felt.count("refused")
                connection.close()
                continue
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.stage.felt.count("connections")
            self._start(self._serve, _Way(connection.fileno(), connection))

    def _serve(self, way: _Way) -> None:
        self._ways.add(way)
        with self.lock:
            session = self.session()
        try:
            while (data := self._heard(way)) is not None:
                t = time.monotonic()
                if not data or self.faults.get("mute") is not None:
                    continue
                with self.lock:
                    self._disturb()
                    answer = session.feed(data)
                if answer:
                    self._answer(way, answer, t)
        except OSError:
            pass  # the other side has gone
        finally:
            self._ways.discard(way)
            way.close()

    def _heard(self, way: _Way) -> bytes | None:
        """What came, nothing at times; None at the end."""
        data = way.receive(0.02)
        if self.faults.take("drop") is not None:
            self._drop()
            return None
        return None if self._closing.is_set() else data

    def _disturb(self) -> None:
        """Bring the stage in line with the faults; `lock` is held."""
        stage, get = self.stage, self.faults.get
        stage.stuck = get("stuck") is not None
        stage.jump = (get("jump") or 0.0) * 1e-6
        saturation = get("saturate")
        stage.saturation = math.inf if saturation is None else saturation

    def _answer(self, way: _Way, answer: bytes, t: float) -> None:
        late = self.timing.latency_s + (self.faults.get("delay") or 0.0)
        while (left := t + late - time.monotonic()) > 0.0 and not self._closing.is_set():
            if left > SPIN:
                time.sleep(min(left - SPIN, 0.1))
        if self.faults.take("garbage") is not None:
            answer = self._noise.randbytes(len(answer) + 8)
        if self.faults.take("truncate") is not None:
            answer = answer[: len(answer) // 2]
        if self.faults.take("pull") is not None:
            answer = answer[: len(answer) // 2]
            self.inject("mute")
        way.send(answer)

    def _accept_control(self, listener: socket.socket) -> None:
        for connection in _connections(listener):
            with connection, connection.makefile("rwb") as file, contextlib.suppress(OSError):
                for line in file:
                    file.write(json.dumps(self._controlled(line.decode().split())).encode() + b"\n")
                    file.flush()

    def _controlled(self, words: list[str]) -> Any:
        """Answer one line of the control channel."""
        match words:
            case ["fault", text]:
                try:
                    self.inject(text)
                except ParameterError as error:
                    return {"error": str(error)}
                return {"monotonic_ns": time.monotonic_ns()}
            case ["clear", *names]:
                self.clear(*names[:1])
                return {"monotonic_ns": time.monotonic_ns()}
            case ["log"]:
                return self.told()
            case ["since", t] if t.isdecimal():
                with self.lock:
                    return self.stage.felt.since(int(t))
        return {"error": "write fault NAME[=VALUE][@SECONDS], clear [NAME], log, or since NS"}


class Control:
    """The other side of an emulator's control channel.

    Parameters
    ----------
    address : str
        ``tcp://127.0.0.1:PORT``, as the emulator has printed it.
    """

    def __init__(self, address: str) -> None:
        host, _, port = address.removeprefix("tcp://").rpartition(":")
        self._socket = socket.create_connection((host, int(port)), 5.0)
        self._file = self._socket.makefile("rwb")

    def _ask(self, line: str) -> Any:
        self._file.write(line.encode() + b"\n")
        self._file.flush()
        answer = json.loads(self._file.readline())
        if isinstance(answer, dict) and "error" in answer:
            raise ParameterError(answer["error"])
        return answer

    def fault(self, text: str) -> int:
        """Put a fault in force; monotonic clock (ns) when it was."""
        return int(self._ask(f"fault {text}")["monotonic_ns"])

    def clear(self, name: str = "") -> None:
        """End a fault, or all of them."""
        self._ask(f"clear {name}")

    def log(self) -> dict[str, Any]:
        """What the device has felt; see `Felt.told`."""
        return dict(self._ask("log"))

    def since(self, t: int) -> list[tuple[int, float]]:
        """Commands from the monotonic clock t (ns) on: its time (ns) and the voltage (V)."""
        return [(int(at), float(u)) for at, u in self._ask(f"since {t}")]

    def close(self) -> None:
        """Close it."""
        self._file.close()
        self._socket.close()


class _Way:
    """A file descriptor for bytes, of a socket or a pty; the thread that serves it closes it."""

    def __init__(self, descriptor: int, connection: socket.socket | None = None) -> None:
        self._fd = descriptor
        self._connection = connection
        self._ended = False

    def receive(self, timeout: float) -> bytes | None:
        """What is there, nothing after the time-out (s), None at the end."""
        if self._ended:
            return None
        if not select.select([self._fd], [], [], timeout)[0]:
            return b""
        return os.read(self._fd, SIZE) or None

    def send(self, data: bytes) -> None:
        """Send all of it."""
        while data and not self._ended:
            data = data[os.write(self._fd, data) :]

    def end(self) -> None:
        """Let the other side see the end, and `receive` return it."""
        self._ended = True
        if self._connection is not None:
            with contextlib.suppress(OSError):
                self._connection.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Close it."""
        if self._connection is not None:
            self._connection.close()
        else:
            os.close(self._fd)


def _listen(port: int) -> socket.socket:
    listener = socket.socket()
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((LOOPBACK, port))
    except OSError as error:
        listener.close()
        raise ParameterError(
            f"port {port}: {error.strerror}; give another one, or 0 for any that is free"
        ) from None
    listener.listen()
    return listener


def _connections(listener: socket.socket) -> Iterator[socket.socket]:
    while True:
        try:
            yield listener.accept()[0]
        except OSError:
            return
