"""What a run records, as other people's libraries read it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

FIG9 = "fig9_hysteresis_10hz"
SHORT = ("--duration", "0.0157")
SAMPLES, T_NS = 314, 50_000

SAMPLED = ("/pea/displacement", "/pea/state", "/pea/voltage")
TYPES = {
    "/pea/displacement": "sensor_msgs/msg/JointState",
    "/pea/state": "sensor_msgs/msg/JointState",
    "/pea/voltage": "sensor_msgs/msg/JointState",
    "/pea/reference": "trajectory_msgs/msg/JointTrajectory",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}


@pytest.fixture(params=["batch", "composed", "distributed"])
def bag(request: pytest.FixtureRequest, recorded) -> Path:
    return recorded(request.param, FIG9, *SHORT).directory


def stamp(message: Any) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec  # type: ignore[no-any-return]


def ours(mcap: Path) -> dict[str, list[tuple[int, Any]]]:
    """Log time and message of each topic, as mcap-ros2-support decodes them."""
    found: dict[str, list[tuple[int, Any]]] = {topic: [] for topic in TYPES}
    with open(mcap, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    return found


def raw(directory: Path, topic: str) -> list[tuple[int, bytes]]:
    with AnyReader([directory]) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        return [(time, bytes(data)) for _, time, data in reader.messages(connections)]


def test_rosbags_reads_every_sample_exactly_once(bag):
    with AnyReader([bag]) as reader:
        for topic in SAMPLED:
            connections = [c for c in reader.connections if c.topic == topic]
            assert [c.msgtype for c in connections] == [TYPES[topic]]
            assert [c.msgcount for c in connections] == [SAMPLES]
            stamps, times = [], []
            for connection, time, data in reader.messages(connections):
                message = reader.deserialize(data, connection.msgtype)
                stamps.append(stamp(message))
                times.append(time)
                assert message.name == ["x"]
            assert stamps == times == [k * T_NS for k in range(SAMPLES)]


def test_mcap_ros2_reads_every_sample_exactly_once(bag):
    (file,) = bag.glob("*.mcap")
    found = ours(file)
    for topic in SAMPLED:
        times = [k * T_NS for k in range(SAMPLES)]
        assert [time for time, _ in found[topic]] == times
        assert [stamp(message) for _, message in found[topic]] == times


def test_types_are_those_of_the_topic_table(bag):
    with AnyReader([bag]) as reader:
        found = {c.topic: c.msgtype for c in reader.connections}
    assert found.items() >= TYPES.items()


def test_reference_covers_the_run(bag):
    (file,) = bag.glob("*.mcap")
    times, w = [], []
    for _, chunk in ours(file)["/pea/reference"]:
        assert list(chunk.joint_names) == ["x"]
        for point in chunk.points:
            after = point.time_from_start
            times.append(stamp(chunk) + after.sec * 10**9 + after.nanosec)
            w.append(point.positions[0])
            assert len(point.velocities) == len(point.accelerations) == 1
    assert times == [k * T_NS for k in range(len(times))]
    assert len(times) >= SAMPLES
    t = np.array(times) * 1e-9
    assert np.allclose(w, 5e-6 * np.sin(2 * math.pi * 10 * t) + 5e-6, rtol=0, atol=1e-18)


def test_fields_hold_what_the_topic_table_says(bag):
    (file,) = bag.glob("*.mcap")
    found = ours(file)
    for (_, y), (_, x), (_, u) in zip(*(found[topic] for topic in SAMPLED), strict=True):
        assert len(y.position) == len(y.velocity) == len(y.effort) == 1
        assert len(x.position) == len(x.velocity) == len(x.effort) == 1
        assert (len(u.position), len(u.velocity), len(u.effort)) == (0, 0, 1)
        assert (x.position, x.velocity) == (y.position, y.velocity)  # passthrough
    applied = [y.effort[0] for _, y in found["/pea/displacement"]]
    commands = [u.effort[0] for _, u in found["/pea/voltage"]]
    assert applied[0] == 0.0
    assert applied[1:] == commands[:-1]


def test_metadata_is_of_version_9(bag):
    (mcap,) = bag.glob("*.mcap")
    found = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert found["version"] == 9
    assert found["storage_identifier"] == "mcap"
    assert found["relative_file_paths"] == [mcap.name]
    assert found["starting_time"]["nanoseconds_since_epoch"] == 0
    assert found["duration"]["nanoseconds"] >= (SAMPLES - 1) * T_NS
    counts = {
        topic["topic_metadata"]["name"]: topic["message_count"]
        for topic in found["topics_with_message_count"]
    }
    assert {counts[topic] for topic in SAMPLED} == {SAMPLES}
    assert sum(counts.values()) == found["message_count"]
    assert found["files"][0]["message_count"] == found["message_count"]


def test_qos_is_reliable_and_keeps_the_last(bag):
    found = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    for topic in found["topics_with_message_count"]:
        (qos,) = topic["topic_metadata"]["offered_qos_profiles"]
        assert (qos["reliability"], qos["history"]) == ("reliable", "keep_last")
        assert qos["depth"] > 0
        assert topic["topic_metadata"]["type_description_hash"].startswith("RIHS01_")


@pytest.mark.parametrize("topic", SAMPLED)
@pytest.mark.parametrize("mode", ["composed", "distributed"])
def test_modes_record_the_same_bytes(recorded, mode, topic):
    batch = raw(recorded("batch", FIG9, *SHORT).directory, topic)
    assert len(batch) == SAMPLES
    assert raw(recorded(mode, FIG9, *SHORT).directory, topic) == batch
