from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pea_core.params import ParameterError
from pea_observer.model.current_form import current_gain, refuse_unstable

control = pytest.importorskip("control")

F2 = np.array([[0.97, 4e-5], [-1200.0, 0.6]])
C2 = np.array([[1.0, 0.0]])


def test_distinct_poles_agree_with_place():
    poles = [0.3, 0.55]
    expected = control.place(F2.T, (C2 @ F2).T, poles)[0]
    np.testing.assert_allclose(current_gain(F2, C2, poles), expected, rtol=1e-8)


def test_repeated_poles_agree_with_acker():
    poles = [0.3, 0.3]
    expected = np.ravel(control.acker(F2.T, (C2 @ F2).T, poles))
    np.testing.assert_allclose(current_gain(F2, C2, poles), expected, rtol=1e-8)


@settings(max_examples=50, deadline=None)
@given(modulus=st.floats(0.05, 0.9), angle=st.floats(0.05, 3.0), coupling=st.floats(0.1, 1.0))
def test_the_error_has_the_poles_asked_for(modulus, angle, coupling):
    F = np.array([[0.9, coupling], [-0.2, 0.7]])
    poles = [modulus * np.exp(1j * angle), modulus * np.exp(-1j * angle)]
    L = current_gain(F, C2, poles)
    error = (np.eye(2) - L[:, None] @ C2) @ F
    found = sorted(np.linalg.eigvals(error), key=lambda p: p.imag)
    np.testing.assert_allclose(found, sorted(poles, key=lambda p: p.imag), atol=1e-8)


def test_states_that_y_does_not_tell_are_refused():
    with pytest.raises(ParameterError, match="does not determine"):
        current_gain(np.diag([0.9, 0.8]), C2, [0.1, 0.2])


def test_a_gain_that_rounding_made_useless_is_refused():
    with pytest.raises(ParameterError, match="would not decay"):
        refuse_unstable(F2, C2, np.array([-3.0, 0.0]))
    with pytest.raises(ParameterError, match="would not decay"):
        refuse_unstable(F2, C2, np.array([np.nan, 0.0]))
