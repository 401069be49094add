from __future__ import annotations

import numpy as np
import pytest

from pea_core.block import Block
from pea_core.nominal import NominalModel
from pea_core.params import ParameterError
from pea_observer.model import pid_sliding_mode

A22, A21, B2 = -2 * 0.82 * 5450.0, -(5450.0**2), 0.142e-6 * 5450.0**2


@pytest.mark.parametrize("omega_o", [3000.0, 20000.0])
def test_three_poles_are_at_omega_o_and_the_filter_has_its_own(bench, poles, omega_o):
    c = pid_sliding_mode.design(pid_sliding_mode.Params(omega_o=omega_o), bench.T_s)
    p = np.exp(-omega_o * bench.T_s)
    found = np.poly(poles(pid_sliding_mode, c))
    np.testing.assert_allclose(found, np.poly([p, p, p, c.gamma, 0.0]), atol=1e-6)


def test_the_filter_takes_the_zero_of_the_sampled_plant(bench):
    F, G = bench.sampled()
    step = [G, F @ G, F @ F @ G]  # C Phi (zI - Phi)^-1 Gamma starts n, n', ...
    n, n_next = step[1][0], step[2][0]
    zero = -(n_next / n + -np.trace(F))
    c = pid_sliding_mode.design(pid_sliding_mode.Params(), bench.T_s)
    assert c.gamma == pytest.approx(zero, rel=1e-6)


def test_sampled_fast_the_gains_are_those_of_continuous_time():
    omega_o, T_s = 6000.0, 1e-7
    c = pid_sliding_mode.design(pid_sliding_mode.Params(omega_o=omega_o), T_s)
    found = [c.P, c.I_T / T_s, c.D_T / (1 - c.gamma) * T_s]
    expected = np.array([3 * omega_o**2 + A21, omega_o**3, 3 * omega_o + A22]) / B2
    np.testing.assert_allclose(found, expected, rtol=0.01)


def test_what_the_sampled_plant_cannot_tell_is_refused():
    with pytest.raises(ParameterError, match="does not determine eps"):
        pid_sliding_mode.design(
            pid_sliding_mode.Params(**vars(NominalModel(zeta=10.0, omega_n=1e6))), 0.1
        )


def test_the_injection_is_all_that_moves_the_model(bench, drive):
    u = drive(50)
    x = bench.plant(u, 3.0)
    rows = bench.watch(Block(pid_sliding_mode, pid_sliding_mode.Params(), bench.T_s), x[:, 0], u)
    F, G = bench.sampled()
    for k in range(1, 50):
        moved = F @ rows[k - 1, :2] + G * (u[k - 1] + rows[k, 2])
        np.testing.assert_allclose(rows[k, :2], moved, rtol=1e-9)
