"""A PI controller in volts and metres.

One cycle is one write, ``SVA axis command`` and ``POS? axis``, and one answer. Answers come in
the order of the questions and do not say to which they belong, so the driver counts those that
are still owed and skips them after a failure.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

from pea_core.params import ParameterError, param
from pea_core.signals import Measurement
from pea_plant.drivers import device
from pea_plant.drivers.driver import DriverError, Limits
from pea_plant.drivers.gcs import protocol

MAKER = "Physik Instrumente"


@dataclass(frozen=True)
class Params(device.Params):
    """PI controller by the General Command Set 2.0, over TCP or a serial line."""

    device: str = param("", help="part of the answer to *IDN?; empty: any of PI", fixed=True)
    axis: str = param("1", help="axis of the controller", fixed=True)
    command_min: float = param(
        0.0, "V", -1e4, 1e4, help="lowest command, where the controller does not tell", fixed=True
    )
    command_max: float = param(
        0.0, "V", -1e4, 1e4, help="highest command; equal to the lowest: must tell", fixed=True
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.axis or not self.axis.isprintable() or " " in self.axis:
            raise ParameterError(f"axis = {self.axis!r}: give one word, as SAI? tells it")
        if self.command_min > self.command_max:
            raise ParameterError(
                f"command_min = {self.command_min:g}: must not be above command_max "
                f"({self.command_max:g} V)"
            )


class Gcs(device.Device):
    """Driver of one axis of a PI controller; see `device.Device`."""

    NAME = "PI controller"

    def __init__(self, params: Params, voltage_min: float, voltage_max: float) -> None:
        super().__init__(params, voltage_min, voltage_max)
        self._read = protocol.encode(f"POS? {params.axis}")
        self._begin()

    def _begin(self) -> None:
        self._reader = protocol.Reader()
        self._answers: list[list[str]] = []
        self._owed, self._lost = 0, False

    def _identify(self) -> None:
        params = self._params
        self.identity = " ".join(self._ask("*IDN?"))
        if MAKER not in self.identity or params.device not in self.identity:
            raise ParameterError(
                f"device = {params.device!r}: at {params.address} is {self.identity[:80]!r}; "
                "check the address"
            )
        version = protocol.number(self._ask("CSV?")[0])
        if not 2.0 <= version < 3.0:
            raise ParameterError(
                f"device = {params.device!r}: {self.identity} speaks GCS {version:g}; must be 2.0"
            )

    def _fit(self) -> None:
        """See axis and servo, read the limits."""
        axis = self._params.axis
        self._ask("ERR?")  # of whoever was here before
        axes = [line.strip() for line in self._ask("SAI?")]
        if axis not in axes:
            raise ParameterError(f"axis = {axis!r}: {self.identity} has {', '.join(axes)}")
        if self._value("SVO?") != 0.0:
            raise ParameterError(
                f"axis = {axis!r}: its servo is on, two controllers would fight; switch it "
                f"off with SVO {axis} 0, when the stage may move"
            )
        self._send(protocol.encode(f"SVO {axis} 0"))
        low, high = self._value("TMN?"), self._value("TMX?")
        if not low < high:
            raise ParameterError(
                f"axis = {axis!r}: {self.identity} tells a travel of {low:g} to {high:g} "
                "um; is a stage connected?"
            )
        self._sensor = self._sensor_over(low, high)
        self.limits = Limits(*self._reach(*self._commands()), *self._sensor.image)

    def _commands(self) -> tuple[float, float]:
        """Lowest and highest command: what the controller tells, what the rig narrows or says."""
        params = self._params
        low, high = params.command_min, params.command_max
        lowest, highest = self._ask_if_known("VMI?"), self._ask_if_known("VMA?")
        if lowest is not None and highest is not None:
            if low < high:
                low, high = max(low, lowest), min(high, highest)
            else:
                low, high = lowest, highest
        if not low < high:
            raise ParameterError(
                f"command_max = {params.command_max:g}: {self.identity} does not tell the range "
                "of its amplifier; give command_min and command_max from its data sheet"
            )
        return low, high

    def _held(self) -> float:
        return self._amplifier.inverse(self._value("SVA?"))

    def exchange(self, u: float) -> Measurement:
        """Command u (V) and tell the newest displacement, in one cycle."""
        held, line = self._u, self._line(u)
        return self._measurement(self._answer(line + self._read), held)

    def read(self) -> Measurement:
        """Tell the newest displacement (m) and the voltage held (V)."""
        return self._measurement(self._answer(self._read), self._u)

    def write(self, u: float) -> None:
        """Command u (V), and wait for no answer."""
        self._send(self._line(u))

    def check(self) -> None:
        """Ask for an error; after a failure, get into step first."""
        if self._lost:
            self._wait_for_silence()
        code = protocol.error(self._ask("ERR?"))
        if code:
            raise self._wrong(f"{protocol.named(code)}; see the controller, then reset")

    def last_resort(self, u: float) -> bytes:
        """Bytes that command u (V), servo off; a line that broke off before them ends there."""
        if self._way is None:
            return b""
        axis = self._params.axis
        return b"\n" + protocol.encode(f"SVO {axis} 0", f"SVA {axis} {self._command(u):.6f}")

    def _line(self, u: float) -> bytes:
        """Line that commands u (V); the device will hold what the line says."""
        text = f"{self._command(u):.6f}"
        self._u = self._amplifier.inverse(float(text))
        return protocol.encode(f"SVA {self._params.axis} {text}")

    def _measurement(self, lines: list[str], held: float) -> Measurement:
        reading = protocol.value(lines, self._params.axis)
        return Measurement(self._sensor(reading), math.nan, held)

    def _send(self, data: bytes) -> None:
        try:
            self._open().send(data)
        except DriverError:
            self._lost = True
            raise

    def _ask(self, question: str) -> list[str]:
        return self._answer(protocol.encode(question))

    def _value(self, question: str) -> float:
        """The value that the axis has."""
        axis = self._params.axis
        return protocol.value(self._ask(f"{question} {axis}"), axis)

    def _ask_if_known(self, question: str) -> float | None:
        """The value, None where the controller does not know the question."""
        axis = self._params.axis
        self._send(protocol.encode(f"{question} {axis}", "ERR?"))
        first = self._next()
        if "=" not in first[0]:
            return None
        code = protocol.error(self._next())
        return protocol.value(first, axis) if code == 0 else None

    def _answer(self, request: bytes) -> list[str]:
        """Send a request that ends in a question, and wait for its answer."""
        self._send(request)
        self._owed += 1
        try:
            while True:
                lines = self._next()
                self._owed -= 1
                if self._owed == 0:
                    return lines
        except DriverError:
            self._lost = True
            raise

    def _next(self) -> list[str]:
        way = self._open()
        while not self._answers:
            self._answers += self._reader.feed(way.receive())
        return self._answers.pop(0)

    def _wait_for_silence(self) -> None:
        """Throw away what is under way, so that the next answer is the next question's."""
        way = self._open()
        deadline = time.monotonic() + 10.0 * self._params.timeout_s
        try:
            while time.monotonic() < deadline:
                way.receive()
        except DriverError:
            pass  # silent, or gone: the next question tells
        self._begin()


def make(plant: Any, T_s: float) -> Gcs:
    """Driver for the plant's parameters."""
    return Gcs(plant.driver, plant.voltage_min, plant.voltage_max)
