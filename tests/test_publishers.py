"""One node publishes each topic: a second one stops the loop, or trips the plant, and is named."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from typing import Any

import pytest
import rclpy
from builtin_interfaces.msg import Time
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from pea_core import config
from pea_engine.compiled import SWITCH as COMPILE
from pea_ros.paths import FAST, NAIVE, SWITCH, TURBO
from pea_ros.publishers import Publishers
from pea_ros.transport import Inbox, NaiveInbox, Outbox
from pea_wire import convert
from pea_wire.topics import STATE, VOLTAGE

T_NS = 50_000
KINDS = {
    "reference": JointTrajectory,
    "state": JointState,
    "voltage": JointState,
    "displacement": JointState,
    "consumed": Time,
    "recorded": Time,
}


@pytest.fixture
def nodes(free_domain: int, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Make nodes, each a participant of its own."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    made: list[tuple[Context, Node]] = []

    def make(name: str) -> Node:
        context = Context()
        rclpy.init(context=context, domain_id=free_domain)
        made.append((context, Node(name, namespace="/pea", context=context)))
        return made[-1][1]

    yield make
    for context, node in made:
        node.destroy_node()
        rclpy.shutdown(context=context)


def inbox_of(way: str, node: Node, judge: Any) -> Any:
    if way == FAST:
        return Inbox(node, STATE, best_effort=True, judge=judge)
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    return NaiveInbox(node, STATE, executor.spin_once, judge)


def until(true: Any, patience: float = 30.0) -> Any:
    end = time.monotonic() + patience
    while not (found := true()) and time.monotonic() < end:
        time.sleep(0.005)
    return found


def message(k: int) -> bytes:
    return convert.forms().state.encode(k * T_NS, 1.0, 2.0, 3.0)


@pytest.mark.parametrize("way", [FAST, NAIVE])
def test_a_message_of_a_second_publisher_is_not_used_and_both_are_named(nodes, way):
    reader, first = nodes("reader"), nodes("observer")
    publishers = Publishers(reader)
    inbox = inbox_of(way, reader, publishers.judge)
    one = Outbox(first, STATE)
    assert until(lambda: inbox.publishers == 1 and one.subscribers == 1)
    one.send(message(0))
    assert until(inbox.take) == message(0)
    two = Outbox(nodes("rogue"), STATE)
    assert until(lambda: inbox.publishers == 2 and two.subscribers == 1)
    two.send(message(1))

    def looked() -> str:
        assert inbox.take() is None
        return publishers.intruder([])

    text = until(looked)
    assert f"2 publishers of {STATE.name}: /pea/observer (process" in text
    assert "and /pea/rogue (process" in text
    one.send(message(2))  # who is right is not known
    assert until(looked)


@pytest.mark.parametrize("way", [FAST, NAIVE])
def test_where_the_first_one_ends_the_next_one_is_heard(nodes, way):
    reader, first = nodes("reader"), nodes("observer")
    publishers = Publishers(reader)
    inbox = inbox_of(way, reader, publishers.judge)
    one = Outbox(first, STATE)
    assert until(lambda: inbox.publishers == 1 and one.subscribers == 1)
    one.send(message(0))
    assert until(inbox.take) == message(0)
    first.destroy_publisher(one.publisher)
    two = Outbox(nodes("observer"), STATE)
    assert until(lambda: inbox.publishers == 1 and two.subscribers == 1)
    two.send(message(1))
    assert until(inbox.take) == message(1)
    assert publishers.intruder([]) == ""


def test_lost_messages_do_not_make_an_intruder(nodes):
    reader, first = nodes("reader"), nodes("observer")
    publishers = Publishers(reader)
    inbox = inbox_of(FAST, reader, publishers.judge)
    one = Outbox(first, STATE)
    assert until(lambda: inbox.publishers == 1 and one.subscribers == 1)
    for k in range(3):
        one.send(message(k))
    assert until(inbox.take) == message(0)
    inbox.due = 9  # as if the next one had number 8
    inbox.holder = b""
    assert until(inbox.take) == message(1)
    inbox.due = 2
    assert until(inbox.take) == message(2)
    assert publishers.intruder([]) == ""


def test_a_loss_is_no_intruder_while_a_second_node_of_ours_looks(nodes, monkeypatch):
    monkeypatch.setattr("pea_ros.publishers.PATIENCE", 1e9)
    reader, first = nodes("reader"), nodes("observer")
    publishers = Publishers(reader)
    inbox = inbox_of(FAST, reader, publishers.judge)
    one = Outbox(first, STATE)
    assert until(lambda: inbox.publishers == 1 and one.subscribers == 1)
    one.send(message(0))
    assert until(inbox.take) == message(0)
    assert inbox.due is not None
    two = Outbox(nodes("observer"), STATE)
    assert until(lambda: inbox.publishers == 2 and two.subscribers == 1)
    assert until(lambda: len(publishers.of(STATE)) == 2)
    inbox.due -= 1  # the next number leaves a gap
    one.send(message(1))
    assert until(inbox.take) == message(1)
    assert publishers.intruder([]) == ""
    two.send(message(2))  # it had to be silent: its count is lower

    def looked() -> str:
        assert inbox.take() is None
        return publishers.intruder([])

    assert f"2 publishers of {STATE.name}" in until(looked)
    one.send(message(3))  # who is right is not known
    assert until(looked)


PUBLISHES = """
import sys, time, rclpy
from rclpy.node import Node
from sensor_msgs.msg import JointState
rclpy.init()
publisher = Node("observer", namespace="/pea").create_publisher(JointState, "/pea/state", 10)
print("there", flush=True)
time.sleep(1000.0)
"""


def test_a_killed_process_is_told_from_one_that_lives(ros, monkeypatch):
    node = Node("reader", namespace="/pea", context=ros.context)
    publishers = Publishers(node)
    node.create_publisher(JointState, "/diagnostics", 1)  # a place to read its own identifier
    started = [
        subprocess.Popen([sys.executable, "-c", PUBLISHES], env=ros.env, stdout=subprocess.PIPE)
        for _ in range(2)
    ]
    try:
        assert until(lambda: ros.node.count_publishers(STATE.name) == 2)
        assert until(lambda: all(one.name for one in publishers.of(STATE)))
        told = {one.process for one in publishers.of(STATE)}
        assert told == {process.pid & 0xFFFF for process in started}
        publishers.oversee([STATE])
        assert not publishers.intruder([])  # a second node of ours may end by itself
        monkeypatch.setattr("pea_ros.publishers.PATIENCE", 0.0)
        text = until(lambda: publishers.intruder([]))
        assert all(f"/pea/observer (process {p.pid & 0xFFFF})" in text for p in started)
        started[0].send_signal(signal.SIGKILL)
        started[0].wait()
        assert ros.node.count_publishers(STATE.name) == 2  # the graph remembers
        (left,) = publishers.of(STATE)
        assert left.process == started[1].pid & 0xFFFF
        started[1].send_signal(signal.SIGSTOP)  # stands still, and may go on
        assert len(publishers.of(STATE)) == 1
    finally:
        for process in started:
            process.kill()
            process.wait()
        node.destroy_node()


class Law(Node):
    """A law that somebody wrote: u = 2 V."""

    def __init__(self, context: Context, name: str = "law") -> None:
        super().__init__(name, context=context)
        self.last = -1
        self.voltage = self.create_publisher(JointState, VOLTAGE.name, 10)

    def listen(self) -> None:
        self.create_subscription(JointState, STATE.name, self.estimated, 10)

    def estimated(self, state: JointState) -> None:
        command = JointState(name=list(state.name), effort=[2.0])
        command.header.stamp = state.header.stamp
        self.last = (state.header.stamp.sec * 10**9 + state.header.stamp.nanosec) // T_NS
        self.voltage.publish(command)


@pytest.mark.parametrize(("way", "compiled"), [(NAIVE, "0"), (TURBO, "1")])
def test_a_second_controller_stops_the_plant_in_lock_step(ros, way, compiled):
    law = Law(ros.context)
    law.listen()
    ros.executor.add_node(law)
    ros.env |= {SWITCH: way, COMPILE: compiled}
    for node in ("plant", "observer"):
        ros.start(node)
    assert ros.until(lambda: law.last > 50, 100.0), ros.log("plant")
    rogue = Law(ros.context, "rogue")
    assert ros.until(lambda: ros.processes["plant"].poll() is not None), ros.log("plant")
    assert ros.processes["plant"].returncode == 3
    (line,) = [s for s in ros.log("plant").splitlines() if s.startswith("plant: ")]
    assert "2 publishers of /pea/voltage: /law (process" in line
    assert "and /rogue (process" in line
    for node in (law, rogue):
        node.destroy_node()


@pytest.fixture
def rig(ros: Any) -> Any:
    """A loop in wall time on the simulated rig; asks its plant's services."""
    file = ("--ros-args", "--params-file", str(config.find("rigs", "simulated_200hz", "rig")))
    late = ("safety.stale_samples:=2000", "safety.following_samples:=2000")
    patient = ("-p", "clock:=wall", *(word for rule in late for word in ("-p", rule)))
    for each in ("plant", "observer", "controller", "reference"):
        ros.start(each, *file, *(patient if each == "plant" else ()))

    def ask(name: str) -> Any:
        client = ros.node.create_client(Trigger, f"/pea/plant/{name}")
        assert ros.until(client.service_is_ready)
        asked = client.call_async(Trigger.Request())
        assert ros.until(asked.done)
        ros.node.destroy_client(client)
        return asked.result()

    ros.ask = ask
    return ros


