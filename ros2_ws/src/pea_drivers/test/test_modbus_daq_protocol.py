import contextlib
import math
import random
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymodbus.pdu import ExceptionResponse
from pymodbus.pdu.register_message import ReadHoldingRegistersRequest

from pea_drivers.modbus_daq import protocol
from pea_drivers.modbus_daq.protocol import Feedback, FeedbackAnswer, Frames, ProtocolError

MANY = settings(max_examples=1000, deadline=None)
"""Each example is cut into a hundred strings."""

noise = st.integers(0, 2**64).map(lambda seed: random.Random(seed).randbytes(2000 + seed % 2000))


def header(pdu: bytes, count: int = 7) -> bytes:
    return struct.pack(">HHHB", count, 0, len(pdu) + 1, 1) + pdu


def read(frames: Frames, data: bytes) -> None:
    """Whatever is understood is finite."""
    with contextlib.suppress(ProtocolError):
        for message in frames.feed(data):
            if protocol.error(message) is None:
                assert all(map(math.isfinite, protocol.floats(protocol.feedback(message), 1)))


@MANY
@given(noise, st.booleans())
def test_100_000_random_strings_raise_nothing_else(data, server):
    size = len(data) // 100
    stream = Frames(server)
    for i in range(0, 100 * size, size):
        text = data[i : i + size]
        for frames, sent in ((stream, text), (Frames(server), header(text))):
            read(frames, sent)
            assert len(frames.rest) < protocol.LONGEST


@settings(deadline=None)
@given(st.lists(st.integers(0, 127).map(lambda f: bytes([f])) | st.binary(max_size=40), max_size=9))
def test_nearly_right_frames_raise_nothing_else(pdus):
    for server in (False, True):
        read(Frames(server), b"".join(header(pdu) for pdu in pdus))


def test_cycle_on_the_wire():
    """By hand: write 2.5 to DAC0, read AIN0, in one frame of function 76."""
    pieces = [protocol.writing(protocol.DAC, 2.5), protocol.reading(protocol.AIN)]
    sent = Frames().encode(Feedback(pieces, 5))
    assert sent.hex(" ") == ("00 05 00 00 00 0e 01 4c 01 03 e8 02 40 20 00 00 00 00 00 02")


@pytest.mark.parametrize("size", [1, 3, 7, 1000])
def test_messages_in_any_pieces(size):
    pieces = [protocol.writing(1000, -1.25), protocol.reading(0), protocol.Piece(41500, 1, b"\0\1")]
    client, server = Frames(), Frames(server=True)
    data = client.encode(Feedback(pieces, 3)) + client.encode(
        ReadHoldingRegistersRequest(address=60000, count=2, transaction_id=4, dev_id=1)
    )
    found = []
    for i in range(0, len(data), size):
        found += server.feed(data[i : i + size])
    assert [message.transaction_id for message in found] == [3, 4]
    assert found[0].pieces == pieces
    assert (found[1].address, found[1].count) == (60000, 2)


def test_answer_of_floats():
    data = Frames().encode(FeedbackAnswer(struct.pack(">2f", 1.5, -2.0), 9))
    (message,) = Frames().feed(data)
    assert protocol.floats(message, 2) == (1.5, -2.0)
    with pytest.raises(ProtocolError, match="must be 1 floats"):
        protocol.floats(message, 1)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_only_finite_floats(value):
    with pytest.raises(ProtocolError, match="must be finite"):
        protocol.floats(FeedbackAnswer(struct.pack(">f", value)), 1)


def test_exceptions_have_names():
    (message,) = Frames().feed(header(bytes([76 | 0x80, 2])))
    assert isinstance(message, ExceptionResponse)
    assert protocol.error(message) == "error 2 (illegal data address)"


@pytest.mark.parametrize(
    "data", [b"HTTP/1.1 400 Bad Request", b"\0\0\0\0\0\0\0", header(b"\x4c" * 300), header(b"\x07")]
)
def test_what_is_no_modbus_is_refused(data):
    with pytest.raises(ProtocolError):
        Frames().feed(data)
