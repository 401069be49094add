"""Shaped moves against limits, vibration by simulation, and differences."""

import math

import numpy as np
import pytest
from scipy.signal import cont2discrete

from pea_core.block import Signal
from pea_core.params import ParameterError, build
from pea_reference import shaped
from pea_reference.model import MODELS, shaper

T_S = 50e-6
OMEGA, ZETA = 2 * math.pi * 739.0, 0.01
MODE = {"omega_n": [OMEGA], "zeta": [ZETA], "K": 0.135}


def signal(kind, T_s=T_S, **values):
    model = MODELS[kind]
    return shaped.signal(model, build(model.Params, values), T_s)


def under(**values):
    return {f"shaper.{name}": value for name, value in values.items()}


def vibration(w, T_s, omega=OMEGA):
    """Response of the mode to w as a voltage, relative to a level of 1."""
    A = np.array([[0.0, 1.0], [-(omega**2), -2 * ZETA * omega]])
    B = np.array([[0.0], [omega**2]])
    F, G = cont2discrete((A, B, np.eye(2), 0 * B), T_s)[:2]
    x, out = np.zeros(2), []
    for w_k in w:
        out.append(x[0])
        x = F @ x + G[:, 0] * w_k
    return np.array(out)


@pytest.mark.parametrize(
    ("kind", "error", "allowed"),
    [("zv", 0.0, 0.002), ("zvd", 0.02, 0.003), ("robust", 0.08, 0.05), ("robust", -0.08, 0.05)],
)
def test_little_vibration_is_left_of_a_shaped_step(kind, error, allowed):
    """Impulses alone: the S-curve is made so short that it damps nothing."""
    T_s = 2e-6
    s = signal(
        "step", T_s, amplitude_um=1.0,
        **under(type=kind, **MODE, move_time=2e-5, spread=0.1, tolerance=0.05),
    )  # fmt: skip
    n = 3000
    y = vibration([1e6 * s.at(k).w for k in range(n)], T_s, OMEGA * (1 + error))
    settled = round(s.c.b.move.length / T_s) + 2
    assert np.abs(y[settled:] - 1.0).max() < allowed
    assert np.abs(vibration(np.ones(n), T_s, OMEGA) - 1.0).max() > 0.9  # a raw step


@pytest.mark.parametrize(
    "limits",
    [
        {"velocity_max": 1000.0, "acceleration_max": 1e6, "jerk_max": 1e10},
        {"velocity_max": 1000.0},
        {"acceleration_max": 1e6},
        {"jerk_max": 1e10},
        {"velocity_max": 1e5, "acceleration_max": 1e6, "jerk_max": 1e9},
        {"slew_rate": 4000.0},
        {"current_max": 0.002, "capacitance": 1e-6},
    ],
)
@pytest.mark.parametrize("amplitude", [0.01, 5.0, -12.0])
def test_no_limit_is_passed(limits, amplitude):
    T_s = 1e-6
    s = signal(
        "step", T_s, amplitude_um=amplitude,
        **under(type="smooth", **MODE, move_time=1e-5, **limits),
    )  # fmt: skip
    n = round(s.c.b.move.length / T_s) + 3
    rows = 1e6 * np.array([s.at(k) for k in np.linspace(0, n, 4000).astype(int)])
    times = np.linspace(0, n, 4000).astype(int) * T_s
    gap = np.diff(times)
    jerk = np.diff(rows[:, 2])[gap > 0] / gap[gap > 0]
    B2 = 0.135 * OMEGA**2
    u = (rows[:, 2] + 2 * ZETA * OMEGA * rows[:, 1] + OMEGA**2 * rows[:, 0]) / B2
    rate = np.abs(np.diff(u)[gap > 0] / gap[gap > 0]).max()
    slack = 1.0 + 1e-6
    assert np.abs(rows[:, 1]).max() <= limits.get("velocity_max", math.inf) * slack
    assert np.abs(rows[:, 2]).max() <= limits.get("acceleration_max", math.inf) * slack
    assert np.abs(jerk).max() <= limits.get("jerk_max", math.inf) * (1 + 1e-3)
    assert rate <= limits.get("slew_rate", math.inf) * (1 + 1e-3)
    assert rate <= limits.get("current_max", math.inf) / limits.get("capacitance", 1) * (1 + 1e-3)
    assert rows[-1].tolist() == pytest.approx([amplitude, 0.0, 0.0])


