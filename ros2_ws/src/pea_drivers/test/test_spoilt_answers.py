"""A spoilt answer is refused in one line, and none is taken for that to another question.

What is tried stands in ``tests/fuzz/protocols.py``; ``make fuzz`` tries more of it.
"""

import importlib.util
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

RUN = Path(__file__).parents[4] / "tests" / "fuzz" / "run.py"


def protocols():
    spec = importlib.util.spec_from_file_location("pea_fuzz_run", RUN)
    run = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(run)
    return run.target("protocols")


if not RUN.exists():
    pytest.skip("needs the whole checkout", allow_module_level=True)
TARGET = protocols()

pieces = st.lists(st.sampled_from(TARGET.PIECES) | st.binary(max_size=20), max_size=6).map(b"".join)
places = st.tuples(
    st.integers(0, 2),
    st.integers(0, TARGET.ANSWERS - 1),
    st.sampled_from([0, 1, 5]),
    st.integers(0, 3),
)


@settings(max_examples=250, deadline=None)
@given(places, pieces)
@example((0, 17, 1, 2), b"1=7.5\n0\n")  # taken for the next displacement by who drops nothing
@example((1, 20, 0, 2), b"\x13meas,7.5\r\n\x11")
@example((0, 16, 0, 0), b"x" * 100_000)
@example((2, 16, 0, 0), b"\x00\x05\x00\x00\x01\x00\x01")
def test_pieces_of_answers(place, data):
    TARGET.attempt(bytes(place) + data)


def test_answers_changed_a_little():
    for data in TARGET.fuzz(seed=20, n=250):
        TARGET.attempt(data)
