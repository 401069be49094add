"""Theory: against python-control, loops assembled by hand, and the simulated loop itself."""

import math
import re

import control
import numpy as np
import pytest
from scipy.signal import cont2discrete

from pea_core.params import ParameterError
from pea_core.signals import Measurement, Reference
from pea_experiment import experiments
from pea_experiment.metrics import truth
from pea_lab.check import check, covariance, poles, refuse_unstable, rows
from pea_lab.linear import Nonlinear, assemble, blocks, systems
from pea_lab.settling import unslewed

T_S = 50e-6
ZETA, OMEGA_N, K = 0.82, 5450.0, 0.142e-6
A21, A22, B2 = -(OMEGA_N**2), -2.0 * ZETA * OMEGA_N, K * OMEGA_N**2
SMALL = ["reference.type=constant", "plant.hysteresis.type=none", "plant.creep.enabled=false"]


def load(name="sine_series", *sets):
    return experiments.load(name, sets, 0.01)


def by_hand(m, P, I, D_c, late=0):  # noqa: E741
    """A PIDSMC on true states from Eqs 2, 9, 12 and 14: states x1, x2, v_I and late commands."""
    system = (
        np.array([[0.0, 1.0], [A21, A22]]),
        np.array([[0.0], [B2]]),
        np.eye(2),
        np.zeros((2, 1)),
    )
    F, G, *_ = cont2discrete(system, T_S)
    D = 1.0 + B2 * D_c * 1e6
    I_T = I * 1e6 * T_S
    q = np.array([m, 1.0, 0.0])
    u = -np.array([A21, m + A22, 0.0]) / B2 - ((P * 1e6 + I_T) * q + np.array([0, 0, 1.0])) / D
    n = 3 + late
    A = np.zeros((n, n))
    A[:2, :2] = F
    A[2, :3] = np.array([0, 0, 1.0]) + I_T * q
    if late:
        A[:2, 3:4] = G
        A[3 : n - 1, 4:n] = np.eye(late - 1)
        A[n - 1, :3] = u
    else:
        A[:2, :3] += G * u
    return A


def margins(experiment):
    """Margins by python-control, from the frequency response: its polynomials lose digits."""
    loop = systems(experiment)["loop"]
    omega = np.geomspace(1.0, 0.9999 * math.pi / T_S, 3000)
    return control.stability_margins(-control.frd(loop, omega), returnall=True)


SET_2 = {"m": 22000.0, "P": 0.0004, "I": 1.0, "D_c": 1e-8}


@pytest.mark.parametrize(
    ("name", "gains"),
    [
        ("fig8_initial_condition", {"m": 2200.0, "P": 0.004, "I": 0.06, "D_c": 1e-8}),
        ("fig9_hysteresis_10hz", SET_2),
    ],
)
def test_poles_are_those_of_a_loop_assembled_by_hand(name, gains):
    found = poles(assemble(blocks(load(name))))
    expected = np.linalg.eigvals(by_hand(**gains))
    assert np.sort_complex(found) == pytest.approx(np.sort_complex(expected), rel=1e-9)


def test_a_delayed_sample_is_a_state_of_the_loop():
    found = poles(assemble(blocks(load("fig9_hysteresis_10hz", "plant.delay_samples=1"))))
    expected = np.linalg.eigvals(by_hand(**SET_2, late=1))
    assert np.sort_complex(found) == pytest.approx(np.sort_complex(expected), rel=1e-8)


def test_delay_margin_lies_between_the_whole_delays_that_do_and_do_not_hold():
    margin = check(load("fig9_hysteresis_10hz"))["delay_margin_samples"]
    radius = [max(abs(np.linalg.eigvals(by_hand(**SET_2, late=d)))) for d in range(5)]
    holds = max(d for d in range(5) if radius[d] < 1.0)
    assert holds <= margin < holds + 1


