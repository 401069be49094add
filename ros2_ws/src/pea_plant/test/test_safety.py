import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pea_plant.gate import UnsafeCommand, check, limit


@pytest.mark.parametrize("u", [math.nan, math.inf, -math.inf])
def test_no_number_is_refused_with_its_sample(u):
    with pytest.raises(UnsafeCommand, match=f"sample 17 is {u}"):
        check(u, 17)


@given(u=st.floats(allow_nan=False, allow_infinity=False))
def test_a_finite_number_passes(u):
    check(u, 0)


@given(u=st.floats(allow_nan=False))
def test_limit_stays_within_the_range(u):
    assert -20.0 <= limit(u, -20.0, 110.0) <= 110.0


@given(u=st.floats(-20.0, 110.0))
def test_limit_leaves_what_is_within_alone(u):
    assert limit(u, -20.0, 110.0) == u


def test_limits_are_the_amplifier_s():
    assert limit(1e9, -20.0, 110.0) == 110.0
    assert limit(-1e9, -20.0, 110.0) == -20.0
