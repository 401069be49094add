import errno
import io
import struct
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Chunk, Footer, Message, MessageIndex, Metadata, SummaryOffset
from mcap.stream_reader import StreamReader, get_chunk_data_stream

from pea_record.mcap import McapWriter

ROWS = np.dtype([("a", "<u4"), ("b", "<f8"), ("c", "u1")])
CHANNELS = 3

times = st.integers(0, 2**62)
single = st.tuples(st.integers(1, CHANNELS), times, st.binary(max_size=40))
block = st.tuples(st.integers(1, CHANNELS), st.lists(times, max_size=12))
actions = st.lists(st.one_of(single, block, st.just("flush")), max_size=25)

few = settings(max_examples=40, deadline=None)


def start(stream, **options):
    writer = McapWriter(stream, "test", **options)
    schema = writer.schema("test_msgs/msg/Any", "uint8 value")
    for i in range(CHANNELS):
        writer.channel(f"/topic_{i + 1}", schema, {"number": str(i + 1)})
    return writer


def rows_of(count):
    rows = np.zeros(count, ROWS)
    rows["a"] = np.arange(count)
    rows["b"] = np.pi * np.arange(count)
    return rows


def perform(writer, steps):
    """Carry out `steps`; return (channel, time, data) of each message."""
    sent = []
    for step in steps:
        if step == "flush":
            writer.flush()
        elif isinstance(step[1], int):
            writer.message(*step)
            sent.append(step)
        else:
            channel, stamps = step
            rows = rows_of(len(stamps))
            writer.messages(channel, np.array(stamps, np.int64), rows)
            sent += [(channel, t, row.tobytes()) for t, row in zip(stamps, rows)]
    return sent


def messages_of(data):
    reader = NonSeekingReader(io.BytesIO(data), validate_crcs=True)
    return [m for _, _, m in reader.iter_messages(log_time_order=False)]


def written(steps, chunk_size=300):
    stream = io.BytesIO()
    writer = start(stream, chunk_size=chunk_size)
    sent = perform(writer, steps)
    writer.finish()
    return sent, stream.getvalue()


@few
@given(actions)
def test_messages_come_back_in_order(steps):
    sent, data = written(steps)

    read = messages_of(data)

    assert [(m.channel_id, m.log_time, m.data) for m in read] == sent
    assert all(m.publish_time == m.log_time for m in read)


@few
@given(actions)
def test_sequence_counts_each_channel(steps):
    _, data = written(steps)

    for channel in range(1, CHANNELS + 1):
        numbers = [m.sequence for m in messages_of(data) if m.channel_id == channel]
        assert numbers == list(range(len(numbers)))


@few
@given(actions)
def test_indexed_reader_finds_every_message_by_time(steps):
    sent, data = written(steps)

    reader = make_reader(io.BytesIO(data), validate_crcs=True)

    read = [(m.channel_id, m.log_time, m.data) for _, _, m in reader.iter_messages()]
    assert sorted(read) == sorted(sent)
    assert [t for _, t, _ in read] == sorted(t for _, t, _ in sent)


@few
@given(actions)
def test_statistics(steps):
    sent, data = written(steps)

    statistics = make_reader(io.BytesIO(data)).get_summary().statistics

    stamps = [t for _, t, _ in sent] or [0]
    counted = {c: sum(s[0] == c for s in sent) for c in range(1, CHANNELS + 1)}
    assert statistics.message_count == len(sent)
    assert statistics.channel_message_counts == counted
    assert (statistics.message_start_time, statistics.message_end_time) == (
        min(stamps),
        max(stamps),
    )


@few
@given(actions)
def test_message_indexes_point_at_their_messages(steps):
    sent, data = written(steps)
    found = 0
    raw = b""

    for record in StreamReader(io.BytesIO(data), emit_chunks=True).records:
        if isinstance(record, Chunk):
            stream, size = get_chunk_data_stream(record, validate_crc=True)
            raw = stream.read(size)
        elif isinstance(record, MessageIndex):
            for time, offset in record.records:
                opcode, _, channel, _, log_time = struct.unpack_from("<BQHIQ", raw, offset)
                assert (opcode, channel, log_time) == (5, record.channel_id, time)
            found += len(record.records)

    assert found == len(sent)


@few
@given(st.integers(1, CHANNELS), st.lists(times, max_size=30))
def test_block_gives_the_same_bytes_as_single_messages(channel, stamps):
    rows = rows_of(len(stamps))
    singly = [(channel, t, row.tobytes()) for t, row in zip(stamps, rows)]

    assert written([(channel, stamps)])[1] == written(singly)[1]


