"""Recordings in several files: nothing lost, nothing twice, each file readable by itself."""

import shutil

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

import pea
from pea_cli import cli
from pea_core.params import ParameterError
from pea_core.signals import SAMPLE
from pea_experiment import experiments
from pea_record import bag as bags
from pea_record.bag import METADATA, BagWriter, Split, split_of
from pea_record.copy import cut, lacks, recover
from pea_record.origin import ORIGIN
from pea_record.read import load
from pea_record.rows import record
from pea_run.modes import batch
from pea_wire import convert, events
from pea_wire.topics import DISPLACEMENT, PARAMETER_EVENTS, SAMPLED, VOLTAGE

T_NS = 50_000
N = 240
PIECE = 10
TENTHS = Split(duration=0.001)  # 20 samples
FIELDS = ("w", "y", "u_applied", "x1_hat", "x2_hat", "eps_hat", "u")


@pytest.fixture(scope="module")
def samples():
    made = np.empty(N, SAMPLE)
    noise = np.random.default_rng(6)
    for field in SAMPLE.names:
        made[field] = noise.normal(size=N)
    return made


def fill(writer, samples):
    writer.metadata(ORIGIN, {"format": "1", "sample_period_ns": str(T_NS)})
    for k in range(0, len(samples), PIECE):
        record(writer, k, T_NS, samples[k : k + PIECE])
        if k == 100:
            event = events.encode(k * T_NS, "/pea/controller", {"P": 0.5})
            writer.write(PARAMETER_EVENTS, k * T_NS, event)


@pytest.fixture(scope="module")
def bag(tmp_path_factory, samples):
    directory = tmp_path_factory.mktemp("run") / "bag"
    with BagWriter(directory, T_NS, TENTHS) as writer:
        fill(writer, samples)
    return directory


def files(directory):
    return sorted(directory.glob("*.mcap"), key=lambda path: int(path.stem.split("_")[-1]))


def test_a_file_is_as_long_as_was_asked(bag):
    told = yaml.safe_load((bag / METADATA).read_text())["rosbag2_bagfile_information"]

    assert told["relative_file_paths"] == [f"bag_{i}.mcap" for i in range(12)]
    assert [path.name for path in files(bag)] == told["relative_file_paths"]
    for i, file in enumerate(told["files"]):
        assert file["path"] == f"bag_{i}.mcap"
        assert file["starting_time"]["nanoseconds_since_epoch"] == i * 1_000_000
        assert file["duration"]["nanoseconds"] == 19 * T_NS
    assert sum(file["message_count"] for file in told["files"]) == told["message_count"]
    assert told["duration"]["nanoseconds"] == (N - 1) * T_NS


def test_rosbags_reads_the_directory_sample_by_sample(bag, samples):
    with AnyReader([bag]) as reader:
        assert reader.message_count == 3 * N + N // PIECE + 1
        for topic in SAMPLED:
            chosen = [c for c in reader.connections if c.topic == topic.name]
            efforts = [
                (time, reader.deserialize(data, connection.msgtype).effort[0])
                for connection, time, data in reader.messages(chosen)
            ]
            name = {"displacement": "u_applied", "state": "eps_hat", "voltage": "u"}
            expected = samples[name[topic.name.rpartition("/")[2]]]
            assert efforts == [(k * T_NS, value) for k, value in enumerate(expected)]


