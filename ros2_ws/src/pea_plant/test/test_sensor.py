import itertools
import math

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pea_core.params import build
from pea_plant.drivers.simulated import Params, Simulated
from pea_plant.model.sensor import Noise

T_S = 50e-6


def readings(values, samples, u=0.0):
    plant = Simulated(build(Params, values), T_S)
    y = []
    for _ in range(samples):
        y.append(plant.read())
        plant.write(u)
    return y


def test_noise_is_white_with_the_stated_rms():
    y = np.array([m.y for m in readings({"sensor.noise_nm": 0.7}, 20000)])
    assert np.std(y) == pytest.approx(0.7e-9, rel=0.02)
    assert abs(np.mean(y)) < 0.02e-9
    assert abs(np.corrcoef(y[1:], y[:-1])[0, 1]) < 0.02


def test_same_seed_gives_the_same_noise():
    assert list(itertools.islice(Noise(7), 5000)) == list(itertools.islice(Noise(7), 5000))


def test_another_seed_gives_other_noise():
    assert list(itertools.islice(Noise(7), 5)) != list(itertools.islice(Noise(8), 5))


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 5000)), max_size=6))
@settings(max_examples=20, deadline=None)
def test_noise_taken_in_pieces_is_the_noise_taken_one_by_one(pieces):
    noise, found = Noise(3), []
    for whole, count in pieces:
        found += noise.take(count).tolist() if whole else [next(noise) for _ in range(count)]
    assert found == list(itertools.islice(Noise(3), len(found)))


def test_noise_does_not_reach_the_actuator():
    quiet, loud = (Simulated(build(Params, {"sensor.noise_nm": rms}), T_S) for rms in (0.0, 50.0))
    for plant in (quiet, loud):
        for _ in range(20):
            plant.read()
            plant.write(30.0)
    assert quiet.truth == loud.truth


def test_ideal_sensor_tells_the_true_velocity():
    plant = Simulated(build(Params, {"sensor.ideal": True}), T_S)
    for _ in range(10):
        plant.read()
        plant.write(50.0)
    assert plant.read().y_dot == plant.truth.x2 != 0.0


def test_ordinary_sensor_tells_no_velocity():
    assert math.isnan(readings({}, 1)[0].y_dot)


def ramp(values, samples=200):
    """Readings and true displacements (m) while the voltage jumps about."""
    plant = Simulated(build(Params, values), T_S)
    u = np.random.default_rng(9).uniform(0.0, 80.0, samples)
    y, x1 = [], []
    for u_k in u:
        y.append(plant.read().y)
        x1.append(plant.truth.x1)
        plant.write(u_k)
    return np.array(y), np.array(x1), u


def test_quantised_reading_is_the_nearest_step():
    y, x1, _ = ramp({"sensor.quantisation_nm": 3.0})
    steps = y / 3e-9
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    assert np.max(np.abs(y - x1)) <= 1.5e-9 * (1 + 1e-9)
    assert np.max(np.abs(y - x1)) > 1e-9


def test_noise_is_quantised_with_the_reading():
    y, *_ = ramp({"sensor.quantisation_nm": 3.0, "sensor.noise_nm": 2.0})
    steps = y / 3e-9
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)


@pytest.mark.parametrize("delay", [1, 2, 7])
def test_delayed_reading_is_the_old_displacement(delay):
    y, x1, _ = ramp({"sensor.delay_samples": delay})
    assert y[delay:].tolist() == x1[:-delay].tolist()
    assert y[:delay].tolist() == [0.0] * delay


def test_delayed_sensor_starts_with_the_initial_displacement():
    y, *_ = ramp({"sensor.delay_samples": 3, "x10_um": 5.0})
    assert y[:4] == pytest.approx([5e-6] * 4)


def test_bandwidth_is_exact():
    y, _, u = ramp({"sensor.bandwidth_hz": 1500.0})
    pole = 2.0 * math.pi * 1500.0
    G = control.tf([pole], [1.0, pole]) * control.tf(
        [0.142e-6 * 5450.0**2], [1.0, 2.0 * 0.82 * 5450.0, 5450.0**2]
    )
    sampled = control.sample_system(G, T_S, "zoh")
    expected = control.forced_response(sampled, np.arange(200) * T_S, u).outputs
    np.testing.assert_allclose(y, expected, atol=1e-12, rtol=0)


@pytest.mark.parametrize(
    "values",
    [
        {"sensor.bandwidth_hz": 1500.0},
        {"sensor.delay_samples": 4},
        {"sensor.quantisation_nm": 5.0},
        {"sensor.bandwidth_hz": 300.0, "sensor.delay_samples": 2, "creep.enabled": True},
    ],
)
def test_truth_does_not_see_the_sensor(values):
    _, x1, _ = ramp(values)
    _, expected, _ = ramp({"creep.enabled": values.get("creep.enabled", False)})
    np.testing.assert_allclose(x1, expected, atol=1e-17)


def test_lag_starts_settled():
    y, *_ = ramp({"sensor.bandwidth_hz": 1500.0, "x10_um": 5.0}, 1)
    assert y[0] == pytest.approx(5e-6)
