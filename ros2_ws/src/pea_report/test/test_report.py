"""The report of recordings: one page that needs nothing else, with every figure in it."""

import base64
import dataclasses
import io
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image
from rosbags.typesys import Stores, get_typestore

from pea_cli import cli
from pea_core.signals import SAMPLE
from pea_experiment import experiments
from pea_experiment.metrics import metrics
from pea_experiment.scoring import Segment
from pea_record.bag import BagWriter
from pea_record.copy import cut
from pea_record.origin import ORIGIN, origin
from pea_record.read import load
from pea_record.rows import record
from pea_report import figures as report
from pea_run.modes import batch
from pea_wire.topics import DIAGNOSTICS

SINE = ("fig9_hysteresis_10hz", ("reference.frequency_hz=200",), 0.02)
N, T_NS = 400, 50_000


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    """Two runs with different gains."""
    there = tmp_path_factory.mktemp("bags")
    for name, sets in (("first", ()), ("second", ("controller.P=0.001",))):
        experiment = experiments.load(SINE[0], (*SINE[1], *sets), SINE[2])
        batch.run(experiment, there / name, lambda k: None)
    return there / "first", there / "second"


@pytest.fixture
def quick(monkeypatch):
    """Pages with blank figures, for what is not about figures."""
    monkeypatch.setattr(report, "figure", lambda *_: report.plt.figure(figsize=(1, 1)))


def status(capsys, *arguments):
    code = cli.main(["report", *map(str, arguments)])
    return code, capsys.readouterr()


