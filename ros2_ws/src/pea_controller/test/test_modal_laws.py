"""Laws on modes behind a delay, held against a simulation that is written here."""

import numpy as np
import pytest
from scipy.linalg import expm

from pea_controller.model import harmonics, pidsmc, pidsmc_modal, state_feedback
from pea_core.modal import ModalModel, Noises, inverse, optimal_gain, sampled
from pea_core.params import ParameterError
from pea_core.signals import Estimate, Reference

T_S = 50e-6
MODEL = ModalModel((4643.2741, 12566.3706), (0.01, 0.01), (0.135, 0.007))


class Stage:
    """Modes by matrix exponentials over tenths of a sample; a command late by so many tenths."""

    def __init__(self, model, tenths, sensor):
        self.parts = []
        for omega, zeta, K in zip(model.omega_n, model.zeta, model.K, strict=True):
            A = np.array([[0.0, 1.0, 0.0], [-(omega**2), -2 * zeta * omega, K * 1e-6 * omega**2],
                          [0.0, 0.0, 0.0]])  # fmt: skip
            self.parts.append([expm(A * T_S / 10), np.zeros(2)])
        self.commands, self.seen = [0.0] * tenths, [0.0] * (sensor + 1)

    def step(self, u, eps=0.0):
        """Displacement before the step, and y, as late as the sensor."""
        x = sum(part[1][0] for part in self.parts)
        self.seen = [*self.seen[1:], x]
        y = self.seen[0]
        self.commands += [u] * 10
        for _ in range(10):
            v = self.commands.pop(0) + eps
            for part in self.parts:
                part[1] = (part[0] @ np.append(part[1], v))[:2]
        return x, y


def follow(law, params, stage, w, samples, eps=lambda k: 0.0):
    c = law.design(params, T_S)
    s = law.start(c)
    error, y, u = [], 0.0, 0.0
    x, y = 0.0, 0.0
    ahead = int(params.preview)
    for k in range(samples):
        x = sum(part[1][0] for part in stage.parts)
        y = ([*stage.seen[1:], x])[0]
        W, W_ff = w(k * T_S), w((k + ahead) * T_S)
        estimate = Estimate(y, 0.0, 0.0)
        u = law.output(c, s, W, W_ff, estimate)
        s = law.update(c, s, W, W_ff, estimate, u)
        stage.step(u, eps(k))
        error.append(x - W.w)
    return np.array(error)


def raised(f):
    """5 - 5 cos, in m."""
    o = 2 * np.pi * f

    def w(t):
        c, s = np.cos(o * t), np.sin(o * t)
        return Reference(5e-6 * (1 - c), 5e-6 * o * s, 5e-6 * o * o * c)

    return w


@pytest.mark.parametrize(
    ("delay", "fraction", "sensor"), [(0, 0, 0), (1, 0, 0), (1, 3, 3), (2, 7, 6)]
)
@pytest.mark.parametrize("law", [state_feedback, pidsmc_modal])
def test_the_exact_model_is_followed_whatever_is_late(law, delay, fraction, sensor):
    model = ModalModel(MODEL.omega_n, MODEL.zeta, MODEL.K, fraction * T_S / 10)
    gains = {} if law is state_feedback else {"m": 400.0, "P": 1e-4}
    params = law.Params(
        model=model, delay_samples=delay, sensor_delay_samples=sensor,
        estimator=Noises(0.7, 1000.0, 0.02), **gains,
    )  # fmt: skip
    stage = Stage(model, 10 * delay + fraction, sensor)
    error = follow(law, params, stage, raised(100.0), 3600)
    assert np.abs(error[-400:]).max() < 1e-9  # what the start has excited has rung down


def test_an_unknown_input_is_taken_off():
    params = state_feedback.Params(model=MODEL, delay_samples=1, sensor_delay_samples=3,
                                   estimator=Noises(0.7, 485.0, 0.0184), effort=250.0)  # fmt: skip
    stage = Stage(MODEL, 10, 3)
    error = follow(state_feedback, params, stage, raised(10.0), 4000, lambda k: 3.0 * (k > 50))
    assert np.abs(error[60:200]).max() > 100e-9
    assert np.abs(error[-200:]).max() < 2e-9


def test_a_stage_of_another_gain_is_adapted_to():
    stage_model = ModalModel(MODEL.omega_n, MODEL.zeta, tuple(1.1 * K for K in MODEL.K))
    errors = []
    for adaptation in (0.0, 50.0):
        params = state_feedback.Params(
            model=MODEL, delay_samples=1, estimator=Noises(0.7, 1789.0, 0.097), effort=596.0,
            adaptation=adaptation,
        )  # fmt: skip
        error = follow(state_feedback, params, Stage(stage_model, 10, 0), raised(50.0), 6000)
        errors.append(np.sqrt(np.mean(error[-400:] ** 2)))
    assert errors[1] < 0.1 * errors[0]


