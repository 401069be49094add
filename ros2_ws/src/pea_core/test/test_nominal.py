import math

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import cont2discrete

from pea_core.nominal import NominalModel, hold, ramping, state_space

PAPER = NominalModel()
MODELS = [PAPER, NominalModel(zeta=0.02, omega_n=900.0, K=1.3), NominalModel(zeta=3.0)]
PERIODS = [50e-6, 1e-3]


def transfer_function(model: NominalModel) -> control.TransferFunction:
    """K omega_n^2 / (s^2 + 2 zeta omega_n s + omega_n^2), K in m/V."""
    w2 = model.omega_n**2
    return control.tf([model.K * 1e-6 * w2], [1.0, 2.0 * model.zeta * model.omega_n, w2])


def test_defaults_are_the_papers_actuator():
    assert (PAPER.zeta, PAPER.omega_n, PAPER.K) == (0.82, 5450.0, 0.142)


def test_input_gain_of_the_papers_actuator():
    _, B, _ = state_space(PAPER)
    assert B[1, 0] == pytest.approx(4.21776, rel=1e-5)  # m/(V s^2)


@pytest.mark.parametrize("model", MODELS)
def test_state_space_has_the_transfer_function_of_eq_1(model):
    system = control.ss(*state_space(model), 0.0)
    s = 1j * np.logspace(1, 5, 60)
    assert system(s) == pytest.approx(transfer_function(model)(s), rel=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_steady_state_gain_is_K(model):
    A, B, C = state_space(model)
    assert (-C @ np.linalg.solve(A, B)).item() == pytest.approx(model.K * 1e-6, rel=1e-12)


@pytest.mark.parametrize("model", MODELS)
def test_poles_have_the_natural_frequency_and_the_damping(model):
    omega, zeta, _ = control.damp(control.ss(*state_space(model), 0.0), doprint=False)
    assert math.sqrt(omega[0] * omega[1]) == pytest.approx(model.omega_n, rel=1e-9)
    assert (zeta @ omega) / (2.0 * model.omega_n) == pytest.approx(model.zeta, rel=1e-9)


def test_second_state_is_the_velocity_of_the_first():
    A, B, C = state_space(PAPER)
    assert (A[0].tolist(), B[0].tolist(), C.tolist()) == ([0.0, 1.0], [0.0], [[1.0, 0.0]])


@pytest.mark.parametrize("T_s", PERIODS)
@pytest.mark.parametrize("model", MODELS)
def test_hold_agrees_with_scipy(model, T_s):
    A, B, C = state_space(model)
    A_d, B_d, *_ = cont2discrete((A, B, C, np.zeros((1, 1))), T_s, "zoh")
    got_A, got_B = hold(A, B, T_s)
    np.testing.assert_allclose(got_A, A_d, rtol=1e-11)
    np.testing.assert_allclose(got_B, B_d, rtol=1e-11)


@pytest.mark.parametrize("T_s", PERIODS)
@pytest.mark.parametrize("model", MODELS)
def test_hold_agrees_with_python_control_in_its_transfer_function(model, T_s):
    A, B, C = state_space(model)
    z = np.exp(1j * np.linspace(0.01, math.pi, 40))
    # a hold does not mind the units of time and gain; with these no digits are lost there
    unit = control.tf([1.0], [1.0, 2.0 * model.zeta, 1.0])
    sampled = control.sample_system(unit, model.omega_n * T_s, method="zoh")
    expected = model.K * 1e-6 * sampled(z)
    got = control.ss(*hold(A, B, T_s), C, 0.0, T_s)(z)
    np.testing.assert_allclose(got, expected, rtol=1e-9)


@pytest.mark.parametrize("T_s", PERIODS)
def test_hold_steps_along_the_closed_form_step_response(T_s):
    zeta, omega_n = PAPER.zeta, PAPER.omega_n
    omega_d = omega_n * math.sqrt(1.0 - zeta * zeta)
    A, B, _ = state_space(PAPER)
    A_d, B_d = hold(A, B, T_s)
    x = np.zeros((2, 1))
    for k in range(1, 40):
        x = A_d @ x + B_d * 10.0
        t = k * T_s
        decay = math.exp(-zeta * omega_n * t)
        swing = math.cos(omega_d * t) + zeta * omega_n / omega_d * math.sin(omega_d * t)
        assert x[0, 0] == pytest.approx(10.0 * 0.142e-6 * (1.0 - decay * swing), rel=1e-9)


def test_sampling_zero_of_the_papers_actuator_at_20_khz():
    A, B, C = state_space(PAPER)
    A_d, B_d = hold(A, B, 50e-6)
    b_1 = (C @ B_d).item()
    b_2 = (C @ A_d @ B_d).item() - np.trace(A_d) * b_1
    assert b_1 == pytest.approx(4.540e-9, rel=1e-3)  # m/V
    assert -b_2 / b_1 == pytest.approx(-0.8615, abs=1e-4)


def test_hold_takes_several_inputs_and_a_singular_matrix():
    A = np.array([[0.0, 1.0], [0.0, 0.0]])
    A_d, B_d = hold(A, np.eye(2), 0.1)
    np.testing.assert_allclose(A_d, [[1.0, 0.1], [0.0, 1.0]], rtol=1e-14)
    np.testing.assert_allclose(B_d, [[0.1, 0.005], [0.0, 0.1]], rtol=1e-14, atol=1e-17)


@given(
    zeta=st.floats(0.01, 10.0),
    omega_n=st.floats(1.0, 1e5),
    T_s=st.floats(1e-5, 1e-3),
)
@settings(deadline=None, max_examples=25)
def test_two_steps_of_hold_are_one_of_twice_the_period(zeta, omega_n, T_s):
    A, B, _ = state_space(NominalModel(zeta, omega_n, 1.0))
    A_1, B_1 = hold(A, B, T_s)
    A_2, B_2 = hold(A, B, 2.0 * T_s)
    scale = np.array([1.0, omega_n])  # displacement and velocity in like units
    like = scale[None, :] / scale[:, None]
    np.testing.assert_allclose(A_1 @ A_1 * like, A_2 * like, atol=1e-9)
    np.testing.assert_allclose((A_1 @ B_1 + B_1)[:, 0] / scale, B_2[:, 0] / scale, atol=1e-15)


def test_a_ramp_of_eps_acts_within_the_sample_that_it_has_risen_in():
    A, B, _ = state_space(PAPER)
    F, G = hold(A, B, 50e-6)
    step, into = ramping(F, G, 50e-6)
    x, eps, eps_dot = np.array([3e-6, 0.02]), 4.0, -900.0
    x_1, eps_1 = F @ x + G[:, 0] * (eps - 0.045), eps - 0.045
    after = step @ [*x, eps, eps_dot]
    assert after == pytest.approx([*x_1, eps_1, eps_dot], rel=1e-12)
    assert into @ [2.0, 7.0] == pytest.approx([*(2.0 * G[:, 0]), 2.0, 7.0], rel=1e-12)
