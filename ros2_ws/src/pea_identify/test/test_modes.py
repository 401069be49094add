import control
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lfilter, ss2tf

from pea_core.params import ParameterError
from pea_identify import excitation, mode_fit, modes
from pea_identify.control_objects import frd, ss
from pea_identify.frequency_response import from_periods
from pea_identify.records import record
from pea_identify.stage import identify

T_s = 5e-5


def stepped(u, f, zeta, K, delay):
    """One mode by matrix exponentials of its real state space."""
    w = 2 * np.pi * f
    n, rest = int(delay / T_s), delay - int(delay / T_s) * T_s
    A, B = np.array([[0, 1], [-w * w, -2 * zeta * w]]), np.array([[0], [K * w * w]])

    def held(t):
        M = np.zeros((3, 3))
        M[:2, :2], M[:2, 2:] = A * t, B * t
        E = expm(M)
        return E[:2, :2], E[:2, 2:]

    onward, now = held(T_s - rest)
    y = np.zeros(len(u))
    for B_d, lag in ((now, n), (onward @ held(rest)[1], n + 1)):
        num, den = ss2tf(held(T_s)[0], B_d, np.array([[1.0, 0.0]]), np.zeros((1, 1)))
        y += lfilter(num[0], den, np.concatenate([np.zeros(lag), u[: len(u) - lag]]))
    return y


MODES = ((700.0, 0.012, 1.2e-7), (1900.0, 0.3, 2e-8))
DELAY = 3.37 * T_s


def experiment(noise=1e-9, seed=1, N=2048, realisations=4, periods=3, truth=MODES, lowest=50.0):
    rng = np.random.default_rng(seed)
    lines = excitation.lines_between(lowest, 6000.0, N, T_s)
    u = np.empty((N, 1, realisations, periods - 1))
    y = np.empty_like(u)
    for r in range(realisations):
        drive = np.tile(excitation.multisine(N, lines, 1.0, rng), periods)
        moved = sum(stepped(drive, *mode, DELAY) for mode in truth)
        moved += noise * rng.standard_normal(len(moved))
        u[:, 0, r] = drive[N:].reshape(-1, N).T
        y[:, 0, r] = moved[N:].reshape(-1, N).T
    return u, y


def test_modes_and_fractional_delay_are_found():
    u, y = experiment()
    whole = from_periods(u, y, T_s)
    fitted = mode_fit.fit(
        from_periods(u[:, :, :3], y[:, :, :3], T_s),
        from_periods(u[:, :, 3:], y[:, :, 3:], T_s),
        most=3,
        whole=whole,
    )
    assert len(fitted.omega_n) == 2
    for i, (f, zeta, K) in enumerate(MODES):
        assert fitted.omega_n[i] == pytest.approx(2 * np.pi * f, rel=1e-3)
        assert fitted.zeta[i] == pytest.approx(zeta, rel=0.02)
        assert fitted.K[i, 0, 0] == pytest.approx(K, rel=0.01)
    assert fitted.delay == pytest.approx(DELAY, abs=0.5e-6)
    assert fitted.gain[0, 0] == pytest.approx(1.4e-7, rel=2e-3)


def test_a_light_mode_far_above_does_not_hide_the_main_one():
    """Both are narrower than the lines are apart; either alone explains next to nothing."""
    truth = (639.24, 0.00535, 1.358e-7), (2003.8, 0.00857, 6.5e-9)
    u, y = experiment(0.7e-9, N=2000, truth=truth, periods=4, lowest=10.0)
    found = mode_fit.fit(
        from_periods(u[:, :, :3], y[:, :, :3], T_s), from_periods(u[:, :, 3:], y[:, :, 3:], T_s)
    )
    strong = found.shares > 0.02
    np.testing.assert_allclose(found.omega_n[strong] / (2 * np.pi), [639.24, 2003.8], rtol=1e-3)
    assert found.error < 0.05


def forgetting(u, share, rate):
    """Bouc-Wen with gamma = 0 at a small amplitude: h forgets along the way that u goes."""
    h, out, last = 0.0, np.empty(len(u)), 0.0
    for k, x in enumerate(u.tolist()):
        h = (h + share * (x - last)) * np.exp(-rate * abs(x - last))
        out[k], last = x - h, x
    return out


