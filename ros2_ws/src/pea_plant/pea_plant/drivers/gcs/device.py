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

from pea_core.params import ParameterError, group, param
from pea_core.signals import Measurement
from pea_plant.drivers import calibration, transport
from pea_plant.drivers.calibration import Curve
from pea_plant.drivers.driver import DriverError, Limits, refusing, within
from pea_plant.drivers.gcs import protocol
from pea_plant.drivers.transport import Transport

MAKER = "Physik Instrumente"

PATIENCE = 2.0
"""Longest wait for each answer while connecting (s): nothing moves, and some need time."""


@dataclass(frozen=True)
class Params:
    """PI controller by the General Command Set 2.0, over TCP or a serial line."""

    address: str = param("tcp://127.0.0.1:50000", help="tcp://HOST:PORT or serial:…", fixed=True)
    device: str = param("", help="part of the answer to *IDN?; empty: any of PI", fixed=True)
    axis: str = param("1", help="axis of the controller", fixed=True)
    timeout_s: float = param(0.1, "s", 1e-3, 60.0, help="longest wait for an answer", fixed=True)
    command_min: float = param(
        0.0, "V", -1e4, 1e4, help="lowest command, where the controller does not tell", fixed=True
    )
    command_max: float = param(
        0.0, "V", -1e4, 1e4, help="highest command; equal to the lowest: must tell", fixed=True
    )
    calibration: calibration.Params = group(calibration.Params)

    def __post_init__(self) -> None:
        transport.parse(self.address)
        if not self.axis or not self.axis.isprintable() or " " in self.axis:
            raise ParameterError(f"axis = {self.axis!r}: give one word, as SAI? tells it")
        if self.command_min > self.command_max:
            raise ParameterError(
                f"command_min = {self.command_min:g}: must not be above command_max "
                f"({self.command_max:g} V)"
            )


