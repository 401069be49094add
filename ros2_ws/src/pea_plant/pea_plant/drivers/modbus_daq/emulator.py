"""A LabJack without hardware: its registers on the loopback interface."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

from pymodbus.pdu import ExceptionResponse, ModbusPDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadHoldingRegistersResponse,
    ReadInputRegistersResponse,
    WriteMultipleRegistersRequest,
    WriteMultipleRegistersResponse,
)

from pea_core.params import ParameterError, param
from pea_plant.drivers import emulator
from pea_plant.drivers.calibration import Curve
from pea_plant.drivers.emulator import Stage, Timing
from pea_plant.drivers.modbus_daq import protocol

SERIAL_NUMBER, FIRMWARE = 470_012_345, 1.0307
INPUTS, OUTPUTS = 14, 2
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE = 1, 2, 3


@dataclass(frozen=True)
class Params(Timing):
    """Emulated LabJack."""

    latency_s: float = param(1.1e-3, "s", 0.0, 10.0, help="from a frame to its answer")
    update_s: float = param(1e-4, "s", 1e-6, 10.0, help="period in which the input is read")
    product: float = param(7.0, "", 0.0, 100.0, help="what PRODUCT_ID says")
    dac_bits: int = param(12, "", 0, 32, help="steps of the output; 0: none")
    ain_bits: int = param(16, "", 0, 32, help="steps of the input; 0: none")


def make(plant: Any, params: Params, port: int | None = 0, compiled: bool = False) -> Emulator:
    """Emulator of the device that the plant's parameters drive."""
    if port is None:
        raise ParameterError("modbus_daq: Modbus TCP runs over TCP; give a port, not a pty")
    return Emulator(plant, params, port, compiled)


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
        See `pea_plant.drivers.emulator.Stage`.
    """

    timing: Params

    def __init__(self, plant: Any, params: Params, port: int = 0, compiled: bool = False) -> None:
        driven = plant.driver
        self.driven = driven
        self._amplifier = Curve(
            "calibration.amplifier",
            driven.calibration.amplifier,
            plant.voltage_min,
            plant.voltage_max,
        )
        self._sensor = Curve(
            "calibration.sensor",
            driven.calibration.sensor,
            -driven.ain_range,
            driven.ain_range,
            scale=1e-6,
        )
        ends = [self._amplifier.inverse(v) for v in (driven.dac_min, driven.dac_max)]
        stage = Stage(plant, min(ends), max(ends), params.update_s, compiled=compiled)
        self._outputs = [0.0] * OUTPUTS
        self._outputs[driven.dac] = self._amplifier(stage.u)
        self._resolutions = [0] * INPUTS
        super().__init__(stage, params, port)

    def session(self) -> Session:
        """A new connection."""
        return Session(self)

    def answer(self, request: ModbusPDU) -> ModbusPDU:
        """Carry out a request."""
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
        if isinstance(request, WriteMultipleRegistersRequest):
            registers = request.registers
            self._write(request.address, struct.pack(f">{len(registers)}H", *registers))
            return WriteMultipleRegistersResponse(address=request.address, count=len(registers))
        raise _Refused(ILLEGAL_FUNCTION)

    def _read(self, address: int, count: int) -> bytes:
        """Registers as bytes."""
        data, end = b"", address + count
        while address < end:
            part = self._value(address)
            data += part
            address += len(part) // 2
        if address != end:
            raise _Refused(ILLEGAL_ADDRESS)
        return data

    def _value(self, address: int) -> bytes:
        """What begins at a register."""
        if address == protocol.SERIAL:
            return struct.pack(">I", SERIAL_NUMBER)
        ain = address - protocol.AIN_RESOLUTION
        if 0 <= ain < INPUTS:
            return struct.pack(">H", self._resolutions[ain])
        return struct.pack(">f", self._float(address))

    def _float(self, address: int) -> float:
        if address == protocol.PRODUCT:
            return self.timing.product
        if address == protocol.FIRMWARE:
            return FIRMWARE
        for first, count in (
            (protocol.AIN, INPUTS),
            (protocol.DAC, OUTPUTS),
            (protocol.AIN_RANGE, INPUTS),
        ):
            channel, odd = divmod(address - first, 2)
            if odd or not 0 <= channel < count:
                continue
            if first == protocol.DAC:
                return self._outputs[channel]
            if first == protocol.AIN_RANGE:
                return float(self.driven.ain_range)
            return self._input() if channel == self.driven.ain else 0.0
        raise _Refused(ILLEGAL_ADDRESS)

    def _input(self) -> float:
        span = self.driven.ain_range
        volts = min(max(self._sensor.inverse(self.stage.reading()), -span), span)
        return _in_steps(volts, 2.0 * span, self.timing.ain_bits)

    def _write(self, address: int, data: bytes) -> None:
        channel, odd = divmod(address - protocol.DAC, 2)
        if not odd and 0 <= channel < OUTPUTS and len(data) == 4:
            self._output(channel, struct.unpack(">f", data)[0])
            return
        ain = address - protocol.AIN_RESOLUTION
        if not (0 <= ain < INPUTS and len(data) == 2):
            raise _Refused(ILLEGAL_ADDRESS)
        self._resolutions[ain] = int.from_bytes(data, "big")

    def _output(self, channel: int, volts: float) -> None:
        driven = self.driven
        if volts != volts:
            raise _Refused(ILLEGAL_VALUE)
        volts = min(max(volts, driven.dac_min), driven.dac_max)
        self._outputs[channel] = volts
        if channel == driven.dac:
            given = _in_steps(volts, driven.dac_max - driven.dac_min, self.timing.dac_bits)
            self.stage.command(self._amplifier.inverse(given))


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
