"""The nodes one by one, as ``ros2 run`` starts them, among nodes that are none of ours."""

from __future__ import annotations

import math
import signal
import subprocess
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import ParameterEvent, ParameterType
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_msgs.msg import UInt8MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from pea_core import config
from pea_record.read import load
from pea_report.recorded import axes_experiment_of
from pea_report.replay import replay
from pea_ros.context import context
from pea_ros.neighbours import Remote
from pea_ros.shell import Shell

FIG9 = "fig9_hysteresis_10hz"
T_NS = 50_000
NODES = ("plant", "observer", "controller", "reference")
RECORDER = "recorder"
ALL_HEARD = QoSProfile(depth=20_000, reliability=ReliabilityPolicy.RELIABLE)


def experiment() -> tuple[str, ...]:
    """Arguments of a node that takes its parameters from the experiment's file."""
    return ("--ros-args", "--params-file", str(config.find("experiments", FIG9, "experiment")))


def k_of(message: Any) -> int:
    """Sample number of a message."""
    k, rest = divmod(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec, T_NS)
    assert rest == 0
    return k


class Heard:
    """Messages that a plain subscriber of the test's node has got."""

    def __init__(self, ros: Any, kind: type, topic: str) -> None:
        self.messages: list[Any] = []
        ros.node.create_subscription(kind, topic, self.messages.append, ALL_HEARD)

    def __len__(self) -> int:
        return len(self.messages)


def end_all(ros: Any, signum: int = signal.SIGINT) -> None:
    """End every node and see that it ends well."""
    for node in list(ros.processes):
        status = ros.end(node, signum)
        assert status == 0, f"{node} ended with {status}: {ros.log(node)}"
        assert "Traceback" not in ros.log(node)


def looks_round(ros: Any, node: str) -> None:
    """Wait until a node has said something of its neighbours."""
    words = ("waiting for", "all neighbours")
    assert ros.until(lambda: any(w in ros.log(node) for w in words)), ros.log(node)


def start_all(ros: Any, **more: tuple[str, ...]) -> None:
    for node in NODES:
        ros.start(node, *experiment(), *more.get(node, ()))


@pytest.mark.parametrize(
    "order",
    [NODES, ("controller", "plant", "reference", "observer")],
    ids=lambda order: " ".join(order),
)
def test_loop_starts_by_itself_in_any_order(ros, order):
    displacement = Heard(ros, JointState, "/pea/displacement")
    for node in order[:-1]:
        ros.start(node, *experiment())
        looks_round(ros, node)
    assert "loop starts" not in ros.log("plant")
    assert len(displacement) == 0
    ros.start(order[-1], *experiment())
    assert ros.until(lambda: len(displacement) > 100), "\n".join(map(ros.log, NODES))
    for node in NODES:
        ros.says(node, "all neighbours are there")
    first = displacement.messages[0]
    heard = [k_of(m) for m in displacement.messages]  # the loop does not wait for who only listens
    assert heard == sorted(set(heard))
    assert list(first.name) == ["x"]
    assert len(first.position) == len(first.velocity) == len(first.effort) == 1

    end_all(ros)


@pytest.mark.parametrize(
    ("node", "awaited", "signum"),
    [
        ("plant", ("observer", "controller"), signal.SIGINT),
        ("observer", ("plant", "controller"), signal.SIGTERM),
        ("controller", ("observer", "plant", "reference"), signal.SIGTERM),
        ("reference", ("controller",), signal.SIGINT),
        (RECORDER, ("plant", "observer", "controller", "reference"), signal.SIGTERM),
    ],
)
def test_waiting_node_says_for_whom_and_ends_well(ros, tmp_path, node, awaited, signum):
    out = ("--ros-args", "-p", f"out:={tmp_path}/bag")
    ros.start(node, *(out if node == RECORDER else experiment()))
    ros.says(node, "waiting for")
    line = next(line for line in ros.log(node).splitlines() if "waiting for" in line)
    assert all(name in line for name in awaited)
    end_all(ros, signum)
    if node == RECORDER:
        assert (tmp_path / "bag" / "metadata.yaml").exists()  # an empty bag, and a whole one


def test_running_nodes_tell_how_they_are_and_end_well(ros, tmp_path):
    displacement = Heard(ros, JointState, "/pea/displacement")
    diagnostics = Heard(ros, DiagnosticArray, "/diagnostics")
    ros.start(RECORDER, "--ros-args", "-p", f"out:={tmp_path}/bag")
    ros.says(RECORDER, "waiting for")
    start_all(ros)
    assert ros.until(lambda: len(displacement) > 200)

    def told() -> bool:
        return {s.name for m in diagnostics.messages for s in m.status} >= {
            f"pea: {node}" for node in NODES
        }

    assert ros.until(told)
    end_all(ros, signal.SIGTERM)
    recording = load(tmp_path / "bag")
    assert recording.damage == ""
    assert len(recording.samples) > 0


