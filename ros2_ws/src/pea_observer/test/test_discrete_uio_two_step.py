from __future__ import annotations

import numpy as np
import pytest

from pea_core.block import Block
from pea_observer.model import discrete_uio, discrete_uio_two_step

C = np.array([[1.0, 0.0]])


def block(bench, **values):
    return Block(discrete_uio_two_step, discrete_uio_two_step.Params(**values), bench.T_s)


def test_the_unknown_input_is_out_of_the_error(bench):
    c = block(bench).c
    F, G = bench.sampled()
    K = np.array([[c.k11, c.k12], [c.k21, c.k22]])
    M = np.array([(C @ G)[0], (C @ (F + np.eye(2)) @ G)[0]])
    np.testing.assert_allclose(K @ M, G, rtol=1e-9)
    assert c.h1 * M[0] + c.h2 * M[1] == pytest.approx(1.0, rel=1e-9)


def test_both_poles_of_the_error_are_at_omega_o(bench, poles):
    p = np.exp(-12000.0 * bench.T_s)
    found = poles(discrete_uio_two_step, block(bench, omega_o=12000.0).c)
    np.testing.assert_allclose(np.poly(found), np.poly([p, p, 0.0]), atol=1e-6)


def test_it_turns_noise_into_less_than_a_tenth_of_what_the_one_step_form_makes(bench):
    y = 0.7e-9 * np.random.default_rng(6).standard_normal(4000)
    told = [
        bench.watch(b, y, np.zeros(3999))[100:, 2].std()
        for b in (
            block(bench),
            Block(discrete_uio, discrete_uio.Params(), bench.T_s),
        )
    ]
    assert told[0] < 0.1 * told[1]
