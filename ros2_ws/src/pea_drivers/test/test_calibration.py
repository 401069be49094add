import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pea_core.params import ParameterError
from pea_drivers.calibration import CalibrationCurve


def test_a_gain_and_an_offset():
    curve = CalibrationCurve("amplifier", (1.0, 0.1), -20.0, 110.0)
    assert curve(50.0) == pytest.approx(6.0)
    assert curve.inverse(6.0) == pytest.approx(50.0)
    assert curve.image == pytest.approx((-1.0, 12.0))


def test_an_inverting_amplifier_falls():
    curve = CalibrationCurve("amplifier", (0.0, -0.1), -20.0, 110.0)
    assert curve.image == pytest.approx((-11.0, 2.0))
    assert curve.inverse(-11.0) == pytest.approx(110.0)


@pytest.mark.parametrize(
    ("coefficients", "low", "high"),
    [
        ((), 0.0, 1.0),
        ((3.0,), 0.0, 1.0),
        ((0.0, 0.0), 0.0, 1.0),
        ((0.0, 1.0, -0.01), 0.0, 110.0),  # turns at 50
        ((0.0, 0.0, 1.0), -1.0, 1.0),
    ],
)
def test_what_has_no_inverse_is_refused(coefficients, low, high):
    with pytest.raises(ParameterError, match=r"sensor = .*must rise or fall"):
        CalibrationCurve("sensor", coefficients, low, high)


def test_a_curve_may_turn_outside_its_range():
    assert CalibrationCurve("sensor", (0.0, 1.0, -0.01), 0.0, 49.0)(10.0) == pytest.approx(9.0)


@given(
    st.sampled_from((-1.0, 1.0)),
    st.tuples(st.floats(-2.0, 2.0), st.floats(1e-3, 2.0), *[st.floats(-1.0, 1.0)] * 2),
    st.floats(0.0, 1.0),
)
def test_the_inverse_leads_back(sign, of_curve, at):
    low, high = -1.5, 2.5
    zero, least, constant, linear = of_curve
    slope = np.polynomial.Polynomial((constant, linear)) ** 2 + least  # above 0 everywhere
    coefficients = (sign * slope.integ(k=zero)).coef
    curve = CalibrationCurve("sensor", tuple(coefficients), low, high)
    x = low + at * (high - low)
    assert curve(x) == pytest.approx(np.polynomial.Polynomial(coefficients)(x), abs=1e-12)
    assert curve.inverse(curve(x)) == pytest.approx(x, abs=1e-9)
