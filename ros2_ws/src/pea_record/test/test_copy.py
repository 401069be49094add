"""Recordings made from recordings: recovered and cut."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from pea_cli import cli
from pea_core.signals import SAMPLE
from pea_experiment import experiments
from pea_record.bag import METADATA, BagWriter
from pea_record.copy import CUT, RECOVERED, cut, lacks, recover
from pea_record.origin import ORIGIN, origin
from pea_record.read import load
from pea_record.recording import BagError
from pea_record.rows import record
from pea_wire import events
from pea_wire.topics import DIAGNOSTICS, PARAMETER_EVENTS, REFERENCE, SAMPLED, STATE

T_NS = 50_000
N = 60


@pytest.fixture(scope="module")
def samples():
    made = np.empty(N, SAMPLE)
    noise = np.random.default_rng(5)
    for field in SAMPLE.names:
        made[field] = noise.normal(size=N)
    return made


@pytest.fixture(scope="module")
def bag(tmp_path_factory, samples):
    """A recording in many chunks, with a change of a parameter at sample 20."""
    directory = tmp_path_factory.mktemp("run") / "bag"
    what = experiments.load("fig9_hysteresis_10hz", (), N * T_NS * 1e-9)
    with BagWriter(directory, T_NS) as writer:
        writer.metadata(ORIGIN, origin(what.name, what.sections(), "batch", T_NS))
        for k in range(0, N, 6):
            record(writer, k, T_NS, samples[k : k + 6])
            writer.write(DIAGNOSTICS, k * T_NS, b"\0\1\0\0any")
            if k == 18:
                event = events.encode(20 * T_NS, "/pea/controller", {"P": 0.0125})
                writer.write(PARAMETER_EVENTS, 20 * T_NS, event)
            writer.flush()
    return directory


def mcap(directory):
    (file,) = directory.glob("*.mcap")
    return file


def assert_same_bits(read, samples):
    for field in SAMPLE.names:
        assert read[field].tobytes() == samples[field].tobytes(), field


def messages(directory, *names):
    """Topic, log time and bytes of each message, as rosbags reads them."""
    with AnyReader([directory]) as reader:
        chosen = [c for c in reader.connections if not names or c.topic in names]
        return [(c.topic, time, bytes(data)) for c, time, data in reader.messages(chosen)]


def test_whole_recording_is_copied_as_it_is(tmp_path, bag):
    recording, missing = recover(bag, tmp_path / "new")

    assert missing == []
    assert sorted(messages(tmp_path / "new")) == sorted(messages(bag))
    assert recording.metadata[ORIGIN] == load(bag).metadata[ORIGIN]
    assert lacks(recording) == []


@pytest.fixture(scope="module")
def content(bag):
    return mcap(bag).read_bytes()


@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_truncated_recording_becomes_a_valid_one(tmp_path_factory, content, samples, data):
    there = tmp_path_factory.mktemp("cut")
    (there / "broken.mcap").write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])

    try:
        recording, missing = recover(there / "broken.mcap", there / "new")
    except BagError as error:
        assert str(error).count("\n") == 0  # noqa: PT017
        assert not (there / "new").exists()
        return

    n = len(recording.samples)
    assert n % 6 == 0
    assert_same_bits(recording.samples, samples[:n])
    assert recording.damage == ""
    assert "broken.mcap is cut off" in missing
    assert (n == N) != (f"it ends after {n} of the run's {N} samples" in missing)
    with AnyReader([there / "new"]) as reader:
        assert reader.message_count == sum(recording.counts.values())


@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_damaged_recording_gives_no_wrong_sample(tmp_path_factory, content, samples, data):
    there = tmp_path_factory.mktemp("damaged")
    broken = bytearray(content)
    broken[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
    (there / "broken.mcap").write_bytes(broken)

    try:
        recording, _ = recover(there / "broken.mcap", there / "new")
    except BagError as error:
        assert str(error).count("\n") == 0  # noqa: PT017
        return

    assert_same_bits(recording.samples, samples[recording.stamps // T_NS])


def test_what_is_missing_in_the_middle_is_said(tmp_path, content, samples):
    with open(tmp_path / "whole.mcap", "wb") as file:
        file.write(content)
    with open(tmp_path / "whole.mcap", "rb") as file:
        index = make_reader(file).get_summary().chunk_indexes[4]
    broken = bytearray(content)
    broken[index.chunk_start_offset + index.chunk_length // 2] ^= 0x55
    (tmp_path / "broken.mcap").write_bytes(broken)

    recording, missing = recover(tmp_path / "broken.mcap", tmp_path / "new")

    assert_same_bits(recording.samples, np.delete(samples, range(24, 30)))
    assert any("a damaged chunk" in line for line in missing)
    for topic in SAMPLED:
        line = f"{topic.name}: 6 samples are missing between 0.000000 s and 0.002950 s"
        assert line in missing
        assert line.split(" between")[0] in recording.metadata[RECOVERED]["missing"]


def test_recording_that_was_never_closed_is_recovered(tmp_path, bag, content, samples):
    old = tmp_path / "old"
    old.mkdir()
    (old / "old_0.mcap").write_bytes(content[: content.rindex(b"\x0f\x04\0\0\0\0\0\0\0")])
    assert not (old / METADATA).exists()

    recording, missing = recover(old, tmp_path / "new")

    assert_same_bits(recording.samples, samples)
    assert missing == ["old_0.mcap is cut off"]
    assert (tmp_path / "new" / METADATA).is_file()


def test_recording_is_never_written_over(tmp_path, bag):
    before = mcap(bag).read_bytes()

    with pytest.raises(FileExistsError):
        recover(bag, bag)
    recover(bag, tmp_path / "new")
    with pytest.raises(FileExistsError):
        recover(bag, tmp_path / "new")
    with pytest.raises(FileExistsError):
        cut(bag, tmp_path / "new", 0, 10**9, None)
    assert mcap(bag).read_bytes() == before


@pytest.mark.parametrize(("start", "end"), [(0, 60), (0, 1), (17, 43), (59, 60), (6, 12)])
def test_part_holds_the_samples_from_start_to_before_end(tmp_path, bag, samples, start, end):
    part = cut(bag, tmp_path / "part", start * T_NS, end * T_NS, None)

    assert part.stamps.tolist() == [k * T_NS for k in range(start, end)]
    assert_same_bits(part.samples, samples[start:end])
    assert part.metadata[CUT] == {
        "from": "bag", "start_ns": str(start * T_NS), "end_ns": str(end * T_NS)
    }  # fmt: skip
    whole = messages(bag, STATE.name)
    assert messages(tmp_path / "part", STATE.name) == whole[start:end]
    assert lacks(part) == []


def test_part_holds_what_a_preview_needs(tmp_path, bag, samples):
    part = cut(bag, tmp_path / "part", 0, 12 * T_NS, None)

    assert len(part.after) >= 6
    assert part.after[:, 0].tolist() == samples["w"][12 : 12 + len(part.after)].tolist()
    assert part.counts[REFERENCE.name] < load(bag).counts[REFERENCE.name]


def test_part_beyond_the_recording_is_refused(tmp_path, bag):
    with pytest.raises(BagError, match="holds no sample from 1 s to 2 s: it has those from 0 s"):
        cut(bag, tmp_path / "part", 10**9, 2 * 10**9, None)
    assert not (tmp_path / "part").exists()


@pytest.mark.parametrize(("start", "P"), [("0.001", None), ("0.0011", 0.0125)])
def test_part_says_what_was_in_force_at_its_start(tmp_path, bag, capsys, start, P):
    there = tmp_path / "part"
    assert cli.main(["bag", "cut", str(bag), "--from", start, "--out", str(there)]) == 0

    part = load(there)
    what = experiments.load("fig9_hysteresis_10hz").nodes["controller"].values["P"]
    assert f"P: {P or what}\n" in part.metadata[ORIGIN]["parameters"]
    assert len(part.events) == (P is None)


@pytest.mark.parametrize("option", [[], ["--from", "-1"], ["--from", "x"], ["--to", "nan"],
                                    ["--from", "2", "--to", "1"]])  # fmt: skip
def test_bad_times_are_refused_in_one_line(bag, capsys, option):
    assert cli.main(["bag", "cut", str(bag), *option]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_check_tells_a_whole_recording_from_another(tmp_path, bag, content, capsys):
    (tmp_path / "broken.mcap").write_bytes(content[:-400])

    assert cli.main(["bag", "check", str(tmp_path / "broken.mcap"), "--json"]) == 3
    told = json.loads(capsys.readouterr().out)
    assert (told["complete"], told["missing"][0]) == (False, "broken.mcap is cut off")
    assert told["replays_exactly"] is False  # its samples are made up

    assert cli.main(["bag", "check", str(bag), "--json"]) == 3
    told = json.loads(capsys.readouterr().out)
    assert (told["complete"], told["samples"], told["sample_period_ns"]) == (True, N, T_NS)


def test_info_tells_what_is_there(bag, capsys):
    assert cli.main(["bag", "info", str(bag), "--json"]) == 0

    told = json.loads(capsys.readouterr().out)
    assert (told["samples"], told["changes"], told["run"]["mode"]) == (N, 1, "batch")
    assert told["bytes"] == mcap(bag).stat().st_size
    assert told["topics"][STATE.name] == {
        "messages": N, "first_ns": 0, "last_ns": 59 * T_NS, "gaps": 0, "repeats": 0
    }  # fmt: skip


@pytest.mark.parametrize("text", ["{", "[1]", "%", "/pea/experiment: 1", "\t: x"])
def test_damaged_texts_are_no_trouble(bag, text):
    recording = load(bag)
    recording.metadata[ORIGIN]["parameters"] = text

    assert lacks(recording) == []


def test_message_lost_before_the_end_is_missed(tmp_path, bag):
    recording = load(bag)
    recording.counts[STATE.name] -= 1

    assert f"{STATE.name}: 59 messages of 60 written" in lacks(recording)