def served(ros: Any, node: str) -> Callable[..., Any]:
    """Call a standard parameter service of a node, and wait for the answer."""
    client = AsyncParameterClient(ros.node, f"/pea/{node}")
    assert ros.until(client.services_are_ready)

    def call(what: str, *arguments: Any) -> Any:
        future = getattr(client, what)(*arguments)
        assert ros.until(future.done)
        return future.result()

    return call


def test_new_gain_acts_between_two_samples(ros, recorded):
    batch = load(recorded("batch", FIG9, "--duration", "10").directory).samples["u"]
    voltage = Heard(ros, JointState, "/pea/voltage")
    events = Heard(ros, ParameterEvent, "/parameter_events")
    start_all(ros)
    call = served(ros, "controller")
    assert call("get_parameters", ["P"]).values[0].double_value == 0.0004
    assert ros.until(lambda: len(voltage) > 50)
    before = len(voltage)
    (result,) = call("set_parameters", [Parameter("P", value=0.001)]).results
    assert result.successful, result.reason

    def told():
        changes = ((e.stamp, p.name) for e in events.messages for p in e.changed_parameters)
        return [stamp for stamp, name in changes if name == "P"]

    assert ros.until(told)
    acts = (told()[0].sec * 10**9 + told()[0].nanosec) // T_NS
    assert ros.until(lambda: k_of(voltage.messages[-1]) > acts + 100)
    assert call("get_parameters", ["P"]).values[0].double_value == 0.001
    end_all(ros)

    first = k_of(voltage.messages[0])
    assert [k_of(m) for m in voltage.messages] == list(range(first, first + len(voltage)))
    u = [m.effort[0] for m in voltage.messages]
    changed = next(i for i, command in enumerate(u) if command != batch[first + i])
    assert before <= changed
    assert acts <= first + changed <= acts + 2  # the first sample is the same to rounding
    assert abs(u[changed] - u[changed - 1]) < 0.5  # V: no step
    assert all(map(math.isfinite, u))


def test_parameters_describe_themselves(ros):
    ros.start("controller", *experiment())
    call = served(ros, "controller")
    P, T_s = call("describe_parameters", ["P", "T_s"]).descriptors
    assert P.type == ParameterType.PARAMETER_DOUBLE
    assert "V s/um" in P.description
    assert not P.read_only
    (allowed,) = P.floating_point_range
    assert (allowed.from_value, allowed.to_value) == (0.0, 10.0)
    assert T_s.read_only
    end_all(ros)


REFUSED = {
    "below the range": ("P", -1.0),
    "above the range": ("P", 1e6),
    "nan": ("P", math.nan),
    "inf": ("P", math.inf),
    "text": ("P", "0.001"),
    "whole number": ("P", 1),
    "list": ("P", [0.001]),
    "number for a truth": ("feedforward", 1.0),
    "fixed": ("T_s", 1e-4),
    "limits the wrong way round": ("voltage_min", 2000.0),
    "unknown": ("nosuch", 1.0),
}


def test_bad_parameters_are_refused_with_a_reason(ros):
    ros.start("controller", *experiment())
    ros.says("controller", "waiting for")
    call = served(ros, "controller")
    names = sorted({name for name, _ in REFUSED.values()} - {"nosuch"})
    before = call("get_parameters", names).values
    for title, (name, value) in REFUSED.items():
        (result,) = call("set_parameters", [Parameter(name, value=value)]).results
        assert not result.successful, title
        assert result.reason, title
    assert call("get_parameters", names).values == before
    end_all(ros)


def test_limits_wider_than_the_plants_are_refused_live(ros):
    displacement = Heard(ros, JointState, "/pea/displacement")
    start_all(ros)
    assert ros.until(lambda: len(displacement) > 10)
    call = served(ros, "controller")
    (result,) = call("set_parameters", [Parameter("voltage_max", value=2000.0)]).results
    assert not result.successful
    assert "-1000 to 1000 V" in result.reason
    end_all(ros)


