"""The watchdog: a process that brings the amplifier to its safe voltage when the plant cannot.

It holds a connection to the device and the commands of a ramp, ready to send. It contains no driver
and no protocol, and imports only the standard library, so it starts in some 30 ms. It acts when the
plant dies (the end of a pipe), when the plant asks for it, or when the plant has been silent for a
stated time. If it does not reach the device, it tries again until it is told to stop: by the plant,
or by SIGTERM once the plant is dead. A device that closed the connection may have been switched
off, and then it holds another voltage. So the process that connects again asks which voltage the
device holds: the plant as long as it lives, else the watchdog. The driver defines the question, and
where in the answer the number is.

An unplugged cable loses data without an error. So a watchdog that was left alone ends only when the
device answers that it holds the safe voltage.

Both sides share memory, so neither waits for the other. The plant writes the present voltage and
its time, and a new ramp when its limits change. The watchdog writes its state and the time at which
it has last run. Its whole ramp keeps the limits that the plant wrote last.
"""

from __future__ import annotations

import base64
import bisect
import contextlib
import importlib.util
import json
import mmap
import os
import re
import select
import signal
import socket
import stat
import struct
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

FIRE, STAND_DOWN, LEAVE = b"f", b"d", b"l"
"""Orders to the watchdog: act; end; act and go on alone. The pipe ends when the plant dies."""

STARTING, WATCHING, ACTING, SAFE, UNREACHED = range(5)
"""States of the watchdog; it is `UNREACHED` until it reaches the device."""

PERIOD = 0.002
"""Longest time (s) between two commands of the ramp."""

STEPS_MIN, STEPS_MAX = 10, 2000
"""Number of commands of a ramp over the whole range. A ramp that would need fewer than the least
goes at half the slew limit, because a sampling device may see two commands nearly at once."""

AGAIN = 10
"""How many times the safe voltage is sent again if data may be lost."""

NEAR, HEEDED = 0.01, 10
"""Largest distance of the held voltage from the safe one, as a share of the range; most ramps for a
device that answers that it holds another voltage."""

DIAL = 1.0
"""Longest time (s) for a new connection, and for sending a command."""

RETRY = 0.1
"""Seconds between two attempts to reach the device."""

PATIENCE = 5.0
"""Longest time (s) for the start of the process, and for all answers of the device."""

END = 0.5
"""Seconds for the process to end when it is told to, before it is killed."""

LOOK = 0.02
"""Longest time (s) between two checks of the plant."""

HUNG = 1.0
"""Seconds without a check by the watchdog after which it counts as hung."""

PRIORITY = 10
"""Real-time priority of the watchdog, if permitted."""

UNHEEDED = (signal.SIGINT, signal.SIGHUP, signal.SIGTERM)
"""Signals that do not end it while the plant lives; blocked until it is ready for them."""

EXITING = 0x4
"""Flag of a process that is exiting, in its ``stat`` (``PF_EXITING`` of Linux)."""

HUSH = 0.2
"""After this time (s) without data, no answer is expected any more."""

POLL = 5e-4
"""Seconds between two checks for an answer."""

VOLTAGE, TOLD, STATE, _SEEN, _RAMP = range(5)
"""Cells of eight bytes in the shared memory: voltage (V), its time (ns), state, time of the last
check by the watchdog (ns), number of the present ramp."""

_OTHERS = 64
"""First of the cells with the voltages of further channels (V)."""

_HEAD, _SLOT = 4096, 1 << 20
"""Bytes before the two places for a ramp, which are used in turn, and bytes of each place."""


