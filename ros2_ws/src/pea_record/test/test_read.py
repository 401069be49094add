import io
import signal
import struct
import subprocess
import sys

import numpy as np
import pytest
import yaml
from builtin_interfaces.msg import Time
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from rclpy.serialization import serialize_message
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from pea_core.signals import SAMPLE
from pea_record.bag import TOPICS, BagWriter
from pea_record.read import load, load_axes, topics
from pea_record.recording import BagError
from pea_record.rows import record
from pea_wire import convert, events
from pea_wire.topics import (
    DIAGNOSTICS,
    DISPLACEMENT,
    PARAMETER_EVENTS,
    REFERENCE,
    SAMPLED,
    STATE,
    VOLTAGE,
)

FORMS = convert.forms()

T_NS = 50_000
LOOP = (*SAMPLED, REFERENCE)
ANY_VOLTAGE = FORMS.voltage.encode(7 * T_NS, 1.0)
ARRIVAL = 1_700_000_000 * 10**9
"""Log time of recorders that note when a message came."""


def made_up(n, ideal=True):
    """Samples of no sense, in which every bit matters."""
    samples = np.empty(n, SAMPLE)
    noise = np.random.default_rng(n)
    for field in SAMPLE.names:
        samples[field] = noise.normal(size=n)
    if not ideal:
        samples["y_dot"] = np.nan
    return samples


def messages(samples, k=0):
    """(topic, stamp, CDR) of each message, as nodes send them."""
    for i, row in enumerate(samples.tolist(), k):
        stamp = i * T_NS
        yield REFERENCE, stamp, FORMS.reference.encode(stamp, T_NS, np.array([row[:3]]))
        yield DISPLACEMENT, stamp, FORMS.displacement_ideal.encode(stamp, *row[3:6])
        yield STATE, stamp, FORMS.state.encode(stamp, *row[6:9])
        yield VOLTAGE, stamp, FORMS.voltage.encode(stamp, row[9])


def foreign_messages(samples, k=0):
    """The same from nodes of others: a frame, another axis, every array full."""
    for i, row in enumerate(samples.tolist(), k):
        header = Header(stamp=Time(sec=0, nanosec=i * T_NS), frame_id="stage")
        point = [[9.0, v] for v in row[:3]]
        trajectory = JointTrajectory(header=header, joint_names=["z", "x"])
        trajectory.points = [
            JointTrajectoryPoint(positions=point[0], velocities=point[1], accelerations=point[2])
        ]
        yield REFERENCE, i * T_NS, serialize_message(trajectory)
        for topic, values in (
            (DISPLACEMENT, row[3:6]),
            (STATE, row[6:9]),
            (VOLTAGE, (8.0, 8.0, row[9])),
        ):
            arrays = dict(zip(("position", "velocity", "effort"), [[9.0, v] for v in values]))
            message = JointState(header=header, name=["z", "x"], **arrays)
            yield topic, i * T_NS, serialize_message(message)


def bag_of(directory, stream):
    with BagWriter(directory) as bag:
        for topic, stamp, data in stream:
            bag.write(topic, stamp, data)
    return directory


def assert_same_bits(read, samples):
    for field in SAMPLE.names:
        assert read[field].tobytes() == samples[field].tobytes(), field


