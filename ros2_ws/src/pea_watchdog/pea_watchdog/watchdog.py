"""The watchdog: a process that brings the amplifier to its safe voltage when the plant cannot.

It holds a connection to the device and the commands of a ramp, ready to send. It knows no driver
and no protocol, and imports nothing but the standard library, so it starts in some 30 ms. It acts
when the plant dies (the end of a pipe), asks for it, or has been silent for a stated time. A
device that it does not reach is tried again until somebody tells it to stop: the plant, or a
SIGTERM once the plant is dead. A device that has hung up may have been switched off, and then it
holds another voltage: a new connection is the plant's as long as the plant lives, and whoever makes
one asks what is held. How to ask, and where in the answer the number stands, the driver says.

A line may be silent both ways and lose what is sent: left alone, the watchdog has done when the
device says that it holds the safe voltage.

Both sides share memory, so neither waits for the other: the plant writes the voltage of now and
when it has done so, and a new ramp when its limits change; the watchdog writes its state and when
it has looked last. Its whole ramp keeps the limits that were in force when the plant wrote last.
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
"""Orders to it: act; end; act, and go on alone. The end of the pipe is the death of the plant."""

STARTING, WATCHING, ACTING, SAFE, UNREACHED = range(5)
"""Its states: `UNREACHED` until it succeeds after all."""

PERIOD = 0.002
"""Seconds between two commands of the ramp, at most."""

STEPS_MIN, STEPS_MAX = 10, 2000
"""Commands of a ramp over the whole range. One that is so fast that it would take fewer goes at
half the limit: a device that samples may see two of them nearly at once."""

AGAIN = 10
"""How often the safe voltage is sent once more where what is sent may be lost."""

NEAR, HEEDED = 0.01, 10
"""Share of the range by which what a device holds may differ from the safe voltage, and ramps that
a device gets that says it holds another one."""

DIAL = 1.0
"""Seconds for a new connection, and for a device to take a command."""

RETRY = 0.1
"""Seconds between two attempts to reach the device."""

PATIENCE = 5.0
"""Seconds that the process has to start, and the device to answer all."""

END = 0.5
"""Seconds that the process has to end when told, before it is killed."""

LOOK = 0.02
"""Longest pause between two looks at the plant (s)."""

HUNG = 1.0
"""Seconds without a look of the watchdog after which it counts as hung."""

PRIORITY = 10
"""Its real-time priority, where permitted."""

EXITING = 0x4
"""Flag of a process that is on its way out, in its ``stat`` (``PF_EXITING`` of Linux)."""

HUSH = 0.2
"""Seconds without an answer after which none is under way."""

POLL = 5e-4
"""Seconds between two looks at what it says."""

VOLTAGE, TOLD, STATE, _SEEN, _RAMP = range(5)
"""Cells of eight bytes in the shared memory: voltage (V), when it was told (ns), state, when the
watchdog has looked (ns), number of the ramp in force."""

_OTHERS = 64
"""First of the cells with the voltages of further channels (V)."""

_HEAD, _SLOT = 4096, 1 << 20
"""Bytes before the two places for a ramp, which are used in turn, and of each."""


class Shared:
    """The shared memory of plant and watchdog.

    Parameters
    ----------
    descriptor : int
        Of a memory file.
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
        """Voltage that the device has, or has from now on (V)."""
        return self._cells[VOLTAGE]

    @voltage.setter
    def voltage(self, u: float) -> None:
        self._cells[VOLTAGE] = u

    def of(self, channel: int) -> float:
        """Voltage of a channel (V)."""
        return self._cells[_OTHERS + channel if channel else VOLTAGE]

    def put(self, channel: int, u: float) -> None:
        """Note the voltage of a channel (V)."""
        self._cells[_OTHERS + channel if channel else VOLTAGE] = u

    def told(self) -> None:
        """The plant has told the voltage, now."""
        self._set(TOLD, time.monotonic_ns())

    def seen(self) -> None:
        """The watchdog has looked, now."""
        self._set(_SEEN, time.monotonic_ns())

    @property
    def silent(self) -> float:
        """Seconds since the plant has told the voltage."""
        return (time.monotonic_ns() - self._get(TOLD)) * 1e-9

    @property
    def unseen(self) -> float:
        """Seconds since the watchdog has looked."""
        return (time.monotonic_ns() - self._get(_SEEN)) * 1e-9

    @property
    def state(self) -> int:
        """State of the watchdog."""
        return self._get(STATE)

    @state.setter
    def state(self, state: int) -> None:
        self._set(STATE, state)

    def write(self, ramp: dict[str, object]) -> None:
        """Put a ramp in force: whole, or not at all.

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
        """The ramp in force, of each channel."""
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
    """Seconds between two commands, safe voltage (V), the voltage (V) and bytes of each.

    `ask` is None, or question and answer in base 64, form, and the number at each level.
    """

    period: float
    safe: float
    levels: list[tuple[float, bytes]]
    ask: list[Any] | None = None


def ramp(levels: list[tuple[float, bytes]], u: float, safe: float) -> list[tuple[float, bytes]]:
    """Levels and commands from the voltage u (V) to the safe one, which is a level."""
    down = [(v, data) for v, data in levels if safe <= v < u]
    up = [(v, data) for v, data in levels if u < v <= safe]
    return down[::-1] + up or [(v, data) for v, data in levels if v == safe]


def between(numbers: Sequence[float], levels: Sequence[float], number: float) -> float:
    """The voltage (V) of a number that a device says, by those of the levels around it."""
    if numbers[0] > numbers[-1]:
        numbers, levels = numbers[::-1], levels[::-1]
    i = min(max(bisect.bisect(numbers, number), 1), len(numbers) - 1)
    span = numbers[i] - numbers[i - 1]
    share = (number - numbers[i - 1]) / span if span else 0.0
    return levels[i - 1] + share * (levels[i] - levels[i - 1])


def peer_of(descriptor: int) -> Any:
    """Who is at the other end of a TCP connection; None of another line."""
    if not stat.S_ISSOCK(os.fstat(descriptor).st_mode):
        return None
    with socket.socket(fileno=os.dup(descriptor)) as held:
        return held.getpeername()[:2]


def heard(descriptor: int) -> None:
    """Throw away what the device has answered over a socket, and see that it has not hung up.

    Raises
    ------
    OSError
        It has: what was sent last may not have arrived.
    """
    with socket.socket(fileno=os.dup(descriptor)) as held, contextlib.suppress(BlockingIOError):
        while held.recv(4096, socket.MSG_DONTWAIT):
            pass
        raise ConnectionResetError("the device closed the connection")


def reached(descriptor: int, peer: Any, alone: bool) -> int:
    """The connection, or a new one where the device has closed it and nobody else sees to it.

    Raises
    ------
    OSError
        The device takes none, or the plant makes the next one.
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
    """Send all of it, within `DIAL`.

    Raises
    ------
    OSError
        The device does not take it.
    """
    while data:
        if not select.select([], [descriptor], [], DIAL)[1]:
            raise TimeoutError(f"it takes no command within {DIAL:g} s")
        data = data[os.write(descriptor, data) :]


