"""`precise` fitted to a stage, on stages that it was not made for."""

import numpy as np
import pytest

from pea_controller.model import CHOICE
from pea_core.nominal import NominalModel
from pea_core.params import ParameterError, build
from pea_lab import fitted
from pea_lab.sweep import simulate

WANTED = {10.0: 1.0, 50.0: 3.5, 150.0: 22.0}


def rms_nm(law, *plant):
    sets = [
        "plant.preset=hysteresis_creep_noise_delay",
        *("plant.sensor.ideal=false", "plant.voltage_min=-40", "plant.voltage_max=220"),
        *("observer.type=extended_state", "reference.phase_deg=-90"),
        *(f"plant.{each}" for each in plant),
    ]
    return simulate(
        "fig10_sine_150hz",
        {"reference.frequency_hz": list(WANTED)},
        sets=[*sets, *law],
        duration=0.25,
        progress=False,
    )["rms_error_nm"]


@pytest.mark.parametrize(
    ("model", "type", "values"),
    [
        ({"K": 0.071}, "prandtl_ishlinskii", {}),
        ({"zeta": 0.3}, "prandtl_ishlinskii", {}),
        ({}, "bouc_wen", {"alpha": 0.5}),
    ],
)
def test_it_meets_its_targets_where_the_compromise_missed_them(model, type, values):
    law = fitted.precise(NominalModel(**model), type, values).sets
    plant = [f"{n}={v}" for n, v in model.items()]
    plant += [f"hysteresis.type={type}", *(f"hysteresis.{n}={v}" for n, v in values.items())]
    assert (rms_nm(law, *plant) <= list(WANTED.values())).all()


def staircase(share, u):
    """v of a uniform Preisach operator: a grid of relays, as in its definition."""
    low, high = -20.0, 110.0
    n = 600
    at = low + (high - low) * (np.arange(n) + 0.5) / n
    alpha, beta = np.meshgrid(at, at, indexing="ij")  # up at alpha, down at beta
    used = alpha >= beta
    on = np.where(alpha + beta < 0.0, 1.0, -1.0)  # half of the relays each way: v = 0 at rest
    out = []
    for u_k in u:
        on = np.where(alpha <= u_k, 1.0, np.where(beta >= u_k, -1.0, on))
        out.append((1.0 - share) * u_k + share * (high - low) * 0.5 * on[used].mean())
    return np.array(out)


def test_plays_follow_the_loops_of_a_preisach_operator():
    """Against relays; shapes of settled loops, up to the factor that scales the plant's model."""
    values = {"share": 0.5}
    params = build(fitted.hysteresis.CHOICE.kinds["preisach"], values)
    r, w = fitted.plays("preisach", params, 90.0)
    for size in (80.0, 20.0):
        u = 0.5 * size * (1.0 - np.cos(2.0 * np.pi * np.arange(300) / 100))
        z, p = np.zeros(r.size), []
        for u_k in u:
            z = np.clip(z, u_k - r, u_k + r)
            p.append(w @ z)
        p, v = np.array(p)[-100:], staircase(0.5, u)[-100:]
        p, v = p - p.mean(), v - v.mean()
        left = p - v * (p @ v) / (v @ v)
        assert np.sqrt(np.mean(left**2)) < 2e-3 * np.ptp(p)


@pytest.mark.parametrize("span", [110.0, 130.0, 200.0])
def test_plays_stay_in_the_range_of_a_preisach_operator(span):
    """Identification gives the range that was measured, from below 0 on."""
    values = {"share": 0.34, "range_min": -20.0, "range_max": 94.0, "u_max": 94.0, "v_max": 94.0}
    params = build(fitted.hysteresis.CHOICE.kinds["preisach"], values)
    # beyond 94 V the operator has no density: what is fitted there is of none of its loops
    whole, given = (fitted.plays("preisach", params, each) for each in (114.0, span))
    u = 35.0 * (1.0 - np.cos(2.0 * np.pi * np.arange(300) / 100))
    loops = []
    for r, w in (whole, given):
        z, p = np.zeros(r.size), []
        for u_k in u:
            z = np.clip(z, u_k - r, u_k + r)
            p.append(w @ z)
        loops.append(np.array(p)[-100:] - np.mean(p[-100:]))
    assert np.ptp(loops[0] - loops[1]) < 2e-3 * np.ptp(loops[0])
    model = fitted.hysteresis.MODELS["preisach"]
    c = model.design(params, 1.0)
    s, v = model.start(c), []
    for u_k in u.tolist():
        s = model.update(c, s, u_k)
        v.append(model.output(c, s))
    v = np.array(v)[-100:] - np.mean(v[-100:])
    assert np.ptp(loops[1] - v) < 5e-3 * np.ptp(v)


def test_gains_go_with_the_stage_and_a_law_takes_them():
    one = fitted.precise(NominalModel())
    other = fitted.precise(NominalModel(K=0.071, omega_n=10900.0), "bouc_wen", {"alpha": 0.2})
    assert one.controller["P"] == pytest.approx(0.0017)
    assert other.controller["P"] == pytest.approx(0.0017 / 2)
    assert other.controller["inverse.alpha"] == 0.2
    assert other.observer["K"] == other.controller["K"] == 0.071
    for preset in (one, other):
        build(CHOICE, preset.controller)


def test_the_curve_of_a_modified_operator_is_handed_on_in_volts():
    plays = {"thresholds": [0.0, 5.0], "weights": [0.8, 0.3], "u_max": 40.0, "v_max": 42.5}
    found = fitted.precise(
        NominalModel(K=0.1), fitted.MODIFIED, plays, knots=[0, 2, 3, 8], slopes=[0.9, 1.0, 1.2]
    ).controller
    assert found["inverse.weights"] == pytest.approx((0.8, 0.3))
    assert found["inverse.knots"] == pytest.approx((20.0, 30.0))
    assert found["inverse.slopes"] == (0.9, 1.0, 1.2)


@pytest.mark.parametrize(
    ("type", "values", "text"),
    [
        ("preisch", {}, "did you mean preisach"),
        ("bouc_wen", {"alpha": 0.99}, "cannot be inverted"),
        ("bouc_wen", {"alpha": 2.0}, "must be 0 to 1"),
    ],
)
def test_what_has_no_inverse_is_refused_in_one_line(type, values, text):
    with pytest.raises(ParameterError, match=text) as error:
        fitted.precise(NominalModel(), type, values)
    assert "\n" not in str(error.value)