def test_limits_wider_than_the_plants_end_the_controller(ros):
    start_all(ros, controller=("-p", "voltage_max:=2000.0"))
    assert ros.processes["controller"].wait(60.0) == 2
    (line,) = [s for s in ros.log("controller").splitlines() if s.startswith("controller: ")]
    assert "voltage_max = 2000" in line
    assert "-1000 to 1000 V" in line
    assert "Traceback" not in ros.log("controller")


def test_passthrough_without_true_velocity_ends_in_one_line(ros):
    start_all(ros, plant=("-p", "sensor.ideal:=false"))
    assert ros.processes["observer"].wait(60.0) == 3
    (line,) = [s for s in ros.log("observer").splitlines() if s.startswith("observer: ")]
    assert "passthrough" in line
    assert "sensor.ideal" in line
    assert "Traceback" not in ros.log("observer")


BAD = {
    "unknown": ("plant", ("-p", "KK:=1.0"), ("KK", "plant.K")),
    "out of range": ("plant", ("-p", "K:=-1.0"), ("-1.0", "um/V")),
    "text": ("controller", ("-p", "P:=abc"), ("'abc'", "number")),
    "mixed list": ("controller", ("-p", "P:=[1, a]"), ()),
    "preset": ("controller", ("-p", "preset:=paper_set3"), ("'paper_set3'", "paper_set2")),
    "recorder without out": (RECORDER, (), ("out",)),
    "recorder with more": (RECORDER, ("-p", "out:=bag", "-p", "outs:=x"), ("outs", "out")),
    "samples as text": ("plant", ("-p", "samples:=many"), ("samples",)),
    "missing file": ("plant", ("--params-file", "nosuch.yaml"), ("nosuch.yaml",)),
    "broken rule": ("plant", ("-r", "a b"), ()),
    "unknown ROS argument": ("plant", ("--nope",), ("--nope",)),
}


