"""What is put into a cell comes back, and compiled code finds it there."""

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

cells = pytest.importorskip("pea_core.cells", reason="needs numba")
from pea_core.compiled import compile_kernel  # noqa: E402

Cell, get, put = cells.Cell, cells.get, cells.put


class Inner(NamedTuple):
    on: bool
    rate: float
    past: np.ndarray


class Outer(NamedTuple):
    k: int
    inner: Inner
    rest: tuple[float, tuple[int, float]]


def value(k=3, on=True, rate=1.5, past=(1.0, 2.0)):
    return Outer(k, Inner(on, rate, np.array(past)), (rate, (k, -rate)))


@pytest.fixture(scope="module")
def cell():
    return Cell(value())


@settings(max_examples=50, deadline=None)
@given(
    k=st.integers(-(2**63), 2**63 - 1),
    on=st.booleans(),
    rate=st.floats(allow_nan=False),
    past=st.lists(st.floats(allow_nan=False), max_size=9),
)
def test_what_is_put_in_comes_back(cell, k, on, rate, past):
    before = value(k, on, rate, past)
    cell.value = before
    after = cell.value
    assert type(after) is Outer
    assert type(after.inner) is Inner
    assert after._replace(inner=None) == before._replace(inner=None)
    assert after.inner[:2] == before.inner[:2]
    assert np.array_equal(after.inner.past, before.inner.past)


def test_arrays_stay_where_they_are(cell):
    before = value()
    cell.value = before
    before.inner.past[0] = 7.0
    assert cell.value.inner.past[0] == 7.0


def test_compiled_code_keeps_its_values_from_call_to_call(cell):
    def step(address, like):
        held = get(address, like)
        held.inner.past[0] += held.inner.rate
        put(address, Outer(held.k + 1, held.inner, held.rest))
        return held.k

    before = value(k=40)
    cell.value = before
    kernel = compile_kernel(step)
    assert [kernel.again(cell.address, cell.like) for _ in range(3)] == [40, 41, 42]
    assert cell.value.k == 43
    assert before.inner.past[0] == 1.0 + 3 * 1.5