def sender(rescue: Sequence[str]) -> Callable[[bytes], None]:
    """What sends a command where the connection is no file: made by a file of the driver."""
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
    """Take the device's answers until it is silent.

    A connection that closes with answers unread is reset: commands under way would be lost.
    """
    end = time.monotonic() + PATIENCE
    with contextlib.suppress(OSError):
        while time.monotonic() < end and select.select([descriptor], [], [], HUSH)[0]:
            if not os.read(descriptor, 4096):
                return


def dying(pid: int) -> bool:
    """Whether a process is dead or dies. Its files close last: its memory goes before them.

    To give back 300 MB takes 0.1 s and more.
    """
    try:
        with open(f"/proc/{pid}/stat", "rb") as file:
            fields = file.read().rpartition(b")")[2].split()
    except FileNotFoundError:
        return os.path.exists("/proc/self/stat")
    except OSError:  # the end of the pipe will tell
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
        """What the plant has ordered, waiting at most so long; nothing once it is dead."""
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
                if self.shared.silent > self.silence:  # else it has come back just now
                    self.act(f"the plant is silent for {silent:.2g} s")
                else:
                    self.shared.state = WATCHING

    def act(self, cause: str) -> None:
        """Bring the device to its safe voltage; try until that is done, or told to stop."""
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
        """One ramp: from and to where; empty where it was told to stop.

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
                if held is None and self.lost:  # a ramp from what it was told last may be a step
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
                self.shared.put(channel, u)  # a period later the device has not hung up
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
        """See that the device holds what it was sent, where its driver knows how to ask.

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
        """Tell people, as long as anybody listens."""
        with contextlib.suppress(OSError):
            os.write(2, f"watchdog: {text}\n".encode())


def main() -> None:
    """Run the process."""
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGPIPE):
        signal.signal(number, signal.SIG_IGN)
    with contextlib.suppress(OSError):  # it sleeps nearly always, and must not wait when it acts
        if not os.sched_getparam(0).sched_priority:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    descriptor, memory, silence, *rescue = sys.argv[1:]
    Process(int(descriptor), Shared(int(memory)), float(silence), rescue).run()


if __name__ == "__main__":
    main()