@pytest.mark.parametrize(("node", "arguments", "words"), BAD.values(), ids=BAD)
def test_bad_parameter_ends_the_node_in_one_line(
    executable, user_environment, tmp_path, node, arguments, words
):
    done = subprocess.run(
        [str(executable(node)), "--ros-args", *arguments],
        env=user_environment(ROS_AUTOMATIC_DISCOVERY_RANGE="OFF", ROS_LOG_DIR=str(tmp_path)),
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    lines = [line for line in done.stderr.splitlines() if not line.startswith("[")]
    assert done.returncode == 2, done.stderr
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith(f"{node}: ")
    assert all(word in lines[0] for word in words)
    assert not list(tmp_path.glob("bag*"))


def test_unknown_key_in_a_parameter_file_ends_the_node(executable, user_environment, tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("/pea/plant:\n  ros__parameters:\n    sensor:\n      noise_um: 1.0\n")
    done = subprocess.run(
        [str(executable("plant")), "--ros-args", "--params-file", str(file)],
        env=user_environment(ROS_LOG_DIR=str(tmp_path)),
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "plant.sensor.noise_um" in line
    assert "plant.sensor.noise_nm" in line


class ForeignController(Node):
    """A law that somebody wrote from the topic table alone: u = 2 V, as ordinary messages."""

    def __init__(self, context: Any) -> None:
        super().__init__("somebodys_law", context=context)
        self.stamps: list[int] = []
        self.voltage = self.create_publisher(JointState, "/pea/voltage", 10)
        self.create_subscription(JointState, "/pea/state", self.estimated, 10)

    def estimated(self, state: JointState) -> None:
        self.stamps.append(k_of(state))
        command = JointState(name=list(state.name), effort=[2.0])
        command.header.stamp = state.header.stamp
        command.header.frame_id = "somewhere"
        self.voltage.publish(command)


def test_foreign_controller_keeps_the_loop_going(ros):
    displacement = Heard(ros, JointState, "/pea/displacement")
    law = ForeignController(ros.context)
    ros.executor.add_node(law)
    for node in ("plant", "observer"):
        ros.start(node, *experiment())
    assert ros.until(lambda: len(displacement) > 300), ros.log("plant")
    end_all(ros)
    first = k_of(displacement.messages[0])  # nobody waits for a subscriber that only listens
    assert [k_of(m) for m in displacement.messages] == list(range(first, first + len(displacement)))
    assert law.stamps == list(range(len(law.stamps)))
    assert {m.effort[0] for m in displacement.messages if k_of(m)} == {2.0}
    law.destroy_node()


class ForeignReference(Node):
    """Somebody's reference: 1 um for ever, in chunks of 700 ordinary points."""

    CHUNK = 700
    w = 1e-6

    def __init__(self, context: Any) -> None:
        super().__init__("somebodys_signal", context=context)
        from builtin_interfaces.msg import Time

        self.sent = 0
        self.reference = self.create_publisher(JointTrajectory, "/pea/reference", 10)
        self.create_subscription(Time, "/pea/consumed", self.consumed, 10)

    def consumed(self, stamp: Any) -> None:
        used = (stamp.sec * 10**9 + stamp.nanosec) // T_NS
        while self.sent < used + 2 * self.CHUNK:
            self.send()

    def send(self) -> None:
        chunk = JointTrajectory(joint_names=["x"])
        start = chunk.header.stamp
        start.sec, start.nanosec = divmod(self.sent * T_NS, 10**9)
        for i in range(self.CHUNK):
            point = JointTrajectoryPoint(
                positions=[self.w], velocities=[0.0], accelerations=[0.0], effort=[]
            )
            point.time_from_start.nanosec = i * T_NS
            chunk.points.append(point)
        self.reference.publish(chunk)
        self.sent += self.CHUNK


class Stammering(ForeignReference):
    """One that does not answer the first time, and says all twice."""

    def __init__(self, context: Any) -> None:
        super().__init__(context)
        self.asked = 0

    def consumed(self, stamp: Any) -> None:
        self.asked += 1
        if self.asked > 1:
            super().consumed(stamp)

    def send(self) -> None:
        super().send()
        self.sent -= self.CHUNK
        super().send()


@pytest.mark.parametrize("kind", [ForeignReference, Stammering])
def test_foreign_reference_is_followed_to_the_bit(ros, recorded, kind):
    constant = ("--set", "reference.type=constant", "--set", "reference.offset_um=1")
    batch = load(recorded("batch", FIG9, *constant).directory).samples["u"]
    voltage = Heard(ros, JointState, "/pea/voltage")
    signal_ = kind(ros.context)
    ros.executor.add_node(signal_)
    for node in NODES[:3]:
        ros.start(node, *experiment())
    assert ros.until(lambda: len(voltage) > 1200), ros.log("controller")
    end_all(ros)
    first = k_of(voltage.messages[0])
    end = first + len(voltage)
    assert [k_of(m) for m in voltage.messages] == list(range(first, end))
    assert [m.effort[0] for m in voltage.messages] == list(batch[first:end])
    signal_.destroy_node()


def test_a_plant_that_the_graph_does_not_tell_of_is_taken_as_there_where_samples_come(ros):
    voltage = Heard(ros, JointState, "/pea/voltage")
    signal_ = ForeignReference(ros.context)
    ros.executor.add_node(signal_)
    state = ros.node.create_publisher(JointState, "/pea/state", 10)
    ros.node.create_publisher(UInt8MultiArray, "/pea/state/blocks", 10)  # as our observer has
    ros.start("controller", *experiment())
    ros.says("controller", "waiting for plant (subscriber of /pea/voltage)\n")  # and nobody else
    assert ros.until(lambda: state.get_subscription_count())
    state.publish(JointState(name=["x"], position=[0.0], velocity=[0.0], effort=[0.0]))
    assert ros.until(lambda: len(voltage)), ros.log("controller")
    assert k_of(voltage.messages[0]) == 0
    signal_.destroy_node()


class Once(ForeignReference):
    """One that is volatile, sends all it has when somebody subscribes, and is never heard again."""

    CHUNK = 2000

    def __init__(self, context: Any) -> None:
        super().__init__(context)
        self.timer = self.create_timer(0.01, self.look)

    def consumed(self, stamp: Any) -> None:
        pass

    def look(self) -> None:
        if self.reference.get_subscription_count() and not self.sent:
            self.send()


@pytest.mark.parametrize(
    "order",
    [
        ("controller", RECORDER, "reference", "plant", "observer"),
        ("reference", "controller", RECORDER, "observer", "plant"),
    ],
)
def test_a_reference_that_is_sent_once_to_its_first_subscriber_is_followed(ros, tmp_path, order):
    """The controller alone subscribes to it, and passes it on to the recorder."""
    signals: list[Once] = []
    voltage = Heard(ros, JointState, "/pea/voltage")
    for node in order:
        if node == "reference":
            signals.append(Once(ros.context))
            ros.executor.add_node(signals[0])
            assert ros.until(lambda: signals[0].count_publishers("/pea/reference"))
        elif node == RECORDER:
            ros.start(node, "--ros-args", "-p", f"out:={tmp_path}/bag")
        else:
            ros.start(node, *experiment())
        if node != "reference":
            ros.says(node, "transport: ")
    (signal_,) = signals
    assert ros.until(lambda: len(voltage) > 800), ros.log("controller")
    end_all(ros)
    assert signal_.sent == Once.CHUNK
    recording = load(tmp_path / "bag")
    assert set(recording.samples["w"][:500]) == {1e-6}
    what = axes_experiment_of(recording, tmp_path / "bag", through="both")
    again = replay(recording, what, tmp_path / "bag")
    assert (again.first, len(again.samples) > 500) == (None, True)
    signal_.destroy_node()


class Contradicting(ForeignReference):
    """One that says another thing the second time."""

    def send(self) -> None:
        super().send()
        self.sent -= self.CHUNK
        self.w = 2e-6
        super().send()


def test_two_references_stop_the_controller(ros):
    signal_ = Contradicting(ros.context)
    ros.executor.add_node(signal_)
    for node in NODES[:3]:
        ros.start(node, *experiment())
    assert ros.until(lambda: ros.processes["controller"].poll() is not None)
    assert ros.processes["controller"].returncode == 3
    assert "expected points from sample 700 on" in ros.log("controller")
    signal_.destroy_node()


def test_lost_sample_stops_the_loop_and_names_both(ros):
    law = ForeignController(ros.context)
    ros.executor.add_node(law)
    send = law.voltage.publish

    def late(command: JointState) -> None:
        if k_of(command) == 50:
            command.header.stamp.nanosec += T_NS
        send(command)

    law.voltage.publish = late
    for node in ("plant", "observer"):
        ros.start(node, *experiment())
    assert ros.until(lambda: ros.processes["plant"].poll() is not None)
    assert ros.processes["plant"].returncode == 3
    (line,) = [s for s in ros.log("plant").splitlines() if s.startswith("plant: ")]
    assert "expected sample 50" in line
    assert "got 51" in line
    law.destroy_node()


def test_command_that_is_no_number_stops_the_plant(ros):
    law = ForeignController(ros.context)
    ros.executor.add_node(law)
    send = law.voltage.publish

    def bad(command: JointState) -> None:
        if k_of(command) == 50:
            command.effort = [math.nan]
        send(command)

    law.voltage.publish = bad
    for node in ("plant", "observer"):
        ros.start(node, *experiment())
    assert ros.until(lambda: ros.processes["plant"].poll() is not None)
    assert ros.processes["plant"].returncode == 3
    (line,) = [s for s in ros.log("plant").splitlines() if s.startswith("plant: ")]
    assert "nan" in line
    law.destroy_node()


def test_recorder_never_writes_over_a_bag(ros, recorded, tmp_path: Path):
    there = recorded("batch", FIG9, "--duration", "0.0157").directory
    before = {p.name: p.stat().st_mtime_ns for p in there.iterdir()}
    ros.start(RECORDER, "--ros-args", "-p", f"out:={there}")
    assert ros.processes[RECORDER].wait(60.0) == 2
    (line,) = ros.log(RECORDER).splitlines()
    assert "never overwritten" in line
    assert {p.name: p.stat().st_mtime_ns for p in there.iterdir()} == before


def test_a_neighbour_is_asked_again_where_its_answer_is_lost(ros, free_domain, monkeypatch):
    ros.start("plant")
    asked = []

    def get_parameters(client, names):
        asked.append(names)
        return Future() if len(asked) == 1 else genuine(client, names)

    genuine = Remote.get
    monkeypatch.setattr(Remote, "get", get_parameters)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_domain))
    with context():
        shell = Shell("asker")
        try:
            assert ros.until(lambda: shell.ask("plant", ["T_s"]) == {"T_s": 5e-5})
        finally:
            shell.close()
    assert len(asked) == 2


def test_a_plant_of_others_tells_what_it_has(ros, free_domain, monkeypatch):
    """A node of rclpy gives no value at all where it is asked for one that it lacks."""
    plant = Node("plant", namespace="/pea", context=ros.context)
    for name, value in {"voltage_min": -5.0, "voltage_max": 50.0, "delay_samples": 1}.items():
        plant.declare_parameter(name, value)
    ros.executor.add_node(plant)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_domain))
    with context(), ThreadPoolExecutor(1) as pool:
        shell = Shell("asker")
        try:
            names = ("voltage_min", "voltage_max", "delay_samples", "safety.slew_rate")
            asked = pool.submit(shell.ask, "plant", names)
            assert ros.until(asked.done)
            told = asked.result()
        finally:
            shell.close()
    assert told == {"voltage_min": -5.0, "voltage_max": 50.0, "delay_samples": 1}
    plant.destroy_node()
