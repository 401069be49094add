import contextlib
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pea_drivers.gcs.protocol import (
    LINE_MAX,
    LINES_MAX,
    AnswerReader,
    ProtocolError,
    encode,
    error,
    named,
    value,
)

STRINGS = 500
"""Byte strings of one example; with EXAMPLES of them 100 000 in all."""
EXAMPLES = 200
ALPHABET = b"\n\n\n\n  ==0123456789.+-eE1POS?\r\t\0\x81\x8d\xff\x1b"


def test_a_command_and_a_question_are_two_lines_of_one_write():
    assert encode("SVA 1 12.5", "POS? 1") == b"SVA 1 12.5\nPOS? 1\n"


def test_an_answer_of_several_lines_ends_at_the_line_without_a_space():
    reader = AnswerReader()
    assert reader.feed(b"1=3.141 \n2=-0.5 \n3=1e-3\n0\n") == [
        ["1=3.141", "2=-0.5", "3=1e-3"],
        ["0"],
    ]


@given(st.lists(st.integers(0, 12), max_size=8))
def test_the_same_answers_come_whatever_the_pieces(cuts):
    data = b"(c) Physik Instrumente\n1 \n2\n1=+003.1410\n\xb5m\n"
    whole = AnswerReader().feed(data)
    reader, answers = AnswerReader(), []
    for cut in cuts:
        piece, data = data[:cut], data[cut:]
        answers += reader.feed(piece)
    assert answers + reader.feed(data) == whole
    assert whole[-1] == ["µm"]


def test_values_belong_to_their_items():
    assert value(["1=3.141", "2=-7"], "2") == -7.0


@pytest.mark.parametrize("lines", [["1=nan"], ["1=inf"], ["1="], ["1"], ["2=1"], [""], ["1=1=2"]])
def test_what_is_no_finite_number_is_refused(lines):
    with pytest.raises(ProtocolError):
        value(lines, "1")


def test_errors_have_their_names():
    assert error(["79"]) == 79
    assert "servo is on" in named(79)
    assert "manual" in named(4711)
    with pytest.raises(ProtocolError):
        error(["1=2"])


def test_an_endless_line_is_refused_and_forgotten():
    reader = AnswerReader()
    with pytest.raises(ProtocolError, match="characters"):
        reader.feed(b"x" * (LINE_MAX + 1))
    assert reader.feed(b"0\n") == [["0"]]


def test_endless_lines_are_refused():
    with pytest.raises(ProtocolError, match="lines"):
        AnswerReader().feed(b"1=0 \n" * (LINES_MAX + 1))


@settings(max_examples=EXAMPLES, deadline=None)
@given(st.integers(0, 2**64 - 1))
def test_100_000_random_strings_raise_nothing_else(seed):
    rng = random.Random(seed)
    reader = AnswerReader()
    for _ in range(STRINGS):
        n = rng.choice((0, 1, 3, 17, 60, 600))
        data = rng.randbytes(n) if rng.random() < 0.5 else bytes(rng.choices(ALPHABET, k=n))
        with contextlib.suppress(ProtocolError):
            for lines in reader.feed(data):
                assert lines
                value(lines, "1")
        assert len(reader.rest) <= LINE_MAX
        assert sum(map(len, reader.lines)) <= LINE_MAX * LINES_MAX
