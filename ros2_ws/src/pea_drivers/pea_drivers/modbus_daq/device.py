"""An analogue output and an analogue input in volts and metres.

The output goes to an amplifier's input, the input comes from a sensor's output; the calibration
says what their volts mean.
"""

from __future__ import annotations

import math
import re
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pea_core.params import ParameterError, param
from pea_core.signals import KINDS, Measurement
from pea_drivers import device, transport
from pea_plant.drivers.driver import DriverError, Limits
from pea_watchdog.client import Question

if TYPE_CHECKING:
    from pea_drivers.modbus_daq import protocol

OWN = 0
"""Number of the watchdog's question: the driver's are others."""

PRODUCTS = {"T4": 4.0, "T7": 7.0, "T8": 8.0}
"""What the register of the product says."""


@dataclass(frozen=True)
class Params(device.Params):
    """LabJack of the T series over Modbus TCP: one analogue output, one analogue input."""

    address: str = param("tcp://127.0.0.1:502", help="tcp://HOST:PORT", fixed=True)
    model: str = param("T7", choices=tuple(PRODUCTS), help="product", fixed=True)
    dac: int = param(0, "", 0, 1, help="output, to the amplifier", fixed=True)
    ain: int = param(0, "", 0, 253, help="input, from the sensor", fixed=True)
    dac_min: float = param(0.0, "V", -100.0, 100.0, help="lowest voltage of the output", fixed=True)
    dac_max: float = param(5.0, "V", -100.0, 100.0, help="highest voltage of it", fixed=True)
    dac_bits: int = param(
        12, "", 1, 32, help="2^bits steps of it; half of one is left to both limits", fixed=True
    )
    ain_range: float = param(10.0, "V", 1e-3, 100.0, help="range of the input, +-", fixed=True)
    resolution: int = param(
        1, "", 0, 12, help="resolution index of the input: 1 is the fastest", fixed=True
    )
    trigger: str = param(
        "none",
        choices=("none", *KINDS),
        help="events of a scan at which the digital line is high for a sample",
        fixed=True,
    )
    trigger_fio: int = param(0, "", 0, 7, help="that line: 0 is FIO0", fixed=True)

    signal_ain: int = param(
        -1, "", -1, 253, help="input of a detector, recorded as the sample signal (V); -1: none",
        fixed=True,
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.signal_ain == self.ain:
            raise ParameterError(
                f"signal_ain = {self.signal_ain}: is the input of the displacement sensor; give "
                "another, or -1"
            )
        if self.dac_min >= self.dac_max:
            raise ParameterError(
                f"dac_min = {self.dac_min:g}: must be below dac_max ({self.dac_max:g} V)"
            )
        if transport.parse(self.address)[0] != "tcp":
            raise ParameterError(f"address = {self.address!r}: Modbus TCP needs tcp://HOST:PORT")


class ModbusDaq(device.Device):
    """Driver of an output and an input of a LabJack; see `device.Device`."""

    NAME = "LabJack"
    NUMBERED = True

    def __init__(self, params: Params, voltage_min: float, voltage_max: float) -> None:
        from pea_drivers.modbus_daq import protocol

        super().__init__(params, voltage_min, voltage_max)
        self._protocol = protocol
        self._sensor = self._sensor_over(-params.ain_range, params.ain_range)
        reach = self._reach(params.dac_min, params.dac_max)
        half = 0.5 * (params.dac_max - params.dac_min) / 2**params.dac_bits
        ends = sorted(map(self._amplifier, (voltage_min, voltage_max)))
        self._ends = ends[0] + half, ends[1] - half
        self.limits = Limits(*reach, *self._sensor.image)
        self._dac, self._ain = protocol.DAC + 2 * params.dac, protocol.AIN + 2 * params.ain
        self._readings = [protocol.reading(self._ain)]
        self.signal = math.nan
        if params.signal_ain >= 0:
            self._readings.append(protocol.reading(protocol.AIN + 2 * params.signal_ain))
        self._count = 0
        self._marked = False
        self._begin()

    def mark(self) -> None:
        """Set the trigger line with the next exchange, for one sample."""
        self._marked = True

    def _exchange(self, u: float) -> Measurement:
        """Read the sensor, write u (V) and set the trigger line, in this order, in one frame."""
        applied, pieces = self._u, [*self._readings, self._piece(u)]
        if self._params.trigger != "none":
            pieces.append(self._protocol.switching(self._params.trigger_fio, self._marked))
            self._marked = False
        return Measurement(self._measured(pieces), math.nan, applied)

    def _read(self) -> Measurement:
        return Measurement(self._measured(self._readings), math.nan, self._u)

    def _measured(self, pieces: list[protocol.Piece]) -> float:
        """Displacement (m) that the first reading of a frame tells; keep the sample signal (V)."""
        reading, *detector = self._floats(pieces, len(self._readings))
        self.signal = detector[0] if detector else math.nan
        return self._sensor(reading)

    def _write(self, u: float) -> None:
        self._open().send(self._request([self._piece(u)]))

    def _check(self) -> None:
        """Read the output back: it holds what was written."""
        before = self._u
        self._u = self._held()
        if abs(self._u - before) > 1e-3 * (self.limits.voltage_max - self.limits.voltage_min):
            raise self._wrong(
                f"the output holds {self._u:.4g} V at the actuator, not {before:.4g} V; "
                "is somebody else connected, or has it restarted?"
            )

    def last_resort(self, u: float) -> bytes:
        """Write u (V); a frame stands for itself."""
        piece = self._protocol.writing(self._dac, self._command(u))
        return self._frames.encode(self._protocol.Feedback([piece]))

    def question(self) -> Question:
        """How to ask what is held: a frame whose answer has a number of its own."""
        protocol = self._protocol
        asked = protocol.Feedback([protocol.reading(self._dac)], OWN)
        head = struct.pack(">HHHBB", OWN, 0, 6, 1, protocol.Feedback.function_code)
        return Question(
            self._frames.encode(asked), re.escape(head) + b"(.{4})", ">f", self._command
        )

    def _begin(self) -> None:
        """Forget what has come so far."""
        self._frames = self._protocol.Frames()

    def _recover(self) -> None:
        """Begin anew at the next frame: answers are known by their numbers."""
        self._open().drop()

    def _identify(self) -> None:
        """Ask for product, serial number and firmware; refuse another product."""
        protocol, params = self._protocol, self._params
        product, firmware = self._floats(
            [protocol.reading(protocol.PRODUCT), protocol.reading(protocol.FIRMWARE)], 2
        )
        answer = self._ask([protocol.reading(protocol.SERIAL)])
        names = {number: name for name, number in PRODUCTS.items()}
        found = names.get(product, f"product {product:g}")
        serial = int.from_bytes(answer.data, "big")
        self.identity = f"LabJack {found}, serial number {serial}, firmware {firmware:.4f}"
        if found != params.model:
            raise ParameterError(
                f"model = {params.model!r}: at {params.address} is {self.identity}; "
                "check the address, or give its model"
            )

    def _fit(self) -> None:
        """Resolution of the input; refuse an input that is not there or of another range."""
        protocol, params = self._protocol, self._params
        try:
            (span,) = self._floats([protocol.reading(protocol.AIN_RANGE + 2 * params.ain)], 1)
            index = struct.pack(">H", params.resolution)
            self._ask([protocol.Piece(protocol.AIN_RESOLUTION + params.ain, 1, index)])
            self._floats(self._readings[:1], 1)
        except DriverError as error:
            raise ParameterError(
                f"ain = {params.ain}: not an input of the device with "
                f"resolution = {params.resolution} ({error})"
            ) from None
        if params.signal_ain >= 0:
            try:
                self._floats(self._readings[1:], 1)
            except DriverError as error:
                raise ParameterError(
                    f"signal_ain = {params.signal_ain}: not an input of the device ({error})"
                ) from None
        if abs(span - params.ain_range) > 1e-3 * params.ain_range:
            raise ParameterError(
                f"ain_range = {params.ain_range:g}: the input is set to +-{span:g} V; "
                "give that, or set the device"
            )

    def _held(self) -> float:
        """Voltage (V) that the device holds."""
        (value,) = self._floats([self._protocol.reading(self._dac)], 1)
        return self._amplifier.inverse(value)

    def _command(self, u: float) -> float:
        """Voltage of the output (V) for u (V); the step that it takes is within the range, too."""
        return min(max(super()._command(u), self._ends[0]), self._ends[1])

    def _piece(self, u: float) -> protocol.Piece:
        """What writes u (V)."""
        value = self._command(u)
        self._u = self._amplifier.inverse(value)
        return self._protocol.writing(self._dac, value)

    def _floats(self, pieces: list[protocol.Piece], count: int) -> tuple[float, ...]:
        return self._protocol.floats(self._ask(pieces), count)

    def _ask(self, pieces: list[protocol.Piece]) -> protocol.FeedbackAnswer:
        """Send, and wait for the answer of the same number.

        Raises
        ------
        DriverError
            None in time, or the device refuses it.
        """
        request = self._request(pieces)

        def take(data: bytes) -> protocol.FeedbackAnswer | None:
            for answer in self._frames.feed(data):
                if answer.transaction_id == self._count:
                    refused = self._protocol.error(answer)
                    if refused is not None:
                        first = ", ".join(str(piece.address) for piece in pieces)
                        raise self._wrong(f"{refused} on register {first}")
                    return self._protocol.feedback(answer)
            return None

        return self._talk(request, take)

    def _request(self, pieces: list[protocol.Piece]) -> bytes:
        """A frame with the next number."""
        self._count = self._count % 0xFFFF + 1
        return self._frames.encode(self._protocol.Feedback(pieces, self._count))


def make(plant: Any, T_s: float) -> ModbusDaq:
    """Driver for the plant's parameters."""
    return ModbusDaq(plant.driver, plant.voltage_min, plant.voltage_max)
