"""Names of a node's topics and neighbours follow its namespace and its remaps."""

import argparse
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from pea_cli import dashboard
from pea_cli import param as param_cli
from pea_core import config
from pea_core.config import NAMESPACE
from pea_core.params import ParameterError
from pea_dashboard import child
from pea_dashboard.link import Link
from pea_dashboard.stop import PlantProcess, processes
from pea_dashboard.trace import Trace
from pea_record.messages import Messages, diagnostics
from pea_ros.transport import full_name
from pea_wire.topics import (
    CONSUMED,
    DIAGNOSTICS,
    DISPLACEMENT,
    PARAMETER_EVENTS,
    STATE,
    VOLTAGE,
    Topic,
    blocks_of,
)


@contextmanager
def node(*arguments: str) -> Iterator[Any]:
    """A node of ours as a process with these ROS arguments has it."""
    context = rclpy.Context()
    rclpy.init(args=["--ros-args", *arguments], context=context)
    try:
        yield Node(
            "controller",
            namespace=NAMESPACE,
            context=context,
            enable_rosout=False,
            start_parameter_services=False,
        )
    finally:
        context.try_shutdown()


CASES: dict[str, tuple[tuple[str, ...], dict[Topic, str]]] = {
    "by default": ((), {VOLTAGE: "/pea/voltage", blocks_of(VOLTAGE): "/pea/voltage/blocks"}),
    "a namespace stands for pea": (
        ("-r", "__ns:=/stage1"),
        {
            VOLTAGE: "/stage1/voltage",
            CONSUMED: "/stage1/consumed",
            blocks_of(STATE): "/stage1/state/blocks",
            DIAGNOSTICS: "/diagnostics",
            PARAMETER_EVENTS: "/parameter_events",
        },
    ),
    "one in another": (("-r", "__ns:=/lab/a"), {DISPLACEMENT: "/lab/a/displacement"}),
    "blocks follow a remap": (
        ("-r", "voltage:=/b/u"),
        {VOLTAGE: "/b/u", blocks_of(VOLTAGE): "/b/u/blocks", STATE: "/pea/state"},
    ),
    "a remap by full name": (("-r", "/pea/state:=/b/state"), {STATE: "/b/state"}),
}


@pytest.mark.parametrize(("arguments", "names"), CASES.values(), ids=CASES)
def test_topics_are_where_the_user_puts_them(arguments, names):
    with node(*arguments) as made:
        assert {topic: full_name(made, topic) for topic in names} == names


@pytest.mark.parametrize("text", ["stage1", "/stage1", "/stage1/"])
def test_a_namespace_is_given_with_or_without_slash(text):
    assert param_cli.space(text.rstrip("/")) == "/stage1"
    assert param_cli.role("/stage1/controller", "/stage1") == "controller"


@pytest.mark.parametrize("text", ["", "/", "a b", "1a", "a//b", "/**"])
def test_a_namespace_that_is_none_is_refused(text):
    with pytest.raises(ParameterError, match="--namespace"):
        param_cli.space(text)


LOOSE = [
    word
    for limit in ("stale_samples=4000", "slew_samples=0", "following_samples=100000")
    for word in ("--set", f"plant.safety.{limit}")
]
"""Limits that a busy machine does not reach."""


def test_two_rigs_in_one_domain_run_and_trip_for_themselves(ros, tmp_path):
    """Both are started alike, but for their namespace."""
    runs, last = {}, {}
    for space in ("stage1", "stage2"):
        hear = lambda message, space=space: last.__setitem__(space, message)  # noqa: E731
        ros.node.create_subscription(JointState, f"/{space}/displacement", hear, 10)
        words = ("run", "fig9_hysteresis_10hz", "--rig", "simulated_200hz", "--duration", "60")
        more = ("--namespace", space, "--out", str(tmp_path / space), *LOOSE)
        with open(tmp_path / f"{space}.log", "wb") as log:
            runs[space] = subprocess.Popen(
                [sys.executable, "-P", "-m", "pea_cli.cli", *words, *more],
                env=ros.env,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
            )
    try:
        seen = ("stage1", "stage2")
        assert ros.until(lambda: all(s in last and last[s].header.stamp.nanosec for s in seen))
        stop = ros.node.create_client(Trigger, "/stage1/plant/stop")
        assert ros.until(stop.service_is_ready)
        answer = stop.call_async(Trigger.Request())
        assert ros.until(answer.done)
        assert ros.until(lambda: runs["stage1"].poll() is not None)
        assert runs["stage1"].returncode == 3
        assert "asked by ~/stop" in (tmp_path / "stage1.log").read_text()
        before = last["stage2"].header.stamp
        assert ros.until(lambda: last["stage2"].header.stamp != before)
        assert last["stage2"].header.frame_id == ""  # a sample: its gate is active
        assert runs["stage2"].poll() is None
        runs["stage2"].send_signal(signal.SIGINT)
        assert runs["stage2"].wait(20.0) == 130
    finally:
        for run in runs.values():
            if run.poll() is None:
                run.send_signal(signal.SIGINT)
            run.wait(20.0)
    for space, state in (("stage1", "fault"), ("stage2", "inactive")):
        told = [status for _, status in diagnostics(tmp_path / space)]
        assert {status.name.partition(":")[0] for status in told} == {"pea"}
        assert [s for s in told if s.name == "pea: plant: gate"][-1].message == state