def rogue_message(topic: str) -> Any:
    if topic == "reference":
        point = JointTrajectoryPoint(positions=[1e-5], velocities=[0.0], accelerations=[0.0])
        return JointTrajectory(joint_names=["x"], points=[point] * 10)
    if KINDS[topic] is Time:
        return Time()
    return JointState(name=["x"], position=[1e-5], velocity=[0.0], effort=[0.0])


@pytest.mark.alone
def test_a_second_publisher_of_any_topic_trips_the_plant_and_once_it_is_gone_all_goes_on(rig):
    owner = {"reference": "reference", "state": "observer", "displacement": "plant"}
    heard: list[JointState] = []
    rig.node.create_subscription(JointState, "/pea/voltage", heard.append, 1000)
    assert rig.until(lambda: len(heard) > 20), rig.log("plant")
    for number, topic in enumerate(("reference", "state", "displacement", "voltage")):
        rogue = Node("rogue", context=rig.context)
        publisher = rogue.create_publisher(KINDS[topic], f"/pea/{topic}", 10)
        assert rig.until(publisher.get_subscription_count)
        publisher.publish(rogue_message(topic))
        trips = f"active -> fault: controllers: 2 publishers of /pea/{topic}: "
        rig.says("plant", f"{trips}/pea/{owner.get(topic, 'controller')} (process")
        assert rig.log("plant").count("and /rogue (process") == number + 1
        assert rig.ask("reset").success
        refused = rig.ask("enable")
        assert not refused.success
        assert f"2 publishers of /pea/{topic}" in refused.message
        rogue.destroy_node()
        heard.clear()
        assert rig.until(lambda: rig.ask("enable").success), rig.log("plant")
        assert rig.until(lambda: len(heard) > 20), "\n".join(map(rig.log, rig.processes))
    assert all(process.poll() is None for process in rig.processes.values())


