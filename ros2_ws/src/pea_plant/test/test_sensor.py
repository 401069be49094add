import itertools
import math

import numpy as np
import pytest

from pea_core.params import build
from pea_plant.drivers.simulated import Params, Simulated
from pea_plant.model.sensor import noise

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
    assert list(itertools.islice(noise(7), 5000)) == list(itertools.islice(noise(7), 5000))


def test_another_seed_gives_other_noise():
    assert list(itertools.islice(noise(7), 5)) != list(itertools.islice(noise(8), 5))


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