class Shared:
    """The shared memory of plant and watchdog.

    Parameters
    ----------
    descriptor : int
        File descriptor of a memory file.
    """

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        head = memoryview(mmap.mmap(descriptor, _HEAD))
        # one store of eight bytes each: struct.pack_into clears them first, and the other side
        # would now and then read a 0
        self._counts, self._cells = head.cast("q"), head.cast("d")

    def _set(self, place: int, value: int) -> None:
        self._counts[place] = value

    def _get(self, place: int) -> int:
        return self._counts[place]

    @property
    def cells(self) -> tuple[memoryview[int], memoryview[float]]:
        """The same memory as whole numbers and as floats, for a loop that calls no method."""
        return self._counts, self._cells

    @property
    def voltage(self) -> float:
        """Voltage (V) that the device has, or gets next."""
        return self._cells[VOLTAGE]

    @voltage.setter
    def voltage(self, u: float) -> None:
        self._cells[VOLTAGE] = u

    def of(self, channel: int) -> float:
        """Voltage of a channel (V)."""
        return self._cells[_OTHERS + channel if channel else VOLTAGE]

    def put(self, channel: int, u: float) -> None:
        """Write the voltage of a channel (V)."""
        self._cells[_OTHERS + channel if channel else VOLTAGE] = u

    def told(self) -> None:
        """Write the time at which the plant wrote the voltage: now."""
        self._set(TOLD, time.monotonic_ns())

    def seen(self) -> None:
        """Write the time of the watchdog's check: now."""
        self._set(_SEEN, time.monotonic_ns())

    @property
    def silent(self) -> float:
        """Seconds since the plant has written the voltage."""
        return (time.monotonic_ns() - self._get(TOLD)) * 1e-9

    @property
    def unseen(self) -> float:
        """Seconds since the last check by the watchdog."""
        return (time.monotonic_ns() - self._get(_SEEN)) * 1e-9

    @property
    def state(self) -> int:
        """State of the watchdog."""
        return self._get(STATE)

    @state.setter
    def state(self, state: int) -> None:
        self._set(STATE, state)

    def write(self, ramp: dict[str, object]) -> None:
        """Replace the ramp, completely or not at all.

        Raises
        ------
        OSError
            It is too long.
        """
        data = json.dumps(ramp).encode() + b"\n"
        if len(data) > _SLOT:
            raise OSError(f"the watchdog's ramp takes {len(data)} bytes, at most {_SLOT}")
        number = self._get(_RAMP) + 1
        os.pwrite(self.descriptor, data, _HEAD + number % 2 * _SLOT)
        self._set(_RAMP, number)

    def read(self) -> list[Ramp]:
        """The present ramp of each channel."""
        at = _HEAD + self._get(_RAMP) % 2 * _SLOT
        ramps = json.loads(os.pread(self.descriptor, _SLOT, at).partition(b"\n")[0])["channels"]
        return [
            Ramp(
                ramp["period"],
                ramp["safe"],
                [(u, base64.b64decode(data)) for u, data in ramp["levels"]],
                ramp["ask"],
            )
            for ramp in ramps
        ]


def new_memory() -> int:
    """Descriptor of a memory file for `Shared`."""
    memory = os.memfd_create("pea_watchdog")
    os.truncate(memory, _HEAD + 2 * _SLOT)
    return memory


class Ramp(NamedTuple):
    """Seconds between two commands, safe voltage (V), voltage (V) and bytes of each command.

    `ask` is None, or question and answer in base 64, form, and the number at each level.
    """

    period: float
    safe: float
    levels: list[tuple[float, bytes]]
    ask: list[Any] | None = None


def ramp(levels: list[tuple[float, bytes]], u: float, safe: float) -> list[tuple[float, bytes]]:
    """Levels and commands of the ramp from the voltage u (V) to the safe voltage."""
    down = [(v, data) for v, data in levels if safe <= v < u]
    up = [(v, data) for v, data in levels if u < v <= safe]
    return down[::-1] + up or [(v, data) for v, data in levels if v == safe]


def between(numbers: Sequence[float], levels: Sequence[float], number: float) -> float:
    """The voltage (V) for a number that a device returns, interpolated between levels."""
    if numbers[0] > numbers[-1]:
        numbers, levels = numbers[::-1], levels[::-1]
    i = min(max(bisect.bisect(numbers, number), 1), len(numbers) - 1)
    span = numbers[i] - numbers[i - 1]
    share = (number - numbers[i - 1]) / span if span else 0.0
    return levels[i - 1] + share * (levels[i] - levels[i - 1])


def peer_of(descriptor: int) -> Any:
    """Address at the other end of a TCP connection; None for another line."""
    if not stat.S_ISSOCK(os.fstat(descriptor).st_mode):
        return None
    with socket.socket(fileno=os.dup(descriptor)) as held:
        return held.getpeername()[:2]


def heard(descriptor: int) -> None:
    """Discard what the device has sent over a socket; check that the connection is open.

    Raises
    ------
    OSError
        The connection is closed: the last data may not have arrived.
    """
    with socket.socket(fileno=os.dup(descriptor)) as held, contextlib.suppress(BlockingIOError):
        while held.recv(4096, socket.MSG_DONTWAIT):
            pass
        raise ConnectionResetError("the device closed the connection")


def reached(descriptor: int, peer: Any, alone: bool) -> int:
    """The connection, or a new one if the device has closed it and the plant makes none.

    Raises
    ------
    OSError
        The device accepts no connection, or the plant makes the next one.
    """
    if peer is None:
        return descriptor
    try:
        heard(descriptor)
    except OSError:
        if not alone:
            raise
        return socket.create_connection(peer, DIAL).detach()
    return descriptor


