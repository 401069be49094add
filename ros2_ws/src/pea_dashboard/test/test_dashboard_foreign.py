"""What others send to the dashboard: whatever it is, the page shows it or says what it is not."""

import json
import math
import os
import time
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pea_dashboard import desk as desks
from pea_dashboard.desk import HEALTH, Desk
from pea_dashboard.foreign import LONGEST, count, number, plain
from pea_dashboard.link import SUBJECTS, End, Link, Told
from pea_dashboard.live import BrowserFrames, view_of
from pea_dashboard.recording import Recordings
from pea_dashboard.trace import Trace
from pea_dashboard.window import View
from pea_wire import convert, events

T_NS = 50_000
ODD = ["many", "", "-1", "1e3", "nan", "inf", "9" * 5000, "\x1b[31m7", "\udcff", "٣", "[/red]"]


@given(st.text(st.characters()) | st.integers() | st.floats() | st.none())
def test_whatever_is_shown_is_printable_and_short(told):
    shown = plain(told)
    assert shown.isprintable()
    assert len(shown) <= LONGEST + 1
    json.dumps(shown, ensure_ascii=False).encode()


@given(st.text() | st.integers() | st.floats() | st.booleans() | st.none() | st.tuples())
def test_a_number_is_finite_and_a_count_is_whole(told):
    assert number(told) is None or math.isfinite(number(told))
    assert count(told) is None or count(told) >= 0


@pytest.mark.parametrize("odd", ODD)
def test_no_count_is_made_of_what_is_none(odd):
    assert count(odd) is None


# Diagnostics


def told(text="", level=0, age=0.0, **values):
    return Told(level, text, values, time.monotonic() - age)


@pytest.fixture
def desk():
    """A desk over a loop that runs, without ROS."""
    made = object.__new__(Desk)
    made.link = object.__new__(Link)
    made.link.namespace = "/pea"
    made.link.forget()
    made.permitted = ()
    made.link.ends = [End("/pea/displacement", ("plant",), ())]
    made.trace = Trace(2**12)
    made.trace.T_ns = T_NS
    made.link.trace = made.trace
    made.child = SimpleNamespace(runs=True, failed=False, outcome="", domain=1, plan=None)
    made.truth = SimpleNamespace(lost="")
    made.notice, made.rate = "", 20_024.0
    made.moved = made.counted = time.monotonic()
    made.link.diagnostics = {
        "loop": told("every deadline kept", missed="3", missed_fraction="0.01", backlog_samples="5")
    }
    return made


@pytest.mark.parametrize("odd", ODD)
def test_one_odd_count_leaves_every_other_figure(desk, odd):
    desk.link.diagnostics["rogue"] = told(lost_samples=odd)
    found = desk.health()
    assert tuple(found) == HEALTH
    assert found["rate"] == ("good", "20,024 of 20,000 Hz")
    assert found["missed"] == ("good", "3 (1.000%)")
    assert found["recorder"] == ("good", "keeps up")
    assert found["lost"][0] == "warning"
    assert "not a number" in found["lost"][1]


@pytest.mark.parametrize("odd", ODD)
@pytest.mark.parametrize("key", ["missed", "missed_fraction", "backlog_samples"])
def test_no_value_of_a_diagnostic_is_trusted(desk, key, odd):
    values = {"missed": "3", "missed_fraction": "0.01", "backlog_samples": "5", key: odd}
    desk.link.diagnostics["loop"] = told(**values)
    found = desk.health()
    assert found["rate"][0] == "good"
    assert all(isinstance(text, str) for _, text in found.values())


def test_losses_are_counted_over_all_nodes(desk):
    desk.link.diagnostics["plant"] = told(lost_samples="2")
    desk.link.diagnostics["rogue"] = told(lost_samples="many")
    desk.link.diagnostics["observer"] = told(lost_samples="40")
    assert desk.health()["lost"] == ("bad", "42")


def test_what_is_old_says_how_old_it_is(desk):
    desk.link.diagnostics = {"plant: gate": told("active", age=7.0, reason="none", late="1")}
    desk.moved -= 12.0
    found = desk.health()
    assert found["safety"] == ("stale", "active, 7 s ago")
    assert found["missed"][0] == "stale"
    assert found["rate"] == ("stale", "20,024 of 20,000 Hz, 12 s ago")
    assert desk.state == "standing"


def test_figures_that_nobody_counts_any_more_are_old(desk):
    desk.counted -= 5.0  # the thread that counts hangs, samples come
    assert desk.health()["rate"][0] == "stale"


def test_what_is_unforeseen_in_one_figure_stays_in_it(desk, monkeypatch):
    def fails(item, at, now):
        if item[1] == "keeps up":
            raise RuntimeError("unforeseen \x1b[31m")
        return item

    monkeypatch.setattr(desks, "aged", fails)
    desk.link.recorded = desk.trace.end
    found = desk.health()
    assert found["recorder"] == ("stale", "unknown: unforeseen �[31m")
    assert found["rate"][0] == "good"


# Messages


@pytest.fixture
def link():
    made = object.__new__(Link)
    made.namespace = "/pea"
    made.trace = Trace(2**12)
    made.changes = []
    made.changed = made.changes.append
    made.stale = set()
    made.forget()
    return made


def status(name, **values):
    pairs = [SimpleNamespace(key=key, value=value) for key, value in values.items()]
    return SimpleNamespace(name=name, level=b"\0", message="said\x1b[0m", values=pairs)


