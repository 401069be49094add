"""Predictive law against transfer functions, a loop in matrices and closed forms of its parts."""

import math
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import cont2discrete

from pea_controller.model import predictive, repetitive
from pea_core.block import Block
from pea_core.params import ParameterError, build
from pea_core.signals import Estimate, Reference

T_S = 50e-6
ZETA, OMEGA_N, K = 0.82, 5450.0, 0.142e-6
A21, A22, B2 = -(OMEGA_N**2), -2 * ZETA * OMEGA_N, K * OMEGA_N**2
REST = Reference(0.0, 0.0, 0.0)
WIDE = {"voltage_min": -1e4, "voltage_max": 1e4}


def block(**values):
    return Block(predictive, build(predictive.Params, values), T_S)


def sampled(gain=1.0, speed=1.0):
    """Phi and Gamma of an actuator with other gain and natural frequency."""
    omega_n = speed * OMEGA_N
    A = np.array([[0.0, 1.0], [-(omega_n**2), -2 * ZETA * omega_n]])
    B = np.array([[0.0], [gain * K * omega_n**2]])
    F, G = cont2discrete((A, B, np.eye(2), 0 * B), T_S)[:2]
    return F, G[:, 0]


def loop(law, w, samples, gain=1.0, speed=1.0, eps=0.0, hysteresis=None, delay=1, x=(0.0, 0.0)):
    """True x1 and command; the law is told the true x1, the previewed reference is exact."""
    F, G = sampled(gain, speed)
    x, waiting, rows = np.array(x), 0.0, []
    for k in range(samples):
        t = k * T_S
        u = law.output(w(t), w(t + (delay + 0.5) * T_S), Estimate(x[0], math.nan, math.nan))
        law.update()
        rows.append((x[0], u))
        acting, waiting = (waiting, u) if delay else (u, u)
        v = acting if hysteresis is None else hysteresis(acting)
        x = F @ x + G * (v + (eps(k) if callable(eps) else eps))
    return np.array(rows).T


def sine(f, amplitude=5e-6):
    omega = 2 * math.pi * f

    def w(t):
        s, c = math.sin(omega * t), math.cos(omega * t)
        return Reference(amplitude * (1 - c), amplitude * omega * s, amplitude * omega**2 * c)

    return w


def plays():
    """Hysteresis of play operators, unlike that of the law."""
    widths, share = np.array([1.0, 3.0, 6.0, 10.0, 15.0, 21.0]), 0.07
    z = np.zeros(widths.size)

    def H(u):
        nonlocal z
        z = np.maximum(u - widths, np.minimum(u + widths, z))
        return (1 - share * z.size) * u + share * z.sum()

    return H


def rms_nm(e):
    return 1e9 * np.sqrt(np.mean(e**2))


def test_estimator_has_the_poles_of_butterworth():
    c = predictive.design(predictive.Params(omega_o=9000.0), T_S)
    F2, G2 = sampled()
    F = np.zeros((4, 4))
    F[:2, :2], F[:2, 2], F[:2, 3] = F2, G2, G2 * T_S
    F[2, 2:], F[3, 3] = (1.0, T_S), 1.0
    L = np.array([c.l1, c.l2, c.l3, c.l4])
    size = np.array([1e-7, 1e-3, 1.0, 1e4])
    closed = ((np.eye(4) - np.outer(L, [1, 0, 0, 0])) @ F) * size / size[:, None]
    s = np.log(np.linalg.eigvals(closed)) / T_S
    # |H|^2 = 1/(1 + (omega/omega_o)^8): its poles are the roots of s^8 = -omega_o^8
    np.testing.assert_allclose((s / 9000.0) ** 8, -1.0, atol=1e-6)
    assert (s.real < 0).all()


def test_hysteresis_is_dahl_s_operator():
    law = block(hysteresis_max=6.0, hysteresis_length=17.0)
    v = [0.0, 40.0, 25.0, 26.0, -10.0]
    for at in v[1:]:  # a level w needs w/K volts
        W = Reference(at * K, 0.0, 0.0)
        law.output(W, W, Estimate(0.0, 0.0, 0.0))
        law.update()
    h = 0.0
    for a, b in pairwise(v):
        up = math.copysign(1.0, b - a)
        way = solve_ivp(lambda x, h, up=up: (6.0 - up * h) / 17.0 * up, (0, abs(b - a)), [h])
        h = way.y[0, -1]
    assert law.s.h == pytest.approx(h, abs=2e-3)
    assert 1.0 < abs(h) < 6.0


def test_hysteresis_does_not_depend_on_how_a_change_is_divided():
    ends = []
    for steps in (1, 7):
        law = block()
        for v in np.linspace(0.0, 30.0, steps + 1)[1:]:
            W = Reference(v * K, 0.0, 0.0)
            law.output(W, W, Estimate(0.0, 0.0, 0.0))
            law.update()
        ends.append(law.s.h)
    assert ends[0] == pytest.approx(ends[1], rel=1e-12)


@pytest.mark.parametrize("delay", [0, 1])
def test_nominal_plant_follows_to_a_fraction_of_a_nanometre(delay):
    law = block(preview_samples=0.5, delay_samples=delay, hysteresis_max=0.0, **WIDE)
    w = sine(150.0)
    x1, _ = loop(law, w, 2000, delay=delay)
    e = x1 - [w(k * T_S).w for k in range(2000)]
    assert rms_nm(e[1000:]) < 0.4  # 2.7 nm where the velocity between the samples is forgotten