def test_chunk_is_closed_at_its_size():
    _, data = written([(1, list(range(100)))], chunk_size=1000)

    indexes = make_reader(io.BytesIO(data)).get_summary().chunk_indexes

    record = 31 + ROWS.itemsize
    assert len(indexes) == -(-100 // -(-1000 // record))
    assert all(1000 <= i.uncompressed_size < 1000 + record for i in indexes[:-1])


def test_summary_crc_and_offsets():
    _, data = written([(1, [5, 6]), "flush", (2, [1])])

    records = list(StreamReader(io.BytesIO(data)).records)

    footer = next(r for r in records if isinstance(r, Footer))
    assert footer.summary_crc == zlib.crc32(data[footer.summary_start : -12])
    at = footer.summary_start
    for group in (r for r in records if isinstance(r, SummaryOffset)):
        assert group.group_start == at
        assert data[at] == group.group_opcode
        at += group.group_length
    assert at == footer.summary_offset_start


def test_metadata_is_indexed():
    stream = io.BytesIO()
    writer = start(stream)
    writer.message(1, 0, b"open chunk")
    writer.metadata("run", {"mode": "batch", "seed": "1 ε"})
    writer.finish()

    assert list(make_reader(io.BytesIO(stream.getvalue())).iter_metadata()) == [
        Metadata(name="run", metadata={"mode": "batch", "seed": "1 ε"})
    ]


def test_flush_brings_messages_into_the_stream():
    stream = io.BytesIO()
    writer = start(stream)
    writer.message(1, 7, b"kept")
    writer.flush()
    writer.message(1, 8, b"lost")

    read = []
    with pytest.raises(EndOfFile):
        read.extend(StreamReader(io.BytesIO(stream.getvalue())).records)

    assert [r.data for r in read if isinstance(r, Message)] == [b"kept"]


@pytest.mark.parametrize("stamp", [-1, 2**64])
def test_time_out_of_range_is_refused(stamp):
    stream = io.BytesIO()
    writer = start(stream)

    with pytest.raises(ValueError, match="log time"):
        writer.message(1, stamp, b"")
    writer.finish()

    assert messages_of(stream.getvalue()) == []


def test_block_with_a_negative_time_is_refused_whole():
    stream = io.BytesIO()
    writer = start(stream)

    with pytest.raises(ValueError, match="log time = -5 ns"):
        writer.messages(1, np.array([3, -5, 4]), rows_of(3))
    writer.finish()

    assert messages_of(stream.getvalue()) == []


def test_block_without_a_time_for_each_row_is_refused():
    with pytest.raises(ValueError, match="2 times for 3 rows"):
        start(io.BytesIO()).messages(1, np.array([3, 4]), rows_of(3))


class Disk(io.BytesIO):
    """Takes so many bytes, then is full, as a file is: first a short write, then an error."""

    def __init__(self, room):
        super().__init__()
        self.room = room

    def write(self, data):
        taken = bytes(data)[: max(0, self.room - self.tell())]
        if not taken and len(data):
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().write(taken)


def fill(room):
    """Write 20 chunks of 10 messages to a disk; return it and the messages taken by then."""
    disk = Disk(room)
    writer = start(disk)
    noise = np.random.default_rng(1)
    told = None
    for k in range(20):
        try:
            for i in range(10):
                writer.message(1, 10 * k + i, noise.bytes(50))
            writer.flush()
        except OSError as error:
            told = told or error
    return disk, writer, told


def test_every_message_after_a_failure_is_refused():
    _, writer, told = fill(5000)

    assert told.errno == errno.ENOSPC
    with pytest.raises(OSError, match="No space left"):
        writer.message(1, 0, b"more")


@few
@given(st.integers(500, 22_000))
def test_full_disk_leaves_what_was_complete(room):
    enough, whole, _ = fill(2**20)
    whole.finish()
    chunks = make_reader(io.BytesIO(enough.getvalue())).get_summary().chunk_indexes
    ends = [c.chunk_start_offset + c.chunk_length + c.message_index_length for c in chunks]
    complete = sum(end <= room for end in ends)

    disk, writer, _ = fill(room)

    assert writer.counts[1] == 10 * complete
    assert disk.getvalue() == enough.getvalue()[: ([len(disk.getvalue()), *ends])[complete]]


@few
@given(st.integers(500, 22_000))
def test_file_is_finished_on_a_full_disk_or_left_at_its_last_chunk(room):
    disk, writer, _ = fill(room)
    before = disk.getvalue()

    try:
        writer.finish()
    except OSError:
        assert disk.getvalue() == before
    else:
        assert [m.log_time for m in messages_of(disk.getvalue())] == list(range(writer.counts[1]))


def test_room_of_the_lost_chunk_serves_the_summary():
    _, data = written([])
    disk = Disk(len(data) + 2000)
    writer = start(disk)

    with pytest.raises(OSError, match="No space"):
        perform(writer, [(1, list(range(500))), "flush"])
    writer.finish()

    assert messages_of(disk.getvalue()) == []
