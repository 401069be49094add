from __future__ import annotations

import numpy as np
import pytest

from pea_core.block import Block
from pea_observer.model import discrete_uio


def block(bench):
    return Block(discrete_uio, discrete_uio.Params(), bench.T_s)


def test_any_unknown_input_is_found_at_the_end_of_its_interval(bench, drive):
    u = drive(300)
    eps = 10.0 * np.random.default_rng(5).standard_normal(300)
    x = bench.plant(u, eps)
    rows = bench.watch(block(bench), x[:, 0], u)
    np.testing.assert_allclose(rows[1:, 2], eps, atol=1e-6)
    np.testing.assert_allclose(rows[:, 1], x[:, 1], atol=1e-9)


def test_its_poles_are_zero_and_the_sampling_zero(bench, poles):
    found = poles(discrete_uio, block(bench).c)
    np.testing.assert_allclose(np.sort(found), [-0.8615, 0.0], atol=5e-5)


def test_noise_of_0_7_nm_makes_0_154_volt_in_one_step(bench):
    y = np.zeros(10)
    y[3] = 0.7e-9
    assert bench.watch(block(bench), y, np.zeros(9))[3, 2] == pytest.approx(0.154, abs=5e-4)


def test_it_rings_at_the_nyquist_frequency(bench):
    y = np.zeros(12)
    y[3] = 0.7e-9
    eps = bench.watch(block(bench), y, np.zeros(11))[:, 2]
    np.testing.assert_allclose(eps[7:] / eps[6:-1], -0.8615, atol=1e-4)
