"""A device without hardware: the simulated actuator in wall time behind a real protocol.

The submodule ``emulator`` of a driver offers ``Params``, an extension of `Timing`, and
``make(plant, params, port, compiled)``, which returns an extension of `Emulator` that says how
the device talks. The base listens on the loopback interface or on a pty, keeps the device's
timing, takes no more connections than it does, plays faults (`pea_drivers.faults`), and notes
what a device would have felt (`pea_drivers.stage`).
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import queue
import random
import select
import socket
import threading
import time
import tty
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

from pea_core.params import ParameterError, param
from pea_drivers.faults import Faults, fault
from pea_drivers.stage import T_M, EmulatedStage

SPIN = 1e-4
"""End of a latency that is not slept (s): a sleep ends late by about as much."""

TICK = 0.002
"""Period of what a device does by itself (s)."""

SIZE = 4096
LOOPBACK = "127.0.0.1"


@dataclass(frozen=True)
class Timing:
    """Emulated device."""

    latency_s: float = param(0.0, "s", 0.0, 10.0, help="from a request to its answer")
    update_s: float = param(T_M, "s", 1e-6, 10.0, help="period in which the sensor is read")
    connections: int = param(
        0, "", 0, 1000, help="TCP connections that it takes at a time, 0: any number"
    )
    drops: bool = param(False, help="for one too many it drops the oldest; else it refuses that")


class Session(Protocol):
    """The protocol on one connection."""

    def feed(self, data: bytes) -> bytes:
        """Take in what came, in any pieces; the answers to it, none or several in one."""


class Emulator:
    """Listens, answers with the device's timing, plays faults; extended by each device.

    Parameters
    ----------
    stage : EmulatedStage
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

    def __init__(self, stage: EmulatedStage, timing: Timing, port: int | None = 0) -> None:
        self.stage = stage
        self.timing = timing
        self.faults = Faults(time.monotonic_ns)
        self._commands = 0
        self.lock = threading.Lock()
        self._noise = random.Random(1)
        self._ticking = False
        self.ways: dict[_Way, None] = {}
        self._threads: list[threading.Thread] = []
        self._closing = threading.Event()
        self._control: socket.socket | None = None
        self._listener: socket.socket | None = None
        if port is None:
            master, self._slave = os.openpty()
            tty.setraw(self._slave)
            self.address = f"serial:{os.ttyname(self._slave)}"
            self._start_serving(_Way(master))
        else:
            self._listener = _listen(port)
            self.address = f"tcp://{LOOPBACK}:{self._listener.getsockname()[1]}"
            self._start(self._accept)

    def session(self) -> Session:
        """A new connection's side of the protocol; called with `lock` held, as its `feed`."""
        raise NotImplementedError

    def inject(self, text: str) -> None:
        """Put a fault in force: ``NAME[=VALUE][@SECONDS]``."""
        which = fault(text)
        if which.name == "lose":
            raise ParameterError(f"fault {text!r}: a stream of bytes loses nothing")
        self.faults.set(which)

    def clear(self, name: str = "") -> None:
        """End a fault, or all of them."""
        self.faults.clear(name)

    def ticks(self) -> None:
        """Let `tick` be called from now on; a device that does nothing by itself costs nothing."""
        if not self._ticking:
            self._ticking = True
            self._start(self._tick)

    def tick(self) -> None:
        """What the device does by itself, every `TICK`; called with `lock` held."""
        for stage in self.every_stage().values():
            stage.servo()

    def _tick(self) -> None:
        while not self._closing.wait(TICK):
            with self.lock:
                self._disturb()
                self.tick()

    def every_stage(self) -> dict[str, Any]:
        """The stages behind it by their channels; of most devices one, without a name."""
        return {"": self.stage}

    def told(self) -> dict[str, Any]:
        """What the device has felt, as JSON."""
        with self.lock:
            told = {"address": self.address, **self.stage.felt.told()}
            stages = self.every_stage()
            if len(stages) > 1:
                told["axes"] = {name: stage.felt.told() for name, stage in stages.items()}
            return told

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
        if self._listener is None:
            with contextlib.suppress(OSError):
                os.close(self._slave)

    def __enter__(self) -> Emulator:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _start(self, target: Callable[..., None], *arguments: object) -> None:
        thread = threading.Thread(target=target, args=arguments, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _start_serving(self, way: _Way) -> None:
        self.ways[way] = None
        self._start(self._serve, way)

    def _drop(self) -> None:
        for way in list(self.ways):
            way.end()

    def _accept(self) -> None:
        assert self._listener is not None
        for connection in _connections(self._listener):
            while self.faults.get("mute") is not None and not self._closing.wait(0.02):
                pass  # it neither takes nor refuses a client
            refuses = self.faults.get("refuse") is not None
            if not refuses and self.timing.drops and self._full():
                self.stage.felt.count("dropped")
                next(way for way in list(self.ways) if not way.ended).end()
            if refuses or self._full():
                self.stage.felt.count("refused" if refuses else "further_clients")
                connection.close()
                continue
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.stage.felt.count("connections")
            self._start_serving(_Way(connection.fileno(), connection))

    def _full(self) -> bool:
        """Whether the device has all the connections that it takes."""
        limit = self.timing.connections
        return 0 < limit <= sum(not way.ended for way in list(self.ways))

    def _serve(self, way: _Way) -> None:
        with self.lock:
            session = self.session()
        try:
            while (data := self._heard(way)) is not None:
                t = time.monotonic()
                if not data or self.faults.get("mute") is not None:
                    continue
                if answer := self.hear(session, data):
                    self._answer(way, answer, t)
                with self.lock:
                    for stage in self.every_stage().values():
                        stage.felt.settle()
        except (OSError, ValueError):
            pass  # the other side has gone
        finally:
            self.ways.pop(way, None)
            way.close()

    def _heard(self, way: _Way) -> bytes | None:
        """What came, nothing at times; None at the end."""
        data = way.receive(0.02)
        if self.faults.take("drop") is not None:
            self._drop()
            return None
        return None if self._closing.is_set() else data

    def hear(self, session: Session, data: bytes) -> bytes:
        """Hand what came to the protocol; its answer. A command starts the faults that wait."""
        with self.lock:
            self._disturb()
            answer = session.feed(data)
            commands = self.stage.felt.counts["commands"]
            if commands != self._commands:
                self._commands = commands
                self.faults.commanded()
        return answer

    def _disturb(self) -> None:
        """Bring the stage in line with the faults; `lock` is held."""
        get = self.faults.get
        saturation = get("saturate")
        for stage in self.every_stage().values():
            stage.stuck = get("stuck") is not None
            stage.saturation = math.inf if saturation is None else saturation
        self.stage.jump = (get("jump") or 0.0) * 1e-6  # one sensor of several

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
        self.say(way, answer)

    def say(self, way: _Way, answer: bytes) -> None:
        """Send an answer, at once or in the way of a fault, which keeps no command waiting."""
        if way.outbox is None:
            if self.faults.get("drip") is None and self.faults.get("babble") is None:
                way.send(answer)
                return
            way.outbox = queue.SimpleQueue()
            self._start(self._trickle, way, way.outbox)
        way.outbox.put(answer)

    def _trickle(self, way: _Way, outbox: queue.SimpleQueue[bytes]) -> None:
        """Send what is in an outbox byte by byte, or again and again."""
        answer = b""
        with contextlib.suppress(OSError, ValueError):  # closed meanwhile
            while not (self._closing.is_set() or way.ended):
                babbles = self.faults.get("babble") is not None
                try:
                    answer = outbox.get(timeout=0.001 if babbles and answer else 0.02)
                except queue.Empty:
                    if not babbles:
                        continue
                drip = self.faults.get("drip")
                for i in range(len(answer) if drip else 0):
                    way.send(answer[i : i + 1])
                    if self._closing.wait(drip) or way.ended:
                        return
                if not drip:
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
            case ["since", t, axis] if t.isdecimal() and axis in self.every_stage():
                with self.lock:
                    return self.every_stage()[axis].felt.since(int(t))
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

    def since(self, t: int, axis: str = "") -> list[tuple[int, float]]:
        """Commands from the monotonic clock t (ns) on: its time (ns) and the voltage (V)."""
        return [(int(at), float(u)) for at, u in self._ask(f"since {t} {axis}".strip())]

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
        self.outbox: queue.SimpleQueue[bytes] | None = None
        os.set_blocking(descriptor, False)

    @property
    def ended(self) -> bool:
        """Whether either side has ended it."""
        if self._ended or self._connection is None:
            return self._ended
        try:
            return not self._connection.recv(1, socket.MSG_PEEK)
        except BlockingIOError:
            return False
        except OSError:
            return True

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
            way = self._fd if self._connection is None else self._connection
            if select.select([], [way], [], 0.02)[1]:
                with contextlib.suppress(BlockingIOError):
                    sent = os.write(way, data) if isinstance(way, int) else way.send(data)
                    data = data[sent:]

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
