import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from pea_core.params import ParameterError, build
from pea_plant.model.hysteresis import bouc_wen

VOLTS = st.floats(-100.0, 120.0)


def follow(voltages, params=None):
    """Effective voltage after each of the voltages, from rest."""
    c = bouc_wen.design(params or bouc_wen.Params(), 50e-6)
    s = bouc_wen.start(c)
    v = []
    for u in voltages:
        s = bouc_wen.update(c, s, u)
        v.append(bouc_wen.output(c, s))
    return np.array(v)


def integrated(voltages, p):
    """The same from the differential equation, stopping where |h| has its corner."""
    u, h, v = 0.0, 0.0, []
    for u_next in voltages:
        sign = math.copysign(1.0, u_next - u)

        def slope(s, h, sign=sign):
            return p.alpha * sign - p.beta * h - p.gamma * sign * abs(h)

        def crossing(s, h):
            return h[0]

        done, length = 0.0, abs(u_next - u)
        crossing.terminal = True
        while done < length:
            # away from a start at h = 0, which the solver would take for a crossing
            events = crossing if h != 0.0 else None
            r = solve_ivp(
                slope, (done, length), [h], "DOP853", events=events, rtol=1e-12, atol=1e-13
            )
            done = r.t[-1]
            h = 0.0 if r.status == 1 else r.y[0, -1]
        u = u_next
        v.append(u - h)
    return np.array(v)


@pytest.mark.parametrize(
    "params",
    [
        bouc_wen.Params(),
        bouc_wen.Params(alpha=0.6, beta=0.05, gamma=-0.02),
        bouc_wen.Params(alpha=0.35, beta=0.04, gamma=0.04),
        bouc_wen.Params(alpha=0.35, beta=0.04, gamma=-0.04),
    ],
)
def test_closed_form_solves_the_differential_equation(params):
    path = [30.0, 89.09, 60.0, 75.0, -15.0, 3.0, 2.0, 80.0, 0.0]
    np.testing.assert_allclose(follow(path, params), integrated(path, params), atol=1e-10, rtol=0)


def test_default_gives_12_um_at_full_voltage():
    assert follow([89.09])[-1] * 0.142 == pytest.approx(12.0, abs=2e-3)


@settings(max_examples=50, deadline=None)
@given(
    start=VOLTS,
    end=VOLTS,
    cuts=st.lists(st.floats(0.0, 1.0), max_size=20),
)
def test_does_not_depend_on_how_a_change_is_divided(start, end, cuts):
    parts = [start + (end - start) * x for x in sorted(cuts)]
    whole = follow([start, end])[-1]
    assert follow([start, *parts, end])[-1] == pytest.approx(whole, abs=1e-10)


def test_same_voltage_changes_nothing():
    assert follow([40.0, 20.0, 20.0, 20.0])[-1] == follow([40.0, 20.0])[-1]


def test_minor_loop_does_not_close():
    v = follow([80.0, 40.0, 60.0, 40.0])
    assert abs(v[3] - v[1]) > 0.1


def test_memory_is_not_wiped_out():
    after_minor_loop = follow([40.0, 20.0, 40.0, 80.0])[-1]
    assert abs(after_minor_loop - follow([40.0, 80.0])[-1]) > 0.01


def test_without_alpha_there_is_no_hysteresis():
    path = [50.0, -20.0, 80.0]
    assert follow(path, bouc_wen.Params(alpha=0.0)).tolist() == path


def test_without_alpha_an_old_state_decays_by_the_branch_of_its_sign():
    c = bouc_wen.design(bouc_wen.Params(alpha=0.0), 50e-6)
    s = bouc_wen.update(c, bouc_wen.State(0.0, -3.0), 10.0)
    assert s.h == pytest.approx(-3.0 * math.exp(-(0.0424 - 0.03394) * 10.0), rel=1e-12)


def test_gamma_beyond_beta_is_refused():
    with pytest.raises(ParameterError, match=r"gamma = 0\.05: must be within \+-beta"):
        build(bouc_wen.Params, {"beta": 0.04, "gamma": 0.05})
