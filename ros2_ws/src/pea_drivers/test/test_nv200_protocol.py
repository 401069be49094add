import contextlib
import math
import random
import re

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pea_drivers.nv200 import protocol
from pea_drivers.nv200.protocol import Commands, ProtocolError, Replies, Reply, Telnet

FRAME = b"\x13meas,12.345\r\n\x11"
MANY = settings(max_examples=1000, deadline=None)
"""Each example is cut into a hundred strings."""

noise = st.integers(0, 2**64).map(lambda seed: random.Random(seed).randbytes(2000 + seed % 2000))
PARTS = (
    rb"meas error , 1e99 -4.2 nan \r \n \x11 \x13 \0 \xff \xff\xfd\x03 \xff\xfa \xff\xf0".split()
)
near = st.lists(
    st.sampled_from([part.decode("unicode_escape").encode("latin-1") for part in PARTS]),
    max_size=60,
).map(b"".join)


def strings(data: bytes) -> list[bytes]:
    """A hundred strings out of one."""
    size = len(data) // 100
    return [data[i : i + size] for i in range(0, 100 * size, size)]


def read(replies: Replies, data: bytes) -> list[float]:
    """Numbers of whatever is understood."""
    with contextlib.suppress(ProtocolError):
        return [protocol.number(r) for r in replies.feed(data) if protocol.error(r) is None]
    return []


@MANY
@given(noise)
def test_100_000_random_strings_raise_nothing_else(data):
    stream = Replies()
    for text in strings(data):
        for replies in (stream, Replies()):
            assert all(map(math.isfinite, read(replies, text)))
            assert len(replies.frame) <= protocol.LONGEST


@settings(deadline=None)
@given(near)
@example(b"meas,1\x11" * 1000)
@example(b"x" * 100_000)
def test_nearly_right_answers_raise_nothing_else(data):
    replies = Replies()
    assert all(map(math.isfinite, read(replies, data)))
    assert len(replies.frame) <= protocol.LONGEST


@settings(deadline=None)
@given(noise | near)
def test_options_and_commands_of_random_strings(data):
    telnet, commands = Telnet(), Commands()
    for text in strings(data) if len(data) > 100 else [data]:
        left, answers = telnet.feed(text)
        assert len(left) <= len(text)
        assert len(answers) <= 3 * len(text)
        assert all(commands.feed(text + left))
        assert len(commands.line) <= protocol.LONGEST


@pytest.mark.parametrize("size", [1, 2, 5, 100])
def test_frames_in_any_pieces(size):
    data = b"\x13\x11" + FRAME + b"\x13error,10\r\n\x11"
    replies, found = Replies(), []
    for i in range(0, len(data), size):
        found += replies.feed(data[i : i + size])
    assert found == [Reply("", ()), Reply("meas", ("12.345",)), Reply("error", ("10",))]


def test_one_frame_may_answer_two_commands():
    assert Replies().feed(b"\x13set,1.000\r\nmeas,2.000\r\n\x11") == [
        Reply("set", ("1.000",)),
        Reply("meas", ("2.000",)),
    ]


def test_frame_is_whole_with_xon_only():
    replies = Replies()
    assert replies.feed(FRAME[:-1]) == []
    assert [protocol.number(r) for r in replies.feed(FRAME[-1:])] == [12.345]


def test_what_follows_noise_is_read():
    replies = Replies()
    with pytest.raises(ProtocolError):
        replies.feed(b"\x13\x02\x11")
    assert replies.feed(FRAME) == [Reply("meas", ("12.345",))]


@pytest.mark.parametrize("value", ["nan", "inf", "1e999", "1_0", "0x1", "", " ", "1,2", "--1"])
def test_only_one_finite_number_is_a_number(value):
    with pytest.raises(ProtocolError, match="must be"):
        protocol.number(Reply("meas", tuple(value.split(","))))


def test_every_code_has_its_name():
    assert protocol.error(Reply("error", ("10",))) == "error 10 (parameter too high)"
    assert protocol.error(Reply("error", ("99",))) == "error 99 (unknown)"
    assert protocol.error(Reply("meas", ("10",))) is None
    assert sorted(protocol.ERRORS) == list(range(1, 11))


@pytest.mark.parametrize(
    ("value", "text"),
    [(12.34567, b"12.346"), (-0.0001, b"0.000"), (1e-9, b"0.000"), (-20, b"-20.000")],
)
def test_command_line(value, text):
    assert protocol.command("set", value) == b"set," + text + b"\r\n"
    assert Commands().feed(protocol.command("set", value)) == [("set", text.decode())]


@pytest.mark.parametrize("end", [b"\r", b"\n", b"\r\n"])
def test_commands_end_in_any_line_end(end):
    assert Commands().feed(b"meas" + end + b"cl,0" + end + end) == [("meas",), ("cl", "0"), ("",)]


def test_telnet_options_are_declined():
    data = b"\xff\xfb\x01a\xff\xfd\x03b\xff\xfc\x01\xff\xfe\x01c\xff\xfa\x18\x00x\xff\xf0d\xff\xffe"
    for size in (1, 3, len(data)):
        telnet, left, answers = Telnet(), b"", b""
        for i in range(0, len(data), size):
            one, two = telnet.feed(data[i : i + size])
            left, answers = left + one, answers + two
        assert left == b"abcd\xffe"
        assert answers == b"\xff\xfe\x01\xff\xfc\x03"


def test_identity_is_the_prompt_without_its_bracket():
    (reply,) = Replies().feed(b"\x13NV200/D_NET>\r\n\x11")
    assert protocol.identity(reply) == "NV200/D_NET"
    assert re.fullmatch(r"[\w/]+", protocol.identity(reply))
