"""Levels: where and when, smooth or linear, raw steps, exact derivatives."""

import numpy as np
import pytest

from pea_core.params import ParameterError
from pea_reference.model import levels

T_S = 1e-3


def rows(samples=700, **values):
    c = levels.design(levels.Params(**values), T_S)
    return np.array([levels.output(c, k) for k in range(samples)])


def test_it_goes_to_each_level_in_time_and_stays():
    w = rows(levels_um=(2.0, -1.0), move_s=(0.1, 0.2), hold_s=(0.05, 0.3))[:, 0] * 1e6
    assert w[0] == 0.0
    np.testing.assert_allclose(w[[100, 149, 350, 699]], [2.0, 2.0, -1.0, -1.0])
    assert w[50] == pytest.approx(1.0)
    assert w[250] == pytest.approx(0.5)


def test_derivatives_are_those_of_w():
    W = rows(levels_um=(2.0, -1.0), move_s=(0.2,), hold_s=(0.1,))
    np.testing.assert_allclose(np.gradient(W[:, 0], T_S), W[:, 1], atol=2e-7)
    np.testing.assert_allclose(np.gradient(W[:, 1], T_S), W[:, 2], atol=2e-5)


def test_linear_and_raw():
    w = rows(levels_um=(1.0, 3.0), move_s=(0.1, 0.0), hold_s=(0.1,), shape="linear")
    np.testing.assert_allclose(w[:100, 0], np.arange(100) * 1e-8, atol=1e-20)
    assert w[50, 1] == pytest.approx(1e-5)
    assert (w[199, 0], w[200, 0], w[200, 1]) == pytest.approx((1e-6, 3e-6, 0.0))


def test_counts_must_fit():
    with pytest.raises(ParameterError, match="move_s has 3 values: give one, or one for each"):
        levels.Params(levels_um=(1.0, 2.0), move_s=(1.0, 1.0, 1.0))
    with pytest.raises(ParameterError, match="levels_um is empty"):
        levels.Params(levels_um=())
