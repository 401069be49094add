import math

import pytest

from pea_core.params import build
from pea_plant.drivers.simulated import Params, Simulated
from pea_plant.gate import UnsafeCommand


def plant(**values):
    return Simulated(build(Params, values), 50e-6)


def trace(p, samples):
    seen = []
    for k in range(samples):
        seen.append(p.read().y)
        p.write(10.0 * (k % 7))
    return seen


def test_starts_where_it_is_told():
    p = Simulated(build(Params, {"x10_um": 5.0, "x20_um_s": 7.0}), 50e-6)
    assert p.truth[:2] == pytest.approx((5e-6, 7e-6))
    assert p.read().y == pytest.approx(5e-6)


def test_starts_at_rest_without_voltage():
    p = plant()
    assert p.truth == (0.0, 0.0, 0.0)
    assert p.read().u_applied == 0.0


@pytest.mark.parametrize("u", [math.nan, math.inf, -math.inf])
def test_no_number_is_refused_and_changes_nothing(u):
    p = plant()
    trace(p, 3)
    before = p.truth
    p.read()
    with pytest.raises(UnsafeCommand, match="sample 3"):
        p.write(u)
    assert p.truth == before


def test_same_seed_gives_the_same_trace():
    a, b = (Simulated(build(Params, {"sensor.noise_nm": 0.7}), 50e-6) for _ in range(2))
    assert trace(a, 100) == trace(b, 100)


def test_another_seed_gives_another_trace():
    a, b = (Simulated(build(Params, {"sensor.noise_nm": 0.7, "seed": n}), 50e-6) for n in (1, 2))
    assert trace(a, 100) != trace(b, 100)


def test_without_noise_the_seed_changes_nothing():
    a, b = (Simulated(build(Params, {"seed": n}), 50e-6) for n in (1, 2))
    assert trace(a, 100) == trace(b, 100)


def test_truth_is_what_a_perfect_sensor_reads():
    p = plant()
    trace(p, 20)
    assert p.read().y == p.truth.x1
