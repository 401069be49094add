import control
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pea_core.params import ParameterError, build
from pea_plant.drivers.simulated import Params, Simulated
from pea_plant.model.actuator import actuator, linear

T_S = 50e-6
ON = {"creep.enabled": True}


def step_response(tau, weights, t):
    """F_c after a unit step."""
    return 1.0 + sum(w * (1.0 - np.exp(-t / a)) for a, w in zip(tau, weights, strict=True))


def test_default_operators_follow_log_creep():
    t = np.geomspace(0.05, 50.0, 2000)
    F = step_response((0.05, 0.5, 5.0, 50.0), [0.015] * 4, t)
    basis = np.stack([np.ones_like(t), np.log10(t)], axis=1)
    fit = basis @ np.linalg.lstsq(basis, F, rcond=None)[0]
    assert np.max(np.abs(F - fit) / F) < 0.0012


def test_joint_transfer_function_is_F_c_times_V():
    A, B, C = linear(build(Params, ON))
    V = control.tf([0.142e-6 * 5450.0**2], [1.0, 2.0 * 0.82 * 5450.0, 5450.0**2])
    F_c = 1 + sum(control.tf([0.015], [tau, 1.0]) for tau in (0.05, 0.5, 5.0, 50.0))
    for s in (0.01j, 1j, 100j, 5000j, 3.0 + 7j):
        response = (C @ np.linalg.solve(s * np.eye(len(A)) - A, B))[0, 0]
        assert response == pytest.approx((F_c * V)(s), rel=1e-9)


def test_joint_step_is_exact():
    values = {**ON, "creep.tau": [2e-4, 1e-3], "creep.weights": [0.3, 0.2]}
    plant = Simulated(build(Params, values), T_S)
    u = np.random.default_rng(1).uniform(0.0, 80.0, 60)
    for u_k in u:
        plant.read()
        plant.write(u_k)

    def slope(t, x):
        # V driven by F_c's output, each operator with its own held input
        v = u[min(int(t / T_S), 59)]
        drive = v + x[2] + x[3]
        return [
            x[1],
            5450.0**2 * (0.142e-6 * drive - x[0]) - 2.0 * 0.82 * 5450.0 * x[1],
            (0.3 * v - x[2]) / 2e-4,
            (0.2 * v - x[3]) / 1e-3,
        ]

    x = np.zeros(4)
    for k in range(60):
        ends = (k * T_S * (1 + 1e-12), (k + 1) * T_S * (1 - 1e-12))
        x = solve_ivp(slope, ends, x, "DOP853", rtol=1e-11, atol=1e-18).y[:, -1]
    assert plant.truth.x1 == pytest.approx(x[0], rel=1e-9)
    assert plant.truth.x2 == pytest.approx(x[1], rel=1e-7)


def test_without_creep_there_are_two_states():
    params = build(Params, {})
    assert actuator(params).design(params, T_S).A_d.shape == (2, 2)


def test_unequal_lists_are_refused():
    with pytest.raises(ParameterError, match="give one weight for each time constant"):
        build(Params, {**ON, "creep.tau": [1.0]})
