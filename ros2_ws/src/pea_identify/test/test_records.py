import numpy as np
import pytest

from pea_core.params import ParameterError
from pea_identify.records import kind_of, parts_of, period_of, record

T_s = 5e-5


def multisine(N=512, periods=4, seed=1):
    rng = np.random.default_rng(seed)
    spectrum = np.zeros(N // 2 + 1, dtype=complex)
    spectrum[1:100] = np.exp(2j * np.pi * rng.random(99))
    return np.tile(np.fft.irfft(spectrum, N), periods)


TRIANGLE = np.abs((np.arange(20_000) / 5000) % 2 - 1) * 40.0

KINDS = {
    "periodic": multisine(),
    "general": np.random.default_rng(2).standard_normal(4000),
    "slow": TRIANGLE,
    "step": np.concatenate([np.zeros(100), np.full(9000, 5.0)]),
    "rest": np.full(500, 3.0),
}


@pytest.mark.parametrize("kind", KINDS)
def test_kind_is_found_from_the_voltage(kind):
    assert kind_of(KINDS[kind][:, None], T_s) == kind


def test_period_is_found_and_its_first_one_left_out():
    u = multisine(N=700, periods=5)
    made = record(u, u * 1e-7, T_s)
    ((of_u, of_y, _),) = parts_of(made)
    assert made.period == 700
    assert of_u.shape == of_y.shape == (4, 700, 1)


def test_realisations_one_after_another_are_found_apart():
    u = np.concatenate([multisine(400, 4, seed) for seed in (1, 2, 3)])
    assert [len(p[0]) for p in parts_of(record(u, u * 1e-7, T_s))] == [3, 3, 3]


def test_measured_voltage_with_noise_still_repeats():
    u = multisine(600, 5)
    noisy = u + 2e-4 * np.ptp(u) * np.random.default_rng(3).standard_normal(len(u))
    assert period_of(noisy[:, None]) == 600


def holed(u):
    y = u * 1e-7
    y[70] = np.nan
    return u, y


def clipped(u):
    y = np.minimum(u, 0.6 * u.max()) * 1e-7
    return u, y


BAD = {
    "too short": ((np.ones(10), np.ones(10)), "too short"),
    "lengths": ((np.ones(100), np.ones(90)), "90"),
    "NaN": (holed(multisine()), "not finite.*sample 70"),
    "clipped": (clipped(multisine()), "clipped"),
    "unmoved": ((multisine(), np.full(2048, 1e-6)), "every sample"),
    "text": ((np.array(["a"] * 100), np.ones(100)), "numbers"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line(case):
    (u, y), words = BAD[case]
    with pytest.raises(ParameterError, match=words) as error:
        record(u, y, T_s, "mine")
    assert "\n" not in str(error.value)
    assert str(error.value).startswith("mine")


def test_data_that_do_not_repeat_are_refused_as_periodic():
    u = np.random.default_rng(4).standard_normal(3000)
    with pytest.raises(ParameterError, match="does not repeat"):
        record(u, u, T_s, kind="periodic")
    with pytest.raises(ParameterError, match="after 500 samples"):
        record(u, u, T_s, period=500)


def test_quantised_slow_motion_is_not_taken_for_clipped():
    y = np.round(TRIANGLE * 0.1e-6 / 5e-9) * 5e-9
    record(TRIANGLE, y, T_s)
