from __future__ import annotations

import numpy as np

from pea_core.block import Block
from pea_observer.model import passthrough


def test_it_hands_on_the_true_states(bench, drive):
    u = drive(50)
    x = bench.plant(u)
    block = Block(passthrough, passthrough.Params(), bench.T_s)
    estimates = bench.watch(block, x[:, 0], u, x[:, 1])
    np.testing.assert_array_equal(estimates[:, :2], x)


def test_it_knows_no_unknown_input(bench, drive):
    u = drive(50)
    x = bench.plant(u, 7.0)
    block = Block(passthrough, passthrough.Params(), bench.T_s)
    assert not bench.watch(block, x[:, 0], u, x[:, 1])[:, 2].any()


def test_it_says_that_it_needs_the_velocity():
    assert passthrough.NEEDS_VELOCITY
