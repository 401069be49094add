"""The three modes agree to the bit, and with the figures of the paper."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import expm

from pea_record.read import load

FIG9 = "fig9_hysteresis_10hz"
FIG8 = "fig8_initial_condition"
SHORT = ("--duration", "0.0157")
SAMPLES = 314

NOISY = (
    *(FIG9, *SHORT, "--seed", "5"),
    *("--set", "plant.hysteresis.type=prandtl_ishlinskii"),
    *("--set", "plant.sensor.noise_nm=0.7"),
    *("--set", "plant.creep.enabled=true"),
    *("--set", "plant.delay_samples=1"),
    *("--set", "plant.voltage_min=-20"),
    *("--set", "plant.voltage_max=110"),
    *("--set", "observer.type=extended_state"),
    *("--set", "controller.preset=recommended"),
)
TWO = (
    *(*NOISY, "--set", "axes=[x, y]"),
    *("--set", "plant.stage.cross_talk=[0, 0.02, -0.03, 0]"),
    *("--set", "plant.y.K=0.12", "--set", "plant.y.seed=8"),
    *("--set", "controller.y.preset=pid", "--set", "observer.y.preset=kalman_rate"),
    *("--set", "reference.y.frequency_hz=20"),
)
SHARES = [0.5, 0.5, 1, -0.5, 0.5, 1, 0, -1, 1, 0.1, 0, 0, 0, -0.1, 0, 0, 0, 0.05]
"""Two taps from three axes to three actuators."""
THREE = (
    *(FIG9, *SHORT, "--set", "axes=[tip, tilt, piston]"),
    *("--set", "plant.stage.sensors_to_axes=[1, -1, 0, 0.5, 0.5, -1, 0.4, 0.4, 0.2]"),
    *("--set", f"plant.stage.axes_to_actuators={SHARES}"),
    *("--set", "plant.stage.permitted_um=[-20, -20, 20, -20, 20, 20, -20, 20]"),
    *("--set", "controller.tilt.preset=precise", "--set", "observer.tilt.preset=extended_state"),
    *("--set", "plant.sensor.noise_nm=0.7", "--set", "plant.piston.seed=3"),
    *("--set", "plant.sensor.ideal=true"),
)
SETTINGS = {
    "fig8": (FIG8, *SHORT),
    "noisy": NOISY,
    "two": TWO,
    "three": THREE,
}

KEYS = {
    *("experiment", "mode", "samples", "lost_samples", "sample_period_ns", "duration_s", "wall_s"),
    *("real_time_factor", "rms_error_nm", "max_error_nm", "rms_error_percent"),
    *("rms_voltage_step_V", "saturated_samples", "observer_rms_x1_nm", "observer_rms_x2_um_s"),
    *("observer_rms_eps_V", "trace_sha256"),
}
MODES = ("batch", "composed", "distributed")
OF_THE_MODE = {"mode", "wall_s", "real_time_factor"}


@pytest.mark.parametrize("mode", ["composed", "distributed"])
@pytest.mark.parametrize("setting", SETTINGS.values(), ids=SETTINGS)
def test_modes_agree_to_the_bit(recorded, setting, mode):
    batch, other = recorded("batch", *setting).metrics, recorded(mode, *setting).metrics
    assert other["mode"] == mode
    assert other["samples"] == SAMPLES
    assert other["lost_samples"] == 0
    for key in KEYS - OF_THE_MODE:
        assert other[key] == batch[key], key


def test_the_settings_differ(recorded):
    hashes = {recorded("batch", *s).metrics["trace_sha256"] for s in SETTINGS.values()}
    assert len(hashes) == len(SETTINGS)


def test_another_seed_gives_another_trace(recorded):
    other = [("6" if word == "5" else word) for word in NOISY]
    one, two = recorded("batch", *NOISY), recorded("batch", *other)
    assert one.metrics["trace_sha256"] != two.metrics["trace_sha256"]


def test_another_seed_without_noise_gives_the_same_trace(recorded):
    one, two = recorded("batch", FIG9, *SHORT), recorded("batch", FIG9, *SHORT, "--seed", "6")
    assert one.metrics["trace_sha256"] == two.metrics["trace_sha256"]


@pytest.mark.parametrize("mode", MODES)
def test_metrics_have_every_key(recorded, mode):
    figures = recorded(mode, FIG9, *SHORT).metrics
    assert figures.keys() >= KEYS
    assert figures["experiment"] == FIG9
    assert figures["sample_period_ns"] == 50_000
    assert figures["duration_s"] == pytest.approx(SAMPLES * 50e-6)
    assert figures["real_time_factor"] > 0.0


def test_fig9_with_bouc_wen(recorded):
    figures = recorded("batch", FIG9).metrics
    assert figures["samples"] == 10_000
    assert figures["rms_error_nm"] == pytest.approx(13.85, abs=0.05)
    assert figures["rms_error_percent"] == pytest.approx(100.0 * 13.85e-3 / 5.0, rel=0.01)


def test_fig9_without_hysteresis(recorded):
    figures = recorded("batch", FIG9, "--set", "plant.hysteresis.type=none").metrics
    assert figures["rms_error_nm"] == pytest.approx(0.12, abs=0.01)


def test_fig8_settles_and_undershoots(recorded):
    run = recorded("batch", FIG8, "--duration", "0.2")
    y = load(run.directory).samples["y"] * 1e6
    t = np.arange(len(y)) * 50e-6
    outside = np.flatnonzero(np.abs(y) > 0.02 * 5.0)
    lowest = int(y.argmin())
    assert t[outside[-1] + 1] == pytest.approx(1.85e-3, abs=0.05e-3)
    assert -y[lowest] * 1e3 == pytest.approx(5.80, abs=0.05)
    assert t[lowest] == pytest.approx(5.5e-3, abs=0.15e-3)


ZETA, OMEGA, K, T_S = 0.82, 5450.0, 0.142, 50e-6
"""Section II, in um, V and s."""


def second_order() -> tuple[np.ndarray, np.ndarray]:
    A = np.array([[0.0, 1.0], [-(OMEGA**2), -2.0 * ZETA * OMEGA]])
    joined = np.zeros((3, 3))
    joined[:2, :2], joined[1, 2] = A, K * OMEGA**2
    step = expm(joined * T_S)
    return step[:2, :2], step[:2, 2]


def simulate(samples, x, reference, hysteresis, m, P, I, D_c):  # noqa: E741
    """Displacement (um) and command (V) of the paper's loop with true states."""
    F, G = second_order()
    A21, A22, B2 = -(OMEGA**2), -2.0 * ZETA * OMEGA, K * OMEGA**2
    x = np.array(x)
    v_I = 0.0
    rows = []
    for k in range(samples):
        w, w_1, w_2 = reference(k * T_S)
        e_1, e_2 = x[0] - w, x[1] - w_1
        q = m * e_1 + e_2
        v_I += I * T_S * q
        u = (w_2 - A21 * w - A22 * w_1) / B2
        u -= (m * e_2 + A21 * e_1 + A22 * e_2) / B2
        u -= (P * q + v_I) / (1.0 + B2 * D_c)
        rows.append((x[0], u))
        x = F @ x + G * hysteresis(u)
    return np.array(rows).T