class Page(HTMLParser):
    """What a browser would load, and the text of its tables."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.rows, self._cell = [], [], False
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        self._cell = tag in ("td", "th")
        if tag == "tr":
            self.rows.append([])
        elif self._cell:
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        self._cell = self._cell and tag not in ("td", "th")

    def handle_data(self, data):
        if self._cell:
            self.rows[-1][-1] += data

    def row(self, name):
        (found,) = (row[1:] for row in self.rows if row and row[0] == name)
        return found

    @property
    def pictures(self):
        """Source of each picture, for a light page and for a dark one."""
        return [a.get("src") or a.get("srcset") for t, a in self.tags if t in ("img", "source")]


def picture(source):
    head, data = source.split(",", 1)
    assert head == "data:image/png;base64"
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("L"), float)


def test_page_needs_nothing_but_itself(tmp_path, bags, capsys):
    out = tmp_path / "page.html"
    code, said = status(capsys, bags[0], "--out", out)

    assert (code, said.err) == (0, "")
    text = out.read_text()
    page = Page(text)
    assert not re.search(r"https?:|@import|url\(", re.sub(r"base64,[^\"]*", "", text))
    assert not {"link", "iframe"} & {tag for tag, _ in page.tags}
    scripts = [attributes for tag, attributes in page.tags if tag == "script"]
    assert scripts
    assert all(script.get("src", "data:").startswith("data:") for script in scripts)
    dark, light = (picture(source) for source in page.pictures)
    assert np.median(light) > 240 > 40 > np.median(dark)
    assert "prefers-color-scheme: dark" in text
    beside = np.asarray(Image.open(out.with_suffix(".png")).convert("L"), float)
    assert np.array_equal(beside, light)


def test_metrics_are_those_of_the_run(tmp_path, bags, capsys, quick):
    out = tmp_path / "page.html"
    code, said = status(capsys, *bags, "--out", out, "--json")

    assert code == 0
    told = json.loads(said.out)
    page = Page(out.read_text())
    assert page.rows[0] == ["", "first", "second", ""]
    rms = [told["metrics"][str(bag)]["rms_error_nm"] for bag in bags]
    assert page.row("rms_error_nm") == [*(f"{value:.6g}" for value in rms), "nm"]
    assert rms[0] != rms[1]
    assert page.row("controller.P")[1] == "0.001"
    assert page.row("complete") == ["yes", "yes"]
    span = f"{N} messages, 0 gaps, 0 repeats, 0.000000 s to 0.019950 s"
    assert page.row("/pea/voltage") == [span, span]
    (deadlines,) = set(page.row("deadlines"))
    assert deadlines.startswith("no metrics.json beside the bag says")
    assert len(page.pictures) == 3 * 2


def test_deadlines_are_shown_where_the_run_has_kept_them(tmp_path, bags, capsys, quick):
    kept = tmp_path / "bag"
    kept.mkdir()
    for file in bags[0].iterdir():
        (kept / file.name).write_bytes(file.read_bytes())
    (kept / "metrics.json").write_text(json.dumps({"deadlines": {"missed": 7, "rate_hz": 2e4}}))
    assert status(capsys, kept)[0] == 0
    page = Page((kept / "analysis.html").read_text())
    assert page.row("deadlines: missed") == ["7"]
    assert page.row("deadlines: rate_hz") == ["20000"]


def test_what_nodes_said_at_last_and_every_transition_of_safety_is_shown(
    tmp_path, bags, capsys, quick
):
    types = get_typestore(Stores.ROS2_JAZZY)
    kinds = {name.rsplit("/", 1)[1]: kind for name, kind in types.types.items()}

    def told(k, name, message):
        stamp = kinds["Time"](0, k * T_NS)
        status = kinds["DiagnosticStatus"](
            0, name, message, "pea", [kinds["KeyValue"]("k", str(k))]
        )
        array = kinds["DiagnosticArray"](kinds["Header"](stamp, ""), [status])
        return bytes(types.serialize_cdr(array, DIAGNOSTICS.type))

    with BagWriter(tmp_path / "bag", T_NS) as bag:
        record(bag, 0, T_NS, load(bags[0]).samples)
        for k, name, message in (
            (10, "pea: loop", "late"),
            (20, "plant: safety", "armed -> running"),
            (30, "pea: loop", "fine"),
            (40, "plant: safety", "running -> fault"),
        ):
            bag.write(DIAGNOSTICS, k * T_NS, told(k, name, message))
    assert status(capsys, tmp_path / "bag")[0] == 0
    page = Page((tmp_path / "bag" / "analysis.html").read_text())
    assert page.row("/diagnostics: pea: loop") == ["fine: k 30"]
    assert page.row("/diagnostics: plant: safety at 0.001000 s") == ["armed -> running: k 20"]
    assert page.row("/diagnostics: plant: safety at 0.002000 s") == ["running -> fault: k 40"]


def test_interrupted_it_leaves_no_half_of_a_page(tmp_path, bags, capsys, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(report, "figure", interrupted)
    assert status(capsys, bags[0], "--out", tmp_path / "page.html")[0] == 130
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_written_over(tmp_path, bags, capsys, quick):
    out = tmp_path / "page.html"
    out.with_suffix(".png").write_bytes(b"mine")
    code, said = status(capsys, bags[0], "--out", out)
    assert code == 2
    assert "page.png exists already" in said.err
    assert out.with_suffix(".png").read_bytes() == b"mine"
    assert not out.exists()
    bag = tmp_path / "bag"
    bag.mkdir()
    (file,) = bags[0].glob("*.mcap")
    (bag / "a.mcap").write_bytes(file.read_bytes())
    for name in ("analysis.html", "analysis-2.html"):
        assert status(capsys, bag)[0] == 0
        assert (bag / name).exists()


def test_bag_that_does_not_say_what_ran_is_reported_all_the_same(tmp_path, bags, capsys, quick):
    with BagWriter(tmp_path / "bag", T_NS) as bag:
        bag.metadata(ORIGIN, origin("", {}, "distributed", T_NS))  # nobody told the recorder
        record(bag, 0, T_NS, load(bags[0]).samples)
    assert status(capsys, tmp_path / "bag")[0] == 0
    text = (tmp_path / "bag" / "analysis.html").read_text()
    assert "The recording does not say." in text
    assert Page(text).row("samples")[0] == str(N)


def test_part_of_a_run_is_scored_by_the_periods_that_it_holds(tmp_path, bags, capsys, quick):
    told = load(bags[0]).metadata[ORIGIN]
    cut(bags[0], tmp_path / "part", 150 * T_NS, N * T_NS, told)
    code, said = status(capsys, tmp_path / "part", "--json")
    assert code == 0
    (figures,) = json.loads(said.out)["metrics"].values()
    assert [s["frequency_hz"] for s in figures["segments"]] == [200.0]
    assert figures["scored_from_sample"] == 250 - 100
    w = load(tmp_path / "part").samples["w"][150:]
    y = load(tmp_path / "part").samples["y"][150:]
    assert figures["max_error_nm"] == pytest.approx(np.abs(y - w).max() * 1e9)


def one_file(there, name, data):
    (there / name).write_bytes(data)
    return there / name


def other_period(there, samples):
    """A bag whose messages have another period than its parameters say."""
    experiment = experiments.load(*SINE)
    with BagWriter(there / "bag", 2 * T_NS) as bag:
        bag.metadata(ORIGIN, origin("x", experiment.sections(), "batch", T_NS))
        record(bag, 0, 2 * T_NS, samples)
    return there / "bag"


def other_version(there, samples):
    experiment = experiments.load(*SINE)
    with BagWriter(there / "bag", T_NS) as bag:
        told = origin("x", experiment.sections(), "batch", T_NS)
        bag.metadata(ORIGIN, {**told, "format": "99"})
        record(bag, 0, T_NS, samples)
    return there / "bag"


def without_messages(there, samples):
    BagWriter(there / "bag", T_NS).close()
    return there / "bag"


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda there, s: there / "nowhere", "does not exist"),
        (lambda there, s: there, "no .mcap file in it"),
        (lambda there, s: one_file(there, "a.mcap", b"no bag"), "is no MCAP file"),
        (lambda there, s: one_file(there, "a.mcap", b""), "is empty"),
        (without_messages, "holds no message of /pea/displacement, /pea/state, /pea/voltage"),
        (other_period, "a sample every 100000 ns, and its parameters say T_s = 50000 ns"),
        (other_version, "is of format '99': this version knows 1"),
    ],
)
def test_what_cannot_be_reported_is_one_line(tmp_path, bags, capsys, make, words):
    path = make(tmp_path, load(bags[0]).samples)
    code, said = status(capsys, bags[0], path, "--out", tmp_path / "page.html")
    assert (code, said.out) == (2, "")
    assert said.err.startswith("pea: ")
    assert said.err.count("\n") == 1
    assert words in said.err
    assert not (tmp_path / "page.html").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--out", "page.pdf"), "must end in .html"),
        (("--out", "nowhere/page.html"), "there is no directory nowhere"),
        (("--out", "/proc/page.html"), "in a directory that you may write"),
        (("BAG",), "is given twice"),
    ],
)
def test_bad_option_is_one_line(bags, capsys, arguments, words):
    arguments = (str(bags[0]) if a == "BAG" else a for a in arguments)
    code, said = status(capsys, bags[0], *arguments)
    assert code == 2
    assert said.err.count("\n") == 1
    assert words in said.err


def made(n, error):
    """A run of n samples with a tracking error (m)."""
    samples = np.zeros(n, SAMPLE)
    samples["y"] = error
    samples["w"] = 1e-6 * np.sin(np.arange(n) * 0.1)
    samples["y"] += samples["w"]
    segments = (Segment(0.0, np.inf, 1000.0, 20.0),)
    figures = {"sample_period_ns": T_NS, **metrics(samples, None, segments, -20.0, 110.0)}
    return report.Run("made", np.arange(n) * 50e-6, samples, None, segments, figures)


def test_power_of_the_spectrum_is_the_mean_square():
    generator = np.random.default_rng(3)
    run = made(6000, 3e-9 + 2e-9 * generator.standard_normal(6000))
    f, S = report.error_spectrum(run)
    power = np.mean(run.error(slice(3000, 6000)) ** 2)
    assert np.sum(S) * f[1] == pytest.approx(power, rel=1e-9)


def test_cumulative_power_ends_at_the_mean_square_of_what_is_scored():
    error = 2e-9 * np.random.default_rng(5).standard_normal(7000)
    segments = (Segment(0.0, 3000.0, 1000.0, 20.0), Segment(3000.0, 7000.0, 800.0, 25.0))
    run = dataclasses.replace(made(7000, error), segments=segments)
    figures = metrics(run.samples, None, segments, -20.0, 110.0)
    f, P = report.error_power(run)
    assert np.all(np.diff(f) >= 0.0)
    assert np.sqrt(P[-1]) == pytest.approx(figures["rms_error_nm"], rel=1e-9)
    f, S = report.error_spectrum(run)
    assert np.sqrt(np.sum(S) * f[1]) == pytest.approx(figures["rms_error_nm"], rel=0.01)


def test_sine_is_one_line_of_the_spectrum():
    t = np.arange(20_000) * 50e-6
    f, S = report.error_spectrum(made(20_000, 5e-9 * np.sin(2 * np.pi * 140.0 * t)))
    line = int(np.argmax(S))
    assert f[line] == pytest.approx(140.0)
    assert S[line] * f[1] == pytest.approx(5.0**2 / 2)
    assert S[line] > 1e12 * np.delete(S, line).max()


def curve(x, y):
    run = report.Run("", np.arange(len(x)), x, None, (), {})
    return report.curve(run, x.__getitem__, y.__getitem__, slice(0, len(x)))


@pytest.mark.parametrize("thin", [curve, report.thin_log])
def test_thinning_keeps_spikes_of_both_columns(thin):
    x, y = np.arange(1.0, 500_001.0), np.zeros(500_000)
    y[[7, 123_456, 499_998]] = 3.0, -4.0, 5.0
    found_x, found_y = thin(x, y)
    assert len(found_x) <= report.POINTS + 2
    assert {3.0, -4.0, 5.0} <= set(found_y)
    assert np.isin([8.0, 123_457.0, 499_999.0], found_x).all()


def test_loop_of_a_long_run_keeps_the_spikes_of_its_voltage():
    x, y = np.zeros(100_000), np.zeros(100_000)
    x[54_321] = 9.0
    assert 9.0 in curve(x, y)[0]


@pytest.mark.parametrize(
    ("n", "segments", "end"),
    [
        (6000, (Segment(0.0, np.inf, 1000.0, 20.0),), slice(4000, 6000)),
        (6000, (Segment(0.0, 2500.0, 1000.0, 20.0),), slice(500, 2500)),
        (1000, (Segment(0.0, np.inf, 1000.0, 20.0),), slice(0, 1000)),
        (6000, (), slice(5700, 6000)),
        (1, (), slice(0, 1)),
    ],
)
def test_end_of_a_run_is_its_last_two_periods(n, segments, end):
    run = made(n, 0.0)
    assert report.Run("", run.t, run.samples, None, segments, run.figures).end == end


def test_every_panel_draws_several_runs():
    runs = [made(3000, 1e-9), made(5000, 0.0)]
    plot = report.figure("both", runs)
    assert len(plot.axes) == len(report.PANELS)
    assert all(axis.get_title() and axis.get_xlabel() and axis.get_ylabel() for axis in plot.axes)
    report.plt.close(plot)
