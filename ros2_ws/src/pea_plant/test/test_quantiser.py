import pytest
from hypothesis import given
from hypothesis import strategies as st

from pea_plant.model.quantiser import quantise


@given(x=st.floats(-1e6, 1e6), step=st.floats(1e-3, 10.0))
def test_error_is_at_most_half_a_step(x, step):
    assert abs(quantise(x, step) - x) <= 0.5 * step * (1 + 1e-9) + 1e-9


@given(x=st.floats(-1e6, 1e6), step=st.floats(1e-3, 10.0))
def test_quantising_twice_changes_nothing(x, step):
    once = quantise(x, step)
    assert quantise(once, step) == once


@pytest.mark.parametrize(("x", "expected"), [(0.5, 1.0), (-0.5, 0.0), (1.49, 1.0), (-1.51, -2.0)])
def test_halves_go_up(x, expected):
    assert quantise(x, 1.0) == expected


@given(x=st.floats(allow_nan=False, allow_infinity=False))
def test_steps_too_fine_to_count_leave_the_value(x):
    assert abs(quantise(x, 1e-300) - x) <= 1e-300