@pytest.mark.parametrize("stream", [messages, foreign_messages])
def test_what_is_shown_between_two_samples_is_no_sample(tmp_path, stream):
    samples = made_up(30)
    shown = [(DISPLACEMENT, 0, codec.encode(0, 1.0, 2.0)) for codec in FORMS.marked.values()]
    told = list(stream(samples))
    bag = bag_of(tmp_path / "bag", [*shown, *told[:40], *shown, *shown, *told[40:], *shown])
    read = load(bag)
    assert_same_bits(read.samples, samples)
    assert not sum(read.repeats.values())


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A recording of 60 samples in many chunks, its samples and the bytes of its file."""
    directory = tmp_path_factory.mktemp("whole")
    samples = made_up(60)
    with BagWriter(directory) as bag:
        for k in range(0, 60, 6):
            record(bag, k, T_NS, samples[k : k + 6])
            bag.flush()
    return samples, (directory / f"{directory.name}_0.mcap").read_bytes()


@pytest.mark.parametrize("ideal", [False, True])
def test_samples_recorded_in_blocks_come_back_bit_for_bit(tmp_path, ideal):
    samples = made_up(2500, ideal)
    with BagWriter(tmp_path) as bag:
        for k in range(0, 2500, 1000):
            record(bag, k, T_NS, samples[k : k + 1000])

    recording = load(tmp_path)

    assert_same_bits(recording.samples, samples)
    assert recording.damage == ""


@pytest.mark.parametrize("n", [1000, 1001, 20_000])
def test_samples_that_were_waiting_for_seconds_come_back_bit_for_bit(tmp_path, n):
    """A loop in wall time goes on while what records it is halted."""
    samples = made_up(n)
    with BagWriter(tmp_path) as bag:
        record(bag, 0, T_NS, samples, np.ones((30, 3)))

    assert_same_bits(load(tmp_path).samples, samples)
    with (tmp_path / f"{tmp_path.name}_0.mcap").open("rb") as opened:
        chunks = list(make_reader(opened).iter_messages(topics=["/pea/reference"]))
    points = [len(FORMS.reference.receive(m.data)[1]) for _, _, m in chunks]  # nodes take it, too
    assert sum(points) == n + 30
    assert max(points) <= 1030


def test_a_chunk_that_an_older_recording_holds_is_read(tmp_path):
    """It held as many points as there were samples waiting."""
    samples = made_up(20_000)
    with BagWriter(tmp_path) as bag:
        points = FORMS.points(samples)
        bag.write(REFERENCE, 0, FORMS.reference.encode(0, T_NS, points))
        for topic in SAMPLED:
            stamps = np.arange(len(samples), dtype=np.int64) * T_NS
            bag.write_many(topic, stamps, FORMS.messages(topic, stamps, samples))

    assert_same_bits(load(tmp_path).samples, samples)


def test_samples_recorded_one_by_one_come_back_bit_for_bit(tmp_path):
    samples = made_up(300)

    recording = load(bag_of(tmp_path, messages(samples)))

    assert_same_bits(recording.samples, samples)


def test_directory_and_file_read_alike(tmp_path):
    bag_of(tmp_path, messages(made_up(3)))

    assert_same_bits(load(tmp_path / f"{tmp_path.name}_0.mcap").samples, load(tmp_path).samples)


def test_facts_about_a_recording(tmp_path):
    with BagWriter(tmp_path) as bag:
        record(bag, 4, T_NS, made_up(10))
        bag.write(DIAGNOSTICS, 0, b"any")
        bag.metadata("run", {"seed": "1"})

    recording = load(tmp_path)

    assert recording.T_ns == T_NS
    assert (recording.first, recording.last) == (4 * T_NS, 13 * T_NS)
    assert recording.stamps.tolist() == [k * T_NS for k in range(4, 14)]
    assert {k: n for k, n in recording.counts.items() if n} == {
        **{topic.name: 10 for topic in SAMPLED},
        REFERENCE.name: 1,
        DIAGNOSTICS.name: 1,
    }
    assert set(recording.gaps.values()) == set(recording.repeats.values()) == {0}
    assert recording.metadata["run"] == {"seed": "1"}
    assert recording.metadata.keys() == {"run", TOPICS, "rosbag2"}


def test_writer_and_reader_tell_the_same_of_each_topic(tmp_path):
    stream = [*without(messages(made_up(20)), STATE, 5, 6), (VOLTAGE, 7 * T_NS, ANY_VOLTAGE)]
    with BagWriter(tmp_path, T_NS) as bag:
        for topic, stamp, data in sorted(stream, key=lambda m: m[1]):
            bag.write(topic, stamp, data)

    recording = load(tmp_path)

    told = {name: yaml.safe_load(text) for name, text in recording.metadata[TOPICS].items()}
    span = {"first_ns": 0, "last_ns": 19 * T_NS}
    assert {topic.name: told[topic.name] for topic in SAMPLED} == {
        DISPLACEMENT.name: {"messages": 20, **span, "gaps": 0, "repeats": 0},
        STATE.name: {"messages": 18, **span, "gaps": 2, "repeats": 0},
        VOLTAGE.name: {"messages": 21, **span, "gaps": 0, "repeats": 1},
    }
    assert topics(recording).items() >= {t.name: told[t.name] for t in SAMPLED}.items()


def test_writer_counts_gaps_and_repeats_within_blocks_and_between(tmp_path):
    with BagWriter(tmp_path, T_NS) as bag:
        for stamps in ([0, 1, 1, 2], [5, 6, 8], [8]):
            rows = FORMS.voltage.encode_many(np.array(stamps) * T_NS, np.zeros(len(stamps)))
            bag.write_many(VOLTAGE, np.array(stamps) * T_NS, rows)

    (file,) = tmp_path.glob("*.mcap")
    with open(file, "rb") as opened:
        told = {each.name: each.metadata for each in make_reader(opened).iter_metadata()}
    assert told[TOPICS][VOLTAGE.name] == (
        f"messages: 8\nfirst_ns: 0\nlast_ns: {8 * T_NS}\ngaps: 3\nrepeats: 2\n"
    )


def test_reference_after_the_last_sample_is_kept(tmp_path):
    samples, after = made_up(10), np.arange(9.0).reshape(3, 3)
    with BagWriter(tmp_path) as bag:
        record(bag, 0, T_NS, samples, after)

    recording = load(tmp_path)

    assert recording.after.tolist() == after.tolist()
    assert_same_bits(recording.samples, samples)


def test_reference_beyond_a_gap_is_not_taken_for_what_follows(tmp_path):
    beyond = FORMS.reference.encode(12 * T_NS, T_NS, np.ones((2, 3)))
    with BagWriter(tmp_path) as bag:
        record(bag, 0, T_NS, made_up(10), np.ones((1, 3)))
        bag.write(REFERENCE, 12 * T_NS, beyond)

    assert load(tmp_path).after.shape == (1, 3)


def test_parameter_events_come_in_order(tmp_path):
    with BagWriter(tmp_path) as bag:
        record(bag, 0, T_NS, made_up(10))
        for k in (7, 3):
            event = events.encode(k * T_NS, "/pea/controller", {"P": 0.1 * k})
            bag.write(PARAMETER_EVENTS, k * T_NS, event)

    assert [(e.stamp // T_NS, e.changed) for e in load(tmp_path).events] == [
        (3, {"P": 0.1 * 3}),
        (7, {"P": 0.1 * 7}),
    ]


def test_single_sample_has_no_period(tmp_path):
    recording = load(bag_of(tmp_path, messages(made_up(1))))

    assert (len(recording.samples), recording.T_ns) == (1, 0)


def without(stream, topic, *stamps):
    return [m for m in stream if not (m[0] == topic and m[1] // T_NS in stamps)]


def test_gaps_are_counted_and_their_samples_left_out(tmp_path):
    samples = made_up(20)
    stream = without(messages(samples), STATE, 5, 6, 11)

    recording = load(bag_of(tmp_path, stream))

    assert recording.gaps == {t.name: 3 if t == STATE else 0 for t in LOOP}
    assert_same_bits(recording.samples, np.delete(samples, [5, 6, 11]))


def test_period_is_right_when_most_neighbours_are_missing(tmp_path):
    stream = without(messages(made_up(20)), VOLTAGE, *range(1, 19, 2))

    assert load(bag_of(tmp_path, stream)).T_ns == T_NS


def test_sample_that_is_not_yet_complete_is_left_out(tmp_path):
    samples = made_up(20)
    stream = list(messages(samples))[:-1]

    recording = load(bag_of(tmp_path, stream))

    assert_same_bits(recording.samples, samples[:-1])
    assert set(recording.gaps.values()) == {0}


def test_first_of_repeated_messages_counts(tmp_path):
    samples, others = made_up(20), made_up(21)
    again = [m for m in messages(others) if m[:2] == (VOLTAGE, 7 * T_NS)]

    recording = load(bag_of(tmp_path, [*messages(samples), *again]))

    assert recording.repeats == {t.name: 1 if t == VOLTAGE else 0 for t in LOOP}
    assert_same_bits(recording.samples, samples)


@settings(max_examples=20, deadline=None)
@given(order=st.permutations(range(40)))
def test_order_of_messages_does_not_matter(tmp_path_factory, order):
    samples = made_up(10)
    stream = list(messages(samples))

    recording = load(bag_of(tmp_path_factory.mktemp("order"), [stream[i] for i in order]))

    assert_same_bits(recording.samples, samples)


def test_messages_of_other_publishers(tmp_path):
    samples = made_up(50)

    bag = bag_of(tmp_path, foreign_messages(samples))

    assert load_axes(bag).axes == ("z", "x")
    assert_same_bits(load(tmp_path.with_name(f"{tmp_path.name}@x")).samples, samples)
    with pytest.raises(BagError, match="this takes one: write"):
        load(bag)


def test_own_and_other_publishers_mixed(tmp_path):
    samples = made_up(50)
    stream = [*messages(samples[:20]), *foreign_messages(samples[20:], 20)]

    assert_same_bits(load(bag_of(tmp_path, stream)).samples, samples)


def test_garbage_in_padding_does_not_matter(tmp_path):
    samples = made_up(5)
    pad = FORMS.state.dtype.fields["pad_velocity"][1]
    stream = [
        (topic, stamp, data[:pad] + b"\xab" * 4 + data[pad + 4 :] if topic == STATE else data)
        for topic, stamp, data in messages(samples)
    ]

    assert_same_bits(load(bag_of(tmp_path, stream)).samples, samples)


def test_missing_axis_is_refused(tmp_path):
    other = convert.JointStateCodec(("z",), effort=True)
    stream = [m for m in messages(made_up(2)) if m[0] != VOLTAGE]

    with pytest.raises(BagError, match=f"{VOLTAGE.name}: name: 'z': must hold the axis 'x'"):
        load(bag_of(tmp_path, [*stream, (VOLTAGE, 0, other.encode(0, 1.0))]))


def test_bag_of_rosbags(tmp_path):
    samples = made_up(50)
    store = get_typestore(Stores.ROS2_JAZZY)
    path = tmp_path / "rosbags"
    with RosbagsWriter(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        links = {t: writer.add_connection(t.name, t.type, typestore=store) for t in LOOP}
        for i, (topic, _, data) in enumerate(messages(samples)):
            writer.write(links[topic], ARRIVAL + i, data)

    recording = load(path)

    assert_same_bits(recording.samples, samples)
    assert recording.T_ns == T_NS
    assert recording.damage == ""


@pytest.mark.parametrize(
    "options",
    [
        {"use_chunking": False},
        {"compression": CompressionType.LZ4, "chunk_size": 2000},
        {"compression": CompressionType.NONE, "enable_crcs": False},
        {"index_types": IndexType.NONE, "use_statistics": False},
    ],
    ids=["unchunked", "lz4", "plain", "no index"],
)
def test_files_of_the_reference_writer(tmp_path, options):
    samples = made_up(50)
    path = tmp_path / "other.mcap"
    with open(path, "wb") as file:
        writer = Writer(file, **options)
        writer.start("ros2", "other")
        channels = {
            t: writer.register_channel(
                t.name, "cdr", writer.register_schema(t.type, "ros2msg", b"")
            )
            for t in LOOP
        }
        for i, (topic, _, data) in enumerate(messages(samples)):
            writer.add_message(channels[topic], ARRIVAL + i, data, ARRIVAL, i)
        writer.finish()

    recording = load(path)

    assert_same_bits(recording.samples, samples)
    assert recording.damage == ""


def test_bag_split_into_files(tmp_path):
    samples = made_up(50)
    bag = tmp_path / "bag"
    bag.mkdir()
    for i, (k, end) in enumerate([(0, 30), (30, 50)]):
        part = bag_of(tmp_path / f"part{i}", messages(samples[k:end], k))
        (part / f"part{i}_0.mcap").rename(bag / f"bag_{i}.mcap")

    recording = load(bag)

    assert_same_bits(recording.samples, samples)
    assert recording.counts[STATE.name] == 50


def test_what_does_not_exist_is_refused(tmp_path):
    with pytest.raises(BagError, match="nowhere does not exist"):
        load(tmp_path / "nowhere")


def test_directory_without_a_recording_is_refused(tmp_path):
    with pytest.raises(BagError, match=r"is no recording: no \.mcap file in it"):
        load(tmp_path)


@pytest.mark.parametrize(
    ("content", "why"), [(b"", "is empty"), (b"SQLite format 3\0" * 9, "is no MCAP file")]
)
def test_other_files_are_refused(tmp_path, content, why):
    path = tmp_path / "bag.mcap"
    path.write_bytes(content)

    with pytest.raises(BagError, match=why):
        load(path)


def test_empty_recording_is_refused(tmp_path):
    BagWriter(tmp_path).close()

    with pytest.raises(BagError, match="holds no message of " + ", ".join(t.name for t in LOOP)):
        load(tmp_path)


def test_missing_topic_is_named(tmp_path):
    stream = [m for m in messages(made_up(3)) if m[0] != STATE]

    with pytest.raises(BagError, match=f"holds no message of {STATE.name}$"):
        load(bag_of(tmp_path, stream))


def test_recording_without_a_complete_sample_is_refused(tmp_path):
    stream = [m for m in messages(made_up(4)) if (m[0] == STATE) == (m[1] < 2 * T_NS)]

    with pytest.raises(BagError, match="holds no sample that"):
        load(bag_of(tmp_path, stream))


def test_topic_of_another_type_is_refused(tmp_path):
    path = tmp_path / "other.mcap"
    with open(path, "wb") as file:
        writer = Writer(file)
        writer.start("ros2", "other")
        schema = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data")
        channel = writer.register_channel(STATE.name, "cdr", schema)
        writer.add_message(channel, 0, bytes(12), 0)
        writer.finish()

    with pytest.raises(BagError, match="is std_msgs/msg/Float64 in cdr, must be sensor_msgs"):
        load(path)


def load_or_refuse(path):
    """The recording, or None where it is refused in one line."""
    refused = None
    try:
        return load(path)
    except BagError as error:
        refused = str(error)
    assert refused.count("\n") == 0
    return None


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_truncated_file_gives_what_is_there(tmp_path_factory, whole, data):
    samples, content = whole
    path = tmp_path_factory.getbasetemp() / "truncated.mcap"
    path.write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])

    recording = load_or_refuse(path)
    if recording:
        assert "is cut off" in recording.damage
        assert len(recording.samples) % 6 == 0
        assert_same_bits(recording.samples, samples[: len(recording.samples)])


def test_file_cut_in_its_summary_gives_every_sample(tmp_path, whole):
    samples, content = whole
    path = tmp_path / "cut.mcap"
    path.write_bytes(content[:-20])

    recording = load(path)

    assert_same_bits(recording.samples, samples)
    assert recording.damage == "cut.mcap is cut off"


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_damaged_file_never_gives_a_wrong_sample(tmp_path_factory, whole, data):
    samples, content = whole
    broken = bytearray(content)
    at = data.draw(st.integers(0, len(content) - 1))
    broken[at] ^= data.draw(st.integers(1, 255))
    path = tmp_path_factory.getbasetemp() / "damaged.mcap"
    path.write_bytes(broken)

    recording = load_or_refuse(path)
    if recording:
        assert_same_bits(recording.samples, samples[recording.stamps // T_NS])
        assert recording.damage


def test_every_changed_byte_is_told(tmp_path, whole):
    _, content = whole
    path = tmp_path / "changed.mcap"
    size = len(content)
    silent = []
    for at in (*range(0, size - 120, size // 150), *range(size - 120, size)):
        broken = bytearray(content)
        broken[at] ^= 0x10
        path.write_bytes(broken)
        recording = load_or_refuse(path)
        if recording and not recording.damage:
            silent.append(at)
    assert silent == []


def test_file_without_checksums_is_read(tmp_path, whole):
    """Other recorders leave them out."""
    samples, content = whole
    path = tmp_path / "plain.mcap"
    with open(path, "wb") as file:
        writer = Writer(file, enable_crcs=False)
        writer.start("ros2")
        reader = make_reader(io.BytesIO(content))
        channels = {}
        for schema, channel, message in reader.iter_messages():
            if channel.id not in channels:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, "cdr", schema_id)
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time
            )
        writer.finish()

    recording = load(path)

    assert_same_bits(recording.samples, samples)
    assert recording.damage == ""


def test_damaged_chunk_is_told_and_the_others_are_read(tmp_path, whole):
    samples, content = whole
    path = tmp_path / "damaged.mcap"
    index = make_reader(io.BytesIO(content)).get_summary().chunk_indexes[4]
    broken = bytearray(content)
    broken[index.chunk_start_offset + index.chunk_length // 2] ^= 0x55
    path.write_bytes(broken)

    recording = load(path)

    assert_same_bits(recording.samples, np.delete(samples, range(24, 30)))
    assert "a damaged chunk" in recording.damage
    assert recording.gaps[STATE.name] == 6


def test_chunk_that_passes_for_another_record_is_told(tmp_path, whole):
    samples, content = whole
    index = make_reader(io.BytesIO(content)).get_summary().chunk_indexes[-1]
    broken = bytearray(content)
    broken[index.chunk_start_offset] = 0x7F
    path = tmp_path / "damaged.mcap"
    path.write_bytes(broken)

    recording = load(path)

    assert_same_bits(recording.samples, samples[:54])
    assert recording.damage == "damaged.mcap: 171 messages of 190"


def test_unknown_compression_is_refused(tmp_path, whole):
    path = tmp_path / "odd.mcap"
    path.write_bytes(
        whole[1].replace(struct.pack("<I", 4) + b"zstd", struct.pack("<I", 4) + b"brot")
    )

    with pytest.raises(BagError):
        load(path)


KILLED = """
import os, signal, sys
from pathlib import Path

