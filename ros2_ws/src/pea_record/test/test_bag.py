import contextlib
import errno
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability, QosHistory, QosReliability, QosTime
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from pea_record.bag import FLUSH_EVERY, METADATA, BagWriter, offered_qos
from pea_record.definitions import type_hash
from pea_wire import convert
from pea_wire.topics import (
    CONSUMED,
    DIAGNOSTICS,
    DISPLACEMENT,
    RECORDED_TOPICS,
    REFERENCE,
    STATE,
    VOLTAGE,
)

FORMS = convert.forms()

T_NS = 50_000
N = 2500
STAMPS = np.arange(N) * T_NS
SIGNALS = np.random.default_rng(3).normal(size=(6, N))
POINTS = np.random.default_rng(4).normal(size=(N, 3))
COUNTS = {DISPLACEMENT.name: N, STATE.name: N, VOLTAGE.name: N, REFERENCE.name: 3}


def fill(bag):
    """Record `N` samples: displacement and state as blocks, voltage one by one."""
    for k in range(0, N, 1000):
        part = slice(k, k + 1000)
        stamps = STAMPS[part]
        chunk = FORMS.reference.encode(int(stamps[0]), T_NS, POINTS[part])
        bag.write(REFERENCE, int(stamps[0]), chunk)
        rows = FORMS.displacement.encode_many(stamps, *SIGNALS[:2, part])
        bag.write_many(DISPLACEMENT, stamps, rows)
        rows = FORMS.state.encode_many(stamps, *SIGNALS[2:5, part])
        bag.write_many(STATE, stamps, rows)
        for stamp, u in zip(stamps.tolist(), SIGNALS[5, part].tolist()):
            bag.write(VOLTAGE, stamp, FORMS.voltage.encode(stamp, u))


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    directory = tmp_path_factory.mktemp("runs") / "fig9"
    with BagWriter(directory) as bag:
        bag.metadata("run", {"mode": "batch"})
        fill(bag)
    return directory


