"""`pea replay --publish` on a ROS graph: what arrives, with which QoS, and what is never sent."""

from __future__ import annotations

import re
import signal
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability
from rosbags.interfaces import QosTime as Time
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, String
from trajectory_msgs.msg import JointTrajectory

from pea_cli.cli import main
from pea_record.messages import Channel
from pea_run.play import obstacle, offered

FIG9 = ("fig9_hysteresis_10hz", "--duration", "0.0157")
SLOW = ("--rate", "0.05", "--wait")
INFINITE = Time(9223372036, 854775807)


def raw(directory: Path, topic: str) -> list[bytes]:
    with AnyReader([directory]) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        return [bytes(data) for _, _, data in reader.messages(connections)]


def qos(reliability: QosReliability, durability: QosDurability, depth: int = 10) -> Qos:
    return Qos(
        *(QosHistory.KEEP_LAST, depth, reliability, durability, INFINITE, INFINITE),
        *(QosLiveliness.AUTOMATIC, INFINITE, False),
    )


RELIABLE = qos(QosReliability.RELIABLE, QosDurability.VOLATILE)
BEST_EFFORT = qos(QosReliability.BEST_EFFORT, QosDurability.VOLATILE, 3)
LATCHED = qos(QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, 1)


@pytest.fixture
def foreign(tmp_path: Path) -> Any:
    """A bag as another recorder writes it, with a type that nobody has here."""

    def write(storage: StoragePlugin) -> Path:
        types = get_typestore(Stores.ROS2_JAZZY)
        types.register(get_types_from_msg("float64 force", "acme_msgs/msg/Force"))
        there = tmp_path / "foreign"
        with Writer(there, version=9, storage_plugin=storage) as bag:
            for topic, kind, offers, values in (
                ("/said", "std_msgs/msg/String", LATCHED, ["once"]),
                ("/load", "std_msgs/msg/Float64", BEST_EFFORT, [0.5, 1.5]),
                ("/force", "acme_msgs/msg/Force", RELIABLE, [2.0]),
            ):
                channel = bag.add_connection(
                    topic, kind, typestore=types, offered_qos_profiles=[offers]
                )
                for k, value in enumerate(values):
                    data = types.serialize_cdr(types.types[kind](value), kind)
                    bag.write(channel, 1_700_000_000_000_000_000 + k * 100_000_000, data)
        return there

    return write


@pytest.fixture
def heard(ros: Any) -> Any:
    """Subscribe to topics; the bytes of each that have come."""

    def listen(profile: QoSProfile | None = None, **topics: Any) -> dict[str, list[bytes]]:
        come: dict[str, list[bytes]] = defaultdict(list)
        for name, kind in topics.items():
            topic = "/" + name.replace("__", "/")
            ros.node.create_subscription(
                kind, topic, come[topic].append, profile or QoSProfile(depth=2000), raw=True
            )
        return come

    return listen


def test_recording_arrives_bit_by_bit_with_a_clock(recorded, ros, heard, start_pea):
    bag = recorded("batch", *FIG9).directory
    come = heard(
        pea__displacement=JointState,
        pea__state=JointState,
        pea__voltage=JointState,
        pea__reference=JointTrajectory,
        clock=Clock,
    )
    running = start_pea("replay", str(bag), "--publish", *SLOW, env=ros.env)
    assert ros.until(lambda: running.process.poll() is not None)
    ended = running.finish()
    assert ended.status == 0, ended.err

    for topic in ("/pea/displacement", "/pea/state", "/pea/reference"):
        sent = raw(bag, topic)
        assert ros.until(lambda topic=topic, sent=sent: len(come[topic]) == len(sent))
        assert come[topic] == sent
    assert come["/pea/voltage"] == []
    assert "not played: /pea/voltage (only when named)" in ended.out
    clock = [deserialize_message(data, Clock).clock for data in come["/clock"]]
    times = [t.sec * 10**9 + t.nanosec for t in clock]
    assert times == sorted(times)
    assert times[-1] == 313 * 50_000 + 1
    assert len(times) > 10


def test_command_is_played_when_named(recorded, ros, heard, start_pea):
    bag = recorded("batch", *FIG9).directory
    come = heard(pea__voltage=JointState, pea__state=JointState)
    running = start_pea(
        *("replay", str(bag), "--publish", *SLOW, "--duration", "0.005"),
        *("--topics", "/pea/voltage"),
        env=ros.env,
    )
    assert ros.until(lambda: running.process.poll() is not None)
    assert ros.until(lambda: len(come["/pea/voltage"]) == 100)
    assert come["/pea/voltage"] == raw(bag, "/pea/voltage")[:100]
    assert come["/pea/state"] == []


def test_a_recording_is_played_into_another_namespace(recorded, ros, heard, start_pea):
    bag = recorded("batch", *FIG9).directory
    come = heard(stage1__displacement=JointState, pea__displacement=JointState)
    running = start_pea(
        *("replay", str(bag), "--publish", *SLOW, "--duration", "0.005"),
        *("--topics", "/pea/displacement", "--namespace", "stage1"),
        env=ros.env,
    )
    assert ros.until(lambda: running.process.poll() is not None)
    assert running.finish().status == 0
    assert ros.until(lambda: len(come["/stage1/displacement"]) == 100)
    assert come["/stage1/displacement"] == raw(bag, "/pea/displacement")[:100]
    assert come["/pea/displacement"] == []