@pytest.mark.parametrize(
    "sets",
    [
        (),
        ("controller.preset=pid",),
        ("observer.type=kalman", "observer.preset=kalman"),
        ("observer.type=pid_sliding_mode", "observer.preset=pid_sliding_mode"),
        ("controller.preset=smc_boundary_layer",),
        ("plant.sensor.bandwidth_hz=5000",),
        ("plant.amplifier.bandwidth_hz=2000",),
    ],
    ids=str,
)
def test_margins_are_those_of_python_control(sets):
    experiment = load("sine_series", *sets)
    found = check(experiment)
    gains, phases, _, _, omega, _ = margins(experiment)
    upper = min(g for g in gains if g > 1.0)
    assert found["gain_margin_upper"] == pytest.approx(upper, rel=1e-6)
    assert found["gain_margin_lower"] == max((g for g in gains if g < 1.0), default=0.0)
    delays = [math.radians(p % 360.0) / (w * T_S) for p, w in zip(phases, omega)]
    assert found["delay_margin_samples"] == pytest.approx(min(delays), rel=1e-6)


@pytest.mark.parametrize("angle", [0.01, 0.3, 2.0])
def test_the_loop_of_python_control_is_the_three_blocks_in_a_row(angle):
    parts = systems(load())
    z = np.exp(1j * angle)
    P, O, C = (parts[name](z) for name in ("plant", "observer", "controller"))  # noqa: E741
    assert parts["loop"](z) == pytest.approx((C[:, :3] @ O @ P[:3])[0, 0], rel=1e-6)


def test_the_law_of_python_control_takes_the_reference_too():
    law = systems(load("fig9_hysteresis_10hz"))["controller"]
    z = np.exp(0.3j)
    assert law.input_labels[3:] == ["w", "w_dot", "w_ddot", "w_ff", "w_ff_dot", "w_ff_ddot"]
    assert law(z)[0, 3:5] == pytest.approx(-law(z)[0, :2], rel=1e-6)  # of e = x - w
    assert law(z)[0, 6:] == pytest.approx(np.array([-A21, -A22, 1.0]) / B2, rel=1e-6)  # Eq 7


def test_gain_of_the_actuator_is_where_the_simulated_loop_is_lost():
    """Just inside the limit a start off the reference dies out, just outside it grows."""
    upper = check(load())["actuator_gain_upper"]

    def late_to_early(gain):
        experiment = load(
            "sine_series",
            *SMALL,
            f"plant.K={0.142 * gain}",
            "plant.sensor.noise_nm=0",
            "plant.x10_um=1e-6",
            "reference.offset_um=0",
        )
        loop = experiment.loop()
        y = np.abs(np.concatenate([loop.run(1000)["y"], loop.run(1000)["y"]]))
        return y[1500:].max() / y[500:1000].max()

    assert late_to_early(upper * 0.98) < 0.9
    assert late_to_early(upper * 1.02) > 1.1


def test_noise_is_that_of_the_simulated_loop():
    experiment = load("sine_series", *SMALL, "reference.offset_um=5")
    loop = experiment.loop()
    samples = np.concatenate([loop.run(1000) for _ in range(16)])
    x1 = truth(experiment.plant(), samples, experiment.nominal)["x1"][2000:] * 1e9
    u = samples["u"][2000:]
    found = check(experiment)
    assert np.std(x1) == pytest.approx(found["noise_floor_nm"], rel=0.1)
    assert np.std(u) == pytest.approx(found["voltage_noise_V"], rel=0.05)
    assert np.std(np.diff(u)) == pytest.approx(found["voltage_step_noise_V"], rel=0.05)


def test_covariance_solves_the_equation_of_lyapunov():
    A = np.array([[0.9, 0.2, 0.0], [-0.3, 0.5, 0.1], [0.0, 0.4, -0.7]])
    E = np.array([1.0, -2.0, 0.5])
    P = covariance(A, E)
    assert pytest.approx(A @ P @ A.T + np.outer(E, E), rel=1e-12) == P


def test_noise_floor_is_that_of_python_control():
    found, noise = check(load()), systems(load())["noise"]
    P = control.dlyap(noise.A, noise.B @ noise.B.T)
    floor = math.sqrt((noise.C[:1] @ P @ noise.C[:1].T)[0, 0]) * 0.7
    assert found["noise_floor_nm"] == pytest.approx(floor, rel=1e-6)


def test_noise_to_voltage_is_what_one_nanometre_does_within_the_sample():
    experiment = load()
    loop = experiment.loop()
    rest = Reference(0.0, 0.0, 0.0)
    estimate = loop.observer.output(Measurement(1e-9, math.nan, 0.0))
    u = loop.controller.output(rest, rest, estimate)
    assert check(experiment)["noise_to_voltage_V_per_nm"] == pytest.approx(u, rel=1e-9)


