"""Figures for papers: of runs, of a report, of a loop in theory."""

import re

import numpy as np
import pytest

from pea_cli.cli import main
from pea_core.signals import SAMPLE
from pea_experiment import experiments
from pea_lab.bode import responses
from pea_lab.check import check
from pea_lab.linear import systems
from pea_lab.plot import save_as
from pea_report import figures
from pea_run.modes import batch


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    there = tmp_path_factory.mktemp("run") / "bag"
    batch.run(experiments.load("sine_series", (), 0.02), there, lambda k: None)
    return there


@pytest.mark.parametrize(("name", "begins"), [("a.pdf", b"%PDF"), ("a.svg", b"<?xml")])
def test_panels_become_a_file_of_the_kind_that_its_name_says(bag, tmp_path, name, begins):
    file = tmp_path / name
    assert main(["figure", str(bag), "tracking", "error", "--out", str(file)]) == 0
    data = file.read_bytes()
    assert data.startswith(begins)
    if name.endswith(".svg"):
        assert b">Tracking<" in data  # text stays text
        assert b"http://" not in data.split(b"<defs>")[-1].replace(b"http://www.w3.org", b"")


def test_without_panels_the_figure_is_that_of_the_run(bag, tmp_path):
    file, again = tmp_path / "a.svg", tmp_path / "b.svg"
    assert main(["figure", str(bag), "--out", str(file)]) == 0
    data = file.read_bytes()
    assert b">Hysteresis loop, scored part<" in data
    assert data.startswith(b"<?xml")
    assert main(["figure", str(bag), "--out", str(again)]) == 0
    assert again.read_bytes() == data


def test_that_of_a_measured_response_is_gain_and_phase(tmp_path):
    bag, file = tmp_path / "bag", tmp_path / "a.svg"
    batch.run(experiments.load("fig5_frequency_response", (), 0.2), bag, lambda k: None)
    assert main(["figure", str(bag), "--out", str(file)]) == 0
    text = file.read_text(encoding="utf-8")
    assert ">Gain (dB of 1 µm/V)<" in text
    assert ">1000<" in text  # a tick of a logarithmic axis is a number
    assert "mathdefault" not in text


def test_a_drawing_of_many_samples_is_small_and_has_its_one_spike(tmp_path):
    samples = np.zeros(100_000, SAMPLE)
    samples["y"] = np.random.default_rng(1).normal(0.0, 1e-9, len(samples))
    samples["y"][61_803] = 1e-6
    t = np.arange(len(samples)) * 50e-6
    run = figures.Run("spike", t, samples, None, (), {}, points=figures.FILE_LINE)
    file = tmp_path / "a.svg"
    save_as(figures.paper([run], ["tracking"]), file)
    data = file.read_bytes()
    assert len(data) < 100_000
    heights = [float(y) for y in re.findall(rb"L \S+ (\S+) ", data)]
    assert min(heights) < np.median(heights) - 50.0  # pt


def test_what_is_wrong_is_one_line_and_writes_nothing(bag, tmp_path, capsys):
    for words, says in (
        (["figure", str(bag), "trackin", "--out", "a.pdf"], "did you mean tracking"),
        (["figure", str(bag), "tracking", "--out", "a.doc"], "must end in .pdf, .svg, .png"),
        (["check", "fig9_hysteresis_10hz", "--plot", "a.doc"], "must end in .pdf, .svg, .png"),
        (["report", str(bag), "--pdf", "a.doc"], "must end in .pdf"),
    ):
        words = [str(tmp_path / word) if word.startswith("a.") else word for word in words]
        assert main(words) == 2
        assert says in " ".join(capsys.readouterr().err.split())
    assert not list(tmp_path.iterdir())


def test_check_draws_the_loop_whose_margins_it_tells(tmp_path):
    experiment = experiments.load("sine_series", ("controller.preset=recommended",))
    f, L = responses(experiment)
    sampled = systems(experiment)["loop"]
    z = np.exp(2j * np.pi * f[::200] * experiment.T_s)
    expected = [-sampled(point) for point in z]
    assert np.allclose(L[::200], np.ravel(expected), rtol=1e-6)
    modulus = check(experiment)["modulus_margin"]
    assert np.abs(1.0 + L).min() == pytest.approx(modulus, rel=0.01)
    file = tmp_path / "loop.svg"
    words = ["check", "sine_series", "--set", "controller.preset=recommended"]
    assert main([*words, "--plot", str(file)]) == 0
    assert b">Nyquist<" in file.read_bytes()


def test_a_law_that_switches_has_no_frequency_response(tmp_path, capsys):
    words = ["check", "sine_series", "--set", "controller.type=smc", "--plot"]
    assert main([*words, str(tmp_path / "a.pdf")]) == 2
    assert "linear" in capsys.readouterr().err


def test_a_report_as_pdf_has_a_page_a_panel(bag, tmp_path):
    file = tmp_path / "all.pdf"
    words = ["report", str(bag), "--out", str(tmp_path / "a.html"), "--pdf", str(file)]
    assert main(words) == 0
    assert file.read_bytes().count(b"/Type /Page ") == 10
