from __future__ import annotations

import numpy as np
import pytest

from pea_core.block import Block
from pea_observer.model import luenberger

control = pytest.importorskip("control")

C = np.array([[1.0, 0.0]])


def error_step(c: luenberger.Coefficients) -> np.ndarray:
    """How the error goes on over one sample."""
    F = np.array([[c.f11, c.f12], [c.f21, c.f22]])
    return (np.eye(2) - np.array([[c.l1], [c.l2]]) @ C) @ F


def test_both_poles_of_the_error_are_at_omega_o(bench):
    c = luenberger.design(luenberger.Params(omega_o=12000.0), bench.T_s)
    poles = np.linalg.eigvals(error_step(c))
    np.testing.assert_allclose(poles, np.exp(-12000.0 * bench.T_s), atol=1e-6)


def test_the_gain_is_that_of_acker(bench):
    c = luenberger.design(luenberger.Params(), bench.T_s)
    F, _ = bench.sampled()
    expected = np.ravel(control.acker(F.T, (C @ F).T, [np.exp(-1.0)] * 2))
    np.testing.assert_allclose([c.l1, c.l2], expected, rtol=1e-8)


def test_it_is_exact_from_rest_without_an_unknown_input(bench, drive):
    u = drive(300)
    x = bench.plant(u)
    estimates = bench.watch(Block(luenberger, luenberger.Params(), bench.T_s), x[:, 0], u)
    np.testing.assert_allclose(estimates[:, 0], x[:, 0], atol=1e-16)
    np.testing.assert_allclose(estimates[:, 1], x[:, 1], atol=1e-12)


def test_a_wrong_start_is_forgotten_at_the_rate_of_the_poles(bench, drive):
    u = drive(40)
    x = bench.plant(u, x0=(5e-6, 0.0))
    params = luenberger.Params(omega_o=10000.0)
    error = bench.watch(Block(luenberger, params, bench.T_s), x[:, 0], u)[:, 0] - x[:, 0]
    p = np.exp(-0.5)  # a double pole: e_{k+2} = 2 p e_{k+1} - p^2 e_k
    np.testing.assert_allclose(error[12:32], 2 * p * error[11:31] - p * p * error[10:30], rtol=1e-4)
    assert abs(error[10]) > 1e-9


def test_its_bias_under_a_constant_unknown_input_has_a_closed_form(bench, drive):
    eps, u = 5.0, drive(400)
    x = bench.plant(u, eps)
    bias = (
        (bench.watch(Block(luenberger, luenberger.Params(), bench.T_s), x[:, 0], u)[-1, :2]) - x[-1]
    )
    F, G = bench.sampled()
    L = control.acker(F.T, (C @ F).T, [np.exp(-1.0)] * 2).reshape(2, 1)
    keep = np.eye(2) - L @ C
    expected = -np.linalg.solve(np.eye(2) - keep @ F, keep @ G * eps)
    np.testing.assert_allclose(bias, expected, rtol=1e-6)
    assert abs(expected[1]) > 300e-6  # um/s: no small matter


def test_it_gives_no_unknown_input(bench, drive):
    u = drive(30)
    x = bench.plant(u, 5.0)
    estimates = bench.watch(Block(luenberger, luenberger.Params(), bench.T_s), x[:, 0], u)
    assert not estimates[:, 2].any()
