import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from pea_run.deadlines import PARTS, Deadlines, bin_of, edge

T_NS = 50_000


def counted(*begun: int, took: int = 1000, pieces: int = 1) -> Deadlines:
    times = np.array([[t, t + took] for t in begun], np.int64).reshape(-1, 2)
    deadlines = Deadlines(T_NS)
    for piece in np.array_split(times, pieces):
        deadlines.add(piece)
    return deadlines


@given(st.lists(st.integers(0, 2**62), min_size=1))
def test_a_lateness_lies_in_its_bin(values):
    ns = np.array(values, np.int64)
    bins = bin_of(ns)
    assert (bins < 64 * PARTS).all()
    assert (edge(bins) <= ns.astype(float)).all()
    assert (ns.astype(float) < edge(bins + 1)).all()


@given(st.integers(2 * PARTS, 2**40))
def test_a_bin_is_at_most_a_sixtyfourth_wide(ns):
    low, high = edge(bin_of(np.array([ns])) + np.array([0, 1]))
    assert (high - low) / low <= 1.0 / PARTS


@given(
    st.lists(st.integers(0, 10**9), min_size=1, max_size=300),
    st.sampled_from([0.5, 0.99, 0.999, 1.0]),
)
def test_quantiles_are_those_of_all_values_within_a_bin(values, q):
    exact = np.quantile(values, q, method="inverted_cdf")
    found = counted(*values).quantile(q)
    assert exact <= found <= max(exact * (1.0 + 1.0 / PARTS), exact + 1.0)


@given(st.lists(st.integers(0, 200_000), min_size=1, max_size=60), st.integers(1, 8))
def test_a_run_in_pieces_counts_as_one(values, pieces):
    whole, cut = counted(*values), counted(*values, pieces=pieces)
    assert cut.figures() == whole.figures()
    assert (cut.counts == whole.counts).all()


def test_a_sample_that_ends_with_the_period_is_in_time():
    assert counted(0, took=T_NS).missed == 0
    assert counted(1, took=T_NS).missed == 1


def test_missed_samples_in_a_row_are_one_burst():
    late, fine = 90_000, 100
    deadlines = counted(fine, late, late, late, fine, late, fine, fine, late)
    assert (deadlines.missed, deadlines.bursts, deadlines.longest_burst) == (5, 3, 3)


@pytest.mark.parametrize("pieces", range(1, 8))
def test_a_burst_across_pieces_is_one(pieces):
    late, fine = 90_000, 100
    deadlines = counted(fine, late, late, late, late, late, fine, pieces=pieces)
    assert (deadlines.bursts, deadlines.longest_burst) == (1, 5)


def test_figures_are_in_us_and_shares():
    figures = counted(*[1000] * 98, 2000, 120_000).figures()
    assert figures["missed"] == 1
    assert figures["missed_fraction"] == 0.01
    assert figures["lateness_us_p50"] == pytest.approx(1.0, rel=1.0 / PARTS)
    assert figures["lateness_us_p99"] == pytest.approx(2.0, rel=1.0 / PARTS)
    assert figures["lateness_us_p999"] == figures["lateness_us_max"] == 120.0


def test_rate_is_that_of_the_begins():
    assert counted(*[300] * 1000).rate_hz == pytest.approx(20_000.0)
    slower = counted(*(np.arange(1000) * 50_000).tolist())
    assert slower.rate_hz == pytest.approx(10_000.0)


def test_nothing_counted_is_no_error():
    deadlines = Deadlines(T_NS)
    deadlines.add(np.empty((0, 2), np.int64))
    figures = deadlines.figures()
    assert set(figures.values()) == {0}
    assert {"rate_hz", "missed_fraction", "missed", "bursts"} < figures.keys()


def test_memory_does_not_grow_with_the_run():
    assert counted(*range(10_000)).counts.nbytes == Deadlines(T_NS).counts.nbytes


@pytest.mark.parametrize("begun", [(0,), (100, 900, 70_000, 3_000_000)])
def test_picture_is_drawn(tmp_path, begun):
    counted(*begun).draw(tmp_path / "deadlines.png", "fig9")
    with Image.open(tmp_path / "deadlines.png") as picture:
        assert picture.size == (1080, 405)
