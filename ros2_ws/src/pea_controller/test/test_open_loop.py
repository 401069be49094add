"""Open loop: Eq 7 alone, its static part, and eps compensation on top."""

import math

import numpy as np
import pytest

from pea_controller.model import open_loop
from pea_core.block import Block
from pea_core.params import build
from pea_core.signals import Estimate, Reference

T_S = 50e-6
ZETA, OMEGA_N, K = 0.82, 5450.0, 0.142e-6
W = Reference(5e-6, 2e-3, -3.0)


def command(x=None, ahead=W, **values):
    law = Block(open_loop, build(open_loop.Params, values), T_S)
    return law.output(W, ahead, x or Estimate(1e-6, 1e-3, 4.0))


def test_static_part_is_w_over_K():
    assert command(feedforward=False) == pytest.approx(5e-6 / K, rel=1e-14)


def test_feedforward_inverts_the_nominal_model():
    inverse = (W.w_ddot + 2 * ZETA * OMEGA_N * W.w_dot + OMEGA_N**2 * W.w) / (K * OMEGA_N**2)
    assert command() == pytest.approx(inverse, rel=1e-12)


def test_it_looks_where_the_preview_looks():
    assert command(ahead=Reference(6e-6, 0.0, 0.0)) == pytest.approx(6e-6 / K, rel=1e-14)


def test_nothing_is_fed_back():
    assert command(Estimate(1e-6, 1e-3, 4.0)) == command(Estimate(-2e-6, 5.0, 0.0))


def test_eps_is_subtracted_where_asked_for():
    assert command(eps_compensation=True) == pytest.approx(command() - 4.0, rel=1e-14)


def test_hysteresis_costs_the_known_error_at_10_hz(simulate, sine):
    law = Block(open_loop, build(open_loop.Params, {"feedforward": False}), T_S)
    w = sine(10.0)
    run = simulate(law, w, 6000, hysteresis=True)
    error = (run.x1 - [w(k * T_S).w for k in range(6000)])[2000:]
    assert math.sqrt(np.mean(error**2)) * 1e9 == pytest.approx(578.0, rel=2e-3)