@pytest.mark.parametrize(("share", "rate"), [(0.25, 0.04), (0.4, 0.02), (0.15, 0.08)])
def test_hysteresis_that_forgets_inside_the_band_is_no_mode(share, rate):
    """The factor c/s alone took this for a mode below the band, of negative gain."""
    N, rng = 4096, np.random.default_rng(7)
    lines = excitation.lines_between(20.0, 3000.0, N, T_s)
    u, y = np.empty((N, 1, 6, 1)), np.empty((N, 1, 6, 1))
    for r in range(6):
        drive = np.tile(excitation.multisine(N, lines, 0.5, rng), 3)
        moved = stepped(forgetting(drive, share, rate), *MODES[0], DELAY)
        moved += 1e-9 * rng.standard_normal(len(moved))
        u[:, 0, r, 0], y[:, 0, r, 0] = drive[-N:], moved[-N:]
    fitted = mode_fit.fit(
        from_periods(u[..., :4, :], y[..., :4, :], T_s),
        from_periods(u[..., 4:, :], y[..., 4:, :], T_s),
        most=3,
        whole=from_periods(u, y, T_s),
    )
    assert len(fitted.omega_n) == 1
    assert fitted.omega_n[0] == pytest.approx(2 * np.pi * 700.0, rel=2e-3)
    assert fitted.gain[0, 0] == pytest.approx(MODES[0][2] * (1.0 - share), rel=0.03)


def test_objects_of_python_control_have_the_same_response():
    made = modes.Modes(
        omega_n=np.array([4400.0, 12000.0]),
        zeta=np.array([0.012, 0.3]),
        K=np.array([[[1.2e-7]], [[2e-8]]]),
        delay=DELAY,
        creep=0.0,
        omega_n_95=np.zeros(2),
        zeta_95=np.zeros(2),
        K_95=np.zeros((2, 1, 1)),
        delay_95=0.0,
        creep_95=0.0,
        gain_95=np.zeros((1, 1)),
        misfit=1.0,
        T_s=T_s,
    )
    f = np.array([10.0, 690.0, 705.0, 2500.0, 8000.0])
    system = ss(made)
    said = system(np.exp(2j * np.pi * f * T_s))
    np.testing.assert_allclose(said, made(f)[:, 0, 0], rtol=1e-9)
    u = np.random.default_rng(1).standard_normal(300)
    _, y = control.forced_response(system, np.arange(300) * T_s, u)
    np.testing.assert_allclose(y, made.simulate(u[:, None])[:, 0], atol=1e-18)
    N = 256
    u, y = experiment(N=N, realisations=1, periods=3)
    response = from_periods(u, y, T_s)
    assert frd(response)(2j * np.pi * response.f[3]) == pytest.approx(response.G[3, 0, 0])


def test_a_record_that_is_not_periodic_serves_too():
    rng = np.random.default_rng(5)
    u = lfilter([1.0], [1.0, -0.5], rng.standard_normal(6000))
    y = sum(stepped(u, *mode, DELAY) for mode in MODES) + 1e-10 * rng.standard_normal(len(u))
    stage = identify([record(u, y, T_s)], most_modes=2)
    first = int(np.abs(stage.modes.omega_n - 2 * np.pi * 700.0).argmin())
    assert stage.modes.omega_n[first] == pytest.approx(2 * np.pi * 700.0, rel=1e-3)
    assert stage.modes.zeta[first] == pytest.approx(0.012, rel=0.05)
    assert stage.modes.delay == pytest.approx(DELAY, abs=2e-6)
    assert any("Hysteresis is not determined" in s for s in stage.sentences)
    assert not any("doubtful" in s for s in stage.sentences)


def test_a_model_that_misses_the_response_is_called_doubtful():
    """White u, and y that is proportional to it at the same sample."""
    rng = np.random.default_rng(6)
    u = 20.0 + 0.5 * rng.standard_normal(6000)
    at_once = record(u, 1e-7 * u + 1e-9 * rng.standard_normal(len(u)), T_s)
    stage = identify([at_once], most_modes=1)
    (said,) = (s for s in stage.sentences if s.startswith("V is doubtful"))
    assert "--hold band_limited" in said
    assert stage.modes.error > 0.5


def test_too_few_lines_are_refused():
    u, y = experiment(N=256, realisations=1)
    few = from_periods(u, y, T_s).within(1000.0, 1400.0)
    with pytest.raises(ParameterError, match="8 frequencies"):
        mode_fit.fit(few)


def test_one_sine_does_not_excite_enough():
    u = np.sin(2 * np.pi * 500.0 * T_s * np.arange(4000))
    with pytest.raises(ParameterError, match="frequenc"):
        identify([record(u, 1e-7 * u, T_s, kind="general")])