def derivatives_agree(points, T_s, share=2e-4):
    """w' and w'' are those of w, by central differences, to a share of their size."""
    w, w_dot, w_ddot = np.array(points).T
    assert (w[2:] - w[:-2]) / (2 * T_s) == pytest.approx(
        w_dot[1:-1], abs=share * np.abs(w_dot).max() + 1e-12
    )
    assert (w_dot[2:] - w_dot[:-2]) / (2 * T_s) == pytest.approx(
        w_ddot[1:-1], abs=100 * share * np.abs(w_ddot).max()
    )


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("step", {"time": 0.001}),
        ("step", {"shape": "minimum_jerk", "rise_time": 0.002}),
        ("step", {"shape": "filtered", "rise_time": 0.002}),
        ("sine", {"frequency_hz": 100.0}),
        ("constant", {"offset_um": 3.0}),
        ("levels", {"levels_um": [3.0, 1.0], "move_s": [0.0], "hold_s": [0.005]}),
    ],
)
def test_derivatives_are_those_of_w_and_nothing_jumps(kind, values):
    T_s = 1e-6
    s = signal(kind, T_s, **values, **under(type="zvd", **MODE))
    points = [s.at(k) for k in range(9000)]
    derivatives_agree([(0.0, 0.0, 0.0), *points], T_s)
    assert abs(points[0].w) < 1e-12


@pytest.mark.parametrize("start", [0, 3])
def test_a_change_is_a_move_and_one_that_comes_meanwhile_waits(start):
    s = signal("constant", offset_um=0.0, **under(type="zv", **MODE))
    levels = [(start, 5.0), (start + 4, 1.0), (start + 6, 2.0), (start + 200, 4.0)]
    points = []
    for k in range(400):
        for at, level in levels:
            if k == at:
                s.retune(
                    build(
                        MODELS["constant"].Params, {**under(type="zv", **MODE), "offset_um": level}
                    )
                )
        points.append(s.at(k))
    w = 1e6 * np.array([p.w for p in points])
    assert np.abs(np.diff(w)).max() < 0.6
    assert w[start + 34] == pytest.approx(5.0)  # 1.68 ms: the first move has ended
    assert w[start + 199] == pytest.approx(2.0)  # 1.0 had to wait, and 2.0 came after it
    assert w[-1] == pytest.approx(4.0)
    derivatives_agree(points, T_S, 0.02)


def test_a_change_of_a_moving_signal_is_continuous():
    T_s = 1e-6
    on = under(type="zv", **MODE)
    s = signal("sine", T_s, frequency_hz=150.0, phase_deg=-90.0, **on)
    points = []
    for k in range(8000):
        if k == 3000:
            s.retune(build(MODELS["sine"].Params, {**on, "frequency_hz": 40.0, "offset_um": 2.0}))
        points.append(s.at(k))
    derivatives_agree(points, T_s)
    other = Signal(
        MODELS["sine"], build(MODELS["sine"].Params, {"frequency_hz": 40.0, "offset_um": 2.0}), T_s
    )
    assert points[-1] == other.at(7999)


def test_where_nothing_jumps_nothing_changes():
    plain = Signal(MODELS["sine"], build(MODELS["sine"].Params, {"phase_deg": -90.0}), T_S)
    s = signal("constant", offset_um=0.0, **under(type="zv", **MODE))
    assert s.at(0) == (0.0, 0.0, 0.0)
    with_rest = signal("constant", offset_um=2.0, **under(type="zv", rest_um=2.0))
    assert with_rest.at(0).w == 2e-6
    assert signal("sine", phase_deg=-90.0).at(17) == plain.at(17)


@pytest.mark.parametrize("kind", ["smooth", "zvd"])
def test_compiled_it_gives_the_same_bits(kind):
    pytest.importorskip("numba")
    from pea_engine.kernels import reference_kernel

    for name, values in (("sine", {}), ("step", {"time": 0.001})):
        s = signal(name, **values, **under(type=kind, **MODE))
        points = np.empty((80, 3))
        reference_kernel(s.model)(s.due(0), 0, points)
        assert points.tolist() == [list(s.at(k)) for k in range(80)]


@pytest.mark.parametrize(
    ("values", "text"),
    [
        (under(zeta=[0.1, 0.2]), "one of each for each mode"),
        (under(omega_n=[]), "one of each for each mode"),
        (under(type="zz"), "did you mean|zv"),
        (under(type="zv", omega_n=[1e4] * 12, zeta=[0.0] * 12), "give fewer modes"),
        (under(move_time=0.0), "must be"),
    ],
)
def test_bad_values_are_refused_in_one_line(values, text):
    with pytest.raises(ParameterError, match=text) as error:
        signal("step", **values)
    assert "\n" not in str(error.value)


def test_what_no_short_shaper_stands_is_refused(monkeypatch):
    monkeypatch.setattr(shaper, "LONGEST", 0.5)
    with pytest.raises(ParameterError, match="lower the spread"):
        signal("step", **under(type="robust", omega_n=[5000.0], zeta=[0.003], spread=0.4))


def test_a_level_that_is_left_too_early_is_refused():
    with pytest.raises(ParameterError, match="hold it for longer"):
        signal(
            "levels", levels_um=[3.0, 1.0], move_s=[0.0], hold_s=[0.001], **under(type="zv", **MODE)
        )
