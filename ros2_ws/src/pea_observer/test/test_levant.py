from __future__ import annotations

import math

import numpy as np
import pytest

from pea_core.block import Block
from pea_core.signals import Measurement
from pea_observer.model import extended_state, levant

B2 = 0.142e-6 * 5450.0**2


def correction(c, r):
    """What the innovation r adds to the estimate at rest."""
    return np.array(levant.output(c, levant.start(c), Measurement(r, math.nan, 0.0)))


@pytest.mark.parametrize("r", [1e-10, 1e-9, -3e-8, 1e-6])
def test_the_gain_is_the_linear_one_of_the_pole_that_r_asks_for(bench, r):
    c = levant.design(levant.Params(eps_rate=3e3, omega_min=10.0), bench.T_s)
    omega = (1.1 * B2 * 3e3 / abs(r)) ** (1.0 / 3.0)
    linear = extended_state.design(extended_state.Params(omega_o=omega), bench.T_s)
    np.testing.assert_allclose(correction(c, r) / r, [linear.l1, linear.l2, linear.l3], rtol=1e-6)


def test_a_large_innovation_meets_the_slowest_pole(bench):
    c = levant.design(levant.Params(eps_rate=1.0, omega_min=9000.0), bench.T_s)
    linear = extended_state.design(extended_state.Params(omega_o=9000.0), bench.T_s)
    np.testing.assert_allclose(
        correction(c, 1e-3) / 1e-3, [linear.l1, linear.l2, linear.l3], rtol=1e-6
    )


def test_eps_is_corrected_by_no_more_than_its_bound(bench):
    # |r|^0: in the limit of fast sampling every sample moves eps by 1.1 L T_s
    T_s = 1e-6
    c = levant.design(levant.Params(eps_rate=3e3, omega_min=100.0), T_s)
    for r in (1e-8, -1e-7, 1e-6):
        assert correction(c, r)[2] == pytest.approx(math.copysign(1.1 * 3e3 * T_s, r), rel=0.03)


@pytest.mark.parametrize("r", [0.0, -0.0, 5e-324, 1e-320])
def test_no_innovation_no_correction(bench, r):
    c = levant.design(levant.Params(), bench.T_s)
    assert np.abs(correction(c, r)).max() < 1e-300


def test_it_does_not_chatter(bench, drive):
    u = drive(600)
    x = bench.plant(u, 5.0)
    rows = bench.watch(Block(levant, levant.Params(), bench.T_s), x[:, 0], u)
    assert np.abs(np.diff(rows[300:, 2])).max() < 1e-6


def test_lock_is_kept_within_the_bound_and_lost_beyond(bench):
    u = np.zeros(2000)

    def lag(slope):
        eps = slope * bench.T_s * np.arange(2000)
        params = levant.Params(eps_rate=1e4, omega_min=1000.0)
        rows = bench.watch(Block(levant, params, bench.T_s), bench.plant(u, eps)[:, 0], u)
        return abs(eps[-1] - rows[-1, 2]) / (slope * bench.T_s)

    assert lag(5e3) < 4.0  # samples
    assert lag(3e4) > 40.0
