"""A LabJack without hardware: its registers on the loopback interface."""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

from pymodbus.pdu import ExceptionResponse, ModbusPDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadHoldingRegistersResponse,
    ReadInputRegistersResponse,
    WriteMultipleRegistersRequest,
    WriteMultipleRegistersResponse,
    WriteSingleRegisterRequest,
    WriteSingleRegisterResponse,
)

from pea_core.params import ParameterError, param
from pea_drivers import emulator
from pea_drivers.calibration import CalibrationCurve
from pea_drivers.emulator import Timing
from pea_drivers.modbus_daq import protocol
from pea_drivers.stage import EmulatedStage
from pea_plant import specimen

SERIAL_NUMBER, FIRMWARE = 470_012_345, 1.0307
INPUTS, OUTPUTS, LINES = 14, 2, 8
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE = 1, 2, 3
"""A register that cannot be written, or only whole, is an illegal address; see `Emulator`."""

RANGES = (10.0, 1.0, 0.1, 0.01)
"""Ranges of an input (V), either sign; 0 stands for the first."""

SINGLE_ENDED, INCONSISTENT, INCONSISTENT_FLOAT = 199, 0xFFFF, -9999.0
CORE_HZ, SYSTEM_HZ = 40e6, 20.0
NAME_SIZE = 50
"""Bytes of the name, its end included."""

WATCHDOG, WATCHDOG_S, WATCHDOG_CLEAR = 61600, 61604, 61614
WATCHDOG_OTHERS = {
    61602: "I",  # advanced
    61606: "I",  # start-up delay
    61610: "I",  # strict
    61612: "I",  # its key
    61620: "I",  # reset
    61630: "I",  # digital lines: enable, state, direction, inhibit
    61632: "I",
    61634: "I",
    61636: "I",
}
WATCHDOG_DAC = 61640
"""Of output n, 10 n further: whether it is set at a time-out, and 2 further to what."""


@dataclass(frozen=True)
class Params(Timing):
    """Emulated LabJack."""

    connections: int = param(
        2, "", 0, 1000, help="TCP connections that it takes at a time, 0: any number"
    )
    latency_s: float = param(1.1e-3, "s", 0.0, 10.0, help="from a frame to its answer")
    update_s: float = param(1e-4, "s", 1e-6, 10.0, help="period in which the input is read")
    name: str = param("pea", help="DEVICE_NAME_DEFAULT")
    product: float = param(7.0, "", 0.0, 100.0, help="what PRODUCT_ID says")
    dac_bits: int = param(12, "", 0, 32, help="steps of the output; 0: none")
    ain_bits: int = param(16, "", 0, 32, help="steps of the input; 0: none")


def make(plant: object, params: Params, port: int | None = 0, compiled: bool = False) -> Emulator:
    """Emulator of the device that the plant's parameters drive."""
    if port is None:
        raise ParameterError("modbus_daq: Modbus TCP runs over TCP; give a port, not a pty")
    return Emulator(plant, params, port, compiled)


class Register(NamedTuple):
    """What lies at an address: registers, and how bytes are read and written."""

    size: int
    read: Callable[[], bytes] | None
    write: Callable[[bytes], None] | None