@pytest.mark.parametrize("storage", StoragePlugin)
def test_foreign_bag_plays_with_the_qos_of_its_recording(ros, heard, start_pea, foreign, storage):
    bag = foreign(storage)
    profile = QoSProfile(
        depth=10,
        reliability=ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.VOLATILE,
    )
    come = heard(profile, load=Float64)
    running = start_pea("replay", str(bag), "--publish", "--wait", "--loop", env=ros.env)

    assert ros.until(lambda: len(come["/load"]) > 2)
    values = [deserialize_message(data, Float64).data for data in come["/load"]]
    assert values[:3] == [0.5, 1.5, 0.5]
    (load,) = ros.node.get_publishers_info_by_topic("/load")
    (said,) = ros.node.get_publishers_info_by_topic("/said")
    assert load.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
    assert load.qos_profile.durability == DurabilityPolicy.VOLATILE
    assert said.qos_profile.reliability == ReliabilityPolicy.RELIABLE
    assert said.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    late: list[String] = []
    ros.node.create_subscription(
        String, "/said", late.append, QoSProfile(depth=1, durability=profile.durability)
    )
    assert ros.until(lambda: late)
    assert late[0].data == "once"

    running.process.send_signal(signal.SIGINT)
    ended = running.finish()
    assert ended.status == 130
    assert ended.err.startswith("interrupted at ")
    assert "not played: /force (acme_msgs/msg/Force is not installed)" in ended.out


def test_what_others_publish_is_not_played_over(recorded, ros, start_pea):
    bag = recorded("batch", *FIG9).directory
    ros.node.create_publisher(JointState, "/pea/displacement", 10)
    running = start_pea("replay", str(bag), "--publish", "--topics", "/pea/state", env=ros.env)
    assert ros.until(lambda: running.process.poll() is not None)
    ended = running.finish()
    assert ended.status == 2
    assert ended.err.startswith("pea: /pea/displacement is published by /_tester: ")
    assert len(ended.err.splitlines()) == 1


def test_playing_ends_when_a_plant_comes(recorded, ros, heard, start_pea):
    bag = recorded("batch", *FIG9).directory
    come = heard(pea__state=JointState)
    running = start_pea("replay", str(bag), "--publish", "--loop", *SLOW, env=ros.env)
    assert ros.until(lambda: come["/pea/state"])
    ros.node.create_publisher(JointState, "/pea/displacement", 10)
    assert ros.until(lambda: running.process.poll() is not None)
    ended = running.finish()
    assert ended.status == 3
    assert re.fullmatch("pea: /pea/displacement is published by /_tester: .*\n", ended.err)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--publish", "--topics", "/pea/volts"), "did you mean /pea/voltage"),
        (("--publish", "--topics", "/clock"), "--topics /clock: not in"),
        (("--publish", "--rate", "0"), "--rate = '0': must be 1e-06 to 1e+09"),
        (("--publish", "--rate", "fast"), "--rate = 'fast'"),
        (("--publish", "--start", "1"), "the recording has 0.01565"),
        (("--publish", "--start", "-1"), "--start = '-1'"),
        (("--publish", "--set", "controller.P=1"), "--set does not go with --publish"),
        (("--publish", "--through", "observer"), "--through does not go with --publish"),
        (("--rate", "2"), "--rate goes only with --publish"),
        (("--topics", "/pea/state"), "--topics goes only with --publish"),
    ],
)
def test_bad_option_is_one_line(recorded, capfd, arguments, words):
    bag = recorded("batch", *FIG9).directory
    assert main(["replay", str(bag), *arguments]) == 2
    said = capfd.readouterr().err
    assert len(said.splitlines()) == 1
    assert words in said


def test_domain_that_is_none_is_one_line(recorded, capfd, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "233")
    assert main(["replay", str(recorded("batch", *FIG9).directory), "--publish"]) == 2
    assert "ROS_DOMAIN_ID = '233': must be 0 to 232" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("name", "kind", "digest", "words"),
    [
        ("/a", "sensor_msgs/msg/JointState", "", ""),
        ("/a", "sensor_msgs/msg/JointState", "RIHS01_00", "has another definition here"),
        ("/a", "acme_msgs/msg/Force", "", "acme_msgs/msg/Force is not installed"),
        ("/a", "sensor_msgs/msg/Force", "", "sensor_msgs/msg/Force is not installed"),
        ("/a", "Force", "", "Force is not installed"),
        ("a b", "sensor_msgs/msg/JointState", "", "is not a valid topic name"),
    ],
)
def test_what_cannot_be_played_is_said(name, kind, digest, words):
    found = obstacle(name, Channel(kind, digest, 1, ()))
    assert found.endswith(words)
    assert bool(found) == bool(words)


def test_strongest_of_several_offers_is_offered():
    found = offered([BEST_EFFORT, LATCHED])
    assert found.reliability == ReliabilityPolicy.RELIABLE
    assert found.durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert found.depth == 3
    assert offered([]).depth == 10
    assert offered([BEST_EFFORT]).reliability == ReliabilityPolicy.BEST_EFFORT


def test_finite_deadline_is_offered_and_an_infinite_one_is_not():
    limited = RELIABLE._replace(deadline=Time(0, 250_000_000))
    assert offered([limited]).deadline.nanoseconds == 250_000_000
    assert offered([RELIABLE]).deadline.nanoseconds == 0
