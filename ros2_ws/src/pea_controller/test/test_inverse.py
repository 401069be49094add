"""Inverse hysteresis against the plant's own operators and a forward model written here."""

import math

import numpy as np
import pytest

from pea_controller.model import inverse, open_loop, pid, pidsmc, predictive
from pea_core.block import Block
from pea_core.params import ParameterError, build
from pea_core.signals import Estimate, Reference
from pea_plant.model.hysteresis import bouc_wen, prandtl_ishlinskii

T_S = 50e-6
PLAYS = {"thresholds": [0.0, 1.5, 4.0, 11.0], "weights": [0.6, 0.15, 0.1, 0.12]}
BENT = {**PLAYS, "knots": [-8.0, 5.0, 20.0], "slopes": [1.3, 1.0, 0.8, 1.1]}


def winding(samples=3000):
    """A voltage with major and minor loops, both signs."""
    rng = np.random.default_rng(4)
    t = np.arange(samples) / samples
    return 40 * np.sin(9 * t) * t + 12 * np.sin(60 * t) + np.cumsum(rng.normal(0, 0.3, samples))


def forward(values, u):
    """v of plays behind a curve, from their definition: S found by interpolation of S^-1."""
    z, out = np.zeros(len(values["thresholds"])), []
    r, w = np.array(values["thresholds"]), np.array(values["weights"])
    knots = np.array(values.get("knots", [0.0]))
    slopes = np.array(values.get("slopes", [1.0, 1.0]))
    v = np.concatenate([[-1e3], knots, [1e3]])
    p = np.concatenate([[0.0], np.cumsum(slopes * np.diff(v))])
    p -= np.interp(0.0, v, p)
    for u_k in u:
        z = np.clip(z, u_k - r, u_k + r)
        out.append(np.interp(w @ z, p, v))
    return np.array(out)


def undone(values, v):
    """u of the inverse, sample by sample."""
    c = inverse.design(build(inverse.Params, values))
    s, out = inverse.centred(c), []
    for v_k in v.tolist():
        out.append(v_k + inverse.added(c, s, v_k))
        s = inverse.moved(c, s, v_k)
    return np.array(out)


@pytest.mark.parametrize("values", [PLAYS, BENT, {**PLAYS, "weights": [0.9, -0.1, -0.2, 0.3]}])
def test_the_inverse_of_a_fitted_hysteresis_is_exact(values):
    u = winding()
    assert undone(values, forward(values, u)) == pytest.approx(u, abs=1e-9)


def driven(model, params, u):
    """v of a plant's model of H."""
    c = model.design(params, T_S)
    s, v = model.start(c), []
    for u_k in u.tolist():
        s = model.update(c, s, u_k)
        v.append(model.output(c, s))
    return np.array(v)


def test_it_undoes_the_plants_own_operators():
    params = prandtl_ishlinskii.Params()
    c = prandtl_ishlinskii.design(params, T_S)
    values = {"thresholds": c.r.tolist(), "weights": c.w.tolist()}
    v = driven(prandtl_ishlinskii, params, winding())
    assert undone(values, v) == pytest.approx(winding(), abs=1e-9)


@pytest.mark.parametrize(
    "values",
    [
        {"alpha": 0.35},
        {"alpha": 0.5},
        {"alpha": 0.15, "beta": 0.02, "gamma": -0.01},
        {"alpha": 0.3, "beta": 0.05, "gamma": 0.05},
    ],
)
def test_it_undoes_bouc_wen(values):
    v = driven(bouc_wen, bouc_wen.Params(**values), winding())
    assert undone(values, v) == pytest.approx(winding(), abs=1e-8)


def test_it_undoes_plays_behind_bouc_wen():
    values = {"alpha": 0.2, **BENT}
    v = forward(BENT, driven(bouc_wen, bouc_wen.Params(alpha=0.2), winding()))
    assert undone(values, v) == pytest.approx(winding(), abs=1e-8)


@pytest.mark.parametrize("law", [open_loop, pid, pidsmc, predictive])
def test_every_law_that_takes_it_adds_what_the_hysteresis_takes(law):
    """At rest, of a plant in its estimated place, u is the inverse of w / K."""
    off = {"hysteresis_max": 0.0} if law is predictive else {}
    values = {**{f"inverse.{n}": v for n, v in BENT.items()}, **off}
    block = Block(law, build(law.Params, values), T_S)
    w = [2e-6, 6e-6, 3e-6]
    u = []
    for each in w:
        W = Reference(each, 0.0, 0.0)
        u.append(block.output(W, W, Estimate(each, 0.0, 0.0)))
        block.update()
        if law is predictive:
            block.s = block.s._replace(x1=0.0, x2=0.0, eps=0.0, eps_dot=0.0)
    expected = undone(BENT, np.array(w) / 0.142e-6)
    if law is predictive:  # its estimator starts at rest: only the first step is the law's own
        wanted = Block(law, build(law.Params, off), T_S)
        W = Reference(w[0], 0.0, 0.0)
        alone = wanted.output(W, W, Estimate(w[0], 0.0, 0.0))
        assert u[0] - alone == pytest.approx(expected[0] - w[0] / 0.142e-6)
    else:
        assert u == pytest.approx(expected.tolist())


def test_without_one_nothing_is_added():
    c = inverse.design(inverse.Params())
    assert inverse.fed(c, inverse.centred(c), -0.0) == 0.0
    assert math.copysign(1.0, inverse.fed(c, inverse.centred(c), -0.0)) == -1.0


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"thresholds": [0.0, 2.0]}, "one weight for each threshold"),
        ({"thresholds": [1.0]}, "must begin at 0"),
        ({"thresholds": [], "weights": []}, "must begin at 0"),
        ({"thresholds": [0.0, 2.0, 2.0], "weights": [1.0, 0.1, 0.1]}, "must rise"),
        ({"weights": [0.0]}, "must be positive"),
        ({"thresholds": [0.0, 2.0], "weights": [0.5, -0.5]}, "must be positive"),
        ({"slopes": [1.0]}, "one slope more than knots"),
        ({"knots": [0.0, 0.0], "slopes": [1.0, 1.0, 1.0]}, "must rise"),
        ({"slopes": [1.0, 0.0]}, "must be 0.001 to 1000"),
        ({"alpha": 0.95}, "must be below"),
        ({"beta": 0.01}, "must be within"),
    ],
)  # fmt: skip
def test_a_hysteresis_without_an_inverse_is_refused_in_one_line(values, text):
    with pytest.raises(ParameterError, match=text) as error:
        build(inverse.Params, values)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("law", [open_loop, pid, pidsmc])
def test_what_is_fed_forward_is_not_subtracted_as_eps_too(law):
    values = {**{f"inverse.{n}": v for n, v in PLAYS.items()}, "eps_compensation": True}
    with pytest.raises(ParameterError, match="counted twice"):
        build(law.Params, values)