def test_what_was_recorded_is_in_the_file_half_a_second_later(tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    bag = BagWriter(tmp_path)
    fill(bag)
    size = []
    for now[0] in (FLUSH_EVERY - 1e-3, FLUSH_EVERY, FLUSH_EVERY + 0.1):
        bag.write(VOLTAGE, 0, FORMS.voltage.encode(0, 1.0))
        bag.keep()
        size.append(bag.path.stat().st_size)
    bag.close()

    assert size[0] < size[1] == size[2]


def information(directory):
    text = (directory / METADATA).read_text(encoding="utf-8")
    return yaml.safe_load(text)["rosbag2_bagfile_information"]


def bits(values):
    return np.array(values, "<f8").tobytes()


def test_rosbags_reads_counts_types_and_hashes(recording):
    with Reader(recording) as reader:
        found = {c.topic: (c.msgtype, c.msgcount, c.digest) for c in reader.connections}

    assert found == {
        t.name: (t.type, COUNTS.get(t.name, 0), type_hash(t.type)) for t in RECORDED_TOPICS
    }


def test_rosbags_reads_span_and_distribution(recording):
    with Reader(recording) as reader:
        assert reader.start_time == 0
        assert reader.end_time == (N - 1) * T_NS + 1
        assert reader.message_count == 3 * N + 3
        assert reader.ros_distro == "jazzy"


@pytest.mark.parametrize("as_file", [False, True])
def test_rosbags_reads_qos(recording, as_file):
    endless = QosTime(9223372036, 854775807)
    with Reader(recording / "fig9_0.mcap" if as_file else recording) as reader:
        offered = {c.topic: c.ext.offered_qos_profiles for c in reader.connections}

    for topic in RECORDED_TOPICS:
        (qos,) = offered[topic.name]
        assert (qos.history, qos.depth) == (QosHistory.KEEP_LAST, topic.depth)
        kept = QosDurability.TRANSIENT_LOCAL if topic.latched else QosDurability.VOLATILE
        assert (qos.reliability, qos.durability) == (QosReliability.RELIABLE, kept)
        assert qos.deadline == qos.lifespan == qos.liveliness_lease_duration == endless


def test_latched_topic_offers_transient_local():
    assert offered_qos(CONSUMED)["durability"] == "transient_local"


def test_rosbags_decodes_every_value_bit_for_bit(recording):
    read = {topic.name: [] for topic in RECORDED_TOPICS}
    store = get_typestore(Stores.ROS2_JAZZY)
    with AnyReader([recording], default_typestore=store) as reader:
        for connection, stamp, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            read[connection.topic].append((stamp, message))

    for name in COUNTS:
        for stamp, message in read[name]:
            time = message.header.stamp
            assert stamp == time.sec * 10**9 + time.nanosec
    for name in (DISPLACEMENT.name, STATE.name, VOLTAGE.name):
        assert [stamp for stamp, _ in read[name]] == STAMPS.tolist()
    state = [[m.position[0], m.velocity[0], m.effort[0]] for _, m in read[STATE.name]]
    assert bits(state) == bits(SIGNALS[2:5].T)
    assert bits([m.effort[0] for _, m in read[VOLTAGE.name]]) == bits(SIGNALS[5])


def test_mcap_ros2_decodes_every_value_bit_for_bit(recording):
    displacement, points = [], []
    with open(recording / "fig9_0.mcap", "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for item in reader.iter_decoded_messages([DISPLACEMENT.name, REFERENCE.name]):
            message = item.decoded_message
            if item.channel.topic == DISPLACEMENT.name:
                assert list(message.velocity) == []
                displacement.append([message.position[0], message.effort[0]])
            else:
                points += [
                    [p.positions[0], p.velocities[0], p.accelerations[0]] for p in message.points
                ]

    assert bits(displacement) == bits(SIGNALS[:2].T)
    assert bits(points) == bits(POINTS)


def test_mcap_profile_and_channel_metadata(recording):
    with open(recording / "fig9_0.mcap", "rb") as file:
        reader = make_reader(file)
        header, channels = reader.get_header(), reader.get_summary().channels.values()

    assert header.profile == "ros2"
    assert [c.topic for c in channels] == [t.name for t in RECORDED_TOPICS]
    for topic, channel in zip(RECORDED_TOPICS, channels):
        assert channel.message_encoding == "cdr"
        assert channel.metadata["topic_type_hash"] == type_hash(topic.type)
        assert yaml.safe_load(channel.metadata["offered_qos_profiles"]) == [offered_qos(topic)]


def test_metadata_yaml_is_version_9(recording):
    found = information(recording)

    extent = {
        "duration": {"nanoseconds": (N - 1) * T_NS},
        "starting_time": {"nanoseconds_since_epoch": 0},
        "message_count": 3 * N + 3,
    }
    topics = found.pop("topics_with_message_count")
    assert found == {
        "version": 9,
        "storage_identifier": "mcap",
        **extent,
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": ["fig9_0.mcap"],
        "files": [{"path": "fig9_0.mcap", **extent}],
        "custom_data": {},
        "ros_distro": "jazzy",
    }
    for topic, entry in zip(RECORDED_TOPICS, topics, strict=True):
        assert entry["message_count"] == COUNTS.get(topic.name, 0)
        assert entry["topic_metadata"] == {
            "name": topic.name,
            "type": topic.type,
            "serialization_format": "cdr",
            "offered_qos_profiles": [offered_qos(topic)],
            "type_description_hash": type_hash(topic.type),
        }


def test_metadata_records(recording):
    with open(recording / "fig9_0.mcap", "rb") as file:
        found = {m.name: m.metadata for m in make_reader(file).iter_metadata()}

    assert found["run"] == {"mode": "batch"}
    assert yaml.safe_load(found["rosbag2"]["serialized_metadata"]) == information(recording)


def test_empty_bag_lists_its_topics(tmp_path):
    BagWriter(tmp_path / "empty").close()

    with Reader(tmp_path / "empty") as reader:
        assert {c.topic: c.msgcount for c in reader.connections} == {
            t.name: 0 for t in RECORDED_TOPICS
        }
        assert list(reader.messages()) == []


def test_directory_may_hold_other_files(tmp_path):
    (tmp_path / "metrics.json").write_text("{}")

    BagWriter(tmp_path).close()

    assert sorted(p.name for p in tmp_path.iterdir()) == [
        METADATA,
        "metrics.json",
        f"{tmp_path.name}_0.mcap",
    ]


def test_relative_directory_gives_its_real_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    with BagWriter(Path(".")) as bag:
        assert bag.path.name == f"{tmp_path.name}_0.mcap"


@pytest.mark.parametrize("name", ["other.mcap", METADATA])
def test_recording_is_never_overwritten(tmp_path, name):
    (tmp_path / name).write_bytes(b"precious")

    with pytest.raises(FileExistsError, match=name):
        BagWriter(tmp_path)

    assert [p.name for p in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_bytes() == b"precious"


def test_second_close_does_nothing(tmp_path):
    bag = BagWriter(tmp_path)
    bag.close()
    before = bag.path.read_bytes()

    bag.close()

    assert bag.path.read_bytes() == before


def test_topic_outside_the_table_is_refused(tmp_path):
    with BagWriter(tmp_path) as bag, pytest.raises(ValueError, match=f"{CONSUMED.name} is not"):
        bag.write(CONSUMED, 0, convert.encode_time(0))


def test_messages_of_any_length(tmp_path):
    with BagWriter(tmp_path) as bag:
        bag.write(DIAGNOSTICS, 5, bytes(2_000_000))
        bag.write(DIAGNOSTICS, 6, b"")

    with Reader(tmp_path) as reader:
        assert [len(data) for _, _, data in reader.messages()] == [2_000_000, 0]


def test_failure_in_the_body_still_completes_the_bag(tmp_path):
    def record():
        with BagWriter(tmp_path) as bag:
            fill(bag)
            raise KeyError("something else")

    with pytest.raises(KeyError):
        record()

    assert information(tmp_path)["message_count"] == 3 * N + 3


LIMITED = """
import errno, resource, sys
from pathlib import Path
from pea_wire.topics import DIAGNOSTICS
from pea_record.bag import BagWriter

import numpy as np

resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), resource.RLIM_INFINITY))
try:
    bag = BagWriter(Path(sys.argv[1]))
except OSError as error:
    sys.exit(error.errno)
noise = np.random.default_rng(0)
told = 0
try:
    for k in range(4000):
        bag.write(DIAGNOSTICS, k, noise.bytes(1000))
except OSError as error:
    told = error.errno
bag.close()
sys.exit(told)
"""


def with_file_limit(directory, limit):
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, directory, str(limit)], capture_output=True, text=True
    )
    assert done.stderr == ""
    return done.returncode


def test_full_disk_is_told_and_leaves_a_complete_bag(tmp_path):
    assert with_file_limit(tmp_path, 2_000_000) == errno.EFBIG

    with Reader(tmp_path) as reader:
        stamps = [stamp for _, stamp, _ in reader.messages()]
        assert stamps == list(range(len(stamps)))
        assert 1000 < len(stamps) < 2000
        assert reader.message_count == len(stamps)


CHUNKS = """
import resource, sys
from pathlib import Path

import numpy as np

from pea_wire.topics import DIAGNOSTICS
from pea_record.bag import BagWriter

noise = np.random.default_rng(0)
for limit in range(120_000, 200_000, 2_003):
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
    bag = BagWriter(Path(sys.argv[1]) / str(limit))
    try:
        while True:
            bag.write(DIAGNOSTICS, 0, noise.bytes(1000))
            bag.flush()
    except OSError:
        bag.close()
"""


def test_bag_is_complete_wherever_the_disk_ends(tmp_path):
    subprocess.run([sys.executable, "-c", CHUNKS, tmp_path], check=True)

    for directory in tmp_path.iterdir():
        with Reader(directory) as reader:
            assert reader.message_count > 0
    assert len(list(tmp_path.iterdir())) == 40


def test_disk_full_from_the_start_leaves_no_file(tmp_path):
    assert with_file_limit(tmp_path, 100) == errno.EFBIG

    assert list(tmp_path.iterdir()) == []


KILLED = """
import os, signal, sys
from pathlib import Path

import numpy as np

from pea_wire import convert
from pea_wire.topics import VOLTAGE
from pea_record.bag import BagWriter

bag = BagWriter(Path(sys.argv[1]))
stamps = np.arange(30_000) * 50_000
rows = convert.forms().voltage.encode_many(stamps, stamps * 1e-9)
bag.write_many(VOLTAGE, stamps[:20_000], rows[:20_000])
bag.flush()
bag.write_many(VOLTAGE, stamps[20_000:20_100], rows[20_000:20_100])
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_killed_writer_leaves_what_was_flushed(tmp_path):
    done = subprocess.run([sys.executable, "-c", KILLED, tmp_path])
    assert done.returncode == -signal.SIGKILL

    read = []
    with (
        open(tmp_path / f"{tmp_path.name}_0.mcap", "rb") as file,
        contextlib.suppress(EndOfFile),
    ):
        read.extend(StreamReader(file).records)

    stamps = [record.log_time for record in read if isinstance(record, Message)]
    assert stamps == [k * T_NS for k in range(20_000)]
