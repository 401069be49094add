import control
import numpy as np
import pytest

from pea_core.params import ParameterError, build
from pea_plant.drivers.simulated import Params, Simulated
from pea_plant.model.actuator import linear, steady_state_gain

T_S = 50e-6
MODES = {
    "vibration.type": "modal",
    "vibration.omega_n": [5450.0, 24000.0, 40000.0],
    "vibration.zeta": [0.82, 0.02, 0.01],
    "vibration.K": [0.14, 0.004, -0.002],
}


def displacements(values, voltages):
    plant = Simulated(build(Params, values), T_S)
    y = []
    for u in voltages:
        y.append(plant.read().y)
        plant.write(u)
    return np.array(y), plant


def mode(omega_n, zeta, K):
    return control.tf([K * 1e-6 * omega_n**2], [1.0, 2.0 * zeta * omega_n, omega_n**2])


def test_frequency_response_is_the_sum_of_the_modes():
    A, B, C = linear(build(Params, MODES))
    modes = [mode(*values) for values in zip(*list(MODES.values())[1:], strict=True)]
    for omega in (10.0, 5450.0, 23900.0, 40100.0):
        response = (C @ np.linalg.solve(1j * omega * np.eye(6) - A, B))[0, 0]
        assert response == pytest.approx(sum(m(1j * omega) for m in modes), rel=1e-9)


def test_sampled_response_agrees_with_python_control():
    u = np.random.default_rng(4).uniform(-20.0, 110.0, 200)
    t = np.arange(200) * T_S
    expected = sum(
        control.forced_response(control.sample_system(mode(*values), T_S, "zoh"), t, u).outputs
        for values in zip(*list(MODES.values())[1:], strict=True)
    )
    y, _ = displacements(MODES, u)
    np.testing.assert_allclose(y, expected, atol=1e-12, rtol=0)


def test_one_mode_is_the_second_order_system():
    one = {
        "vibration.type": "modal",
        "vibration.omega_n": [5450.0],
        "vibration.zeta": [0.82],
        "vibration.K": [0.142],
        "x10_um": 2.0,
        "x20_um_s": -50.0,
    }
    u = np.random.default_rng(4).uniform(-20.0, 110.0, 100)
    y, _ = displacements(one, u)
    expected, _ = displacements({"x10_um": 2.0, "x20_um_s": -50.0}, u)
    assert y.tolist() == expected.tolist()


def test_the_plant_s_own_model_does_not_enter():
    y, _ = displacements(MODES, [50.0] * 50)
    other, _ = displacements({**MODES, "K": 0.3, "omega_n": 100.0, "zeta": 2.0}, [50.0] * 50)
    assert y.tolist() == other.tolist()


def test_starts_with_the_stated_displacement_and_velocity():
    plant = Simulated(build(Params, {**MODES, "x10_um": 5.0, "x20_um_s": 30.0}), T_S)
    assert plant.truth[:2] == pytest.approx((5e-6, 30e-6), rel=1e-12)


def test_held_at_its_static_deflection_it_stays():
    y, _ = displacements({**MODES, "x10_um": 0.142 * 50.0}, [50.0] * 100)
    np.testing.assert_allclose(y, 7.1e-6, rtol=1e-9)


def test_steady_state_gain_is_the_sum():
    assert steady_state_gain(build(Params, MODES)) == pytest.approx(0.142, rel=1e-12)
    assert steady_state_gain(build(Params, {})) == pytest.approx(0.142, rel=1e-12)


@pytest.mark.parametrize(
    ("values", "rule"),
    [
        ({"vibration.K": [0.1]}, "2, 2 and 1 values: give each once for each mode"),
        ({"vibration.K": [0.1, -0.1]}, "the sum must be at least"),
        (
            {"vibration.K": [], "vibration.zeta": [], "vibration.omega_n": []},
            "0, 0 and 0 values",
        ),
    ],
)
def test_modes_that_do_not_go_together_are_refused(values, rule):
    with pytest.raises(ParameterError, match=rule):
        build(Params, {"vibration.type": "modal", **values})
