from __future__ import annotations

import numpy as np
import pytest

from pea_core.block import Block
from pea_core.params import ParameterError
from pea_core.signals import Measurement
from pea_observer.model import extended_state

control = pytest.importorskip("control")

C = np.array([[1.0, 0.0, 0.0]])


def matrices(c: extended_state.Coefficients) -> tuple[np.ndarray, np.ndarray]:
    F = np.array([[c.f11, c.f12, c.f13], [c.f21, c.f22, c.f23], [0.0, 0.0, 1.0]])
    return F, np.array([[c.l1], [c.l2], [c.l3]])


def test_all_poles_of_the_error_are_at_omega_o(bench):
    F, L = matrices(extended_state.design(extended_state.Params(), bench.T_s))
    polynomial = np.poly((np.eye(3) - L @ C) @ F)
    np.testing.assert_allclose(polynomial, np.poly([np.exp(-1.0)] * 3), rtol=1e-6)


def test_the_gain_is_that_of_acker(bench):
    F, L = matrices(extended_state.design(extended_state.Params(), bench.T_s))
    scale = np.diag([1e-6, 1e-2, 1.0])  # um, cm/s, V: acker wants numbers of a size
    F_s, C_s = np.linalg.solve(scale, F @ scale), C @ scale
    expected = scale @ np.reshape(control.acker(F_s.T, (C_s @ F_s).T, [np.exp(-1.0)] * 3), (3, 1))
    np.testing.assert_allclose(L, expected, rtol=1e-6)


def test_the_model_holds_the_unknown_input_as_it_holds_the_voltage(bench):
    c = extended_state.design(extended_state.Params(), bench.T_s)
    F, G = bench.sampled()
    np.testing.assert_allclose([c.f11, c.f12, c.f21, c.f22], F.ravel(), rtol=1e-9)
    np.testing.assert_allclose([c.g1, c.g2], G, rtol=1e-9)
    np.testing.assert_allclose([c.f13, c.f23], G, rtol=1e-9)


@pytest.mark.parametrize("eps", [-12.0, 5.0])
def test_a_constant_unknown_input_is_found_without_bias(bench, drive, eps):
    u = drive(400)
    x = bench.plant(u, eps)
    last = bench.watch(Block(extended_state, extended_state.Params(), bench.T_s), x[:, 0], u)[-1]
    np.testing.assert_allclose(last, [*x[-1], eps], rtol=1e-7)


def test_a_ramp_of_eps_lags_by_three_poles_less_the_zeros(bench):
    # eps -> eps_hat is g z (z - z_0) / (z - p)^3, with the sampling zero z_0 = -0.8615
    p, slope = np.exp(-1.0), 0.01
    u = np.zeros(600)
    eps = slope * np.arange(600)
    x = bench.plant(u, eps)
    rows = bench.watch(Block(extended_state, extended_state.Params(), bench.T_s), x[:, 0], u)
    lag = 3.0 / (1.0 - p) - 1.0 - 1.0 / (1.0 + 0.8615)
    assert slope * 600 - rows[-1, 2] == pytest.approx(slope * lag, rel=1e-4)


@pytest.mark.parametrize("T_s", [1e-3, 5e-4, 125e-6])
def test_low_rates_do_not_diverge(bench, T_s):
    rng = np.random.default_rng(1)
    u = 40.0 + 10.0 * rng.standard_normal(2000)
    x = bench.plant(u, 5.0, T_s)
    block = Block(extended_state, extended_state.Params(), T_s)
    error = bench.watch(block, x[:, 0], u)[100:] - np.column_stack([x, np.full(2001, 5.0)])[100:]
    assert np.abs(error[:, 0]).max() < 1e-12
    assert np.abs(error[:, 2]).max() < 1e-5


def test_an_euler_step_would_diverge_at_one_millisecond():
    # what the test above guards against
    A = np.array([[0.0, 1.0], [-(5450.0**2), -2 * 0.82 * 5450.0]])
    assert np.abs(np.linalg.eigvals(np.eye(2) + A * 1e-3)).max() > 1.0


def test_it_predicts_with_the_voltage_applied_not_with_the_command(bench):
    command = np.concatenate([np.full(20, 60.0), np.full(280, 150.0)])
    applied = np.clip(np.concatenate([[0.0], command[:-1]]), -20.0, 110.0)  # late and limited
    x = bench.plant(applied)
    told = bench.watch(Block(extended_state, extended_state.Params(), bench.T_s), x[:, 0], applied)
    np.testing.assert_allclose(told[:, 2], 0.0, atol=1e-6)
    blind = bench.watch(Block(extended_state, extended_state.Params(), bench.T_s), x[:, 0], command)
    assert blind[-1, 2] == pytest.approx(110.0 - 150.0, rel=1e-6)


def test_output_changes_nothing(bench):
    block = Block(extended_state, extended_state.Params(), bench.T_s)
    measured = Measurement(1e-6, float("nan"), 10.0)
    assert block.output(measured) == block.output(measured)


def test_an_observer_that_cannot_be_designed_is_refused():
    with pytest.raises(ParameterError, match="does not determine"):
        extended_state.design(extended_state.Params(zeta=1.0, omega_n=1e6), 1e-3)