@pytest.mark.parametrize("delay", [0, 1])
@pytest.mark.parametrize("eps", [-6.0, lambda k: 0.01 * k], ids=["constant", "ramp"])
def test_constant_and_rising_eps_leave_no_error(delay, eps):
    law = block(delay_samples=delay, **WIDE)
    x1, _ = loop(law, lambda t: REST, 2000, eps=eps, delay=delay)
    assert abs(x1[-1]) < 1e-12


def test_prediction_takes_the_delay_out_of_the_loop():
    # Where the state is known, the delayed loop does one sample later what the prompt one does.
    F, _ = sampled()
    prompt, late = (block(delay_samples=delay, hysteresis_max=0.0, **WIDE) for delay in (0, 1))
    first = np.array([1e-6, -2e-3])
    before = np.linalg.solve(F, first)
    for law, x in ((prompt, first), (late, before)):
        known = np.linalg.solve(F, x)
        law.s = law.s._replace(x1=known[0], x2=known[1])
    x1, _ = loop(prompt, lambda t: REST, 60, x=first, delay=0)
    x1_late, _ = loop(late, lambda t: REST, 61, x=before, delay=1)
    np.testing.assert_allclose(x1_late[1:], x1, atol=1e-15)


@pytest.mark.parametrize("speed", [1.0, 0.85])
@pytest.mark.parametrize("gain", [0.25, 0.5, 1.0, 1.15, 1.4])
def test_loop_is_stable_for_other_actuators(gain, speed):
    law = block(delay_samples=1, **WIDE)
    x1, _ = loop(law, lambda t: REST, 1500, gain, speed, x=(1e-9, 0.0))
    assert np.abs(x1[1000:]).max() < 1e-3 * np.abs(x1[:500]).max()


def test_loop_of_twice_the_gain_is_lost():
    law = block(delay_samples=1, **WIDE)
    x1, _ = loop(law, lambda t: REST, 1500, gain=2.0, x=(1e-9, 0.0))
    assert np.abs(x1[1000:]).max() > 1e3 * np.abs(x1[:500]).max()


def test_feeding_hysteresis_forward_halves_the_error():
    w, errors = sine(150.0), []
    for h_max in (0.0, 6.0):
        law = block(preview_samples=0.5, delay_samples=1, hysteresis_max=h_max, **WIDE)
        x1, _ = loop(law, w, 4000, hysteresis=plays())
        errors.append(rms_nm(x1[2000:] - [w(k * T_S).w for k in range(2000, 4000)]))
    assert errors[1] < 0.5 * errors[0]


@pytest.mark.parametrize("beyond", [30e-6, -30e-6])
def test_saturation_in_and_out_recovers(beyond):
    law = block(delay_samples=1)
    F, G = sampled()
    x, waiting = np.zeros(2), 0.0
    for k in range(1500):
        w = beyond if 200 <= k < 1000 else 5e-6
        W = Reference(w, 0.0, 0.0)
        u = law.output(W, W, Estimate(x[0], 0.0, 0.0))
        law.update()
        x = F @ x + G * (waiting + 3.0)
        waiting = min(max(u, -20.0), 110.0)
        if k == 900:
            assert abs(x[0] - beyond) > 5e-6  # it is saturated indeed
    assert abs(x[0] - 5e-6) < 1e-10


def test_eps_compensation_cannot_be_left_out():
    with pytest.raises(ParameterError, match="eps_compensation = False"):
        build(predictive.Params, {"eps_compensation": False})


def test_estimator_beyond_half_the_sample_rate_is_refused():
    with pytest.raises(ParameterError, match=r"omega_o = 70000: .* 62831\.9 rad/s"):
        block(omega_o=70000.0)


def test_learning_takes_off_what_is_periodic():
    w = sine(160.0)
    errors = []
    for learning in ("none", "repetitive"):
        law = block(preview_samples=0.5, delay_samples=1, learning=learning, **WIDE)
        x1, _ = loop(law, w, 6000, hysteresis=plays())
        errors.append(rms_nm(x1[-2000:] - [w(k * T_S).w for k in range(4000, 6000)]))
    assert errors[0] > 10.0
    assert errors[1] < 0.1 * errors[0]


def test_learning_changes_no_bit_of_a_reference_without_period():
    def chirp(t):
        phase, rate = 2 * math.pi * (50.0 * t + 300.0 * t * t), 2 * math.pi * (50.0 + 600.0 * t)
        a = 5e-6
        return Reference(
            a * (1 - math.cos(phase)),
            a * rate * math.sin(phase),
            a * (rate**2 * math.cos(phase) + 2 * math.pi * 600.0 * math.sin(phase)),
        )

    runs = [
        loop(block(learning=learning, **WIDE), chirp, 4000, hysteresis=plays())
        for learning in ("none", "repetitive")
    ]
    assert (runs[0] == runs[1]).all()


def test_command_does_not_step_when_the_correction_sets_in_or_ends():
    w = sine(160.0)
    law = block(preview_samples=0.5, delay_samples=1, learning="repetitive", **WIDE)

    def other(t):  # the sine goes over into a level at its minimum, after 20 periods
        return w(t) if t < 20 / 160.0 else REST

    acting, commands = [], []
    F, G = sampled()
    x, waiting, H = np.zeros(2), 0.0, plays()
    for k in range(3000):
        acting.append(repetitive.acts(law.c.learning, law.s.memory))
        u = law.output(other(k * T_S), other((k + 1.5) * T_S), Estimate(x[0], 0.0, 0.0))
        law.update()
        commands.append(u)
        x = F @ x + G * H(waiting)
        waiting = u
    changes = np.flatnonzero(np.diff(acting)) + 1
    assert len(changes) == 2
    bend = np.abs(np.diff(commands, 2))
    for k in changes:
        usual = bend[k - 130 : k - 5].max()
        assert bend[k - 2 : k + 1].max() < 2 * usual
