import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pea_report.decimation import FULL, extremes


def test_a_spike_of_one_sample_stays():
    quiet, spiky = np.zeros(10_000), np.zeros(10_000)
    spiky[7777] = -1.0
    assert 7777 in extremes((quiet, spiky), 800)


@pytest.mark.parametrize("unknown", [slice(2000, 2001), slice(2000, 2300), slice(9000, None)])
def test_a_spike_stays_beside_what_is_not_known(unknown):
    signal = np.zeros(10_000)
    spikes = {1700: 1.0, 2399: -1.0, 8999: 1.0}
    for k, value in spikes.items():
        signal[k] = value
    signal[unknown] = np.nan
    assert set(spikes) <= set(extremes((signal,), 800).tolist())


@settings(deadline=None)
@given(
    st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=300),
    st.integers(1, 120),
    st.integers(0, 10**9),
)
def test_least_and_greatest_of_every_row_stay(values, size, first):
    signal = np.array(values)
    kept = extremes((signal,), size, first)
    assert (np.diff(kept) > 0).all()
    rows = (first + np.arange(len(signal))) // size
    for row in np.unique(rows):
        inside = np.flatnonzero(rows == row)
        there = signal[np.intersect1d(kept, inside)]
        assert (there.min(), there.max()) == (signal[inside].min(), signal[inside].max())


def test_few_samples_all_stay():
    assert extremes((np.arange(100.0),), FULL).tolist() == list(range(100))


@pytest.mark.parametrize("size", [50, 400])
def test_what_was_kept_stays_kept_when_more_come(size):
    signal = np.random.default_rng(0).normal(size=5000)
    early = extremes((signal[:4000],), size, 0)
    late = extremes((signal[1000:],), size, 1000) + 1000
    whole = slice(1000 - 1000 % -size, 4000 - 4000 % size)
    among = [k for k in early if whole.start + size <= k < whole.stop - size]
    assert set(among) <= set(late.tolist())
