import json
from pathlib import Path

import control  # noqa: F401  slow to import: not within the time of a test
import numpy as np
import pytest

from pea_core.params import ParameterError
from pea_identify import axes, excitation, rational
from pea_identify.control_objects import ss_rational
from pea_identify.frequency_response import from_periods
from pea_identify.records import Periods, record

DATA = Path(__file__).parents[4] / "tests" / "data"


def test_golden_fit_of_a_steering_mirror():
    """Half of the realisations fitted, the other half predicted; no model is perfect: 5 %."""
    data = np.load(DATA / "fsm_excerpt.npz")
    U, Y, f = data["U"], data["Y"], data["lines"] / data["N"] * data["fs"]
    T_s = 1.0 / float(data["fs"])
    G = np.einsum("fir,frj->fij", Y[:, :, :3], np.linalg.inv(U[:, :, :3]))
    weight = np.broadcast_to(1.0 / np.abs(Y).std(axis=(0, 2))[:, None], (len(f), 3, 3))
    poles = rational.spread(620.0, 1080.0, 8, T_s, reals=2)
    model = rational.fit(f, G, weight, T_s, poles, direct=3)
    left = Y[:, :, 3:] - np.einsum("fij,fjr->fir", model(f), U[:, :, 3:])
    assert (np.abs(model.poles) < 1.0).all()
    assert np.linalg.norm(left) < 0.08 * np.linalg.norm(Y[:, :, 3:])


def made(residues=2, seed=1):
    rng = np.random.default_rng(seed)
    poles = np.array([0.98 * np.exp(0.6j), 0.97 * np.exp(1.2j), 0.8 + 0j])
    return rational.Rational(
        poles, rng.standard_normal((5, 2, 2)), rng.standard_normal((3, 2, 2)), 1e-3
    )


def test_a_rational_model_is_found_again():
    true = made()
    f = np.linspace(1.0, 490.0, 400)
    start = rational.spread(50.0, 300.0, 2, 1e-3, reals=1)
    found = rational.fit(f, true(f), np.ones((400, 2, 2)), 1e-3, start, direct=3)
    np.testing.assert_allclose(found(f), true(f), atol=1e-8)


def test_simulation_response_and_state_space_agree():
    model = made()
    f = np.array([3.0, 95.0, 190.0])
    system = ss_rational(model)
    said = np.array([system(np.exp(2j * np.pi * x * 1e-3)) for x in f])
    np.testing.assert_allclose(said, model(f), rtol=1e-9)
    u = np.zeros((4000, 2))
    u[0, 1] = 1.0
    y = model.simulate(u)
    by_fft = np.fft.rfft(y, axis=0)[[12, 380, 760]]
    np.testing.assert_allclose(by_fft, model(f)[:, :, 1], rtol=1e-6)


def test_axes_are_identified_from_orthogonal_multisines():
    true, rng, N = made(), np.random.default_rng(2), 512
    lines = excitation.lines_between(2.0, 480.0, N, 1e-3)
    u = np.concatenate([excitation.orthogonal(N, lines, 1.0, 2, rng) for _ in range(2)], axis=2)
    y = np.stack([true.simulate(np.tile(u[:, :, r], (6, 1)))[-N:] for r in range(4)], axis=2)
    found = axes.of_group(Periods(u[..., None], y[..., None], 1e-3, "mine"), (2, 3))
    assert found.nrmse < 1e-6
    assert found.model.parameters == found.model.residues.size + len(found.model.residues) + 12


def test_a_scheduled_model_is_kept_and_knows_its_amplitude(tmp_path):
    """Between two amplitudes the response is between theirs; a file holds all of it."""
    small, large = made(), made()._replace(residues=1.2 * made().residues)
    model = axes.Scheduled(np.array([0.1, 0.3]), (small, large))
    response = from_periods(np.ones((8, 1, 1, 1)), np.ones((8, 1, 1, 1)), 1e-3, np.array([0]))
    several = [axes.Axes(r, response, m, 0.05, ()) for r, m in zip((0.1, 0.3), (small, large))]
    there = tmp_path / "axes.json"
    there.write_text(json.dumps(axes.numbers(several)))
    kept = axes.loaded(there)
    assert kept.parameters == model.parameters == 2 + 2 * small.parameters
    rng, N = np.random.default_rng(1), 512
    u = rng.standard_normal((N, 2))
    u *= 0.2 / axes.rms_of(u)
    halfway = np.tile(u, (8, 1))
    y = 0.5 * (small.simulate(halfway) + large.simulate(halfway))[-N:]
    np.testing.assert_allclose(kept.steady(u), y, atol=1e-9 * np.abs(y).max())
    np.testing.assert_allclose(kept.simulate(halfway)[-N:], y, atol=1e-9 * np.abs(y).max())
    found = axes.compared(kept, [record(halfway, np.tile(y, (8, 1)), 1e-3, period=N)])
    assert found["mean_nrmse_percent"] < 1e-6
    assert model.shares(9.0) == [(1.0, large)]
    with pytest.raises(ParameterError, match="the model has 2 and 2"):
        axes.compared(kept, [record(halfway[:, :1], halfway, 1e-3, period=N)])
    there.write_text("{}")
    with pytest.raises(ParameterError, match=r"axes\.json of pea identify"):
        axes.loaded(there)


def test_too_few_realisations_are_refused():
    u = np.zeros((64, 2, 2, 1))
    with pytest.raises(ParameterError, match="at least 4"):
        axes.of_group(Periods(u, u, 1e-3, "mine"))


def test_axes_need_whole_periods():
    u = np.random.default_rng(1).standard_normal((500, 2))
    with pytest.raises(ParameterError, match="whole periods"):
        axes.identify([record(u, u, 1e-3)])
