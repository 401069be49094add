from __future__ import annotations

import numpy as np
import pytest

from pea_core.block import Block
from pea_core.params import ParameterError
from pea_observer.model import extended_state, kalman
from pea_observer.model.current_form import kalman_gain

UNITS = np.array([1e-6, 1e-2, 1.0])


def test_the_gain_is_where_the_covariance_recursion_ends(bench):
    F2, G2 = bench.sampled()
    F = np.eye(3)
    F[:2, :2], F[:2, 2] = F2, G2
    F = F * UNITS / UNITS[:, None]
    walk = np.array([G2[0] / 1e-6, G2[1] / 1e-2, 1.0]) * 30.0 * np.sqrt(bench.T_s)
    P, R = np.eye(3), (0.7e-3) ** 2
    for _ in range(3000):
        P = F @ P @ F.T + np.outer(walk, walk)
        L = P[:, 0] / (P[0, 0] + R)
        P = P - np.outer(L, P[0])
    c = kalman.design(kalman.Params(noise_nm=0.7, eps_walk=30.0), bench.T_s)
    np.testing.assert_allclose([c.l1, c.l2, c.l3], L * UNITS / 1e-6, rtol=1e-5)


def test_only_the_ratio_of_the_noises_counts(bench):
    a = kalman.design(kalman.Params(noise_nm=0.7, eps_walk=30.0), bench.T_s)
    b = kalman.design(kalman.Params(noise_nm=7.0, eps_walk=300.0), bench.T_s)
    np.testing.assert_allclose(a, b, rtol=1e-6)


def test_no_pole_placed_does_better_on_its_own_walk(bench):
    rng = np.random.default_rng(7)
    n, q = 6_000, 30.0
    eps = np.cumsum(q * np.sqrt(bench.T_s) * rng.standard_normal(n))
    x = bench.plant(np.zeros(n), eps)
    y = x[:, 0] + 0.7e-9 * rng.standard_normal(n + 1)

    def rms(block):
        rows = bench.watch(block, y, np.zeros(n))[1000:]
        return np.sqrt(np.mean((rows[:, 2] - eps[999:]) ** 2))

    best = rms(Block(kalman, kalman.Params(noise_nm=0.7, eps_walk=q), bench.T_s))
    for omega_o in (15e3, 20e3, 30e3, 45e3):
        other = Block(extended_state, extended_state.Params(omega_o=omega_o), bench.T_s)
        assert best < rms(other)


def test_noises_without_a_solution_are_refused():
    with pytest.raises(ParameterError, match=r"Riccati|decay"):
        kalman_gain(np.diag([1.0, 1.1]), np.array([[1.0, 0.0]]), np.eye(2), 1.0, np.ones(2))