class Emulator(emulator.Emulator):
    """A LabJack with the simulated actuator between its output and its input.

    Parameters
    ----------
    plant : pea_plant.plant.Params
        With a `modbus_daq` driver: its calibration is that of amplifier and sensor.
    params : Params
    port : int
        TCP port, 0 for any.
    compiled : bool
        See `pea_drivers.stage.EmulatedStage`.
    """

    timing: Params

    def __init__(self, plant: Any, params: Params, port: int = 0, compiled: bool = False) -> None:
        driven = plant.driver
        self.driven = driven
        self._amplifier = CalibrationCurve(
            "calibration.amplifier",
            driven.calibration.amplifier,
            plant.voltage_min,
            plant.voltage_max,
        )
        self._sensor = CalibrationCurve(
            "calibration.sensor",
            driven.calibration.sensor,
            -driven.ain_range,
            driven.ain_range,
            scale=1e-6,
        )
        ends = [self._amplifier.inverse(v) for v in (driven.dac_min, driven.dac_max)]
        stage = EmulatedStage(plant, min(ends), max(ends), params.update_s, compiled=compiled)
        self._specimen = specimen.of((plant,))
        self.outputs = [0.0] * OUTPUTS
        self.outputs[driven.dac] = self._amplifier(stage.u)
        self._ranges = [float(driven.ain_range)] * INPUTS
        self._name = params.name.encode("ascii", "replace")[: NAME_SIZE - 1]
        self._registers: dict[int, Register] = {}
        self._values: dict[int, float] = {}
        self._begun = self._last = time.monotonic()
        self._lay_out()
        super().__init__(stage, params, port)

    def session(self) -> Session:
        """A new connection."""
        return Session(self)

    def _lay_out(self) -> None:
        """Put the registers where the device has them."""
        self._put(protocol.PRODUCT, "f", lambda: self.timing.product)
        self._put(60002, "f", lambda: 1.35)
        self._put(protocol.FIRMWARE, "f", lambda: FIRMWARE)
        self._put(60006, "f", lambda: 1.0)
        self._put(60008, "f", lambda: 0.0)
        self._put(60010, "I", lambda: 0)
        self._put(protocol.SERIAL, "I", lambda: SERIAL_NUMBER)
        self._registers[60500] = Register(NAME_SIZE // 2, self._told_name, self._rename)
        self._put(55100, "I", lambda: 0x00112233)
        for address, kind, value in (
            (55110, "H", 0x0011),
            (55120, "I", 0x00112233),
            (55122, "i", -2003195205),
            (55124, "f", -9999.0),
        ):
            self._keep(address, kind, value)
        self._put(61520, "I", lambda: int(self._ran() * CORE_HZ) & 0xFFFFFFFF)
        self._put(61522, "I", lambda: int(self._ran() * SYSTEM_HZ) & 0xFFFFFFFF)
        for n in range(INPUTS):
            self._put(protocol.AIN + 2 * n, "f", partial(self._input, n))
            address = protocol.AIN_RANGE + 2 * n
            self._put(address, "f", partial(self._ranges.__getitem__, n), partial(self._range, n))
            self._keep(41000 + n, "H", SINGLE_ENDED, (SINGLE_ENDED, n + 1 - n % 2))
            self._keep(protocol.AIN_RESOLUTION + n, "H", 0, range(13))
            self._keep(42000 + 2 * n, "f", 0.0)
        for n in range(LINES):
            self._keep(protocol.FIO + n, "H", 0, (0, 1), told=partial(self._line, n))
        self._all(43900, "f", INCONSISTENT_FLOAT, protocol.AIN_RANGE, 2)
        self._all(43902, "H", INCONSISTENT, 41000, 1)
        self._all(43903, "H", INCONSISTENT, protocol.AIN_RESOLUTION, 1)
        self._all(43904, "f", INCONSISTENT_FLOAT, 42000, 2)
        for n in range(OUTPUTS):
            address = protocol.DAC + 2 * n
            self._put(address, "f", partial(self.outputs.__getitem__, n), partial(self._output, n))
            self._put(51000 + 2 * n, "I", None, partial(self._output_steps, n))
            self._keep(WATCHDOG_DAC + 10 * n, "I", 0, locked=True)
            self._keep(WATCHDOG_DAC + 10 * n + 2, "f", 0.0, locked=True)
        self._put(WATCHDOG, "I", lambda: self._values[WATCHDOG], self._enable_watchdog)
        self._values[WATCHDOG] = 0
        self._keep(WATCHDOG_S, "I", 0, locked=True)
        for address, kind in WATCHDOG_OTHERS.items():
            self._keep(address, kind, 0, locked=True)
        self._put(WATCHDOG_CLEAR, "I", None, lambda value: None)  # all that comes clears it

    def _put(
        self,
        address: int,
        kind: str,
        read: Callable[[], float] | None,
        write: Callable[[Any], None] | None = None,
    ) -> None:
        """Put one value at an address; `kind` as `struct` writes it."""
        form = struct.Struct(f">{kind}")
        self._registers[address] = Register(
            form.size // 2,
            None if read is None else lambda: form.pack(read()),
            None if write is None else lambda data: write(form.unpack(data)[0]),
        )

    def _keep(
        self,
        address: int,
        kind: str,
        value: float,
        allowed: Container[Any] | None = None,
        locked: bool = False,
        told: Callable[[float], None] = lambda new: None,
    ) -> None:
        """Put a value there that can be written; `locked`: not while the watchdog is on.

        Before a new value is kept, `told` gets it.
        """

        def write(new: float) -> None:
            if locked and self._values[WATCHDOG]:
                raise _Refused(ILLEGAL_ADDRESS)
            if new != new or (allowed is not None and new not in allowed):
                raise _Refused(ILLEGAL_VALUE)
            told(new)
            self._values[address] = new

        self._values[address] = value
        self._put(address, kind, lambda: self._values[address], write)

    def _all(self, address: int, kind: str, inconsistent: float, first: int, step: int) -> None:
        """Put there what reads and writes the value of every input."""
        form = struct.Struct(f">{kind}")

        def read() -> float:
            found = {self._read(first + step * n, step) for n in range(INPUTS)}
            return float(form.unpack(found.pop())[0]) if len(found) == 1 else inconsistent

        def write(value: object) -> None:
            for n in range(INPUTS):
                self._write(first + step * n, form.pack(value))

        whole = (lambda: int(read())) if kind == "H" else read
        self._put(address, kind, whole, write)

    def _ran(self) -> float:
        """Time since power-on (s)."""
        return time.monotonic() - self._begun

    def answer(self, request: ModbusPDU) -> ModbusPDU:
        """Carry out a request."""
        self._last = time.monotonic()
        code = self.faults.take("error")
        if code is not None:
            answer: ModbusPDU = ExceptionResponse(request.function_code, int(code))
        else:
            try:
                answer = self._carried_out(request)
            except _Refused as refused:
                self.stage.felt.count("refused_commands")
                answer = ExceptionResponse(request.function_code, refused.code)
        answer.transaction_id, answer.dev_id = request.transaction_id, request.dev_id
        return answer

    def _carried_out(self, request: ModbusPDU) -> ModbusPDU:
        if isinstance(request, protocol.Feedback):
            read = bytearray()
            for address, size, data in request.pieces:
                if data is None:
                    read += self._read(address, size)
                else:
                    self._write(address, data)
            return protocol.FeedbackAnswer(bytes(read))
        if isinstance(request, ReadHoldingRegistersRequest):  # input registers are the same ones
            data = self._read(request.address, request.count)
            kind = (
                ReadHoldingRegistersResponse
                if request.function_code == ReadHoldingRegistersResponse.function_code
                else ReadInputRegistersResponse
            )
            return kind(registers=struct.unpack(f">{len(data) // 2}H", data))
        if isinstance(request, WriteMultipleRegistersRequest | WriteSingleRegisterRequest):
            registers = request.registers
            self._write(request.address, struct.pack(f">{len(registers)}H", *registers))
            if isinstance(request, WriteSingleRegisterRequest):
                return WriteSingleRegisterResponse(address=request.address, registers=registers)
            return WriteMultipleRegistersResponse(address=request.address, count=len(registers))
        raise _Refused(ILLEGAL_FUNCTION)

    def _whole(self, address: int, count: int) -> Iterator[tuple[Register, int]]:
        """Registers that fill a block of addresses, and where in its bytes each begins.

        Raises
        ------
        _Refused
            There is none, or a value would be cut.
        """
        at = address
        while at < address + count:
            one = self._registers.get(at)
            if one is None or at + one.size > address + count:
                raise _Refused(ILLEGAL_ADDRESS)
            yield one, 2 * (at - address)
            at += one.size

    def _read(self, address: int, count: int) -> bytes:
        """Bytes of a block of registers."""
        data = b""
        for one, _ in self._whole(address, count):
            if one.read is None:
                raise _Refused(ILLEGAL_ADDRESS)
            data += one.read()
        return data

    def _write(self, address: int, data: bytes) -> None:
        """Write a block of registers; all of it can be written, or none is."""
        block = list(self._whole(address, len(data) // 2))
        writes = [one.write for one, _ in block]
        for (one, at), write in zip(block, writes, strict=True):
            if write is None or None in writes:
                raise _Refused(ILLEGAL_ADDRESS)
            write(data[at : at + 2 * one.size])

    def _line(self, n: int, level: float) -> None:
        """Count that a digital line goes high."""
        if level > self._values[protocol.FIO + n]:
            self.stage.felt.count(f"pulses of FIO{n}")

    def _input(self, channel: int) -> float:
        y = self.stage.reading()
        if channel == self.driven.ain:
            volts = self._sensor.inverse(y)
        elif channel == self.driven.signal_ain and self._specimen is not None:
            volts = float(specimen.at(self._specimen, (y,)))
        else:
            return 0.0
        span = self._ranges[channel] or RANGES[0]
        volts = min(max(volts, -span), span)
        return _in_steps(volts, 2.0 * span, self.timing.ain_bits)

    def _range(self, channel: int, span: float) -> None:
        allowed = (0.0, *RANGES, float(self.driven.ain_range))
        found = [one for one in allowed if math.isclose(one, span, rel_tol=1e-6)]
        if not found:
            raise _Refused(ILLEGAL_VALUE)
        self._ranges[channel] = found[0] or RANGES[0]

    def _output(self, channel: int, volts: float) -> None:
        driven = self.driven
        if volts != volts:
            raise _Refused(ILLEGAL_VALUE)
        volts = min(max(volts, driven.dac_min), driven.dac_max)
        self.outputs[channel] = volts
        if channel == driven.dac:
            given = _in_steps(volts, driven.dac_max - driven.dac_min, self.timing.dac_bits)
            self.stage.command(self._amplifier.inverse(given))

    def _output_steps(self, channel: int, steps: int) -> None:
        """Write an output in steps of 16 bits."""
        if steps > 0xFFFF:
            raise _Refused(ILLEGAL_VALUE)
        low, high = self.driven.dac_min, self.driven.dac_max
        self._output(channel, low + (high - low) * steps / 0xFFFF)

    def _enable_watchdog(self, on: int) -> None:
        if on not in (0, 1) or (on and not self._values[WATCHDOG_S]):
            raise _Refused(ILLEGAL_VALUE)
        self._values[WATCHDOG] = on
        if on:
            self.ticks()

    def tick(self) -> None:
        """The watchdog: outputs go to their values where nobody has talked for so long."""
        values = self._values
        if not values[WATCHDOG] or time.monotonic() - self._last < values[WATCHDOG_S]:
            return
        self._last = time.monotonic()
        self.stage.felt.count("watchdog time-outs")
        for n in range(OUTPUTS):
            if values[WATCHDOG_DAC + 10 * n]:
                self._output(n, values[WATCHDOG_DAC + 10 * n + 2])

    def _told_name(self) -> bytes:
        return self._name.ljust(NAME_SIZE, b"\0")

    def _rename(self, data: bytes) -> None:
        name, end, _ = data.partition(b"\0")
        if not end or not name.isascii() or not name.decode().isprintable() or b"." in name:
            raise _Refused(ILLEGAL_VALUE)
        self._name = name


class Session:
    """One connection to the device."""

    def __init__(self, device: Emulator) -> None:
        self._device = device
        self._frames = protocol.Frames(server=True)

    def feed(self, data: bytes) -> bytes:
        """Take in bytes; the frames that answer them."""
        try:
            requests = self._frames.feed(data)
        except protocol.ProtocolError:
            return b""
        return b"".join(self._frames.encode(self._device.answer(each)) for each in requests)


class _Refused(Exception):
    def __init__(self, code: int) -> None:
        self.code = code


def _in_steps(value: float, span: float, bits: int) -> float:
    """Value of a converter of so many steps over a span."""
    return value if bits == 0 else round(value * 2**bits / span) * span / 2**bits
