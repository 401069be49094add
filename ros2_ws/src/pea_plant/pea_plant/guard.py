"""The last resort: a process that brings the amplifier to its safe voltage when the plant dies.

It holds a connection to the device and, ready to send, the commands of a ramp; it knows no driver
and no protocol, and imports nothing but the standard library, so it is there in some 30 ms. The
plant tells it, through shared memory, the voltage that the device has. The end of a pipe means
that the plant is dead, however it died.
"""

from __future__ import annotations

import base64
import contextlib
import json
import mmap
import os
import select
import signal
import socket
import stat
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

FIRE, STAND_DOWN = b"f", b"d"
READY, SAFE, UNREACHED = b"r", b"s", b"u"

PERIOD = 0.002
"""Seconds between two commands of the ramp."""

STEPS_MAX = 2000
"""Commands of a ramp over the whole range."""

DIAL = 1.0
"""Seconds for a new connection."""

PATIENCE = 5.0
"""Seconds that the process has to be there, and the device to answer all."""

HUSH = 0.2
"""Seconds without an answer after which none is under way."""

_VOLTAGE = struct.Struct("d")


class Guard:
    """The plant's side of it.

    Parameters
    ----------
    descriptor : int
        Connection to the device; the process keeps it, whoever closes it here.
    command : callable
        Bytes that command a voltage (V) whatever was sent before.
    voltage_min, voltage_max, safe : float
        Range and safe voltage (V).
    slew_rate : float
        Fastest change (V/s).

    Raises
    ------
    OSError
        The process cannot be started.
    """

    def __init__(
        self,
        descriptor: int,
        command: Callable[[float], bytes],
        voltage_min: float,
        voltage_max: float,
        safe: float,
        slew_rate: float,
    ) -> None:
        period = max(PERIOD, (voltage_max - voltage_min) / (slew_rate * STEPS_MAX))
        step = slew_rate * period
        below = int((safe - voltage_min) / step) + 1
        above = int((voltage_max - safe) / step) + 1
        levels = [safe + i * step for i in range(-below, above + 1)]
        levels = [u for u in levels if voltage_min <= u <= voltage_max]
        ramp = [[u, base64.b64encode(command(u)).decode()] for u in levels]
        memory = os.memfd_create("pea_guard")
        os.truncate(memory, _VOLTAGE.size)
        self._memory = mmap.mmap(memory, _VOLTAGE.size)
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", __file__, str(descriptor), str(memory)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=(descriptor, memory),
            start_new_session=True,
        )
        os.close(memory)
        self.tell(safe)
        self._order(json.dumps({"period": period, "safe": safe, "ramp": ramp}).encode() + b"\n")
        if self._answer() != READY:
            raise OSError("the guard process does not start")

    def tell(self, u: float) -> None:
        """Note the voltage (V) that the device has from now on."""
        _VOLTAGE.pack_into(self._memory, 0, u)

    def fire(self) -> None:
        """Have the device brought to its safe voltage, from now on."""
        self._order(FIRE)

    def done(self) -> bool:
        """Wait until that is done; whether the device could be reached."""
        return self._answer() == SAFE

    def stand_down(self) -> None:
        """End the process: nothing is to be done any more."""
        self._order(STAND_DOWN)
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()
        self._process.wait(PATIENCE)

    @property
    def alive(self) -> bool:
        """Whether the process is there."""
        return self._process.poll() is None

    def _order(self, data: bytes) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            self._process.stdin.write(data)
            self._process.stdin.flush()

    def _answer(self) -> bytes:
        assert self._process.stdout is not None
        return bytes(os.read(self._process.stdout.fileno(), 1))