@pytest.mark.parametrize(
    ("preset", "expected"),
    [
        ("paper_set1", (1.818, 132.0, 0.002424, 1e-8)),
        ("paper_set2", (2.758, 22000.0, 0.003717, 1e-8)),
        ("recommended", (4.958, 30000.0, 0.000266, 0.0)),
    ],
)
def test_equivalent_pid_of_the_published_gains(preset, expected):
    gains = check(load("sine_series", f"controller.preset={preset}"))["equivalent_pid"]
    assert list(gains.values()) == pytest.approx(expected, rel=2e-3)


def test_other_laws_have_no_equivalent_pid():
    assert check(load("sine_series", "controller.preset=pid"))["equivalent_pid"] is None


def test_matching_condition_is_met_by_the_sampled_plant_alone():
    met = check(load())["matching"]
    assert (met["continuous"], met["sampled"]) == (False, True)
    assert met["CB_d_um_per_V"] == pytest.approx(4.540e-3, rel=1e-3)


@pytest.mark.parametrize(
    ("sets", "culprit"),
    [
        (("controller.preset=smc",), "controller.type = smc"),
        (("observer.preset=levant", "observer.type=levant"), "observer.type = levant"),
    ],
    ids=["smc", "levant"],
)
def test_nonlinear_blocks_are_named_instead_of_given_poles(sets, culprit):
    experiment = load("sine_series", *sets)
    found = check(experiment)
    assert culprit in found["note"]
    assert not found["linear"]
    assert found["poles"] is None
    assert found["gain_margin_upper"] is None
    with pytest.raises(Nonlinear, match=culprit):
        blocks(experiment)
    refuse_unstable(experiment)


def test_a_boundary_layer_is_linear_inside_it_alone():
    found = check(load("sine_series", "controller.preset=smc_boundary_layer"))
    assert found["linear"]
    assert "small signals only" in found["note"]


def test_an_integral_without_gain_is_no_pole():
    assert check(load("sine_series", "controller.I=0"))["largest_pole"] < 0.999


def test_an_unstable_loop_is_refused_by_how_much():
    experiment = load("sine_series", "controller.I=60")
    found = check(experiment)
    assert not found["stable"]
    assert found["noise_floor_nm"] is None
    with pytest.raises(ParameterError, match=f"unstable.*{found['largest_pole']:.4g}.*--force"):
        refuse_unstable(experiment)


def test_a_delayed_sensor_takes_from_the_delay_margin():
    prompt = check(load("fig4_pid_step"))
    late = check(load("fig4_pid_step", "plant.sensor.delay_samples=2"))
    assert late["delay_margin_samples"] == pytest.approx(prompt["delay_margin_samples"] - 2.0)


def test_what_is_learned_from_period_to_period_is_left_out():
    experiment = load("sine_series", "controller.type=predictive")
    learning = load("sine_series", "controller.type=predictive", "controller.learning=repetitive")
    assert check(learning)["poles"] == check(experiment)["poles"]
    assert "learned" in check(learning)["note"]


@pytest.mark.parametrize(
    ("sets", "stable"),
    [((), "yes"), (("controller.I=60",), "NO"), (("controller.preset=smc",), None)],
    ids=str,
)
def test_the_table_says_all_in_words(sets, stable):
    told = {name: value for name, value, _ in rows(check(load("sine_series", *sets)))}
    assert told.get("stable on the nominal plant") == stable
    assert told["matching condition, continuous"] == "not met"
    assert told["matching condition, sampled"] == "met"


@pytest.mark.parametrize(
    ("sets", "told"),
    [
        (("controller.preset=smc", "plant.amplifier.slew_rate=40000"), "24 V .* leaves 2 V"),
        (("controller.preset=smc", "plant.safety.slew_rate=20000"), "24 V .* leaves 1 V"),
        (("controller.preset=smc", "plant.safety.slew_rate=1e6"), ""),
        (("controller.preset=smc",), ""),
        (("controller.preset=smc_boundary_layer", "plant.safety.slew_rate=20000"), ""),
    ],
)
def test_a_law_that_switches_faster_than_the_actuator_is_named(sets, told):
    said = unslewed(load("sine_series", *sets))
    assert bool(said) is bool(told)
    assert re.search(told, said)
