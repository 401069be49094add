"""95 % intervals of H, K, y_0, creep and noise hold in a Monte Carlo; every number has one."""

import numpy as np
import pytest

from pea_identify import creep, hysteresis, noise, slow
from pea_identify.excitation import triangles
from pea_identify.records import record
from pea_identify.results import numbers
from pea_identify.stage import identify

T_s = 1e-3
U = triangles(0.0, (80.0, 50.0, 70.0, 30.0, 60.0), 160)
ALL = np.ones(len(U), dtype=bool)


def share(hits):
    """95 % of 300 independent runs hold, within four standard deviations."""
    return np.mean(hits, axis=0)


def test_weights_gain_and_offset_of_plays():
    rng, r = np.random.default_rng(1), hysteresis.thresholds(U, 4)
    raw, y_0 = 1e-7 * np.array([0.6, 0.3, 0.2, 0.1]), 3e-8
    clean = hysteresis.plays(U, r) @ raw + y_0
    u_max = U.max()
    K = float(raw @ (u_max - r)) / u_max
    true = np.array([*(raw / K), K, y_0])
    held = []
    for _ in range(300):
        y = clean + 2e-8 * rng.standard_normal(len(U))
        fit = hysteresis.prandtl_ishlinskii(slow.Data(U, y, ALL, ~ALL), 4)
        said = np.array([*fit.values["weights"], fit.K, fit.offset])
        wide = np.array([*fit.intervals["weights"], fit.intervals["K"], fit.intervals["offset"]])
        held.append(np.abs(said - true) <= wide)
    assert (share(held) >= 0.90).all()
    assert (share(held) <= 0.99).all()


def test_a_straight_line_and_noise():
    rng, held = np.random.default_rng(2), []
    for _ in range(300):
        y = 1.4e-7 * U + 1e-8 + 2e-9 * rng.standard_normal(len(U))
        fit = hysteresis.straight(slow.Data(U, y, ALL, ~ALL))
        rest = noise.at_rest(2e-9 * rng.standard_normal(400))
        held.append(
            [
                abs(fit.K - 1.4e-7) <= fit.intervals["K"],
                abs(fit.offset - 1e-8) <= fit.intervals["offset"],
                abs(rest.rms - 2e-9) <= rest.rms_95,
            ]
        )
    assert (share(held) >= 0.90).all()
    assert (share(held) <= 0.99).all()


def test_creep(monkeypatch):
    monkeypatch.setattr(creep, "COUNTS", (1,))
    rng, held = np.random.default_rng(3), []
    u = np.concatenate([np.zeros(300), np.full(4000, 40.0)])
    clean = 1e-7 * creep.through(u, np.array([0.5]), np.array([0.03]), T_s)
    for _ in range(60):
        y = clean + 3e-9 * rng.standard_normal(len(u))
        found = creep.identify(record(u, y, T_s), 0.02)
        held.append(
            [
                abs(found.tau[0] - 0.5) <= found.tau_95[0],
                abs(found.weights[0] - 0.03) <= found.weights_95[0],
                abs(found.total - 0.03) <= found.total_95,
            ]
        )
    assert (share(held) >= 0.85).all()


@pytest.mark.parametrize("type", ["prandtl_ishlinskii", "modified_prandtl_ishlinskii", "bouc_wen"])
def test_every_number_of_a_fit_has_an_interval(type):
    v = hysteresis.driven(type, {}, U)
    y = 1.4e-7 * v + 1e-9 * np.random.default_rng(4).standard_normal(len(U))
    told = numbers(identify([record(U, y, T_s)], hysteresis_types=(type,)))["hysteresis"]
    for name in ("gain_um_per_V", "offset_um"):
        assert told[name]["low_95"] < told[name]["value"] < told[name]["high_95"]
    free = {"bouc_wen": ("alpha", "beta", "gamma")}.get(type, ("weights",))
    for name in free:
        assert np.shape(told["half_width_95"][name]) == np.shape(told["parameters"][name])
    if type.startswith("modified"):
        assert np.shape(told["half_width_95"]["slopes"]) == np.shape(told["slopes"])
