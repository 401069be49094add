"""Raw messages of bags: ours and others', whole and broken."""

import shutil

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from pea_cli.cli import main
from pea_experiment import experiments
from pea_record.messages import Messages
from pea_record.recording import BagError
from pea_run.modes import batch

TIMES = (5, 7, 11)


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    there = tmp_path_factory.mktemp("bags") / "ours"
    experiment = experiments.load("fig9_hysteresis_10hz", (), 0.005)
    batch.run(experiment, there, lambda k: None)
    return there


def foreign(there, storage, times):
    types = get_typestore(Stores.ROS2_JAZZY)
    kind = "std_msgs/msg/Float64"
    with Writer(there, version=9, storage_plugin=storage) as writer:
        channel = writer.add_connection("/load", kind, typestore=types)
        for time in times:
            writer.write(channel, time, types.serialize_cdr(types.types[kind](float(time)), kind))
    return there


def test_messages_come_in_the_order_of_their_time(bag):
    with Messages(bag) as messages:
        assert (messages.start, messages.end) == (0, 99 * 50_000 + 1)
        names = [name for name, channel in messages.channels.items() if channel.messages]
        found = list(messages.between(names, messages.start, messages.end))
    times = [time for time, _, _ in found]
    assert times == sorted(times)
    for name in ("/pea/displacement", "/pea/state", "/pea/voltage"):
        assert [t for t, n, _ in found if n == name] == [k * 50_000 for k in range(100)]


def test_a_part_is_from_its_start_up_to_its_end(bag):
    with Messages(bag) as messages:
        found = list(messages.between(["/pea/voltage"], 10 * 50_000, 20 * 50_000))
    assert [time for time, _, _ in found] == [k * 50_000 for k in range(10, 20)]


def test_a_file_and_a_directory_without_metadata_say_the_same(bag, tmp_path):
    (file,) = bag.glob("*.mcap")
    shutil.copy(file, tmp_path / file.name)
    heard = []
    for path in (bag, file, tmp_path):
        with Messages(path) as messages:
            heard.append(list(messages.between(["/pea/state"], 0, messages.end)))
    assert heard[0] == heard[1] == heard[2]
    assert len(heard[0]) == 100


@pytest.mark.parametrize("storage", StoragePlugin)
def test_foreign_bags_are_read(tmp_path, storage):
    with Messages(foreign(tmp_path / "bag", storage, TIMES)) as messages:
        assert messages.channels["/load"].type == "std_msgs/msg/Float64"
        assert messages.channels["/load"].messages == len(TIMES)
        found = list(messages.between(["/load"], 0, 12))
    assert [time for time, _, _ in found] == list(TIMES)
    assert [float(np.frombuffer(data, "<f8", 1, 4)[0]) for _, _, data in found] == [5.0, 7.0, 11.0]


def empty_file(there, bag):
    (there / "no.mcap").touch()
    return there / "no.mcap"


def other_file(there, bag):
    (there / "no.txt").write_text("no bag")
    return there / "no.txt"


def text_in_mcap(there, bag):
    (there / "no.mcap").write_text("no bag, but long enough to have a footer of 37 bytes in it")
    return there / "no.mcap"


def text_in_sqlite(there, bag):
    (there / "no.db3").write_text("no bag")
    return there / "no.db3"


def without_messages(there, bag):
    return foreign(there / "bag", StoragePlugin.MCAP, ())


def cut_off(there, bag):
    (file,) = bag.glob("*.mcap")
    (there / "no.mcap").write_bytes(file.read_bytes()[:-1000])
    return there / "no.mcap"


def wrong_metadata(there, bag):
    (there / "metadata.yaml").write_text("rosbag2_bagfile_information: {version: 99}")
    return there


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda there, bag: there / "nowhere", "does not exist"),
        (lambda there, bag: there, "is no recording: no metadata.yaml, .mcap, .db3 in it"),
        (empty_file, "seems to be empty"),
        (other_file, "must end in .mcap or .db3"),
        (text_in_mcap, "magic is invalid"),
        (text_in_sqlite, "cannot be read"),
        (without_messages, "holds no message"),
        (cut_off, "pea bag recover"),
        (wrong_metadata, "version 99"),
    ],
)
def test_what_is_no_bag_is_one_line(tmp_path, bag, capfd, make, words):
    path = make(tmp_path, bag)
    with pytest.raises(BagError, match=words):
        Messages(path)
    assert main(["replay", str(path), "--publish"]) == 2
    said = capfd.readouterr().err
    assert len(said.splitlines()) == 1
    assert str(tmp_path) in said


def test_damaged_chunk_is_one_line(tmp_path, bag):
    (file,) = bag.glob("*.mcap")
    data = bytearray(file.read_bytes())
    data[data.rindex(b"\x28\xb5\x2f\xfd") + 50] ^= 0xFF  # a byte of what zstd has compressed
    (tmp_path / "bad.mcap").write_bytes(data)
    with pytest.raises(BagError, match="cannot be read"):  # noqa: SIM117
        with Messages(tmp_path / "bad.mcap") as messages:
            list(messages.between(["/pea/state"], 0, messages.end))