class Gcs:
    """Driver of one axis of a PI controller.

    Parameters
    ----------
    params : Params
    voltage_min, voltage_max : float
        Range that the plant asks for (V).

    Raises
    ------
    ParameterError
        The calibration is not monotone over that range.
    """

    limits: Limits
    identity: str

    def __init__(self, params: Params, voltage_min: float, voltage_max: float) -> None:
        self.params = params
        self.voltage_min, self.voltage_max = voltage_min, voltage_max
        self._command = Curve(
            "calibration.amplifier", params.calibration.amplifier, voltage_min, voltage_max
        )
        self._position: Curve | None = None
        self._transport: Transport | None = None
        self._reader = protocol.Reader()
        self._answers: list[list[str]] = []
        self._owed = 0
        self._lost = False
        self._held = 0.0
        self._held_text = ""
        self._read = protocol.encode(f"POS? {params.axis}")

    def connect(self) -> None:
        """Open, identify, see axis and servo, read the limits; nothing is commanded."""
        axis, params = self.params.axis, self.params
        self.close()
        with refusing(self.close):
            patience = max(PATIENCE, params.timeout_s)
            self._transport = transport.connect(params.address, patience)
            self._identify()
            axes = [line.strip() for line in self._ask("SAI?")]
            if axis not in axes:
                raise ParameterError(f"axis = {axis!r}: {self.identity} has {', '.join(axes)}")
            if protocol.value(self._ask(f"SVO? {axis}"), axis) != 0.0:
                raise ParameterError(
                    f"axis = {axis!r}: its servo is on, two controllers would fight; switch it "
                    f"off with SVO {axis} 0, when the stage may move"
                )
            self._send(protocol.encode(f"SVO {axis} 0"))
            self._read_limits()
            self._held = self._inverse(protocol.value(self._ask(f"SVA? {axis}"), axis))
            self.read()
            self.check()
            self._transport.timeout = params.timeout_s

    def _identify(self) -> None:
        params = self.params
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

    def _read_limits(self) -> None:
        axis, params = self.params.axis, self.params
        ends = [protocol.value(self._ask(f"{what} {axis}"), axis) for what in ("TMN?", "TMX?")]
        if not ends[0] < ends[1]:
            raise ParameterError(
                f"axis = {axis!r}: {self.identity} tells a travel of {ends[0]:g} to {ends[1]:g} "
                "um; is a stage connected?"
            )
        self._position = Curve(
            "calibration.sensor", params.calibration.sensor, ends[0], ends[1], scale=1e-6
        )
        told = [self._ask_if_known(f"{what} {axis}") for what in ("VMI?", "VMA?")]
        low, high = params.command_min, params.command_max
        if told[0] is not None and told[1] is not None:
            if low < high:
                low, high = max(low, told[0]), min(high, told[1])
            else:
                low, high = told[0], told[1]
        if not low < high:
            raise ParameterError(
                f"command_max = {params.command_max:g}: {self.identity} does not tell the range "
                "of its amplifier; give command_min and command_max from its data sheet"
            )
        reach = sorted((self._inverse(low), self._inverse(high)))
        self.limits = Limits(reach[0], reach[1], *self._position.image)
        try:
            within(self.limits, self.voltage_min, self.voltage_max, self.identity)
        except ParameterError as error:
            raise DriverError(str(error)) from None  # of the plant, not of the driver

    def exchange(self, u: float) -> Measurement:
        """Command u (V) and tell the newest displacement, in one cycle."""
        command = self._text(u)
        held = self._held
        lines = self._answer(command + self._read)
        self._held = self._inverse(float(self._held_text))
        return self._measurement(lines, held)

    def read(self) -> Measurement:
        """Tell the newest displacement (m) and the voltage held (V)."""
        return self._measurement(self._answer(self._read), self._held)

    def write(self, u: float) -> None:
        """Command u (V), and wait for no answer."""
        self._send(self._text(u))
        self._held = self._inverse(float(self._held_text))

    def check(self) -> None:
        """Ask for an error; after a failure, get into step first."""
        if self._lost:
            self._wait_for_silence()
        code = protocol.error(self._ask("ERR?"))
        if code:
            raise DriverError(
                f"{self.params.address}: {protocol.named(code)}; see the controller, then reset"
            )

    def last_resort(self, u: float) -> bytes:
        """Bytes that command u (V), servo off; a line that broke off before them ends there."""
        if self._transport is None:
            return b""
        return b"\n" + protocol.encode(f"SVO {self.params.axis} 0") + self._text(u)

    def fileno(self) -> int:
        """File descriptor of the connection, -1 where there is none."""
        return self._transport.fileno() if self._transport is not None else -1

    def close(self) -> None:
        """Close the connection."""
        if self._transport is not None:
            self._transport.close()
            self._transport = None
        self._reader.reset()
        self._answers.clear()
        self._owed, self._lost = 0, False

    def _text(self, u: float) -> bytes:
        """Command of u (V) on the wire."""
        if not self.voltage_min <= u <= self.voltage_max:
            raise DriverError(
                f"voltage {u}: must be within {self.voltage_min:g} to {self.voltage_max:g} V"
            )
        self._held_text = f"{self._command(u):.6f}"
        return protocol.encode(f"SVA {self.params.axis} {self._held_text}")

    def _inverse(self, command: float) -> float:
        return self._command.inverse(command)

    def _measurement(self, lines: list[str], held: float) -> Measurement:
        assert self._position is not None
        reading = protocol.value(lines, self.params.axis)
        return Measurement(self._position(reading), math.nan, held)

    def _open(self) -> Transport:
        if self._transport is None:
            raise DriverError(f"{self.params.address}: not connected; connect first")
        return self._transport

    def _send(self, data: bytes) -> None:
        try:
            self._open().send(data)
        except DriverError:
            self._lost = True
            raise

    def _ask(self, question: str) -> list[str]:
        return self._answer(protocol.encode(question))

    def _ask_if_known(self, question: str) -> float | None:
        """The value, None where the controller does not know the question."""
        axis = self.params.axis
        self._send(protocol.encode(question, "ERR?"))
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
        deadline = time.monotonic() + 10.0 * self.params.timeout_s
        try:
            while time.monotonic() < deadline:
                way.receive()
        except DriverError:
            pass  # silent, or gone: the next question tells
        self._reader.reset()
        self._answers.clear()
        self._owed, self._lost = 0, False


def make(plant: Any, T_s: float) -> Gcs:
    """Driver for the plant's parameters."""
    return Gcs(plant.driver, plant.voltage_min, plant.voltage_max)