import numpy as np

from pea_core.signals import SAMPLE
from pea_record.bag import BagWriter
from pea_record.rows import record

samples = np.zeros(3000, SAMPLE)
samples["y"] = np.arange(3000)
bag = BagWriter(Path(sys.argv[1]))
record(bag, 0, 50_000, samples[:1000])
record(bag, 1000, 50_000, samples[1000:2000])
bag.flush()
record(bag, 2000, 50_000, samples[2000:])
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_killed_writer_is_readable_up_to_its_last_flush(tmp_path):
    done = subprocess.run([sys.executable, "-c", KILLED, tmp_path], check=False)
    assert done.returncode == -signal.SIGKILL

    recording = load(tmp_path)

    assert recording.samples["y"].tolist() == list(range(2000))
    assert recording.damage == f"{tmp_path.name}_0.mcap is cut off"


def test_samples_are_loaded_a_chunk_at_a_time_and_not_one_by_one(tmp_path):
    stream = [m for m in messages(made_up(10_000)) if m[0] != REFERENCE]
    chunk = FORMS.reference.encode(0, T_NS, np.zeros((10_000, 3)))
    bag_of(tmp_path, [(REFERENCE, 0, chunk), *stream])
    load(tmp_path)  # what is made once is there
    calls = []

    def note(frame, event, _):
        if event == "call":
            calls.append(frame.f_code.co_name)

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        load(tmp_path)
    finally:
        sys.setprofile(before)
    assert 0 < len(calls) < 10_000, len(calls)