@pytest.mark.alone
@pytest.mark.parametrize("node", ["observer", "reference"])
def test_a_second_node_of_ours_ends_and_the_first_goes_on(rig, node):
    heard: list[JointState] = []
    rig.node.create_subscription(JointState, "/pea/voltage", heard.append, 1000)
    assert rig.until(lambda: len(heard) > 20), rig.log("plant")
    first = rig.processes[node]
    file = str(config.find("rigs", "simulated_200hz", "rig"))
    second = subprocess.run(
        [*first.args[:1], "--ros-args", "--params-file", file],
        env=rig.env,
        capture_output=True,
        text=True,
        timeout=60.0,
    )
    assert second.returncode == 2, second.stderr
    (line,) = [s for s in second.stderr.splitlines() if s.startswith(f"{node}: ")]
    assert f"/pea/{node} (process {first.pid & 0xFFFF})" in line
    heard.clear()
    assert rig.until(lambda: len(heard) > 20)
    assert "controllers: " not in rig.log("plant")
    assert first.poll() is None


def test_who_holds_a_closed_subscription_sees_no_publisher(ros):
    """A plant looks at its topics piece by piece, and asks for reliability in between."""
    inbox = Inbox(ros.node, VOLTAGE, best_effort=True)
    blocks = inbox.blocks
    assert blocks.publishers == 0
    inbox.rely(ros.node)
    assert blocks.publishers == 0
    assert inbox.publishers == 0
    inbox.close(ros.node)
