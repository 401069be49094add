"""Triggered recordings: which samples are kept, in which files, and what stays in memory."""

import contextlib
import math
import tracemalloc

import numpy as np
import pytest

from pea_core.params import ParameterError
from pea_core.signals import SAMPLE
from pea_record.bag import WHOLE, BagWriter
from pea_record.copy import lacks
from pea_record.read import files_of, load, load_axes
from pea_record.rows import record
from pea_record.trigger import (
    TRIGGER,
    Trigger,
    TriggeredBag,
    fired,
    opened,
    trigger_of,
    windows,
)
from pea_wire import convert, diagnostics, events
from pea_wire.topics import (
    DIAGNOSTICS,
    PARAMETER_EVENTS,
    RECORDED_TOPICS,
    REFERENCE,
    SAMPLED,
    TIME,
    Topic,
)

T_NS = 100_000
N = 20_000
K = np.arange(N)


def samples(n=N):
    """A sine of 1 Hz and 1 um, wanted; measured with a spike of 50 nm at samples 7000 and 7600."""
    rows = np.zeros(n, SAMPLE)
    rows["w"] = 1e-6 * np.sin(2 * np.pi * np.arange(n) * T_NS * 1e-9)
    rows["y"] = rows["w"]
    rows["y"][[7000, 7600]] += 50e-9
    rows["u"] = np.arange(n)
    rows["y_dot"] = math.nan
    return rows


def taken(directory, trigger, rows=None, piece=700, events_=None, also=()):
    """Record samples in pieces with a trigger."""
    rows = samples() if rows is None else rows
    bag = opened(directory, T_NS, trigger=trigger, events=events_)
    also = dict(also)
    with bag:
        for k in range(0, len(rows), piece):
            record(bag, k, T_NS, rows[k : k + piece])
            for at in [at for at in also if k <= at < k + piece]:
                bag.write(also[at][0], at * T_NS, also[at][1])
    return bag


