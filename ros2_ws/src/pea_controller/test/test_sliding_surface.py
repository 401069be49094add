"""Switching function of Eq 9 and the control of Eq 12 that holds it."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pea_controller.model.sliding_surface import equivalent_control, switching_function
from pea_core.signals import Estimate, Reference

A21, A22, B2 = -(5450.0**2), -2 * 0.82 * 5450.0, 0.142e-6 * 5450.0**2


def test_q_weighs_displacement_error_with_m():
    q = switching_function(2000.0, Reference(1e-6, 3e-3, 0.0), Estimate(1.5e-6, 5e-3, 0.0))
    assert q == pytest.approx(2000.0 * 0.5e-6 + 2e-3, rel=1e-12)


@given(
    e1=st.floats(-1e-5, 1e-5),
    e2=st.floats(-0.1, 0.1),
    m=st.floats(100.0, 30000.0),
)
def test_equivalent_control_holds_q(e1, e2, m):
    # Eq 11 without u_3 and eps: q' = m e2 + A21 e1 + A22 e2 + B2 u = 0.
    u = equivalent_control(A21, A22, B2, m, Reference(0.0, 0.0, 0.0), Estimate(e1, e2, 0.0))
    q_dot = m * e2 + A21 * e1 + A22 * e2 + B2 * u
    assert abs(q_dot) < 1e-12 * (m * abs(e2) + abs(A21 * e1) + abs(A22 * e2)) + 1e-300
