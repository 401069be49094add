"""The plant's side of the watchdog: starts the process, tells it the voltage, orders it to act."""

from __future__ import annotations

import base64
import contextlib
import os
import signal
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

from pea_watchdog import watchdog
from pea_watchdog.watchdog import (
    ACTING,
    DIAL,
    END,
    FIRE,
    HUNG,
    LEAVE,
    PATIENCE,
    PERIOD,
    POLL,
    SAFE,
    STAND_DOWN,
    STARTING,
    STEPS_MAX,
    STEPS_MIN,
    WATCHING,
    Shared,
    new_memory,
)


class RampLimits(NamedTuple):
    """What a ramp keeps: range and safe voltage (V), fastest change (V/s)."""

    voltage_min: float
    voltage_max: float
    safe: float
    slew_rate: float


class Question(NamedTuple):
    """How a device is asked what it holds.

    Attributes
    ----------
    data : bytes
        The question; it is valid whatever was sent before.
    answer : bytes
        Regular expression of the answer; its first group is the number.
    form : str
        Format of the number, as of `struct`; empty where it is text.
    number : callable
        The number of a device that holds a voltage (V): a monotone function.
    """

    data: bytes
    answer: bytes
    form: str
    number: Callable[[float], float]


def levels(limits: RampLimits) -> tuple[float, list[float]]:
    """Seconds between two commands of a ramp, and the voltages (V) that it may take."""
    low, high, safe, slew_rate = limits
    whole = (high - low) / slew_rate
    period = max(min(PERIOD, 2.0 * whole / STEPS_MIN), whole / STEPS_MAX)
    step = slew_rate * period * (1.0 if period >= PERIOD else 0.5)
    below, above = int((safe - low) / step) + 1, int((high - safe) / step) + 1
    taken = [safe + i * step for i in range(-below, above + 1)]
    return period, [u for u in taken if low <= u <= high]


Commands = Callable[[float], bytes] | tuple[Callable[[float], bytes], ...]
"""Bytes that command a voltage (V), whatever was sent before; of several channels, one each."""


def _written(
    command: Callable[[float], bytes], limits: RampLimits, question: Question | None
) -> dict[str, object]:
    """The ramp of a channel as the process reads it."""
    period, taken = levels(limits)
    ramp = [[u, base64.b64encode(command(u)).decode()] for u in taken]
    ask: list[Any] | None = None
    if question is not None:
        data, answer, form, number = question
        texts = [base64.b64encode(text).decode() for text in (data, answer)]
        ask = [*texts, form, [number(u) for u in taken]]
    return {"period": period, "safe": limits.safe, "levels": ramp, "ask": ask}


