"""Figures of steps, loops and creep against closed forms."""

import math

import numpy as np
import pytest
from scipy import signal

from pea_core.params import ParameterError
from pea_measure import motion

T_S = 1e-5


def second_order(zeta, omega, T=0.05):
    t = np.arange(0.0, T, T_S)
    _, y = signal.step(signal.lti([omega**2], [1.0, 2.0 * zeta * omega, omega**2]), T=t)
    return y


def test_overshoot_and_rise_of_a_second_order_step():
    zeta, omega = 0.4, 2000.0
    found = motion.step(3e-6 * second_order(zeta, omega), 0.0, 3e-6, T_S)
    assert found.overshoot == pytest.approx(
        math.exp(-math.pi * zeta / math.sqrt(1.0 - zeta**2)), rel=1e-3
    )
    y = second_order(zeta, omega)
    t = np.arange(len(y)) * T_S
    up = slice(0, int(np.argmax(y)))
    assert found.rise == pytest.approx(
        float(np.interp(0.9, y[up], t[up]) - np.interp(0.1, y[up], t[up])), abs=1e-7
    )
    assert found.height == pytest.approx(3e-6)
    assert abs(found.error) < 1e-12


def test_settling_of_a_first_order_step():
    y = 1e-6 * (1.0 - np.exp(-np.arange(20_000) * T_S / 0.01))
    assert motion.step(y, 0.0, 1e-6, T_S).settling == pytest.approx(0.01 * math.log(50.0), abs=2e-5)
    band = motion.step(y, 0.0, 1e-6, T_S, band=1e-9)
    assert band.settling == pytest.approx(0.01 * math.log(1000.0), abs=2e-4)


def test_a_step_down_is_mirrored():
    y = second_order(0.4, 2000.0)
    up, down = motion.step(y, 0.0, 1.0, T_S), motion.step(-y, 0.0, -1.0, T_S)
    assert (up.rise, up.settling, up.overshoot) == pytest.approx(
        (down.rise, down.settling, down.overshoot)
    )


def test_a_step_that_never_settles_has_no_time():
    y = 1.0 + 0.1 * np.sin(np.arange(5000) * 0.1)
    assert math.isnan(motion.step(y, 0.0, 1.0, T_S).settling)


def test_width_of_a_play_loop_is_twice_its_threshold():
    u = np.concatenate([np.linspace(0, 10, 500), np.linspace(10, 0, 500)])
    r, z, y = 1.5, 1.5, []
    for each in u:
        z = min(max(z, each - r), each + r)
        y.append(z)
    width, stroke = motion.loop_width(u, np.array(y), 500)
    assert width == pytest.approx(2.0 * r, abs=0.03)
    assert stroke == pytest.approx(10.0 - 2.0 * r, abs=0.03)


def test_linearity_of_a_parabola():
    """The largest distance of x^2 on 0..1 from its least-squares line x - 1/6 is 1/6."""
    u = np.linspace(0.0, 1.0, 10_001)
    slope, off = motion.linearity(u, u * u)
    assert slope == pytest.approx(1.0, rel=1e-3)
    assert off == pytest.approx(1.0 / 6.0, rel=1e-3)


def test_logarithmic_creep_is_found():
    t = np.arange(1, 50_001) * 1e-3
    found = motion.creeping(1e-6 * (1.0 + 0.013 * np.log10(t / 0.1)), 1e-3)
    assert found["gamma_per_decade"] == pytest.approx(0.013, rel=0.01)
    assert found["left_nm"] < 0.1


def test_a_voltage_that_does_not_move_is_refused():
    with pytest.raises(ParameterError, match="does not go up and down"):
        motion.loop_width(np.zeros(10), np.zeros(10), 5)
