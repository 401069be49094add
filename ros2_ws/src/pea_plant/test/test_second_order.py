import math

import control
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import cont2discrete

from pea_core.params import build
from pea_plant.drivers.simulated import Params, Simulated
from pea_plant.model.actuator import actuator

T_S = 50e-6
NOMINAL = ["zeta", "omega_n", "K"]


def displacements(values, voltages):
    """Noise-free displacement (m) at each sample of the actuator without hysteresis."""
    plant = Simulated(build(Params, values), T_S)
    y = []
    for u in voltages:
        y.append(plant.read().y)
        plant.write(u)
    return np.array(y)


def transfer(zeta, omega_n, K):
    return control.tf([K * 1e-6 * omega_n**2], [1.0, 2.0 * zeta * omega_n, omega_n**2])


@pytest.mark.parametrize("zeta", [0.05, 0.82, 1.0, 3.0])
def test_discretisation_agrees_with_scipy(zeta):
    params = build(Params, {"zeta": zeta})
    c = actuator(params).design(params, T_S)
    A = np.array([[0.0, 1.0], [-(5450.0**2), -2.0 * zeta * 5450.0]])
    B = np.array([[0.0], [0.142e-6 * 5450.0**2]])
    A_d, B_d, *_ = cont2discrete((A, B, np.eye(2), np.zeros((2, 1))), T_S)
    np.testing.assert_allclose(c.A_d, A_d, rtol=1e-12)
    np.testing.assert_allclose(c.B_d, B_d[:, 0], rtol=1e-12)


def test_step_response_is_the_closed_form():
    zeta, omega_n, K = 0.82, 5450.0, 0.142e-6
    t = np.arange(200) * T_S
    omega_d = omega_n * math.sqrt(1.0 - zeta**2)
    decay = np.exp(-zeta * omega_n * t)
    expected = (
        10.0
        * K
        * (1.0 - decay * (np.cos(omega_d * t) + zeta * omega_n / omega_d * np.sin(omega_d * t)))
    )
    y = displacements({}, [10.0] * 200)
    np.testing.assert_allclose(y, expected, atol=1e-18)


@pytest.mark.parametrize("values", [(0.82, 5450.0, 0.142), (0.1, 3000.0, 0.2), (2.0, 8000.0, 0.1)])
def test_response_to_held_voltages_agrees_with_python_control(values):
    u = np.random.default_rng(3).uniform(-20.0, 110.0, 300)
    sampled = control.sample_system(transfer(*values), T_S, "zoh")
    expected = control.forced_response(sampled, np.arange(300) * T_S, u).outputs
    y = displacements(dict(zip(NOMINAL, values, strict=True)), u)
    np.testing.assert_allclose(y, expected, atol=1e-12, rtol=0)


def test_free_motion_is_the_matrix_exponential():
    plant = Simulated(build(Params, {"x10_um": 5.0, "x20_um_s": -300.0}), T_S)
    A = np.array([[0.0, 1.0], [-(5450.0**2), -2.0 * 0.82 * 5450.0]])
    for _ in range(40):
        plant.read()
        plant.write(0.0)
    expected = expm(A * 40 * T_S) @ [5e-6, -300e-6]
    assert plant.truth[:2] == pytest.approx(expected, rel=1e-11)


def test_frequency_response_has_the_paper_model_s_bandwidth():
    G = transfer(0.82, 5450.0, 0.142)
    assert abs(G(2j * math.pi * 732.4)) / 0.142e-6 == pytest.approx(math.sqrt(0.5), rel=1e-4)
    f, n = 732.4, 20000
    u = np.sin(2.0 * math.pi * f * np.arange(n) * T_S)
    y = displacements({}, u)
    last = np.exp(-2j * math.pi * f * np.arange(n) * T_S)[-10000:]
    gain = 2.0 * abs(np.mean(y[-10000:] * last))
    hold_gain = np.sinc(f * T_S)
    assert gain / hold_gain / 0.142e-6 == pytest.approx(math.sqrt(0.5), rel=1e-2)
