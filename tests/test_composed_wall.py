"""Composed mode in wall time: the same bits as batch, all samples, a good end; no timing."""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import pytest
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rosbags.highlevel import AnyReader

from pea_record.read import load

FIG9 = "fig9_hysteresis_10hz"
NOISY = (
    *("--set", "plant.hysteresis.type=prandtl_ishlinskii"),
    *("--set", "plant.sensor.noise_nm=0.7"),
    *("--set", "plant.delay_samples=1"),
    *("--set", "observer.type=extended_state"),
    *("--set", "controller.preset=recommended"),
)
WALL = ("--clock", "wall")
pytestmark = pytest.mark.alone

SETTINGS = {
    "paper": (FIG9, "--duration", "0.0157"),
    "longer than a ring": (FIG9, "--duration", "3.5"),
    "noisy": (FIG9, "--duration", "0.1", "--seed", "5", *NOISY),
}
FIGURES = {
    *("rate_hz", "missed_fraction", "missed", "bursts"),
    *("lateness_us_p50", "lateness_us_p99", "lateness_us_p999", "lateness_us_max"),
}


def of_type(directory: Path, topic: str) -> list:
    with AnyReader([directory]) as reader:
        chosen = [c for c in reader.connections if c.topic == topic]
        return [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(chosen)]


@pytest.mark.parametrize("setting", SETTINGS.values(), ids=SETTINGS)
def test_wall_time_has_the_bits_of_batch(recorded, setting):
    batch, wall = recorded("batch", *setting), recorded("composed", *setting, *WALL)
    assert wall.metrics["trace_sha256"] == batch.metrics["trace_sha256"]
    assert wall.metrics["samples"] == batch.metrics["samples"]
    assert wall.metrics["lost_samples"] == 0
    one, other = load(batch.directory), load(wall.directory)
    assert np.array_equal(one.stamps, other.stamps)
    assert one.samples.tobytes() == other.samples.tobytes()
    assert one.after.tobytes() == other.after.tobytes()


def test_a_run_takes_the_time_that_it_is_about(recorded):
    figures = recorded("composed", *SETTINGS["noisy"], *WALL).metrics
    assert figures["loop_s"] >= figures["duration_s"]
    assert 0.0 < figures["real_time_factor"] <= 1.0


def test_deadlines_are_in_metrics_and_diagnostics(recorded):
    run = recorded("composed", *SETTINGS["noisy"], *WALL)
    deadlines = run.metrics["deadlines"]
    assert deadlines.keys() >= FIGURES
    order = [deadlines[f"lateness_us_{name}"] for name in ("p50", "p99", "p999", "max")]
    assert order == sorted(order)
    assert deadlines["missed"] == round(deadlines["missed_fraction"] * run.metrics["samples"])
    assert deadlines["bursts"] <= deadlines["missed"]
    status = of_type(run.directory, "/diagnostics")[-1].status[0]
    assert status.name == "pea: loop"
    told = {pair.key: pair.value for pair in status.values}
    assert told["samples"] == str(run.metrics["samples"])
    assert told.keys() >= FIGURES
    assert float(told["missed"]) == deadlines["missed"]


def test_deadlines_are_drawn(start_pea):
    command = ("run", *SETTINGS["paper"], "--mode", "composed", *WALL, "--out", "run", "--json")
    running = start_pea(*command, drawn=True)
    assert running.finish().metrics["lost_samples"] == 0
    for figure in ("report.png", "deadlines.png"):
        assert (running.there / "run" / figure).stat().st_size > 1000


def test_other_modes_have_no_deadlines(recorded):
    assert "deadlines" not in recorded("batch", *SETTINGS["noisy"]).metrics


def test_plain_python_has_the_same_bits(start_pea, user_environment, recorded):
    setting = SETTINGS["paper"]
    plain = start_pea(
        *("run", *setting, "--mode", "composed", *WALL, "--out", "run", "--json"),
        env=user_environment(PEA_COMPILE="0"),
    )
    batch = recorded("batch", *setting).metrics
    assert plain.finish().metrics["trace_sha256"] == batch["trace_sha256"]


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM], ids=lambda s: s.name)
def test_interrupted_run_closes_its_bag(start_pea, signum):
    running = start_pea(
        *("run", FIG9, "--mode", "composed", *WALL, "--duration", "60", "--out", "run"), drawn=True
    )
    running.midway()
    running.process.send_signal(signum)
    done = running.finish()
    assert done.status == 130
    assert "interrupted" in done.err
    assert "Traceback" not in done.err
    recording = load(running.there / "run")
    assert recording.damage == ""
    assert not any(recording.gaps.values())
    assert not any(recording.repeats.values())
    assert len(of_type(running.there / "run", "/pea/voltage")) == len(recording.samples)
    assert (running.there / "run" / "report.png").stat().st_size > 1000


def test_recording_that_fails_ends_the_run(start_pea):
    running = start_pea(
        *("run", FIG9, "--mode", "composed", *WALL, "--duration", "60", "--out", "run"),
        file_size=2_000_000,
    )
    done = running.finish()
    assert done.status == 3
    assert "Traceback" not in done.err
    assert len(load(running.there / "run").samples) > 0


def test_a_parameter_set_while_running_counts_between_two_samples(start_pea, user_environment, ros):
    env = user_environment(**{name: ros.env[name] for name in DISCOVERY})
    running = start_pea(
        *("run", FIG9, "--mode", "composed", *WALL, "--duration", "60", "--out", "run"), env=env
    )
    running.midway()
    client = ros.node.create_client(SetParameters, "/pea/controller/set_parameters")
    assert ros.until(client.service_is_ready)
    request = SetParameters.Request(parameters=[Parameter("P", value=0.002).to_parameter_msg()])
    asked = client.call_async(request)
    assert ros.until(asked.done)
    assert asked.result().results[0].successful
    size = running.bag_size()
    assert ros.until(lambda: running.bag_size() > size + 500_000)
    running.process.send_signal(signal.SIGINT)
    assert running.finish().status == 130
    recording = load(running.there / "run")
    (event,) = [e for e in recording.events if e.node == "/pea/controller"]
    assert event.changed == {"P": 0.002}
    assert 0 < event.stamp < recording.stamps[-1]
    assert event.stamp % 50_000 == 0
    assert not any(recording.gaps.values())


DISCOVERY = ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--clock", "wall"), "add --mode composed"),
        (("--mode", "composed", "--clock", "wal"), "unknown clock 'wal'"),
        (("--mode", "composed", "--clock", "wall", "--cpu", "999"), "must be one of"),
        (("--mode", "composed", "--clock", "wall", "--cpu", "one"), "must be one of"),
        (("--cpu", "0"), "is for wall time"),
    ],
)
def test_a_clock_that_cannot_be_is_refused(start_pea, arguments, words):
    done = start_pea("run", FIG9, *arguments).finish()
    assert done.status == 2
    assert words in done.err
    assert done.err.count("\n") == 1
