"""Sliding mode control with a boundary layer: saturation, static error, no chattering."""

import numpy as np
import pytest

from pea_controller.model import pidsmc, smc, smc_boundary_layer
from pea_core.block import Block
from pea_core.params import build
from pea_core.signals import Estimate, Reference

T_S = 50e-6
REST = Reference(0.0, 0.0, 0.0)
WIDE = {"voltage_min": -1e4, "voltage_max": 1e4}


def block(model=smc_boundary_layer, **values):
    return Block(model, build(model.Params, {**WIDE, **values}), T_S)


@pytest.mark.parametrize(
    ("x", "expected"), [(0.3, 0.3), (-0.3, -0.3), (1.5, 1.0), (-1.5, -1.0), (1.0, 1.0)]
)
def test_sat(x, expected):
    assert smc_boundary_layer.sat(x) == expected


def test_outside_the_layer_it_is_the_sliding_mode_law():
    x = Estimate(3e-6, 0.0, 0.0)
    layered = block(m=5000.0, eta=9.0, phi=10000.0).output(REST, REST, x)
    assert layered == block(smc, m=5000.0, eta=9.0).output(REST, REST, x)


def test_inside_the_layer_it_is_pidsmc_with_P_alone():
    x = Estimate(0.3e-6, 2e-4, 0.0)
    layered = block(m=5000.0, eta=9.0, phi=10000.0).output(REST, REST, x)
    linear = block(pidsmc, m=5000.0, P=9.0 / 10000.0, I=0.0, D_c=0.0).output(REST, REST, x)
    assert layered == pytest.approx(linear, rel=1e-12)


@pytest.mark.parametrize("eps", [-5.0, 2.0, 7.0])
def test_static_error_is_eps_phi_over_eta_m(simulate, eps):
    law = block(m=8000.0, eta=12.0, phi=6000.0)
    run = simulate(law, lambda t: REST, 2000, eps=eps)
    assert run.x1[-1] == pytest.approx(eps * 6000.0e-6 / (12.0 * 8000.0), rel=1e-9)


def test_static_error_vanishes_where_eps_is_compensated(simulate):
    law = block(m=8000.0, eta=12.0, phi=6000.0, eps_compensation=True)
    run = simulate(law, lambda t: REST, 200, eps=5.0, tell=True)
    assert np.abs(run.x1).max() < 1e-18


def test_it_does_not_chatter(simulate):
    run = simulate(block(m=8000.0, eta=12.0, phi=6000.0), lambda t: REST, 2000, eps=5.0)
    assert np.abs(np.diff(run.u[1000:])).max() < 1e-9


def test_saturation_in_and_out_recovers(simulate):
    levels = [Reference(w, 0.0, 0.0) for w in (6e-6, 30e-6, 6e-6)]
    law = block(m=8000.0, eta=12.0, phi=6000.0, voltage_min=0.0, voltage_max=90.0)
    run = simulate(law, lambda t: levels[min(int(t / 0.01), 2)], 1500, limits=(0.0, 90.0))
    assert run.x1[399] > 10e-6
    assert abs(run.x1[-1] - 6e-6) < 1e-12