def test_every_file_is_read_alone(bag, samples):
    k = 0
    for path in files(bag):
        with open(path, "rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            decoded = reader.iter_decoded_messages(topics=["/pea/voltage"])
            u = [message.effort[0] for *_, message in decoded]
            assert any(record.name == ORIGIN for record in reader.iter_metadata())
        assert u == samples["u"][k : k + len(u)].tolist()
        alone = load(path)
        assert alone.samples["y"].tobytes() == samples["y"][k : k + len(u)].tobytes()
        k += len(u)
    assert k == N


def test_directory_is_one_recording(bag, samples):
    recording = load(bag)

    for field in FIELDS:
        assert recording.samples[field].tobytes() == samples[field].tobytes(), field
    assert lacks(recording) == []
    assert [event.stamp for event in recording.events] == [100 * T_NS]
    part = pea.load(bag, 0.0055, 0.0085)
    assert part["u"].tobytes() == samples["u"][110:170].tobytes()


def test_missing_file_is_missed(tmp_path, bag):
    copy = shutil.copytree(bag, tmp_path / "bag")
    (copy / "bag_5.mcap").unlink()

    missing = lacks(load(copy))

    assert any("/pea/voltage: 20 samples are missing" in line for line in missing)
    assert "/pea/voltage: 220 messages of 240 written" in missing


def test_files_grow_no_larger_than_asked(tmp_path, samples):
    with BagWriter(tmp_path / "bag", T_NS, Split(size=60_000)) as writer:
        fill(writer, samples)

    sizes = [path.stat().st_size for path in files(tmp_path / "bag")]
    assert len(sizes) > 1
    assert max(sizes) < 100_000
    assert load(tmp_path / "bag").samples["u"].tobytes() == samples["u"].tobytes()


def test_topics_that_lag_make_no_file_more(tmp_path, samples):
    u = convert.forms().voltage.encode_many(np.arange(N) * T_NS, samples["u"])
    y = convert.forms().displacement.encode_many(
        np.arange(N) * T_NS, samples["y"], samples["u_applied"]
    )
    with BagWriter(tmp_path / "bag", T_NS, TENTHS) as writer:
        for k in range(0, N, PIECE):
            for topic, rows, lag in ((VOLTAGE, u, 15), (DISPLACEMENT, y, 0)):
                part = np.arange(max(k - lag, 0), max(k + PIECE - lag, 0))
                writer.write_many(topic, part * T_NS, rows[part])
            writer.write(PARAMETER_EVENTS, 0, events.encode(0, "/pea/controller", {"P": 0.5}))
            writer.keep()

    assert len(files(tmp_path / "bag")) == N // 20


def test_run_that_ends_with_a_file_begins_no_other(tmp_path, samples):
    with BagWriter(tmp_path / "bag", T_NS, Split(duration=N * T_NS * 1e-9)) as writer:
        fill(writer, samples)

    assert len(files(tmp_path / "bag")) == 1


def test_killed_writer_leaves_files_that_are_recovered(tmp_path, samples):
    writer = BagWriter(tmp_path / "bag", T_NS, TENTHS)
    fill(writer, samples[:110])
    writer.flush()
    copy = shutil.copytree(tmp_path / "bag", tmp_path / "killed")
    writer.close()

    recording, missing = recover(copy, tmp_path / "new")

    assert recording.samples["u"].tobytes() == samples["u"][:110].tobytes()
    assert missing == ["bag_5.mcap is cut off"]
    with AnyReader([tmp_path / "new"]) as reader:
        assert reader.message_count == 3 * 110 + 11 + 1


def test_recording_is_cut_across_files(tmp_path, bag, samples):
    part = cut(bag, tmp_path / "part", 35 * T_NS, 47 * T_NS, None)

    assert part.samples["u"].tobytes() == samples["u"][35:47].tobytes()


def test_no_room_for_another_file_is_told_and_the_bag_so_far_is_whole(
    tmp_path, samples, monkeypatch
):
    writer = BagWriter(tmp_path / "bag", T_NS, TENTHS)
    record(writer, 0, T_NS, samples[:20])

    def full(path):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(bags, "File", full)
    with pytest.raises(OSError, match="No space left"):
        record(writer, 20, T_NS, samples[20:30])
    writer.close()

    assert [path.name for path in files(tmp_path / "bag")] == ["bag_0.mcap"]
    recording = load(tmp_path / "bag")
    assert recording.samples["u"].tobytes() == samples["u"][:20].tobytes()
    assert recording.damage == ""


def test_run_in_several_files_replays(tmp_path):
    what = experiments.load("fig9_hysteresis_10hz", (), 0.15)
    batch.run(what, tmp_path / "bag", lambda k: None, split_of(None, "0.1"))

    assert len(files(tmp_path / "bag")) == 2
    assert cli.main(["bag", "check", str(tmp_path / "bag")]) == 0
    assert cli.main(["bag", "check", str(tmp_path / "bag" / "bag_1.mcap")]) == 3


@pytest.mark.parametrize(
    ("size", "expected"),
    [("100kB", 10**5), ("2.5 MB", 2_500_000), ("1GB", 10**9), ("123456", 123456)],
)
def test_sizes_have_units(size, expected):
    assert split_of(size, "60") == Split(expected, 60.0)


@pytest.mark.parametrize(
    ("size", "duration"),
    [("x", None), ("-1MB", None), ("1kB", None), ("5MiB", None), ("nan", None), ("", None),
     ("9999999999GB", None), (None, "0"), (None, "x"), (None, "1MB"), (None, "inf")],
)  # fmt: skip
def test_bad_sizes_and_durations_are_refused_in_one_line(size, duration):
    with pytest.raises(ParameterError, match=r"^--split-(size|duration) .*: give [^\n]*$"):
        split_of(size, duration)
