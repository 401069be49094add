"""What is no recording of a loop is refused in one line, with exit status 2, by every command."""

import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from pea_cli import cli
from pea_experiment import experiments
from pea_record.bag import BagWriter
from pea_record.mcap import MAGIC
from pea_record.origin import ORIGIN, origin
from pea_record.rows import record
from pea_run.modes import batch
from pea_wire import convert
from pea_wire.topics import DISPLACEMENT, VOLTAGE

T_NS = 50_000
EVERY = {
    "replay": ["replay"],
    "info": ["bag", "info"],
    "check": ["bag", "check"],
    "recover": ["bag", "recover"],
    "cut": ["bag", "cut", "--from", "0"],
    "export": ["export", "--csv", "table.csv"],
    "diff": ["diff", "whole"],
    "report": ["report", "--out", "page.html"],
}


def run(directory):
    what = experiments.load("fig9_hysteresis_10hz", (), 0.005)
    batch.run(what, directory, lambda k: None)
    return what


@pytest.fixture
def there(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run(tmp_path / "whole")
    return tmp_path


def text(path):
    path.write_text("a: b\n")


def nothing_in_it(path):
    path.write_bytes(b"")


def without_messages(path):
    BagWriter(path, T_NS).close()


def without_a_topic(path):
    with BagWriter(path, T_NS) as bag:
        bag.write(VOLTAGE, 0, convert.forms().voltage.encode(0, 1.0))


def of_other_topics(path):
    store = get_typestore(Stores.ROS2_JAZZY)
    kind = "std_msgs/msg/Float64"
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        link = writer.add_connection("/chatter", kind, typestore=store)
        writer.write(link, 0, store.serialize_cdr(store.types[kind](1.0), kind))


def of_another_type(path):
    store = get_typestore(Stores.ROS2_JAZZY)
    kind = "std_msgs/msg/Float64"
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        link = writer.add_connection(DISPLACEMENT.name, kind, typestore=store)
        writer.write(link, 0, store.serialize_cdr(store.types[kind](1.0), kind))


def in_sqlite(path):
    store = get_typestore(Stores.ROS2_JAZZY)
    kind = "std_msgs/msg/Float64"
    with Writer(path, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        link = writer.add_connection("/chatter", kind, typestore=store)
        writer.write(link, 0, store.serialize_cdr(store.types[kind](1.0), kind))


BAD = {
    "nothing there": (lambda path: None, "does not exist"),
    "a text": (text, "is no MCAP file"),
    "an empty file": (nothing_in_it, "is empty"),
    "an empty directory": (lambda path: path.mkdir(), "no .mcap file in it"),
    "the magic alone": (lambda path: path.write_bytes(MAGIC), "is cut off"),
    "an empty bag": (without_messages, "holds no message of /pea/displacement"),
    "a missing topic": (without_a_topic, "holds no message of /pea/displacement, /pea/state"),
    "other topics": (of_other_topics, "holds no message of /pea/displacement"),
    "another type": (of_another_type, "/pea/displacement is std_msgs/msg/Float64 in cdr, must be"),
    "a bag in sqlite3": (in_sqlite, "no .mcap file in it"),
}


@pytest.mark.parametrize("command", EVERY.values(), ids=EVERY)
@pytest.mark.parametrize(("make", "why"), BAD.values(), ids=BAD)
def test_what_is_no_recording_is_refused(there, capsys, make, why, command):
    make(there / "bad")

    assert cli.main([*command, "bad"]) == 2

    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("pea: ")
    assert why in said.err
    assert said.err.count("\n") == 1
    assert not (there / "table.csv").exists()
    assert not (there / "bad-recovered").exists()


def told_otherwise(path, change):
    """A run whose bag says something else of it."""
    what = experiments.load("fig9_hysteresis_10hz", (), 0.005)
    loop = what.loop()
    with BagWriter(path, T_NS) as bag:
        bag.metadata(ORIGIN, change(origin(what.name, what.sections(), "batch", T_NS)))
        record(bag, 0, T_NS, loop.run(what.samples))


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda told: {**told, "format": "2"}, "is of format '2': this version knows 1"),
        (
            lambda told: {
                **told,
                "parameters": told["parameters"].replace("T_s: 5.0e-05", "T_s: 1.0e-04"),
            },
            "has a sample every 50000 ns, and its parameters say T_s = 100000 ns",
        ),
        (
            lambda told: {**told, "parameters": told["parameters"].replace("P:", "Q:")},
            "controller.Q",
        ),
        (lambda told: {**told, "parameters": "- no\n- parameters\n"}, ""),
    ],
    ids=["other version", "other T_s", "unknown parameter", "no parameters"],
)
@pytest.mark.parametrize("command", ["replay", "diff", "check", "cut", "report"])
def test_what_this_version_cannot_run_is_refused(there, capsys, change, why, command):
    told_otherwise(there / "bad", change)

    assert cli.main([*EVERY[command], "bad"]) == 2

    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("pea: ")
    assert why in said.err
    assert said.err.count("\n") == 1
