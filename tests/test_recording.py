"""What every mode records: proof of completeness, a bag that a full disk leaves valid."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from rosbags.highlevel import AnyReader

from pea_experiment.experiments import load_axes
from pea_record.bag import TOPICS
from pea_record.copy import lacks
from pea_record.mcap import CHUNK_SIZE, RESERVE
from pea_record.read import load
from pea_run.run import run

FIG9 = "fig9_hysteresis_10hz"
SHORT = (FIG9, "--duration", "0.0157")
SAMPLES, T_NS = 314, 50_000
SAMPLED = ("/pea/displacement", "/pea/state", "/pea/voltage")
MODES = {
    "batch": ("batch",),
    "composed": ("composed",),
    "wall": ("composed", "--clock", "wall"),
    "distributed": ("distributed",),
}


@pytest.mark.parametrize("mode", MODES.values(), ids=MODES)
def test_metrics_and_bag_prove_that_nothing_is_missing(recorded, mode):
    name, *options = mode
    run = recorded(name, *SHORT, *options)

    expected = {
        "messages": SAMPLES,
        "first_ns": 0,
        "last_ns": (SAMPLES - 1) * T_NS,
        "gaps": 0,
        "repeats": 0,
    }
    recording = load(run.directory)
    told = recording.metadata[TOPICS]
    for topic in SAMPLED:
        assert run.metrics["topics"][topic] == expected
        assert yaml.safe_load(told[topic]) == expected
    reference = yaml.safe_load(told["/pea/reference"])
    assert reference["messages"] == recording.counts["/pea/reference"]
    assert lacks(recording) == []


@pytest.mark.parametrize("mode", ["batch", "distributed"])
def test_a_trip_of_the_gate_is_in_the_bag(start_pea, mode):
    low = "plant.safety.displacement_max_um=7.0"
    running = start_pea("run", *SHORT, "--set", low, "--mode", mode, "--out", "run")
    done = running.finish(100.0)

    assert done.status == 3
    assert "the safety gate has tripped: displacement_range at sample 27" in done.err
    with AnyReader([running.there / "run"]) as reader:
        told = [
            (reader.deserialize(data, connection.msgtype))
            for connection, _, data in reader.messages()
            if connection.topic == "/diagnostics"
        ]
    (trip,) = (m for m in told if m.status[0].name == "pea: plant: safety")
    assert trip.header.stamp.nanosec == 27 * T_NS
    (status,) = trip.status
    assert status.level == 2
    assert status.message == "active -> fault: displacement_range at sample 27"
    assert {pair.key: pair.value for pair in status.values}["after"] == "fault"


DISK = 1_200_000
"""Bytes that a file may have."""

OPEN = CHUNK_SIZE + CHUNK_SIZE // 8 + RESERVE
"""Bytes that are lost at most: one chunk, its index, and what stays free for the file's end."""


@pytest.mark.parametrize("mode", MODES.values(), ids=MODES)
def test_full_disk_leaves_a_valid_bag(start_pea, recorded, mode):
    running = start_pea(
        *("run", FIG9, "--duration", "0.9", "--mode", *mode, "--out", "run", "--json"),
        file_size=DISK,
    )
    done = running.finish(100.0)

    assert done.status == 3
    assert "Traceback" not in done.err
    (said,) = (line for line in done.err.splitlines() if line.startswith("pea: "))
    assert "run/run_0.mcap: File too large" in said
    run = running.there / "run"
    assert running.bag_size() > DISK - OPEN
    with AnyReader([run]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
    found = load(run)
    assert found.damage == ""
    assert min(counts[topic] for topic in SAMPLED) >= len(found.samples) > 0
    truth = load(recorded("batch", FIG9, "--duration", "0.9").directory).samples
    assert found.samples.tobytes() == truth[: len(found.samples)].tobytes()
    assert np.array_equal(found.stamps, np.arange(len(found.samples)) * T_NS)


@pytest.mark.parametrize("mode", MODES.values(), ids=MODES)
def test_run_in_several_files_is_the_same(recorded, mode):
    name, *options = mode
    quarter = (FIG9, "--duration", "0.25")
    whole = recorded("batch", *quarter)
    split = recorded(name, *quarter, *options, "--split-duration", "0.1")

    names = sorted(path.name for path in split.directory.glob("*.mcap"))
    assert names == [f"run_{i}.mcap" for i in range(len(names))]
    assert 2 <= len(names) <= 3
    with AnyReader([split.directory]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
    assert {counts[topic] for topic in SAMPLED} == {5000}
    one, other = load(whole.directory), load(split.directory)
    assert one.samples.tobytes() == other.samples.tobytes()
    assert lacks(other) == []
    assert split.metrics["trace_sha256"] == whole.metrics["trace_sha256"]


def test_other_libraries_read_every_value(tmp_path):
    """The command that does the same for 1.2 million samples."""
    script = Path(__file__).parent / "recording_figures.py"
    done = subprocess.run(
        [sys.executable, str(script), "--read-back", "0.05"], capture_output=True, text=True
    )

    assert done.returncode == 0, done.stdout + done.stderr
    *_, batch, wall = done.stdout.splitlines()
    for line in (batch, wall):
        assert "| 1000 | complete, replays exactly |" in line
        assert line.count("1000 samples, 0 values differ") == 2


@pytest.mark.parametrize("axes", [(), ("axes=[x, y]",)], ids=["one axis", "two"])
def test_a_run_that_is_interrupted_leaves_the_metrics_of_what_it_has_recorded(
    tmp_path, monkeypatch, axes
):
    monkeypatch.setenv("PEA_COMPILE", "0")

    def progress(samples: int) -> None:
        if samples >= 2000:
            raise KeyboardInterrupt

    whole = load_axes(FIG9, axes, duration=1e4)
    with pytest.raises(KeyboardInterrupt):
        run(whole, "batch", tmp_path, progress)
    told = json.loads((tmp_path / "metrics.json").read_text())
    assert told["warnings"][0] == f"interrupted after {told['samples']} of {10**4 * 20_000} samples"
    assert 2000 <= told["samples"] < 10**6
    part = load_axes(FIG9, axes, duration=told["samples"] * 50e-6)
    (tmp_path / "again").mkdir()
    again = run(part, "batch", tmp_path / "again", lambda samples: None)
    for name in ("scored", "rms_error_nm", "trace_sha256", "saturated_samples"):
        assert told[name] == again[name]


def test_a_run_that_is_interrupted_is_not_scored_where_it_shall_end_at_once(tmp_path, monkeypatch):
    def progress(samples: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setenv("PEA_COMPILE", "0")
    monkeypatch.setenv("PEA_SCORE", "0")
    with pytest.raises(KeyboardInterrupt):
        run(load_axes(FIG9, duration=1.0), "batch", tmp_path, progress)
    assert load(tmp_path).samples.size
    assert not (tmp_path / "metrics.json").exists()
