import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pea_core.block import Block
from pea_core.params import ParameterError, build
from pea_plant.drivers.simulated import Params, Simulated
from pea_plant.model.actuator import actuator
from pea_plant.model.hysteresis import MODELS

T_S = 50e-6
HYSTERESES = ["none", "bouc_wen", "prandtl_ishlinskii", "preisach"]


def drive(values, voltages):
    """Displacement (m) and applied voltage (V) at each sample, and the plant after them."""
    plant = Simulated(build(Params, values), T_S)
    seen = []
    for u in voltages:
        measured = plant.read()
        seen.append((measured.y, measured.u_applied))
        plant.write(u)
    return np.array(seen), plant


@pytest.mark.parametrize("kind", HYSTERESES[1:])
def test_12_um_at_full_voltage(kind):
    _, plant = drive({"hysteresis.type": kind}, [89.09] * 400)
    assert plant.truth.x1 * 1e6 == pytest.approx(12.0, abs=2e-3)


def test_without_hysteresis_the_gain_is_K():
    _, plant = drive({}, [89.09] * 400)
    assert plant.truth.x1 * 1e6 == pytest.approx(0.142 * 89.09, rel=1e-9)


@pytest.mark.parametrize("kind", HYSTERESES)
def test_hysteresis_drives_V_in_the_interval_of_its_voltage(kind):
    params = build(Params, {"hysteresis.type": kind})
    u = np.random.default_rng(2).uniform(0.0, 90.0, 50)
    _, plant = drive({"hysteresis.type": kind}, u)
    H = MODELS[kind]
    h_c = H.design(params.hysteresis, T_S)
    h, v = H.start(h_c), []
    for u_k in u:
        h = H.update(h_c, h, u_k)
        v.append(H.output(h_c, h))
    _, linear = drive({"voltage_min": -500.0, "voltage_max": 500.0}, v)
    assert plant.truth[:2] == pytest.approx(linear.truth[:2], rel=1e-12)


def test_without_delay_a_command_acts_in_its_own_interval():
    seen, _ = drive({}, [10.0, 20.0, 30.0])
    assert seen[:, 1].tolist() == [0.0, 10.0, 20.0]
    assert seen[1, 0] > 0.0


def test_with_delay_the_first_interval_has_no_voltage():
    seen, _ = drive({"delay_samples": 1}, [10.0, 20.0, 30.0])
    assert seen[:, 1].tolist() == [0.0, 0.0, 10.0]
    assert seen[1, 0] == 0.0
    assert seen[2, 0] > 0.0


@pytest.mark.parametrize("kind", HYSTERESES)
def test_delay_shifts_the_response_by_one_sample(kind):
    u = np.random.default_rng(5).uniform(-30.0, 120.0, 80)
    prompt, _ = drive({"hysteresis.type": kind}, u)
    late, _ = drive({"hysteresis.type": kind, "delay_samples": 1}, u)
    assert late[1:, 0].tolist() == prompt[:-1, 0].tolist()


def test_voltage_is_limited():
    seen, _ = drive({}, [1000.0, -1000.0, 0.0])
    assert seen[1:, 1].tolist() == [110.0, -20.0]


def test_a_range_turned_round_is_refused():
    with pytest.raises(ParameterError, match=r"voltage_min = 10: must be below voltage_max \(5 V"):
        build(Params, {"voltage_min": 10.0, "voltage_max": 5.0})


def test_truth_s_acceleration_is_the_derivative_of_its_velocity():
    _, plant = drive({"creep.enabled": True, "hysteresis.type": "bouc_wen"}, [50.0] * 10)
    # the voltage stays: a much finer plant tells the slope at the same instant
    before, after = (
        fine_velocity(50e-6 * 10 + dt, {"creep.enabled": True, "hysteresis.type": "bouc_wen"})
        for dt in (-1e-7, 1e-7)
    )
    assert plant.truth.x2_dot == pytest.approx((after - before) / 2e-7, rel=1e-5)


def fine_velocity(t, values):
    """Velocity (m/s) at t (s) under 50 V from rest, in one step."""
    plant = Simulated(build(Params, values), t)
    plant.read()
    plant.write(50.0)
    return plant.truth.x2


def test_output_changes_nothing():
    params = build(Params, {"hysteresis.type": "prandtl_ishlinskii", "creep.enabled": True})
    block = Block(actuator(params), params, T_S)
    for _ in range(5):
        block.output(0.3)
        block.update(40.0)
    x = block.s.x.copy()
    assert block.output(0.3) == pytest.approx(block.output(0.3), nan_ok=True)
    assert block.s.x.tolist() == x.tolist()


def test_two_plants_share_no_state():
    params = build(Params, {"hysteresis.type": "prandtl_ishlinskii"})
    a, b = Simulated(params, T_S), Simulated(params, T_S)
    a.read()
    a.write(60.0)
    assert b.truth.x1 == 0.0
    assert a.truth.x1 > 0.0


@given(u=st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=40), kind=st.sampled_from(HYSTERESES))
def test_saturation_in_and_out_recovers(u, kind):
    calm = [0.0] * 100
    _, plant = drive({"hysteresis.type": kind}, [*u, *calm])
    assert plant.read().u_applied == 0.0
    assert abs(plant.truth.x1) < 0.142e-6 * 20.0
    assert abs(plant.truth.x2) < 1e-9
