from __future__ import annotations

import numpy as np
import pytest

from pea_core.block import Block
from pea_observer.model import alpha_beta

T_S = 50e-6


def test_both_poles_of_the_error_are_at_omega_o(poles):
    c = alpha_beta.design(alpha_beta.Params(omega_o=8000.0), T_S)
    p = np.exp(-8000.0 * T_S)
    np.testing.assert_allclose(np.poly(poles(alpha_beta, c)), np.poly([p, p]), rtol=1e-9)


def test_a_constant_velocity_is_found(bench):
    t = np.arange(500) * T_S
    block = Block(alpha_beta, alpha_beta.Params(), T_S)
    last = bench.watch(block, 1e-3 * t, np.zeros(499))[-1]
    np.testing.assert_allclose(last[:2], [1e-3 * t[-1], 1e-3], rtol=1e-9)


def test_its_lag_under_a_constant_acceleration_has_a_closed_form(bench):
    a, p = 3.0, np.exp(-5000.0 * T_S)
    t = np.arange(2000) * T_S
    block = Block(alpha_beta, alpha_beta.Params(omega_o=5000.0), T_S)
    x1, x2, _ = bench.watch(block, a * t * t / 2.0, np.zeros(1999))[-1]
    assert a * t[-1] ** 2 / 2.0 - x1 == pytest.approx(a * T_S**2 * p**2 / (1 - p) ** 2, rel=1e-6)
    assert a * t[-1] - x2 == pytest.approx(a * T_S * ((1 + p) / (1 - p) - 0.5), rel=1e-6)


def test_it_does_not_look_at_the_voltage(bench):
    y = 1e-6 * np.sin(np.arange(50.0))
    told = [
        bench.watch(Block(alpha_beta, alpha_beta.Params(), T_S), y, np.full(49, u))
        for u in (0.0, 90.0)
    ]
    np.testing.assert_array_equal(told[0], told[1])
