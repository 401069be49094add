from __future__ import annotations

import numpy as np

from pea_core.block import Block
from pea_observer.model import extended_state, kalman_rate

UNITS = np.array([1e-6, 1e-2, 1.0, 1e4])


def test_the_gain_is_where_the_covariance_recursion_ends(bench):
    T, q = bench.T_s, 1e5
    F2, G2 = bench.sampled()
    F = np.zeros((4, 4))
    F[:2, :2], F[:2, 2], F[:2, 3] = F2, G2, G2 * T
    F[2, 2:], F[3, 3] = (1.0, T), 1.0
    # eps' walks: its double integral over one sample, in many small steps
    drive = np.zeros((4, 4))
    for theta in (np.arange(2000) + 0.5) / 2000 * T:
        hit = np.array([G2[0] * theta, G2[1] * theta, theta, 1.0])
        drive += np.outer(hit, hit) * q**2 * T / 2000
    F, drive = F * UNITS / UNITS[:, None], drive / np.outer(UNITS, UNITS)
    P, R = np.eye(4), (0.7e-3) ** 2
    for _ in range(4000):
        P = F @ P @ F.T + drive
        L = P[:, 0] / (P[0, 0] + R)
        P = P - np.outer(L, P[0])
    c = kalman_rate.design(kalman_rate.Params(noise_nm=0.7, eps_rate_walk=q), T)
    np.testing.assert_allclose([c.l1, c.l2, c.l3, c.l4], L * UNITS / 1e-6, rtol=1e-4)


def test_a_ramp_of_eps_is_followed_without_lag(bench):
    u, eps = np.zeros(1500), 0.02 * np.arange(1500)
    x = bench.plant(u, eps)
    block = Block(kalman_rate, kalman_rate.Params(), bench.T_s)
    last = bench.watch(block, x[:, 0], u)[-1]
    np.testing.assert_allclose(last, [*x[-1], eps[-1]], rtol=1e-8)
    lagging = Block(extended_state, extended_state.Params(), bench.T_s)
    assert eps[-1] - bench.watch(lagging, x[:, 0], u)[-1, 2] > 0.04


def test_its_state_knows_the_slope(bench):
    u, eps = np.zeros(1500), 0.02 * np.arange(1500)
    block = Block(kalman_rate, kalman_rate.Params(), bench.T_s)
    bench.watch(block, bench.plant(u, eps)[:, 0], u)
    np.testing.assert_allclose(block.s.eps_dot, 0.02 / bench.T_s, rtol=1e-7)
