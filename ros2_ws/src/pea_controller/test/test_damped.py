"""Damped law against transfer functions: inner loop, notches, integral."""

import math

import numpy as np
import pytest
from scipy.signal import cont2discrete, freqz

from pea_controller.model import damped
from pea_core.block import Block
from pea_core.params import ParameterError, build
from pea_core.signals import Estimate, Reference

T_S = 50e-6
OMEGA, ZETA, K = 4643.274, 0.01, 0.135
STAGE = {"omega_n": OMEGA, "zeta": ZETA, "K": K, "voltage_min": -1e4, "voltage_max": 1e4}
REST = Reference(0.0, 0.0, 0.0)


def answer(samples=4000, **values):
    """Impulse response (V/m) of the law from -x1 to u."""
    law = Block(damped, build(damped.Params, {**STAGE, **values}), T_S)
    out = []
    for k in range(samples):
        x1 = -1e-9 if k == 0 else 0.0
        out.append(law.output(REST, REST, Estimate(x1, 0.0, 0.0)) / 1e-9)
        law.update()
    return np.array(out)


def response(h, f):
    return np.array([h @ np.exp(-2j * np.pi * each * T_S * np.arange(h.size)) for each in f])


FREQUENCIES = np.array([200.0, 700.0, 739.0, 1500.0, 5000.0])


@pytest.mark.parametrize("kind", ["irc", "ppf"])
def test_the_inner_loop_is_its_filter_sampled(kind):
    p, g, z_f = 3000.0, 0.6, 0.4
    h = answer(K_i=0.0, damping=kind, damping_gain=g, damping_omega=p, damping_zeta=z_f)
    if kind == "irc":
        num, den = [p], [1.0, p]
    else:
        num, den = [p * p], [1.0, 2 * z_f * p, p * p]
    num, den, _ = cont2discrete((num, den), T_S)
    expected = -g / (K * 1e-6) * freqz(num[0], den, FREQUENCIES, fs=1 / T_S)[1]
    assert response(h, FREQUENCIES) == pytest.approx(expected, rel=1e-5)


def test_two_notches_are_the_bilinear_transform_of_their_product():
    omega, zero, pole = [OMEGA, 12566.4], [0.01, 0.1], [0.7, 0.5]
    h = answer(
        K_p=2.0, K_i=0.0, damping="none",
        notch_omega_n=omega, notch_zero=zero, notch_pole=pole,
    )  # fmt: skip
    expected = 2e6 * np.ones(FREQUENCIES.size, complex)
    for w, z, p in zip(omega, zero, pole, strict=True):
        # s of the bilinear transform that keeps w: real frequency f becomes warped
        s = 1j * w * np.tan(np.pi * FREQUENCIES * T_S) / math.tan(0.5 * w * T_S)
        expected *= (s * s + 2 * z * w * s + w * w) / (s * s + 2 * p * w * s + w * w)
    assert response(h, FREQUENCIES) == pytest.approx(expected, rel=1e-6)


def sampled():
    A = np.array([[0.0, 1.0], [-(OMEGA**2), -2 * ZETA * OMEGA]])
    B = np.array([[0.0], [K * 1e-6 * OMEGA**2]])
    F, G = cont2discrete((A, B, np.eye(2), 0 * B), T_S)[:2]
    return F, G[:, 0]


def ringing(samples=1500, **values):
    """|x1| (m) over the last 200 samples, from 1 nm off and at rest."""
    law = Block(damped, build(damped.Params, {**STAGE, **values}), T_S)
    F, G = sampled()
    x, waiting, out = np.array([1e-9, 0.0]), 0.0, []
    for _ in range(samples):
        u = law.output(REST, REST, Estimate(x[0], x[1], 0.0))
        law.update()
        out.append(abs(x[0]))
        x = F @ x + G * waiting
        waiting = u
    return max(out[-200:])


def test_the_inner_loop_damps_a_stage_that_rings_with_a_sample_of_delay():
    free = ringing(K_i=0.0, damping="none")
    assert free > 1e-11
    preset = {"damping_gain": 0.8, "damping_omega": 0.5 * OMEGA}
    assert ringing(K_i=0.0, **preset) < 1e-3 * free
    assert ringing(K_i=10300.0, **preset) < 1e-3 * free
    assert ringing(300, K_i=10300.0, damping="none") > 1e-8  # unstable without it


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"notch_zero": [0.1, 0.1]}, "one of each for each notch"),
        ({"notch_omega_n": [], "notch_zero": [], "notch_pole": []}, "one of each for each notch"),
        ({"notch_omega_n": [7e4]}, "half the sample rate"),
        ({"damping_gain": 1.0}, "must be 0 to 0.99"),
        ({"damping": "pff"}, "did you mean ppf"),
    ],
)
def test_bad_values_are_refused_in_one_line(values, text):
    with pytest.raises(ParameterError, match=text) as error:
        damped.design(build(damped.Params, values), T_S)
    assert "\n" not in str(error.value)
