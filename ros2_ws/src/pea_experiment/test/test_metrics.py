"""Scoring: which samples count, and what is made of them."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pea_core.signals import SAMPLE, TRUTH
from pea_experiment.metrics import metrics, trace_sha256, transient, unit
from pea_experiment.scoring import Move, Segment, of_round, scored, scoring, unsettled
from pea_record import large

T_S = 50e-6


def series(*rows):
    return [Segment(a, b, p, 1.0 / (p * T_S)) for a, b, p in rows]


ENDLESS = series((0.0, math.inf, 2000.0))


def test_one_sine_is_scored_over_its_last_whole_periods_in_the_second_half():
    (part,) = scored(10000, ENDLESS).values()
    assert part == slice(6000, 10000)


def test_a_run_of_one_period_is_scored_over_it():
    (part,) = scored(2500, ENDLESS).values()
    assert part == slice(500, 2500)


@pytest.mark.parametrize("segments", [[], ENDLESS])
def test_without_a_whole_period_the_second_half_counts(segments):
    assert scored(1001, segments) == {None: slice(500, 1001)}


def test_each_sine_of_a_series_is_scored_in_its_own_second_half():
    parts = scored(500, series((0.0, 200.0, 100.0), (200.0, 500.0, 50.0)))
    assert list(parts.values()) == [slice(100, 200), slice(350, 500)]


def test_a_sine_that_the_run_cuts_before_its_first_period_is_left_out():
    parts = scored(240, series((0.0, 200.0, 100.0), (200.0, 500.0, 50.0)))
    assert list(parts.values()) == [slice(100, 200)]


TWO = series((0.0, 200.0, 100.0), (200.0, 500.0, 50.0))


@pytest.mark.parametrize(("samples", "start"), [(500, 0), (999, 0), (1000, 500), (5100, 4500)])
def test_the_last_whole_round_of_a_series_is_scored(samples, start):
    found = of_round(TWO, samples)
    assert [s.start for s in found] == [start, start + 200]
    assert max(p.stop for p in scored(samples, found).values()) == start + 500


def test_a_series_that_never_ends_has_no_rounds():
    assert of_round(ENDLESS, 10**6) == ENDLESS
    assert of_round([], 10**6) == []


def test_the_soft_start_is_not_scored():
    assert list(scored(10000, ENDLESS, 5000).values()) == [slice(8000, 10000)]
    assert list(scored(1001, [], 501).values()) == [slice(751, 1001)]
    assert list(scored(500, TWO, 150).values()) == [slice(350, 500)]


@pytest.mark.parametrize(
    ("samples", "segments", "begin", "said", "warns"),
    [
        (10000, ENDLESS, 0, "0.3 to 0.5 s (2 periods of 10 Hz)", []),
        (
            2000,
            ENDLESS,
            0,
            "0 to 0.1 s (1 period of 10 Hz)",
            ["less than two periods of 10 Hz: the last is scored, start-up included; 0.2 s are"],
        ),
        (1000, ENDLESS, 0, "0.025 to 0.05 s (second half)", ["no whole period of 10 Hz: its sec"]),
        (1000, [], 0, "0.025 to 0.05 s (second half)", []),
        (300, TWO, 0, "0.005 to 0.01 s (1 period of 200 Hz); 0.0125", []),
        (240, TWO, 0, "0.005 to 0.01 s (1 period of 200 Hz)", ["400 Hz: not scored; 0.025 s are"]),
        (500, series((0.0, 500.0, 500.0)), 0, "0 to 0.025 s (1 period", ["reference.periods of 2"]),
        (4000, ENDLESS, 3000, "0.175 to 0.2 s (second", ["no whole period of 10 Hz"]),
        (100, [], 200, "0.0025 to 0.005 s", ["the run ends within the soft start of 0.01 s"]),
    ],
)
def test_what_is_scored_is_said_and_a_short_run_is_told(samples, segments, begin, said, warns):
    text, warnings = scoring(samples, segments, T_S, begin)
    assert text.startswith(said)
    assert len(warnings) == len(warns)
    assert all(some in warning for some, warning in zip(warns, warnings))


@given(
    st.integers(1, 5000), st.lists(st.tuples(st.integers(1, 40), st.floats(2.0, 300.0)), max_size=4)
)
def test_scored_parts_lie_in_the_run_and_do_not_overlap(samples, rows):
    starts = np.concatenate([[0.0], np.cumsum([n * p for n, p in rows])]).tolist()
    parts = scored(samples, series(*((a, b, p) for a, b, (_, p) in zip(starts, starts[1:], rows))))
    edges = [edge for part in parts.values() for edge in (part.start, part.stop)]
    assert edges == sorted(edges)
    assert edges[0] >= 0
    assert edges[-1] <= samples
    assert all(part.stop > part.start for part in parts.values())


def two_sines():
    """500 samples of w, and errors of 3 nm over the first sine and 5 nm over the second."""
    samples, true = np.zeros(500, SAMPLE), np.zeros(500, TRUTH)
    k = np.arange(500)
    samples["w"] = 5e-6 * np.sin(2 * np.pi * k / np.where(k < 200, 100, 50))
    true["x1"] = samples["w"] + np.where(k < 200, 3e-9, -5e-9)
    return samples, true


def test_each_sine_gets_its_own_figures():
    samples, true = two_sines()
    segments = series((0.0, 200.0, 100.0), (200.0, 500.0, 50.0))
    found = metrics(samples, true, segments, -20.0, 110.0)["segments"]
    assert [row["frequency_hz"] for row in found] == pytest.approx([200.0, 400.0])
    assert [row["rms_error_nm"] for row in found] == pytest.approx([3.0, 5.0])
    assert [row["max_error_nm"] for row in found] == pytest.approx([3.0, 5.0])
    assert [row["rms_error_percent"] for row in found] == pytest.approx([0.06, 0.1], rel=2e-3)


def test_the_run_is_scored_over_all_sines_together():
    samples, true = two_sines()
    segments = series((0.0, 200.0, 100.0), (200.0, 500.0, 50.0))
    found = metrics(samples, true, segments, -20.0, 110.0)
    union = math.sqrt((100 * 3.0**2 + 150 * 5.0**2) / 250)
    assert found["rms_error_nm"] == pytest.approx(union)
    assert found["max_error_nm"] == pytest.approx(5.0)
    assert found["scored_from_sample"] == 100


def test_what_is_not_scored_does_not_count():
    samples, true = two_sines()
    true["x1"][:100] += 1.0
    true["x1"][200:350] += 1.0
    segments = series((0.0, 200.0, 100.0), (200.0, 500.0, 50.0))
    assert metrics(samples, true, segments, -20.0, 110.0)["max_error_nm"] == pytest.approx(5.0)


def test_without_truth_the_measured_displacement_is_scored():
    samples, _ = two_sines()
    samples["y"] = samples["w"] + 2e-9
    found = metrics(samples, None, [], -20.0, 110.0)
    assert found["rms_error_nm"] == pytest.approx(2.0)
    assert found["observer_rms_x1_nm"] is None
    assert found["eps_max_V"] is None


def test_voltage_steps_and_saturation_are_of_the_command():
    samples, true = two_sines()
    samples["u"] = np.where(np.arange(500) % 2, 111.0, 109.0)
    found = metrics(samples, true, [], -20.0, 110.0)
    assert found["rms_voltage_step_V"] == pytest.approx(2.0)
    assert found["saturated_samples"] == 250


def test_largest_eps_and_what_is_left_of_it():
    samples, true = two_sines()
    true["eps"][7], samples["eps_hat"][7] = -6.0, -5.5
    found = metrics(samples, true, [], -20.0, 110.0)
    assert found["eps_max_V"] == 6.0
    assert found["eps_left_max_V"] == 0.5


def test_the_figures_of_a_run_are_the_same_in_pieces(monkeypatch):
    rng = np.random.default_rng(1)
    samples, true = two_sines()
    for name in samples.dtype.names:
        samples[name] += 1e-9 * rng.standard_normal(len(samples))
    segments = series((0.0, 200.0, 100.0), (200.0, 500.0, 50.0))
    whole = metrics(samples, true, segments, -1e-9, 1e-9)
    monkeypatch.setattr(large, "PIECE", 7)
    found = metrics(samples, true, segments, -1e-9, 1e-9)
    parts, whole_parts = found.pop("segments"), whole.pop("segments")
    assert found.pop("trace_sha256") == whole.pop("trace_sha256")
    assert found == pytest.approx(whole, rel=1e-12)
    for one, other in zip(parts, whole_parts, strict=True):
        assert one == pytest.approx(other, rel=1e-12)


def test_digest_takes_every_array_in():
    samples, _ = two_sines()
    digest = trace_sha256(samples)
    for name in ("y", "x1_hat", "x2_hat", "eps_hat", "u", "u_applied"):
        other = samples.copy()
        other[name][0] = 1e-12
        assert trace_sha256(other) != digest


def second_order(zeta, omega, samples, a=0.0, b=5e-6):
    """Closed form of an underdamped step from a to b (m)."""
    t = np.arange(samples) * T_S
    omega_d = omega * math.sqrt(1 - zeta**2)
    fading = np.exp(-zeta * omega * t)
    ringing = np.cos(omega_d * t) + zeta * omega / omega_d * np.sin(omega_d * t)
    return b + (a - b) * fading * ringing


def test_a_move_is_the_same_in_pieces(monkeypatch):
    x1 = second_order(0.3, 3000.0, 4000)
    whole = transient(x1, Move(0, 5e-6), T_S)
    monkeypatch.setattr(large, "PIECE", 7)
    assert transient(x1, Move(0, 5e-6), T_S) == whole


@pytest.mark.parametrize(("a", "b"), [(0.0, 5e-6), (5e-6, 0.0), (3e-6, -2e-6)])
def test_overshoot_is_that_of_the_closed_form(a, b):
    x1 = second_order(0.4, 1000.0, 2000, a, b)
    expected = 100 * math.exp(-math.pi * 0.4 / math.sqrt(1 - 0.16))
    assert transient(x1, Move(0, b), T_S)["overshoot_percent"] == pytest.approx(expected, rel=1e-3)


def test_times_count_from_where_the_move_starts():
    late = np.concatenate([np.zeros(100), 5e-6 * (1 - np.exp(-np.arange(900) * T_S / 2e-3))])
    found = transient(late, Move(100, 5e-6), T_S)
    assert found["rise_time_ms"] == pytest.approx(2.0 * math.log(9.0), abs=0.06)
    assert found["settling_time_ms"] == pytest.approx(2.0 * math.log(50.0), abs=0.06)
    assert found["overshoot_percent"] == 0.0


@pytest.mark.parametrize(
    ("samples", "move", "words"),
    [
        (400, Move(100, 5e-6), None),  # settled at 100 + 79 samples, scored from 200 on
        (300, Move(100, 5e-6), "at 0.005 s settles at 0.00895 s: its transient is scored; 0.0179"),
        (120, Move(100, 5e-6), "at 0.005 s has not settled to 2 %"),
        (400, Move(100, 5e-9), None),
        (400, None, None),
        (90, Move(100, 5e-6), "the run ends before the change of level at 0.005 s"),
        (90, Move(100, 5e-9), None),
    ],
)
def test_a_transient_that_is_scored_is_warned_of(samples, move, words):
    x1 = np.concatenate([np.zeros(100), 5e-6 * (1 - np.exp(-np.arange(300) * T_S / 1e-3))])
    x1 = x1[:samples]
    figures = {**transient(x1, move, T_S), "scored_from_sample": samples // 2}
    found = unsettled(figures, x1, move, T_S)
    assert words in found[0] if words else found == []


@pytest.mark.parametrize(
    ("x1", "move"),
    [
        (np.linspace(0.0, 1e-6, 50), None),
        (np.linspace(0.0, 1e-6, 50), Move(0, 5e-6)),
        (np.zeros(50), Move(0, 0.0)),
        (np.zeros(50), Move(50, 5e-6)),
        (np.full(50, 1e-9), Move(0, 0.0)),
    ],
    ids=["no move", "not over", "already there", "after the run", "below the noise"],
)
def test_where_there_is_no_move_there_are_no_figures(x1, move):
    assert set(transient(x1, move, T_S).values()) == {None}


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("rms_error_nm", "nm"),
        ("samples_per_s", "1/s"),
        ("drift_nm_per_s", "nm/s"),
        ("gain_um_per_V", "um/V"),
        ("median_density_nm_per_rtHz", "nm/√Hz"),
        ("creep_percent_per_decade", "%/decade"),
        ("slew_um_s", "um/s"),
        ("exchange_us_p50", "us"),
        ("samples", ""),
        ("taken_per_turn", ""),
    ],
)
def test_the_unit_of_a_metric_is_in_its_name(name, told):
    assert unit(name) == told
