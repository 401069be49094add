"""What a LabJack of the T series says over Modbus TCP; no I/O.

Requests, answers and frames are pymodbus's. Beside the standard functions the device knows one of
its own, Feedback: several writes and readings in one frame, done in the order in which they stand,
so that a cycle costs one frame each way. Every piece is a kind (0 reads, 1 writes), the first
register, the number of registers, and what to write; the answer is what was read, one after the
other. A float takes two registers, the upper half first.
"""

from __future__ import annotations

import logging
import math
import struct
from collections.abc import Sequence
from typing import NamedTuple

from pymodbus.exceptions import ModbusException
from pymodbus.framer import FramerSocket
from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU

from pea_plant.drivers.driver import DriverError

logging.getLogger("pymodbus").addHandler(logging.NullHandler())

AIN, DAC, FIO, AIN_RANGE, AIN_RESOLUTION = 0, 1000, 2000, 40000, 41500
PRODUCT, FIRMWARE, SERIAL = 60000, 60004, 60028
"""First registers: floats, but a resolution and a digital line are one register, a serial number is
a whole number."""

HEADER = 7
LONGEST = 260
"""Bytes of a frame at most."""

ERRORS = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "server device failure",
    5: "acknowledge",
    6: "server device busy",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "gateway target does not respond",
}
"""Names of the exception codes."""


class ProtocolError(DriverError):
    """What came is no Modbus TCP."""


class Piece(NamedTuple):
    """A reading of `size` registers from `address` on, or the writing of `data` there."""

    address: int
    size: int
    data: bytes | None = None


class Feedback(ModbusPDU):
    """Request of several pieces."""

    function_code = 76

    def __init__(self, pieces: Sequence[Piece] = (), transaction_id: int = 0) -> None:
        super().__init__(dev_id=1, transaction_id=transaction_id)
        self.pieces = list(pieces)

    def encode(self) -> bytes:
        """Bytes behind the function code."""
        return b"".join(
            struct.pack(">BHB", data is not None, address, size) + (data or b"")
            for address, size, data in self.pieces
        )

    def decode(self, data: bytes) -> None:
        """Read them; ValueError or struct.error where they are none."""
        self.pieces, i = [], 0
        while i < len(data):
            kind, address, size = struct.unpack_from(">BHB", data, i)
            i += 4
            written = data[i : i + 2 * size] if kind == 1 else None
            if kind > 1 or size == 0 or (written is not None and len(written) < 2 * size):
                raise ValueError(f"piece of kind {kind}, {size} registers")
            i += len(written or b"")
            self.pieces.append(Piece(address, size, written))


class FeedbackAnswer(ModbusPDU):
    """What was read."""

    function_code = 76

    def __init__(self, data: bytes = b"", transaction_id: int = 0) -> None:
        super().__init__(dev_id=1, transaction_id=transaction_id)
        self.data = data

    def encode(self) -> bytes:
        """Bytes behind the function code."""
        return self.data

    def decode(self, data: bytes) -> None:
        """Take them."""
        self.data = bytes(data)


def _framer(server: bool) -> FramerSocket:
    decoder = DecodePDU(server)
    decoder.register(Feedback if server else FeedbackAnswer)
    return FramerSocket(decoder)


_FRAMERS = {server: _framer(server) for server in (False, True)}
"""They keep nothing from one frame to the next."""


class Frames:
    """Frames out of a stream of bytes, in any pieces, and into one.

    Parameters
    ----------
    server : bool
        Whether requests are read; else answers.
    """

    def __init__(self, server: bool = False) -> None:
        self._server = server
        self._framer = _FRAMERS[server]
        self.rest = bytearray()

    def encode(self, message: ModbusPDU) -> bytes:
        """A frame."""
        return self._framer.buildFrame(message)

    def feed(self, data: bytes) -> list[ModbusPDU]:
        """Take in what came; the messages that are whole now.

        Raises
        ------
        ProtocolError
            No Modbus TCP; what came is forgotten.
        """
        self.rest += data
        messages: list[ModbusPDU] = []
        try:
            while (size := self._size()) and size <= len(self.rest):
                messages.append(self._decode(bytes(self.rest[:size])))
                del self.rest[:size]
        except ProtocolError:
            self.rest.clear()
            raise
        return messages

    def _size(self) -> int:
        """Bytes of the frame that has begun; 0 where its header is not there yet."""
        if len(self.rest) < HEADER:
            return 0
        _, protocol, length = struct.unpack_from(">HHH", self.rest)
        if protocol != 0 or not 2 <= length <= LONGEST - 6:
            raise ProtocolError(f"no header of Modbus TCP: {bytes(self.rest[:HEADER]).hex(' ')}")
        return 6 + int(length)

    def _decode(self, frame: bytes) -> ModbusPDU:
        try:
            used, message = self._framer.handleFrame(frame, 0, 0)
        except ModbusException:
            used, message = 0, None
        if self._server and (message is None or used != len(frame)):
            number, device, function = struct.unpack_from(">H4xBB", frame)
            message = ModbusPDU(dev_id=device, transaction_id=number)
            message.function_code = function & 0x7F  # one that the device does not know
            return message
        if message is None or used != len(frame):
            raise ProtocolError(f"no message of Modbus: {frame[HEADER : HEADER + 20].hex(' ')}")
        return message


def error(message: ModbusPDU) -> str | None:
    """What an answer refuses, as ``error CODE (name)``; None where it does not."""
    if not isinstance(message, ExceptionResponse):
        return None
    code = message.exception_code
    return f"error {code} ({ERRORS.get(code, 'unknown')})"


def reading(address: int) -> Piece:
    """Read the float at a register."""
    return Piece(address, 2)


def writing(address: int, value: float) -> Piece:
    """Write the float at a register."""
    return Piece(address, 2, struct.pack(">f", value))


def switching(line: int, on: bool) -> Piece:
    """Set a digital line."""
    return Piece(FIO + line, 1, struct.pack(">H", on))


def feedback(message: ModbusPDU) -> FeedbackAnswer:
    """An answer to Feedback.

    Raises
    ------
    ProtocolError
        It is to another function.
    """
    if not isinstance(message, FeedbackAnswer):
        raise ProtocolError(f"answer to function {message.function_code}: must be to 76")
    return message


def floats(answer: FeedbackAnswer, count: int) -> tuple[float, ...]:
    """Floats of an answer.

    Raises
    ------
    ProtocolError
        Not so many, or one is not finite.
    """
    data = answer.data
    if len(data) != 4 * count:
        raise ProtocolError(f"answer of {len(data)} bytes: must be {count} floats")
    values: tuple[float, ...] = struct.unpack(f">{count}f", data)
    if not all(map(math.isfinite, values)):
        raise ProtocolError(f"answer {values}: must be finite")
    return values