def test_the_reference_of_a_foreign_controller_is_recorded_and_shown(ros, tmp_path, monkeypatch):
    """It publishes no `followed`: recorder and dashboard subscribe to the reference itself."""
    monkeypatch.setenv("ROS_DOMAIN_ID", ros.env["ROS_DOMAIN_ID"])
    voltage = ros.node.create_publisher(JointState, "/stage1/voltage", 10)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    consumed = ros.node.create_publisher(Time, "/stage1/consumed", latched)
    heard = []

    def law(state):
        heard.append(state)
        voltage.publish(JointState(header=state.header, name=state.name, effort=[1.0]))
        consumed.publish(state.header.stamp)

    ros.node.create_subscription(JointState, "/stage1/state", law, 10)
    ros.node.create_subscription(JointTrajectory, "/stage1/reference", lambda message: None, 10)
    trace = Trace()
    link = Link(trace, lambda change: None, "/stage1")
    try:
        file = str(config.find("experiments", "fig9_hysteresis_10hz", "experiment"))
        for name in ("plant", "observer", "reference", "recorder"):
            more = ("-p", f"out:={tmp_path / 'bag'}") if name == "recorder" else ()
            more = more or ("--params-file", file)
            ros.start(name, "--ros-args", "-r", "__ns:=/stage1", *more)
        w = lambda: trace.samples(trace.first, trace.end, "w")["w"]  # noqa: E731
        assert ros.until(lambda: np.isfinite(w()).any()), ros.log("reference")
        assert np.nanmax(w()) <= 10e-6
    finally:
        link.close()
    ros.processes["plant"].send_signal(signal.SIGINT)
    for process in ros.processes.values():
        process.send_signal(signal.SIGINT)
        process.wait(20.0)
    with Messages(tmp_path / "bag") as bag:
        assert bag.channels.keys() >= {"/pea/reference", "/pea/voltage", "/pea/displacement"}


def test_a_plan_in_a_namespace_starts_its_run_there_and_stops_no_other(monkeypatch):
    monkeypatch.setattr(child, "loop_core", lambda: None)
    asked = argparse.ArgumentParser()
    dashboard.add(asked.add_subparsers())
    words = ["dashboard", "--run", "sine_series", "--namespace", "/stage1"]
    arguments = child.plan_of(asked.parse_args(words)).arguments
    assert arguments[arguments.index("--namespace") + 1] == "/stage1"
    command = [sys.executable, "-c", "import time; time.sleep(60)", "/pea", *arguments]
    environment = {**os.environ, "ROS_DOMAIN_ID": "107"}
    with subprocess.Popen(command, env=environment) as run:
        try:
            there = [processes(107, space) for space in ("/stage1", "/stage2", "/pea")]
            assert there == [[PlantProcess(run.pid, "run")], [], []]
        finally:
            run.kill()


def test_stages_apart_by_remaps_alone_are_refused_where_parameters_could_be_mixed_up(ros):
    """Their nodes have the same names, so either plant may answer for its limits."""
    remaps = ["-r", "voltage:=/b/voltage", "-r", "displacement:=/b/displacement"]
    remaps += [
        "-r",
        "state:=/b/state",
        "-r",
        "reference:=/b/reference",
        "-r",
        "consumed:=/b/consumed",
    ]
    remaps += ["-r", "followed:=/b/followed", "-r", "recorded:=/b/recorded"]
    ros.start("plant", "--ros-args", "-p", "voltage_max:=60.0")
    ros.says("plant", "waiting for")
    other = ros.processes.pop("plant")
    try:
        ros.start("plant", "--ros-args", *remaps)
        for node in ("observer", "controller", "reference"):
            ros.start(node, "--ros-args", *remaps)
        assert ros.until(lambda: ros.processes["controller"].poll() is not None)
        assert ros.processes["controller"].returncode == 2
        (line,) = [s for s in ros.log("controller").splitlines() if s.startswith("controller: ")]
        assert line.count("/pea/plant (process ") == 2
        assert "give each stage a namespace" in line
    finally:
        other.kill()
        other.wait()
