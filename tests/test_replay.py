"""Recorded runs of every mode, run again: the same to the bit, changes of parameters included."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient

from pea_core import config
from pea_experiment import experiments
from pea_record.copy import lacks
from pea_record.origin import ORIGIN
from pea_record.read import load, load_axes
from pea_record.recording import Recording
from pea_report.recorded import axes_experiment_of, experiment_of
from pea_report.replay import OUTPUTS, Replay, replay, replay_axes

FIG9 = "fig9_hysteresis_10hz"
SHORT = ("--duration", "0.0157")
T_NS = 50_000
NODES = ("plant", "observer", "controller", "reference")
RECORDER = "recorder"
GOLDEN = Path(__file__).parent / "golden"

SETTINGS = {
    "paper": (FIG9, *SHORT),
    "noisy": (
        *(FIG9, *SHORT, "--seed", "5"),
        *("--set", "plant.hysteresis.type=prandtl_ishlinskii"),
        *("--set", "plant.sensor.noise_nm=0.7"),
        *("--set", "plant.creep.enabled=true"),
        *("--set", "plant.delay_samples=1"),
        *("--set", "plant.voltage_min=-20"),
        *("--set", "plant.voltage_max=110"),
        *("--set", "observer.type=extended_state"),
        *("--set", "controller.preset=recommended"),
    ),
}


def again(path: Path) -> tuple[Recording, Replay]:
    recording = load(path)
    return recording, replay(recording, experiment_of(recording, path), path)


@pytest.mark.parametrize("setting", SETTINGS)
@pytest.mark.parametrize("mode", ["batch", "composed", "distributed"])
def test_every_mode_replays_exactly(recorded, mode, setting):
    run = recorded(mode, *SETTINGS[setting])

    recording, found = again(run.directory)

    assert lacks(recording) == []
    assert (len(found.samples), found.first) == (314, None)
    told = recording.metadata[ORIGIN]
    seed = "5" if setting == "noisy" else "1"
    assert (told["experiment"], told["mode"], told["seed"]) == (FIG9, mode, seed)
    assert told["parameters"] == (run.directory / "params.yaml").read_text()


@pytest.mark.parametrize("mode", ["batch", "composed", "distributed"])
def test_metrics_prove_that_nothing_is_missing(recorded, mode):
    topics = recorded(mode, *SETTINGS["paper"]).metrics["topics"]

    for name in ("/pea/displacement", "/pea/state", "/pea/voltage"):
        span = {"first_ns": 0, "last_ns": 313 * T_NS}
        assert topics[name] == {"messages": 314, **span, "gaps": 0, "repeats": 0}
    assert topics["/pea/reference"]["last_ns"] >= 313 * T_NS


def size(bag: Path) -> int:
    return sum(path.stat().st_size for path in bag.glob("*.mcap"))


def set_live(ros: Any, node: str, values: dict[str, Any]) -> None:
    """Set parameters of a running node, one after the other."""
    client = AsyncParameterClient(ros.node, f"/pea/{node}")
    assert ros.until(client.services_are_ready)
    for name, value in values.items():
        future = client.set_parameters([Parameter(name, value=value)])
        assert ros.until(future.done)
        (result,) = future.result().results
        assert result.successful, result.reason


LIVE = {"P": 0.0001 + 0.0002, "m": 21000.000000000004}
"""New gains in which every bit matters."""


def assert_replays_with_changes(path: Path) -> None:
    recording, found = again(path)

    before = [e for e in recording.events if e.node == "/pea/controller" and e.changed]
    changes = [e for e in before if e.stamp]  # at 0 it has taken over the plant's limits
    merged = {name: value for event in changes for name, value in event.changed.items()}
    assert merged == LIVE
    assert all(e.stamp % T_NS == 0 and e.stamp < recording.last for e in changes)
    assert (found.first, found.changes) == (None, len(before))
    assert len(found.samples) == len(recording.samples)

    recording.events.remove(changes[-1])
    without = replay(recording, experiment_of(recording, path), path)
    first = without.first
    assert first is not None
    # without a bump: the first voltage after the change is still the same, to rounding
    if first.sample * T_NS == changes[-1].stamp:
        assert first.first == pytest.approx(first.second, rel=1e-14)
    else:
        assert first.sample * T_NS == changes[-1].stamp + T_NS


def test_live_changes_of_separate_nodes_are_replayed(ros, tmp_path):
    file = str(config.find("experiments", FIG9, "experiment"))
    for node in NODES:
        ros.start(node, "--ros-args", "--params-file", file, "-p", "wait_for_recorder:=true")
    ros.start(RECORDER, "--ros-args", "-p", f"out:={tmp_path / 'bag'}")
    assert ros.until(lambda: size(tmp_path / "bag") > 50_000)
    set_live(ros, "controller", LIVE)
    before = size(tmp_path / "bag")
    assert ros.until(lambda: size(tmp_path / "bag") > before + 50_000)
    for node in (*NODES, RECORDER):
        assert ros.end(node) == 0, ros.log(node)

    assert_replays_with_changes(tmp_path / "bag")


def test_a_live_change_of_one_of_two_axes_is_replayed(ros, tmp_path):
    """From one file of both axes, as the launch files start the nodes."""
    file, bag = tmp_path / "two.yaml", tmp_path / "bag"
    config.write(file, experiments.load_axes(FIG9, ["axes=[x, y]"]).sections())
    for node in NODES:
        ros.start(node, "--ros-args", "--params-file", str(file), "-p", "wait_for_recorder:=true")
    ros.start(RECORDER, "--ros-args", "-p", f"out:={bag}")
    assert ros.until(lambda: size(bag) > 50_000)
    set_live(ros, "controller", {"y.P": LIVE["P"]})
    before = size(bag)
    assert ros.until(lambda: size(bag) > before + 50_000)
    for node in (*NODES, RECORDER):
        assert ros.end(node) == 0, ros.log(node)

    recording = load_axes(bag)
    what = axes_experiment_of(recording, bag)
    whole = replay_axes(recording, what, bag)
    assert [(axis, one.first) for axis, one in whole.items()] == [("x", None), ("y", None)]
    (change,) = [e for e in recording.events if e.node == "/pea/controller" and e.stamp]
    assert change.changed == {"y.P": LIVE["P"]}
    recording.events.remove(change)
    without = replay_axes(recording, what, bag)
    assert without["x"].first is None
    assert without["y"].first.sample * T_NS >= change.stamp


def test_live_changes_of_composed_mode_are_replayed(ros, start_pea):
    running = start_pea(
        *("run", FIG9, "--mode", "composed", "--duration", "600", "--out", "run", "--json"),
        env={**ros.env, "PEA_COMPILE": "0"},
    )
    set_live(ros, "controller", LIVE)
    before = running.bag_size()
    assert ros.until(lambda: running.bag_size() > before + 50_000)
    running.process.send_signal(signal.SIGINT)
    assert running.finish().status == 130

    assert_replays_with_changes(running.there / "run")


@pytest.mark.parametrize("path", sorted(GOLDEN.glob("*.mcap")), ids=lambda path: path.stem)
def test_numerics_are_those_of_the_golden_recordings(path):
    """`pea replay FILE --update-golden` makes them anew, where the numerics are meant to change.

    Another machine or library may round otherwise, so that here the bits do not count.
    """
    _, found = again(path)

    assert len(found.samples) == 500
    for name in OUTPUTS["both"]:
        then, now = found.recorded[name], found.samples[name]
        assert np.abs(now - then).max() <= 1e-9 * np.abs(then).max(), name


def test_there_are_small_golden_recordings():
    sizes = [path.stat().st_size for path in GOLDEN.glob("*.mcap")]
    assert len(sizes) >= 3
    assert max(sizes) < 200_000