def send(descriptor: int, data: bytes) -> None:
    """Send all data, within `DIAL`.

    Raises
    ------
    OSError
        The device does not accept the data.
    """
    while data:
        if not select.select([], [descriptor], [], DIAL)[1]:
            raise TimeoutError(f"it takes no command within {DIAL:g} s")
        data = data[os.write(descriptor, data) :]


def sender(rescue: Sequence[str]) -> Callable[[bytes], None]:
    """Function that sends a command if the connection is no file; a file of the driver makes it."""
    path, text = rescue
    spec = importlib.util.spec_from_file_location("pea_rescue", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["pea_rescue"] = module
    spec.loader.exec_module(module)
    made: Callable[[bytes], None] = module.opened(text)
    return made


def hear_out(descriptor: int) -> None:
    """Read and discard the device's answers until it is silent.

    A connection that closes with answers unread is reset: commands under way would be lost.
    """
    end = time.monotonic() + PATIENCE
    with contextlib.suppress(OSError):
        while time.monotonic() < end and select.select([descriptor], [], [], HUSH)[0]:
            if not os.read(descriptor, 4096):
                return


def dying(pid: int) -> bool:
    """Whether a process is dead or exiting. Its files close last, after its memory is freed.

    To give back 300 MB takes 0.1 s and more.
    """
    try:
        with open(f"/proc/{pid}/stat", "rb") as file:
            fields = file.read().rpartition(b")")[2].split()
    except FileNotFoundError:
        return os.path.exists("/proc/self/stat")
    except OSError:  # the end of the pipe will show it
        return False
    return fields[0] in b"ZX" or bool(int(fields[6]) & EXITING)


class Process:
    """The process itself.

    Parameters
    ----------
    descriptor : int
        Connection to the device.
    shared : Shared
    silence : float
        Seconds of silence of the plant after which it acts.
    rescue : sequence of str
        See `Watchdog`.
    """

    def __init__(
        self, descriptor: int, shared: Shared, silence: float, rescue: Sequence[str] = ()
    ) -> None:
        self.descriptor = descriptor
        self.send = sender(rescue) if rescue else lambda data: send(self.descriptor, data)
        self.again, self.heeded = AGAIN if rescue else 0, HEEDED
        self.shared = shared
        self.silence = silence
        self.plant = os.getppid()
        self.peer = peer_of(descriptor)
        self.orphan = self.ended = False
        self.asked, self.lost = True, False
        self.cause = "the plant has died"
        signal.signal(signal.SIGTERM, self.dismiss)

    def dismiss(self, number: int, frame: object) -> None:
        """End at SIGTERM, once the plant is dead."""
        self.ended = self.ended or self.orphan

    def order(self, seconds: float) -> bytes:
        """Order of the plant, after a wait of at most this time; empty if the plant is dead."""
        self.shared.seen()
        if self.orphan:
            time.sleep(seconds)
            return b""
        if not select.select([0], [], [], seconds)[0]:
            self.orphan = dying(self.plant)
            return b""
        order = os.read(0, 1)
        self.orphan = order in (b"", LEAVE)
        if order == LEAVE:
            self.cause = "left to it by the plant"
        self.ended = self.ended or order == STAND_DOWN
        return order

    def run(self) -> None:
        """Watch until it is told to stop, or the dead plant's device is safe."""
        self.shared.seen()
        self.shared.state = WATCHING
        while not self.ended:
            order = self.order(min(self.silence / 4.0, LOOK))
            if self.orphan:
                self.act(self.cause)
                if not self.ended:
                    hear_out(self.descriptor)
                return
            if order == FIRE:
                self.act("asked by the plant")
            elif self.shared.state == WATCHING and (silent := self.shared.silent) > self.silence:
                self.shared.state = ACTING
                if self.shared.silent > self.silence:  # else the plant has just continued
                    self.act(f"the plant is silent for {silent:.2g} s")
                else:
                    self.shared.state = WATCHING

    def act(self, cause: str) -> None:
        """Bring the device to its safe voltage; try until this is done, or until told to stop."""
        began, self.shared.state = time.monotonic(), ACTING
        said = ""
        while not self.ended:
            try:
                told = self.attempt()
            except OSError as error:
                self.shared.state = UNREACHED
                told = f"the device cannot be reached: {error.strerror or error}"
                if told != said:
                    self.say(f"{cause}: {told}; trying again")
                    said = told
                self.order(RETRY)
                continue
            if told:
                took = (time.monotonic() - began) * 1e3
                self.say(f"{cause}: {told} in {took:.0f} ms")
                self.shared.state = SAFE
            return

    def attempt(self) -> str:
        """Ramp once; return from and to which voltage, or an empty text if told to stop.

        Raises
        ------
        OSError
            The device cannot be reached.
        """
        alone = self.orphan or self.shared.silent > self.silence
        before = self.descriptor
        self.descriptor = reached(before, self.peer, alone)
        ramps = self.shared.read()
        if self.descriptor != before:
            self.asked = False
        for channel, own in enumerate(ramps):
            if not self.asked and own.ask is not None:
                held = self.ask(own)
                if held is None and self.lost:  # a ramp from the last known voltage may be a step
                    raise TimeoutError("it does not answer")
                self.shared.put(channel, self.shared.of(channel) if held is None else held)
        if self.ended:
            return ""
        self.asked = True
        begun = [self.shared.of(channel) for channel in range(len(ramps))]
        ways = []
        for own, u in zip(ramps, begun, strict=True):
            way = ramp(own.levels, u, own.safe)
            ways.append([*way, *way[-1:] * self.again])
        reached_u = list(begun)
        for step in range(max(map(len, ways)) + 1):  # the last one waits a period
            due = time.monotonic() + max(own.period for own in ramps)
            while (left := due - time.monotonic()) > 0.0:
                self.order(left)
            if self.peer is not None:
                heard(self.descriptor)
            for channel, u in enumerate(reached_u):
                self.shared.put(channel, u)  # the connection was still open a period later
            if self.ended:
                return ""
            now = [(channel, way[step]) for channel, way in enumerate(ways) if step < len(way)]
            self.send(b"".join(data for _, (_, data) in now))
            for channel, (level, _) in now:
                reached_u[channel] = level
        if self.orphan and not self.ended:
            self.confirm(ramps)
        return " and ".join(
            f"from {u:.3f} V to the safe {own.safe:g} V"
            for u, own in zip(begun, ramps, strict=True)
        )

    def confirm(self, ramps: list[Ramp]) -> None:
        """Check that the device holds the safe voltage, if its driver has a question for it.

        One that goes on saying that it holds something else is left after `HEEDED` ramps.
        """
        for channel, own in enumerate(ramps):
            held = None if own.ask is None else self.ask(own)
            if own.ask is None or self.ended:
                continue
            if held is None:
                self.asked, self.lost = False, True
                raise TimeoutError("it does not answer")
            near = NEAR * (own.levels[-1][0] - own.levels[0][0])
            if abs(held - own.safe) > near:
                self.shared.put(channel, held)
                self.heeded -= 1
                if self.heeded > 0:
                    raise OSError(f"it holds {held:.3f} V")
                self.say(f"the device says that it holds {held:.3f} V")

    def ask(self, ramped: Ramp) -> float | None:
        """Voltage (V) that a device reports to hold; None if no answer comes within `DIAL`."""
        assert ramped.ask is not None
        data, answer, form, numbers = ramped.ask
        send(self.descriptor, base64.b64decode(data))
        seen, end = b"", time.monotonic() + DIAL
        while not self.ended and time.monotonic() < end:
            self.order(0.0)
            if not select.select([self.descriptor], [], [], LOOK)[0]:
                continue
            piece = os.read(self.descriptor, 4096)
            if not piece:
                raise ConnectionResetError("the device closed the connection")
            seen = (seen + piece)[-4096:]
            if found := re.search(base64.b64decode(answer), seen, re.DOTALL):
                with contextlib.suppress(ValueError, struct.error):
                    number = struct.unpack(form, found[1])[0] if form else float(found[1])
                    if abs(number) < float("inf"):
                        return between(numbers, [u for u, _ in ramped.levels], number)
        return None

    def say(self, text: str) -> None:
        """Write a line to standard error, if it is open."""
        with contextlib.suppress(OSError):
            os.write(2, f"watchdog: {text}\n".encode())


def main() -> None:
    """Run the process."""
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGPIPE):
        signal.signal(number, signal.SIG_IGN)
    with contextlib.suppress(OSError):  # it sleeps most of the time, and must act without delay
        if not os.sched_getparam(0).sched_priority:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    descriptor, memory, silence, *rescue = sys.argv[1:]
    process = Process(int(descriptor), Shared(int(memory)), float(silence), rescue)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, UNHEEDED)
    process.run()


if __name__ == "__main__":
    main()