def sine(t: float) -> tuple[float, float, float]:
    a = 2.0 * math.pi * 10.0
    return 5.0 * math.sin(a * t) + 5.0, 5.0 * a * math.cos(a * t), -5.0 * a * a * math.sin(a * t)


class BoucWen:
    """dh = alpha du - beta |du| h - gamma du |h|, in steps far finer than a sample."""

    def __init__(self) -> None:
        self.u = self.h = 0.0

    def __call__(self, u: float) -> float:
        alpha, beta, gamma = 0.35, 0.0424, 0.03394
        pieces = 100
        du = (u - self.u) / pieces

        def slope(h: float) -> float:
            return alpha - beta * math.copysign(1.0, du) * h - gamma * abs(h)

        for _ in range(pieces):
            middle = self.h + 0.5 * du * slope(self.h)
            self.h += du * slope(middle)
        self.u = u
        return u - self.h


CASES = {
    "fig9 without hysteresis": (
        (FIG9, "--duration", "0.2", "--set", "plant.hysteresis.type=none"),
        ((0.0, 0.0), sine, lambda: lambda u: u, 22000.0, 0.0004, 1.0, 1e-8),
        1e-3,
    ),
    "fig8": (
        (FIG8, "--duration", "0.2"),
        ((5.0, 0.0), lambda t: (0.0, 0.0, 0.0), lambda: lambda u: u, 2200.0, 0.004, 0.06, 1e-8),
        1e-3,
    ),
    "fig9 with Bouc-Wen": (
        (FIG9, "--duration", "0.1"),
        ((0.0, 0.0), sine, BoucWen, 22000.0, 0.0004, 1.0, 1e-8),
        0.05,
    ),
}


@pytest.mark.parametrize(("question", "loop", "tolerance_nm"), CASES.values(), ids=CASES)
def test_recorded_trace_is_the_one_of_an_independent_simulation(
    recorded, question, loop, tolerance_nm
):
    samples = load(recorded("batch", *question).directory).samples
    start, reference, hysteresis, *gains = loop
    y, u = simulate(len(samples), start, reference, hysteresis(), *gains)
    assert np.abs(samples["y"] * 1e9 - y * 1e3).max() < tolerance_nm
    assert np.abs(samples["u"] - u).max() < 1e-3