@contextlib.contextmanager
def _blocked(numbers: Iterable[signal.Signals]) -> Iterator[None]:
    """Block signals in this thread, and in a process that it starts."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class Watchdog:
    """The watchdog process as the plant sees it.

    Parameters
    ----------
    descriptor : int
        Connection to the device; the process keeps its copy when this one is closed.
    command : callable
        Bytes that command a voltage (V) whatever was sent before. Of a device of several channels
        `command`, `limits`, `u` and `question` are tuples, and all channels ramp at once.
    limits : RampLimits
    u : float
        Voltage that the device has (V).
    silence : float
        Seconds of silence of the plant after which it acts.
    held : tuple of int
        Further open files that the process keeps.
    question : Question, optional
        How it asks the device what it holds.
    rescue : tuple of str
        A file of Python and a text, where the connection is no file: ``opened(text)`` of that file
        returns what sends a command.

    Raises
    ------
    OSError
        The process cannot be started.
    """

    def __init__(
        self,
        descriptor: int,
        command: Commands,
        limits: RampLimits | tuple[RampLimits, ...],
        u: float | tuple[float, ...],
        silence: float,
        held: tuple[int, ...] = (),
        question: Question | tuple[Question, ...] | None = None,
        rescue: tuple[str, ...] = (),
    ) -> None:
        self._question = question
        self._lock = threading.Lock()
        self._closed = False
        self._until = 0.0
        memory = new_memory()
        self._shared = Shared(memory)
        self.renew(command, limits)
        self.tell(u)
        with _blocked(watchdog.UNHEEDED):
            self.process = subprocess.Popen(
                [
                    *(sys.executable, "-I", "-S", watchdog.__file__),
                    *(str(descriptor), str(memory), str(silence), *rescue),
                ],
                stdin=subprocess.PIPE,
                pass_fds=(descriptor, memory, *held),
                start_new_session=True,
            )
        assert self.process.stdin is not None
        os.set_blocking(self.process.stdin.fileno(), False)
        end = time.monotonic() + PATIENCE
        while self.state == STARTING:
            self.tell(u)
            if time.monotonic() > end or self.process.poll() is not None:
                self.stand_down()
                raise OSError("the watchdog process does not start")
            time.sleep(POLL)

    def renew(self, command: Commands, limits: RampLimits | tuple[RampLimits, ...]) -> None:
        """Replace the ramp by one within new limits, before these limits are in force.

        Raises
        ------
        OSError
            The ramp is too long.
        """
        commands = command if isinstance(command, tuple) else (command,)
        each = (limits,) if isinstance(limits, RampLimits) else limits
        asked = self._question
        questions: tuple[Question | None, ...] = (None,) * len(commands)
        if asked is not None:
            questions = (asked,) if isinstance(asked, Question) else asked
        written = [_written(*own) for own in zip(commands, each, questions, strict=True)]
        with self._lock:
            if self._closed:
                return
            self._shared.write({"channels": written})
        longest = max((own.voltage_max - own.voltage_min) / own.slew_rate for own in each)
        self._patience = 2.0 * longest + DIAL + END

    def tell(self, u: float | tuple[float, ...]) -> None:
        """Note the voltage (V) that the device has from now on, and that the plant lives."""
        if isinstance(u, tuple):
            for channel, own in enumerate(u):
                self._shared.put(channel, own)
        else:
            self._shared.voltage = u
        self._shared.told()

    @property
    def cells(self) -> tuple[memoryview[int], memoryview[float]]:
        """Shared cells at `VOLTAGE`, `TOLD` and `STATE`, which a compiled loop reads and writes."""
        return self._shared.cells

    def present(self) -> None:
        """Note that the plant lives and is reconnecting to the device."""
        self._shared.told()

    @property
    def state(self) -> int:
        """State of the process."""
        return self._shared.state

    @property
    def silent(self) -> float:
        """Seconds since the plant has told a voltage."""
        return self._shared.silent

    @property
    def wrong(self) -> str:
        """What is wrong with the process; empty while it watches."""
        status = self.process.poll()
        if status is not None:
            how = f"killed by {signal.Signals(-status).name}" if status < 0 else f"status {status}"
            return f"the watchdog has ended ({how})"
        if (unseen := self._shared.unseen) > HUNG:
            return f"the watchdog has not looked for {unseen:.1f} s"
        return ""

    @property
    def hung(self) -> bool:
        """Whether it no longer looks, for longer than one that is dialling does not."""
        patience = HUNG if self.state == WATCHING else HUNG + 2.0 * DIAL
        return self.alive and self._shared.unseen > patience

    def fire(self) -> None:
        """Have the device brought to its safe voltage, from now on."""
        self._until = time.monotonic() + self._patience
        self._order(FIRE)

    @property
    def acts(self) -> bool:
        """Whether it still ramps, within the time that a ramp can take."""
        return self._busy and time.monotonic() < self._until

    @property
    def _busy(self) -> bool:
        state = self.state
        return self.alive and (state == ACTING or (state == WATCHING and not self.wrong))

    def done(self) -> bool:
        """Wait until the ramp has ended, or should have; return whether it reached the device."""
        end = time.monotonic() + self._patience
        while self._busy and time.monotonic() < end:
            time.sleep(POLL)
        return self.state == SAFE

    def stand_down(self) -> None:
        """End the process: the device needs no watchdog any more.

        One that hangs is killed at once, one that does not end a moment later.
        """
        if self.wrong:
            self.kill()
            return
        self._order(STAND_DOWN)
        try:
            self.process.wait(END)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self._close()

    def kill(self) -> None:
        """Kill the process at once."""
        self.process.kill()
        self.process.wait()
        self._close()

    def leave(self) -> None:
        """Leave the device to the process for good: it tries until the device is safe."""
        self._order(LEAVE)
        self._close()

    def _close(self) -> None:
        assert self.process.stdin is not None
        with self._lock:
            if self._closed:
                return
            self._closed = True
            with contextlib.suppress(OSError):
                self.process.stdin.close()
            os.close(self._shared.descriptor)

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self.process.poll() is None

    @property
    def pid(self) -> int:
        """Process number."""
        return self.process.pid

    def _order(self, data: bytes) -> None:
        assert self.process.stdin is not None
        with contextlib.suppress(OSError, ValueError):
            os.write(self.process.stdin.fileno(), data)


class HeldLine(NamedTuple):
    """The connection that the process is to hold.

    spare : a driver that holds it; None where it is the plant's own.  text : the same in words.
    """

    spare: Any
    text: str


def line(make: Callable[[], Any], driver: Any) -> HeldLine:
    """Open a second connection for the process, if the device accepts one.

    Parameters
    ----------
    make : callable
        Makes another driver of the same device, not connected.
    driver : Driver
        Connected.
    """
    if getattr(driver, "rescue", ()):
        return HeldLine(None, "the device beside the loop")
    if driver.fileno() < 0 or not stat.S_ISSOCK(os.fstat(driver.fileno()).st_mode):
        return HeldLine(None, "the same connection")
    spare = make()
    try:
        spare.connect()
    except Exception as error:  # the device takes one only
        return HeldLine(None, f"the same connection ({error})")
    return HeldLine(spare, "a connection of its own")


def command_of(driver: Any) -> Commands:
    """What commands a voltage of a driver's device, of each channel where it has several."""
    several: Commands | None = getattr(driver, "commands", None)
    return driver.last_resort if several is None else several


def hold(
    driver: Any,
    held: HeldLine,
    limits: RampLimits | tuple[RampLimits, ...],
    u: float | tuple[float, ...],
    silence: float,
    claims: Sequence[Any] = (),
) -> tuple[Watchdog | None, str]:
    """Start the watchdog of a connected driver.

    Parameters
    ----------
    driver : Driver
        Connected.
    held : HeldLine
        See `line`; closed here once the process has its copy.
    limits : RampLimits
    u : float
        Voltage that the device has (V).
    silence : float
        Seconds of silence of the plant after which it acts.
    claims : sequence of pea_plant.drivers.claim.Claim
        What the process keeps until the stage is at rest.

    Returns
    -------
    Watchdog or None
        None where there is no connection to hold.
    str
        What it holds, for people.
    """
    try:
        if driver.fileno() < 0:
            return None, "no connection, no watchdog"
        holder = driver if held.spare is None else held.spare
        kept = tuple(claim.fileno() for claim in claims)
        ask = getattr(holder, "question", None)
        rescue = getattr(holder, "rescue", ())
        process = Watchdog(
            holder.fileno(), command_of(holder), limits, u, silence, kept, ask and ask(), rescue
        )
    finally:
        if held.spare is not None:
            held.spare.close()
    return process, held.text
