"""Feedforward of Eq 7, limits, and the rules of the common parameters."""

import numpy as np
import pytest

from pea_controller.model.common import CommonParams, feedforward, limited, waits
from pea_core.params import ParameterError, build
from pea_core.signals import Reference


def test_feedforward_is_eq_7_in_matrices():
    A = np.array([[0.0, 1.0], [-(5450.0**2), -2 * 0.82 * 5450.0]])
    B = np.array([[0.0], [0.142e-6 * 5450.0**2]])
    W, W_dot = np.array([3e-6, 2e-3]), np.array([2e-3, -5.0])
    expected = (np.linalg.inv(B.T @ B) @ B.T @ (W_dot - A @ W))[0]
    got = feedforward(A[1, 0], A[1, 1], B[1, 0], Reference(3e-6, 2e-3, -5.0))
    assert got == pytest.approx(expected, rel=1e-12)


def test_feedforward_of_a_level_is_the_level_over_K():
    p = CommonParams()
    assert feedforward(p.A21, p.A22, p.B2, Reference(1.42e-6, 0.0, 0.0)) == pytest.approx(10.0)


@pytest.mark.parametrize(
    ("u", "expected"), [(-20.1, True), (-20.0, False), (110.0, False), (110.1, True)]
)
def test_command_is_limited_outside_the_range(u, expected):
    assert limited(u, -20.0, 110.0) is expected


def test_empty_range_of_voltage_is_refused():
    with pytest.raises(ParameterError, match="voltage_min = 50: must be below voltage_max"):
        build(CommonParams, {"voltage_min": 50.0, "voltage_max": 40.0})


@pytest.mark.parametrize(
    ("preview", "delay", "expected"), [(0.0, 1, 0.0), (0.5, 0, 0.5), (0.5, 1, 1.5)]
)
def test_preview_covers_the_delay_where_it_is_asked_for(preview, delay, expected):
    assert CommonParams(preview_samples=preview, delay_samples=delay).preview == expected


@pytest.mark.parametrize(
    ("u", "push", "spare", "expected"),
    [
        (50.0, 1.0, 0, False),
        (50.0, -1.0, 5, False),
        (111.0, 1.0, 5, True),
        (111.0, -1.0, 5, True),
        (111.0, 1.0, 0, True),
        (111.0, -1.0, 0, False),
        (-21.0, -1.0, 0, True),
        (-21.0, 1.0, 0, False),
        (-21.0, 1.0, 1, True),
    ],
)
def test_integral_waits_while_limited_and_leads_back_once_patience_is_over(
    u, push, spare, expected
):
    assert waits(u, push, -20.0, 110.0, spare) is expected