def test_diagnostics_of_anybody_take_bounded_memory(link):
    for i in range(1000):
        link.diagnosed(SimpleNamespace(status=[status(f"pea: rogue {i}", key="x" * 10_000)]))
    link.diagnosed(SimpleNamespace(status=[status("pea: loop", missed="1")]))
    assert len(link.diagnostics) == SUBJECTS
    assert link.diagnostics["loop"].values == {"missed": "1"}
    assert link.diagnostics["loop"].text == "said�[0m"
    assert all(len(each.values.get("key", "")) <= LONGEST + 1 for each in link.diagnostics.values())


def test_many_names_of_axes_take_no_memory(link):
    names = tuple(f"a{i}" for i in range(2000))
    link.name_axes(names)
    assert link.path is None


@given(st.binary(max_size=200))
def test_no_bytes_on_a_topic_end_the_listening(data):
    made = object.__new__(Link)
    made.namespace = "/pea"
    made.trace = Trace(2**12)
    made.stale = set()
    made.forget()
    made.trace.T_ns = T_NS
    made.values = {"controller": {"P": 0.001}}
    for take in (
        lambda data: made.block("displacement", convert.forms().displacement, data),
        lambda data: made.one("voltage", convert.forms().voltage, data),
        made.points,
        made.chunk,
        made.progress,
        made.changed_by,
    ):
        made.take("/topic", take, data)
        made.take("/topic", take, b"\0\1\0\0" + data)
    assert made.refused.isprintable()


@pytest.mark.parametrize("stamps", [[5, 5], [100, 50], [-50, 0], [-(2**63), 2**62]], ids=str)
def test_stamps_that_do_not_ascend_are_not_used(stamps):
    trace = Trace(2**12)
    values = {"y": np.zeros(2), "u_applied": np.zeros(2)}
    with pytest.raises(ValueError, match="must ascend"):
        trace.put("displacement", np.array(stamps, dtype=np.int64), values)
    assert trace.T_ns == 0


@pytest.mark.parametrize("changed", [{"P": "fast"}, {"nonsense": 1.0}, {"P": 3}], ids=str)
def test_a_change_that_no_node_can_have_made_is_not_shown(link, changed):
    link.values = {"controller": {"P": 0.001, "I": 0.06}}
    link.take("/parameter_events", link.changed_by, events.encode(0, "/pea/controller", changed))
    assert link.values == {"controller": {"P": 0.001, "I": 0.06}}
    assert link.changes == []
    assert "/pea/controller" in link.refused


# What a browser asks for


@pytest.mark.parametrize(
    "text",
    [
        *('{"span": NaN, "end": null}', '{"span": 1, "end": NaN}', '{"span": 1, "end": 1e999}'),
        *('{"span": 1, "end": -Infinity}', '{"span": 1, "end": 1e30}', '{"span": "x", "end": 1}'),
        *('{"span": true, "end": null}', '{"span": 1}', "[]", "null", "", "{", "[" * 9000),
        '{"span": 1, "end": %s}' % ("9" * 6000),
        '{"span": 1, "end": null, "source": "%s"}' % ("x" * 20_000),
    ],
    ids=lambda text: text[:40],
)
def test_nothing_is_shown_for_what_nobody_can_mean(text):
    assert view_of(text) is None


def test_a_picture_that_cannot_be_made_says_so_and_the_next_one_comes(desk, tmp_path):
    (tmp_path / "odd").mkdir()
    (tmp_path / "odd" / "a.mcap").write_bytes(b"\x89MCAP0\r\nnothing")
    desk.recordings = Recordings(tmp_path)
    desk.limits, desk.period = (math.nan, "x"), math.inf
    frames = BrowserFrames(desk)
    for source in (str(tmp_path / "odd"), "\udcff\x1b", ""):
        frames.view = View(source=source)
        frame = frames.next()
        size = int.from_bytes(frame[:4], "little")
        head = json.loads(frame[4 : 4 + size], parse_constant=lambda name: pytest.fail(name))
        assert head["word"].isprintable()
        assert frames.next() is None


# Recordings


def test_a_recording_of_any_name_is_listed_and_can_be_opened(tmp_path):
    names = [b"fine", b"bad\xff", b"bad\xfe", b"esc\x1b[31m", b"l" * 250, b"[red]", b"<b>"]
    for name in names:
        folder = os.fsencode(tmp_path) + b"/" + name
        os.mkdir(folder)
        open(folder + b"/a.mcap", "wb").close()
    found = Recordings(tmp_path)
    assert {os.fsencode(path.name) for path in found.paths.values()} == set(names)
    for name in found.names:
        assert name.isprintable()
        name.encode()


def test_a_folder_of_runs_that_cannot_be_read_has_no_recordings(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    for folder in ("file", "link", "nothing"):
        assert Recordings(tmp_path / folder).names == []


# The page


def test_what_fails_in_one_part_of_the_page_is_said_in_it():
    from nicegui import Client, ui
    from nicegui.page import page

    from pea_dashboard.page import Panel

    def fails():
        raise RuntimeError("no such thing \udcff")

    with Client(page("")):
        now = {"odd": False}
        broken = Panel("Recordings", fails)
        late = Panel("health", lambda: lambda: fails() if now["odd"] else None)
        whole = Panel("Run", lambda: ui.label("Run") and None)
        assert (late.word.text, whole.word.text) == ("", "")
        now["odd"] = True
        late.refresh()
        told = "cannot be shown: RuntimeError: no such thing �"
        assert broken.word.text == f"Recordings: {told}"
        assert late.word.text == f"health: {told}"
        now["odd"] = False
        late.refresh()
        assert late.word.text == ""