@pytest.mark.parametrize("piece", [1, 37, 1000, 16_000])
def test_windows_hold_every_sample_around_a_trigger_and_no_other(tmp_path, piece):
    first = 6850 if piece == 1 else 0
    rows = samples()[first : 7850 if first else None]
    directory = tmp_path / "bag"
    bag = TriggeredBag(directory, T_NS, WHOLE, Trigger("abs_error", 20.0, "rising", 0.01, 0.02))
    with bag:
        for k in range(0, len(rows), piece):
            part = rows[k : k + piece]
            record(bag, first + k, T_NS, part, signal=part["u"])
    found = load(directory)
    k = found.stamps // T_NS
    assert k.tolist() == [*range(6900, 7201), *range(7500, 7801)]
    assert found.samples["u"].tolist() == found.signal.tolist() == k.tolist()
    np.testing.assert_array_equal(found.samples["w"], samples()["w"][k])
    assert lacks(found) == []
    assert [w.fired // T_NS for w in windows(found.metadata)] == [7000, 7600]
    assert (bag.windows, bag.kept, bag.seen) == (2, 602, len(rows))
    assert found.metadata[TRIGGER]["source"] == "abs_error"
    files = files_of(directory)
    parts = [load(file).stamps // T_NS for file in files]
    assert [(part[0], part[-1]) for part in parts] == [(6900, 7200), (7500, 7800)]


def test_a_trigger_within_a_window_makes_it_longer(tmp_path):
    taken(tmp_path / "bag", Trigger("error", 20.0, "rising", 0.02, 0.05))
    found = load(tmp_path / "bag")
    assert (found.stamps // T_NS).tolist() == list(range(6800, 8101))
    assert len(files_of(tmp_path / "bag")) == 1
    assert len(windows(found.metadata)) == 1


@pytest.mark.parametrize(
    ("edge", "first"),
    [("rising", [833, 10833]), ("falling", [4167, 14167]),
     ("either", [833, 4167, 10833, 14167])],
)  # fmt: skip
@pytest.mark.parametrize("source", ["y", "w", "x1_hat"])
def test_edges_of_a_signal(tmp_path, source, edge, first):
    rows = samples()
    rows["x1_hat"] = rows["y"] = rows["w"]
    taken(tmp_path / "bag", Trigger(source, 0.5, edge, 0.0, 0.0), rows)
    found = load(tmp_path / "bag").stamps // T_NS
    assert np.abs(found - first).max() <= 1


def test_a_level_keeps_all_that_lies_beyond_it(tmp_path):
    taken(tmp_path / "bag", Trigger("y", 0.5, "above", 0.001, 0.0))
    k = load(tmp_path / "bag").stamps // T_NS
    above = np.flatnonzero(samples()["y"] * 1e6 >= 0.5)
    wanted = np.unique(np.concatenate([above - i for i in range(11)]))
    assert k.tolist() == wanted.tolist()


def test_fired_needs_a_sample_before():
    values = np.array([2.0, 1.0, 2.0])
    assert fired(values, math.nan, 1.5, "rising").tolist() == [False, False, True]
    assert fired(values, 1.0, 1.5, "rising").tolist() == [True, False, True]
    assert fired(values, 1.0, 1.5, "above").tolist() == [True, False, True]


@pytest.mark.parametrize("source", ["trip", "parameter"])
def test_a_message_keeps_what_came_before_it_though_it_comes_late(tmp_path, source):
    message = {
        "trip": (DIAGNOSTICS, diagnostics.transition(9000 * T_NS, "run", "fault", "test")),
        "parameter": (PARAMETER_EVENTS, events.encode(9000 * T_NS, "/pea/plant", {"K": 1.0})),
    }
    other = "parameter" if source == "trip" else "trip"
    also = {9000: message[source], 3000: message[other]}
    rows = samples(40_000)
    taken(tmp_path / "bag", Trigger(source, pre=0.2, post=0.1), rows, 8000, also=also)
    found = load(tmp_path / "bag")
    assert (found.stamps // T_NS).tolist() == list(range(7000, 10_001))
    assert found.counts[DIAGNOSTICS.name] == found.counts[PARAMETER_EVENTS.name] == 1


def test_of_a_new_topic_what_lies_in_a_window_is_kept(tmp_path, monkeypatch):
    new = Topic("/pea/new", TIME, 1, "plant", (), latched=True)
    monkeypatch.setattr("pea_record.bag.RECORDED_TOPICS", (*RECORDED_TOPICS, new))
    with opened(tmp_path / "bag", T_NS, trigger=Trigger("abs_error", 20.0)) as bag:
        for k in (3000, 7000, 7100):
            bag.write(new, k * T_NS, convert.encode_time(k * T_NS))
        record(bag, 0, T_NS, samples())
    assert load(tmp_path / "bag").counts[new.name] == 2


def test_events_of_a_scan_trigger(tmp_path):
    from pea_reference.model import raster

    params = raster.Params(line_rate_hz=10.0, lines=4, flyback_lines=2)

    def found_events(first, last):
        return raster.events(params, T_NS * 1e-9, first, last)

    taken(tmp_path / "bag", Trigger("frame", pre=0.0, post=0.01), events_=found_events)
    found = load(tmp_path / "bag")
    assert [w.fired // T_NS for w in windows(found.metadata)] == [1000, 7000, 13000, 19000]
    with pytest.raises(ParameterError, match="trigger source 'frame': the reference is no scan"):
        opened(tmp_path / "no", T_NS, trigger=Trigger("frame"))


@contextlib.contextmanager
def traced():
    """Count the bytes that Python and NumPy hold."""
    tracemalloc.start()
    try:
        yield
    finally:
        tracemalloc.stop()


def test_memory_stays_constant_and_topics_may_lag(tmp_path):
    bag = TriggeredBag(tmp_path / "bag", T_NS, WHOLE, Trigger("y", 5.0, "rising", 0.1, 0.1))
    held = []
    with bag, traced():
        rows = samples()[:1000]
        for k in range(0, 200_000, 1000):
            stamps = (k + np.arange(1000)) * T_NS
            points = np.zeros((1000, 3))
            bag.write(
                REFERENCE,
                int(stamps[0]),
                convert.forms().reference.encode(int(stamps[0]), T_NS, points),
            )
            for topic in SAMPLED:
                late = stamps - 1000 * T_NS if topic == SAMPLED[1] else stamps
                if late[0] >= 0:
                    bag.write_many(topic, late, convert.forms().messages(topic, late, rows))
            bag.write(DIAGNOSTICS, int(stamps[0]), diagnostics.encode(0, "loop", 0, "", {}))
            held.append(tracemalloc.get_traced_memory()[0])
        assert held[-1] - max(held[:30]) < 200_000  # less than a byte a sample
        assert bag.windows == 0


def test_a_bag_without_a_window_is_a_valid_one(tmp_path):
    bag = taken(tmp_path / "bag", Trigger("y", 5.0))
    assert bag.said() == "trigger y: 0 windows, 0 of 20000 samples kept"
    assert (tmp_path / "bag" / "metadata.yaml").is_file()


def test_without_a_trigger_all_is_kept(tmp_path):
    bag = opened(tmp_path / "bag", T_NS)
    assert type(bag) is BagWriter
    bag.close()


@pytest.mark.parametrize(
    ("given", "text"),
    [
        (("hight", None, None, None, None), "trigger_source = 'hight': "),
        (("y", None, None, None, None), "'y': needs a level; add trigger_level in um"),
        (("abs_error", None, None, None, None), "needs a level; add trigger_level in nm"),
        (("x.trip", None, None, None, None), "'x.trip': trip is of all axes; give trip"),
        (("y", 1.0, "up", None, None), "trigger_edge = 'up': "),
        (("y", 1.0, None, -1.0, None), "trigger_pre = -1.0: must be 0 to 600 s"),
        (("y", 1.0, None, None, 1e9), "trigger_post = 1000000000.0: must be 0 to 600 s"),
        (("trip", 1.0, None, None, None), "trigger_level = 1.0: trip is no signal; omit it"),
        (("frame", None, "rising", None, None), "trigger_edge = rising: frame is no signal"),
        ((None, 1.0, None, None, None), "trigger_level = 1.0: has no source; add trigger_source"),
    ],
)  # fmt: skip
def test_what_is_no_trigger_is_refused_in_one_line(given, text):
    with pytest.raises(ParameterError) as refused:
        trigger_of(*given)
    assert text in str(refused.value)


def test_a_trigger_is_what_was_asked_for():
    assert trigger_of("y", 2.0, None, None, 0.5) == Trigger("y", 2.0, "rising", 0.1, 0.5)
    assert trigger_of(None, None, None, None, None) is None


@pytest.mark.parametrize(
    ("source", "first"), [("abs_error", [7000, 7600, 9000]), ("y.abs_error", [9000])]
)
def test_any_axis_fires_or_the_one_that_is_named(tmp_path, source, first):
    both = np.stack([samples(), samples()], axis=1)
    both["y"][:, 1] = both["w"][:, 1]
    both["y"][9000, 1] -= 50e-9
    bag = opened(tmp_path / "bag", T_NS, trigger=Trigger(source, 20.0, pre=0.001, post=0.001))
    with bag:
        for k in range(0, N, 500):
            record(bag, k, T_NS, both[k : k + 500], axes=("x", "y"))
    found = load_axes(tmp_path / "bag")
    assert [w.fired // T_NS for w in windows(found.metadata)] == first
    k = found.stamps // T_NS
    assert k.tolist() == [i for at in first for i in range(at - 10, at + 11)]
    assert (found.samples["y"] == both["y"][k]).all()