def test_what_repeats_is_learned_whatever_is_late():
    law, model = state_feedback, ModalModel(MODEL.omega_n, MODEL.zeta, MODEL.K, 0.4 * T_S)
    params = law.Params(
        model=model, delay_samples=1, sensor_delay_samples=2,
        estimator=Noises(0.7, 1000.0, 0.05),
        learning=harmonics.Params("iterative", rate=1.0, bandwidth_hz=950.0, period_max=0.02,
                                  spread_frequency=0.005),
    )  # fmt: skip
    f = 133.7  # no whole number of samples

    def eps(k):
        x = 2 * np.pi * f * k * T_S
        return 3.0 * np.sin(x) + np.cos(3 * x) + 0.5 * np.sin(5 * x)

    stage = Stage(model, 14, 2)
    error = follow(law, params, stage, raised(f), 5200, eps)
    assert np.std(error[750:900]) > 10e-9
    assert np.std(error[-300:]) < 0.05 * np.std(error[750:900])


def test_an_unstable_zero_is_inverted_from_the_future():
    model = ModalModel((4643.2741, 12566.3706), (0.01, 0.01), (0.135, -0.03))
    assert inverse(model, T_S).ahead > 0
    params = state_feedback.Params(model=model, delay_samples=1,
                                   estimator=Noises(0.7, 10.0, 1e-4), effort=1e6)  # fmt: skip
    error = follow(state_feedback, params, Stage(model, 10, 0), raised(150.0), 3000)
    assert np.abs(error[-400:]).max() < 3e-9


def test_one_mode_without_delay_is_the_pidsmc_of_the_paper():
    plain = pidsmc.Params(m=5000.0, P=0.0012, I=6.0, D_c=1e-8, eps_compensation=True)
    gains = {"m": 5000.0, "P": 0.0012, "I": 6.0, "D_c": 1e-8}
    ours = pidsmc_modal.design(pidsmc_modal.Params(**gains), T_S)
    c = pidsmc.design(plain, T_S)
    rng = np.random.default_rng(5)
    v_I = ours_I = 0.0
    s, zero = pidsmc.start(c), Reference(0.0, 0.0, 0.0)
    for e1, e2, eps, eps_dot in rng.normal(size=(20, 4)) * [1e-6, 1e-3, 3.0, 0.0]:
        x = Estimate(e1, e2, eps)
        u = pidsmc.output(c, s._replace(v_I=v_I), zero, zero, x)
        e = np.array([e1, e2])
        q = ours.q.x @ e
        row = ours.g.x @ e + ours.g.eps * eps + ours.g.eps_dot * eps_dot
        assert -row - (ours_I + ours.I_T * q) / ours.D == pytest.approx(u, rel=1e-11)
        v_I += c.I_T * (5000.0 * e1 + e2)
        ours_I += ours.I_T * q
        assert ours_I == pytest.approx(v_I, rel=1e-11)


def test_the_sliding_motion_has_the_slope_and_the_other_modes_for_poles():
    from scipy.signal import ss2zpk

    from pea_core.modal import continuous

    A, B, _ = continuous(MODEL)
    S = pidsmc_modal.surface(MODEL, 700.0)
    zeros = ss2zpk(A, B, S[None, :], np.zeros((1, 1)))[0]
    other = 12566.3706 * np.exp(1j * (np.pi - np.arccos(0.01)))
    expected = np.sort_complex([-700.0, other, np.conj(other)])
    np.testing.assert_allclose(np.sort_complex(zeros), expected, rtol=1e-6)


def test_the_gain_is_that_of_python_control():
    import control

    of = sampled(MODEL, T_S)
    size = MODEL.size
    F, G = of.F * size / size[:, None], (of.G / size)[:, None]
    C = (of.C * size / MODEL.gain)[None, :]
    K = control.dlqr(F, G, C.T @ C, [[3.0]])[0]
    np.testing.assert_allclose(optimal_gain(MODEL, 3.0, T_S), np.asarray(K)[0] / size, rtol=1e-6)


@pytest.mark.parametrize(
    ("values", "rule"),
    [
        ({"model": ModalModel((70000.0,), (0.01,), (0.1,))}, "below half the sample rate"),
        ({"model": ModalModel((4643.0,), (0.01,), (0.1,), 0.0021)}, "as far as the reference"),
    ],
)
def test_models_that_cannot_be_sampled_are_refused(values, rule):
    with pytest.raises(ParameterError, match=rule):
        state_feedback.design(state_feedback.Params(**values), T_S)


def test_a_law_without_its_feedforward_is_refused():
    with pytest.raises(ParameterError, match="feedforward = False"):
        state_feedback.Params(feedforward=False)
