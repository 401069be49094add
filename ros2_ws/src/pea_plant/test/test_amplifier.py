import math

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pea_core.params import ParameterError, build
from pea_plant.drivers.simulated import Params, Simulated
from pea_plant.model import amplifier

T_S = 50e-6


def drive(values, voltages, T_s=T_S):
    """Displacement (m) and applied voltage (V) at each sample, and the plant after them."""
    plant = Simulated(build(Params, values), T_s)
    seen = []
    for u in voltages:
        measured = plant.read()
        seen.append((measured.y, measured.u_applied))
        plant.write(u)
    seen.append((plant.read().y, plant.read().u_applied))
    return np.array(seen).T, plant


def dac(bits):
    return amplifier.design(amplifier.Params(dac_bits=bits), -20.0, 110.0, T_S)


@given(bits=st.integers(1, 32), u=st.floats(-1e3, 1e3))
def test_dac_gives_the_nearest_level(bits, u):
    got = amplifier.command(dac(bits), u)
    step = 130.0 / (2**bits - 1)
    assert -20.0 <= got <= 110.0
    assert abs(got - min(max(u, -20.0), 110.0)) <= step / 2.0 + 1e-12
    level = (got + 20.0) / step
    assert abs(level - round(level)) < 1e-4


def test_one_bit_has_two_levels():
    assert {amplifier.command(dac(1), u) for u in (-20.0, 0.0, 44.9, 45.1, 110.0)} == {
        -20.0,
        110.0,
    }


def test_dac_reaches_both_ends():
    assert amplifier.command(dac(16), -1e9) == -20.0
    assert amplifier.command(dac(16), 1e9) == 110.0


def test_applied_voltage_is_what_the_dac_gives():
    (_, u), _ = drive({"amplifier.dac_bits": 3}, [50.0, 60.0])
    step = 130.0 / 7
    assert u[1:] == pytest.approx([-20.0 + 4 * step] * 2)


def test_slew_rate_bounds_each_change():
    (_, u), _ = drive({"amplifier.slew_rate": 1e5}, [20.0, 20.0, 20.0, 20.0, 20.0, -7.0, -7.0])
    assert u == pytest.approx([0.0, 5.0, 10.0, 15.0, 20.0, 20.0, 15.0, 10.0])


def test_slewing_leads_the_true_ramp_by_half_a_sample_on_average():
    S, n = 1e5, 12
    # the ramp S t, sampled so finely that it is one
    fine = 200
    (y, _), _ = drive({}, S * T_S / fine * (np.arange(n * fine) + 0.5), T_S / fine)
    true = y[::fine]
    (stair, _), _ = drive({"amplifier.slew_rate": S}, [1000.0] * n)
    late, _ = drive({}, S * T_S / fine * (np.arange(n * fine) + 0.5 + fine / 2), T_S / fine)
    lead = stair[1:] - true[1:]
    assert np.all(lead > 0.0)
    assert np.max(lead) < 0.142e-6 * S * T_S / 2.0
    assert np.max(np.abs(stair - late[0][::fine])) < 0.06 * np.max(lead)


def test_delay_comes_before_the_slew_rate():
    (_, u), _ = drive({"amplifier.slew_rate": 1e5, "delay_samples": 1}, [20.0] * 5)
    assert u == pytest.approx([0.0, 0.0, 5.0, 10.0, 15.0, 20.0])


def test_bandwidth_is_exact_without_hysteresis():
    u = np.random.default_rng(8).uniform(-20.0, 110.0, 150)
    pole = 2.0 * math.pi * 2000.0
    G = control.tf([pole], [1.0, pole]) * control.tf(
        [0.142e-6 * 5450.0**2], [1.0, 2.0 * 0.82 * 5450.0, 5450.0**2]
    )
    expected = control.forced_response(
        control.sample_system(G, T_S, "zoh"), np.arange(150) * T_S, u
    ).outputs
    (y, _), _ = drive({"amplifier.bandwidth_hz": 2000.0}, u)
    np.testing.assert_allclose(y[:-1], expected, atol=1e-11, rtol=0)


@pytest.mark.parametrize("kind", ["bouc_wen", "prandtl_ishlinskii", "preisach"])
def test_bandwidth_with_hysteresis_is_second_order(kind):
    values = {"hysteresis.type": kind, "amplifier.bandwidth_hz": 2000.0}

    def at_the_end(parts, n=40):
        # the same staircase of commands, stepped in ever finer parts
        u = 45.0 + 40.0 * np.sin(2.0 * np.pi * np.arange(n) / n)
        return drive(values, np.repeat(u, parts), T_S / parts)[1].truth.x1

    exact = at_the_end(64)
    coarse = abs(at_the_end(1) - exact)
    assert coarse < 3e-9
    assert abs(at_the_end(4) - exact) < max(0.25 * coarse, 5e-12)


def test_applied_voltage_is_told_before_the_bandwidth():
    (_, u), plant = drive({"amplifier.bandwidth_hz": 500.0}, [30.0] * 3)
    assert u.tolist() == [0.0, 30.0, 30.0, 30.0]
    assert plant.s.u_a == pytest.approx(30.0 * -math.expm1(-2 * math.pi * 500.0 * 3 * T_S))


def test_truth_is_right_behind_a_bandwidth():
    values = {"amplifier.bandwidth_hz": 800.0, "creep.enabled": True, "load.type": "step"}
    _, plant = drive(values, [40.0] * 20)
    # a finer plant under the same command gives the same states, and their slope
    parts = 100
    _, fine = drive(values, [40.0] * (20 * parts), T_S / parts)
    assert plant.truth == pytest.approx(fine.truth, rel=1e-7)
    before = drive(values, [40.0] * (20 * parts - 1), T_S / parts)[1].truth.x2
    after = drive(values, [40.0] * (20 * parts + 1), T_S / parts)[1].truth.x2
    slope = (after - before) / (2.0 * T_S / parts)
    assert plant.truth.x2_dot == pytest.approx(slope, rel=1e-3)


@pytest.mark.parametrize("group", ["amplifier", "sensor"])
def test_a_bandwidth_too_low_to_compute_is_refused(group):
    with pytest.raises(ParameterError, match=r"must be 0 \(no limit\) or at least 0\.001 Hz"):
        build(Params, {f"{group}.bandwidth_hz": 1e-9})


def test_a_wide_bandwidth_is_none():
    u = np.random.default_rng(8).uniform(-20.0, 110.0, 50)
    (y, _), _ = drive({}, u)
    (lagging, _), _ = drive({"amplifier.bandwidth_hz": 1e6}, u)
    np.testing.assert_allclose(lagging, y, atol=2e-7 * 110.0 * 0.142)
