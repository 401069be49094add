"""The chirp."""

import numpy as np
import pytest
from scipy.signal import chirp as scipy_chirp

from pea_core.block import Signal
from pea_core.params import ParameterError, build
from pea_reference.model import chirp

SWEEP = {"frequency_start_hz": 10.0, "frequency_end_hz": 200.0, "sweep_time": 0.1}
SWEEPS = ["linear", "logarithmic"]


def signal(T_s=1e-6, **values):
    return Signal(chirp, build(chirp.Params, {**SWEEP, **values}), T_s)


@pytest.mark.parametrize("sweep", SWEEPS)
def test_it_is_the_chirp_of_another_library(sweep):
    k = np.arange(0, 100000, 500)
    expected = 5.0 - 5.0 * scipy_chirp(k * 1e-6, 10.0, 0.1, 200.0, method=sweep)
    moving = signal(sweep=sweep)
    np.testing.assert_allclose([moving.at(int(i)).w * 1e6 for i in k], expected, atol=1e-9)


@pytest.mark.parametrize("sweep", SWEEPS)
@pytest.mark.parametrize("k", [4, 12345, 50000, 99000, 150000])
def test_derivatives(sweep, k, differences_agree):
    differences_agree(signal(sweep=sweep), k)


@pytest.mark.parametrize("sweep", SWEEPS)
def test_it_goes_on_without_a_jump(sweep, is_continuous):
    is_continuous(signal(sweep=sweep), 100000)


@pytest.mark.parametrize("sweep", SWEEPS)
def test_after_the_sweep_it_is_a_sine_of_the_end_frequency(sweep):
    w = [signal(50e-6, sweep=sweep).at(k) for k in (2000, 2100)]
    assert w[0].w == pytest.approx(w[1].w, rel=1e-9)  # one period of 200 Hz apart
    assert w[0].w_dot == pytest.approx(w[1].w_dot, rel=1e-9)


def test_equal_frequencies_give_a_sine():
    a = signal(sweep="logarithmic", frequency_end_hz=10.0)
    b = signal(sweep="linear", frequency_end_hz=10.0)
    assert a.at(33333) == b.at(33333)
    assert a.at(33333).w == pytest.approx(5e-6 - 5e-6 * np.cos(2 * np.pi * 10.0 * 0.033333))


@pytest.mark.parametrize("name", ["frequency_start_hz", "frequency_end_hz"])
def test_frequency_beyond_half_the_sample_rate_is_refused(name):
    with pytest.raises(ParameterError, match=f"{name} = 20000: must be below half"):
        signal(50e-6, **{name: 20000.0})
