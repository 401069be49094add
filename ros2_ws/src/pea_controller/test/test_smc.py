"""Sliding mode control: reaching law, chattering, robustness."""

import numpy as np
import pytest

from pea_controller.model import smc
from pea_core.block import Block
from pea_core.params import build
from pea_core.signals import Estimate, Reference

T_S = 50e-6
B2 = 0.142e-6 * 5450.0**2
REST = Reference(0.0, 0.0, 0.0)
WIDE = {"voltage_min": -1e4, "voltage_max": 1e4}


def block(T_s=T_S, **values):
    return Block(smc, build(smc.Params, {**WIDE, **values}), T_s)


@pytest.mark.parametrize(("x", "expected"), [(3.0, 1.0), (-1e-300, -1.0), (0.0, 0.0)])
def test_sgn(x, expected):
    assert smc.sgn(x) == expected


def test_on_the_reference_the_command_is_the_feedforward():
    u = block().output(*[Reference(1.42e-6, 0.0, 0.0)] * 2, Estimate(1.42e-6, 0.0, 0.0))
    assert u == pytest.approx(10.0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_eta_acts_against_q(sign):
    x = Estimate(sign * 1e-6, 0.0, 0.0)
    gap = block(eta=9.0).output(REST, REST, x) - block(eta=0.0).output(REST, REST, x)
    assert gap == pytest.approx(-9.0 * sign, rel=1e-12)


def test_q_reaches_zero_at_the_rate_of_eq_11(simulate):
    # q' = B2 (eps - eta) from q_0 > 0: reached after q_0 / (B2 (eta - eps)).
    m, eta, eps, T_s = 5000.0, 12.0, 5.0, 1e-7
    run = simulate(block(T_s, m=m, eta=eta), lambda t: REST, 6000, x0=(1e-6, 0.0), eps=eps)
    q = m * run.x1 + run.x2
    reached = np.flatnonzero(q <= 0.0)[0] * T_s
    assert reached == pytest.approx(m * 1e-6 / (B2 * (eta - eps)), rel=5e-3)


def test_after_reaching_q_stays_within_two_steps_of_zero(simulate):
    m, eta, eps = 5000.0, 12.0, 5.0
    run = simulate(block(m=m, eta=eta), lambda t: REST, 2000, x0=(1e-6, 0.0), eps=eps)
    q = (m * run.x1 + run.x2)[400:]
    assert np.abs(q).max() < 2 * B2 * (eta + eps) * T_S


def test_command_chatters(simulate):
    run = simulate(block(m=5000.0, eta=12.0), lambda t: REST, 4000, eps=5.0)
    assert np.sqrt(np.mean(np.diff(run.u[2000:]) ** 2)) > 12.0


def test_eta_below_eps_does_not_hold_the_reference(simulate):
    run = simulate(block(eta=4.0), lambda t: REST, 4000, eps=5.0)
    assert abs(run.x1[-1]) > 10 * 1e-9


def test_compensated_eps_needs_no_eta(simulate):
    law = block(eta=0.0, eps_compensation=True)
    run = simulate(law, lambda t: REST, 100, eps=5.0, tell=True)
    assert np.abs(run.x1).max() < 1e-18