def guard(
    make: Callable[[], Any], driver: Any, limits: Any, slew_rate: float
) -> tuple[Guard | None, str]:
    """Start the guard of a connected driver.

    Parameters
    ----------
    make : callable
        Makes another driver of the same device, not connected.
    driver : Driver
        Connected.
    limits : pea_plant.safety.Coefficients
        Range and safe voltage (V).
    slew_rate : float
        V/s.

    Returns
    -------
    Guard or None
        None where there is no connection to hold.
    str
        What it holds, for people.
    """
    if driver.fileno() < 0:
        return None, "no connection, no guard"
    spare, held = None, "the same connection"
    if stat.S_ISSOCK(os.fstat(driver.fileno()).st_mode):
        spare = make()
        try:
            spare.connect()
            held = "a connection of its own"
        except Exception as error:  # the device takes one only
            spare, held = None, f"the same connection ({error})"
    holder = driver if spare is None else spare
    try:
        process = Guard(
            holder.fileno(),
            holder.last_resort,
            limits.voltage_min,
            limits.voltage_max,
            limits.safe,
            slew_rate,
        )
    finally:
        if spare is not None:
            spare.close()
    return process, held


def ramp(levels: list[tuple[float, bytes]], u: float, safe: float) -> list[bytes]:
    """Commands from the voltage u (V) to the safe one, which is a level."""
    down = [(v, data) for v, data in levels if safe <= v < u]
    up = [(v, data) for v, data in levels if u < v <= safe]
    way = [data for _, data in down[::-1]] + [data for _, data in up]
    return way or [data for v, data in levels if v == safe]


def peer_of(descriptor: int) -> Any:
    """Who is at the other end of a TCP connection; None of another line."""
    if not stat.S_ISSOCK(os.fstat(descriptor).st_mode):
        return None
    return socket.socket(fileno=os.dup(descriptor)).getpeername()[:2]


def reached(descriptor: int, peer: Any) -> int:
    """The connection, or a new one where the device has closed it.

    Raises
    ------
    OSError
        The device takes none.
    """
    if peer is None:
        return descriptor
    held = socket.socket(fileno=os.dup(descriptor))
    try:
        while held.recv(4096, socket.MSG_DONTWAIT):
            pass  # answers that nobody has read
    except BlockingIOError:
        return descriptor
    except OSError:
        pass
    return socket.create_connection(peer, DIAL).detach()


def hear_out(descriptor: int) -> None:
    """Take the device's answers until it is silent.

    A connection that closes with answers unread is reset: commands under way would be lost.
    """
    end = time.monotonic() + PATIENCE
    with contextlib.suppress(OSError):
        while time.monotonic() < end and select.select([descriptor], [], [], HUSH)[0]:
            if not os.read(descriptor, 4096):
                return


def main() -> None:
    """Run the process: wait for an order, or for the end of whoever gives it."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGPIPE):
        signal.signal(number, signal.SIG_IGN)
    descriptor, memory = (int(word) for word in sys.argv[1:3])
    told = json.loads(sys.stdin.buffer.readline())
    period, safe = told["period"], told["safe"]
    levels = [(u, base64.b64decode(data)) for u, data in told["ramp"]]
    voltage = mmap.mmap(memory, _VOLTAGE.size)
    peer = peer_of(descriptor)
    os.write(1, READY)
    while (order := sys.stdin.buffer.read(1)) != STAND_DOWN:
        began = time.monotonic()
        (u,) = _VOLTAGE.unpack_from(voltage, 0)
        answer = SAFE
        try:
            descriptor = reached(descriptor, peer)
            for data in ramp(levels, u, safe):
                time.sleep(period)
                while data:
                    data = data[os.write(descriptor, data) :]
            _VOLTAGE.pack_into(voltage, 0, safe)
            took = (time.monotonic() - began) * 1e3
            told_people = f"from {u:.3f} V to the safe {safe:g} V in {took:.0f} ms"
        except OSError as error:
            answer, told_people = UNREACHED, f"the device cannot be reached: {error.strerror}"
        cause = "asked by the plant" if order else "the plant has died"
        with contextlib.suppress(OSError):
            os.write(2, f"guard: {cause}: {told_people}\n".encode())
        with contextlib.suppress(OSError):
            os.write(1, answer)
        if not order:
            hear_out(descriptor)
            return


if __name__ == "__main__":
    main()
