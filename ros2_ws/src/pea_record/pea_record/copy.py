"""Recordings made from recordings: what is readable of a broken one, or a part of a whole one.

Messages are copied as they are, byte by byte; the new bag has its indexes and ``metadata.yaml``.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pea_core.units import NS, SECOND
from pea_record.bag import TOPICS, BagWriter
from pea_record.contents import BEFORE, Contents
from pea_record.origin import ORIGIN, mapping
from pea_record.read import files_of, load_axes
from pea_record.recording import BagError, Recording
from pea_record.tape import Tape
from pea_record.trigger import TRIGGER, lacking
from pea_wire import convert
from pea_wire.topics import RECORDED_TOPICS, REFERENCE, SAMPLED, Topic

RECOVERED = "pea_recovered"
CUT = "pea_cut"
"""Names of the metadata records that say what was done."""

OWN = ("rosbag2", TOPICS)
"""Metadata records that a writer makes anew."""

_LOG_TIME = struct.Struct("<Q")
_BEFORE_DATA = 16
"""Bytes from a message's log time to its data."""

_TOPICS = {topic.name: topic for topic in RECORDED_TOPICS}

MARGIN = 16
"""Samples of reference kept after the last one, for a preview."""

Message = tuple[Topic, int, bytes]
"""Topic, time (ns) and bytes."""

Take = Callable[[Topic, int, bytes], None]


class _Source(Tape):
    """Hands every message on as it is read."""

    def __init__(self, take: Take) -> None:
        super().__init__()
        self.take = take
        self.left: dict[str, int] = {}

    def _messages(self, file: Path, data: bytes, channel: int, spans: np.ndarray) -> None:
        super()._messages(file, data, channel, spans)
        name = self.topics.get(channel)
        topic = _TOPICS.get(name or "")
        if topic is None:
            if name is not None:
                self.left[name] = self.left.get(name, 0) + len(spans)
            return
        for start, end in spans.tolist():
            time = _LOG_TIME.unpack_from(data, start - _BEFORE_DATA)[0]
            self.take(topic, time, data[start:end])


def recover(path: Path, out: Path) -> tuple[Recording, list[str]]:
    """Copy what is readable of a broken recording into a new one.

    Parameters
    ----------
    path : Path
        A bag's directory, or an MCAP file.
    out : Path
        The new bag.

    Returns
    -------
    Recording
        The new bag, read back.
    list of str
        What is missing in it, a line each; empty where nothing is.

    Raises
    ------
    BagError
        Nothing can be read, or not one whole sample.
    FileExistsError
        There is a recording in `out` already.
    """
    files = files_of(path)
    found = load_axes(path)
    with BagWriter(out, found.T_ns) as bag:
        source = _Source(bag.write)
        for file in files:
            source.read(file)
        for name, values in found.metadata.items():
            if name not in OWN:
                bag.metadata(name, values)
        missing = lacks(found)
        missing += [f"{n} messages of {name} are left out" for name, n in source.left.items()]
        bag.metadata(RECOVERED, {"from": path.name, "missing": "\n".join(missing)})
    return load_axes(out), missing


def lacks(recording: Recording) -> list[str]:
    """What a recording lacks: a line for each."""
    found = [recording.damage] if recording.damage else []
    for name in (topic.name for topic in SAMPLED):
        first, last = recording.spans[name]
        where = f"between {first * NS:.6f} s and {last * NS:.6f} s"
        if recording.gaps[name] and TRIGGER not in recording.metadata:
            found.append(f"{name}: {recording.gaps[name]} samples are missing {where}")
        if recording.repeats[name]:
            found.append(f"{name}: {recording.repeats[name]} samples came again {where}")
    found += lacking(recording.metadata, recording.stamps, recording.T_ns)
    if recording.first and not {CUT, TRIGGER} & recording.metadata.keys():
        found.append(f"the first whole sample is at {recording.first * NS:.6f} s")
    found += _told(recording)
    ends = {recording.spans[topic.name][1] for topic in SAMPLED}
    if max(ends) != recording.last:
        found.append(f"the last sample, at {max(ends) * NS:.6f} s, is not whole")
    return found


def _told(recording: Recording) -> list[str]:
    """What the recording itself says should be there and is not."""
    found = []
    for name, text in recording.metadata.get(TOPICS, {}).items():
        written = mapping(text).get("messages")
        if name not in recording.spans:
            continue
        if not isinstance(written, int) or written > recording.counts[name]:
            found.append(f"{name}: {recording.counts[name]} messages of {written} written")
    origin = recording.metadata.get(ORIGIN, {})
    partly = {CUT, TRIGGER} & recording.metadata.keys()
    if origin.get("experiment") and not partly and recording.T_ns:
        about = mapping(origin.get("parameters", "")).get("/pea/experiment")
        values = about.get("ros__parameters") if isinstance(about, dict) else None
        duration = values.get("duration") if isinstance(values, dict) else None
        samples = round(duration * SECOND / recording.T_ns) if isinstance(duration, float) else 0
        end = recording.last // recording.T_ns + 1
        if end < samples:
            found.append(f"it ends after {end} of the run's {samples} samples")
    return found


def cut(path: Path, out: Path, start: int, end: int, origin: dict[str, str] | None) -> Recording:
    """Copy the samples of a part of a recording into a new one.

    Parameters
    ----------
    path : Path
        A bag's directory, or an MCAP file.
    out : Path
        The new bag.
    start, end : int
        Stamps (ns): of the first sample that is taken, and of the first past the end.
    origin : dict, optional
        Takes the place of the record of where the recording comes from.

    Returns
    -------
    Recording
        The new bag, read back.

    Raises
    ------
    BagError
        There is no whole sample in that part.
    FileExistsError
        There is a recording in `out` already.
    """
    found = load_axes(path)
    inside = (found.stamps >= start) & (found.stamps < end)
    if not inside.any():
        raise BagError(
            f"{path} holds no sample from {start * NS:g} s to {end * NS:g} s: it has those "
            f"from {found.first * NS:g} s to {found.last * NS:g} s"
        )
    sampled, others = _messages(path, found, start, end)
    times = [time for topic, time, _ in sampled if topic in SAMPLED]
    low, high = min(times), max(times)
    with BagWriter(out, found.T_ns) as bag:
        for name, values in found.metadata.items():
            if name not in OWN:
                bag.metadata(name, (origin or values) if name == ORIGIN else values)
        bag.metadata(CUT, {"from": path.name, "start_ns": str(start), "end_ns": str(end)})
        chosen = sampled + [message for message in others if low <= message[1] <= high]
        for topic, time, data in sorted(chosen, key=lambda message: message[1]):
            bag.write(topic, time, data)
    return load_axes(out)


def _messages(
    path: Path, found: Recording, start: int, end: int
) -> tuple[list[Message], list[Message]]:
    """Messages of the samples between two stamps (ns), and those of other topics about them."""
    sampled: list[Message] = []
    others: list[Message] = []

    def take(topic: Topic, time: int, data: bytes) -> None:
        if topic in SAMPLED:
            if start <= convert.stamp(data) < end:
                sampled.append((topic, time, data))
        elif topic == REFERENCE:
            stamp, times, _ = convert.forms(found.axes).reference.decode(data)
            stamps = stamp + times
            if len(stamps) and stamps[-1] >= start and stamps[0] < end + MARGIN * found.T_ns:
                sampled.append((topic, time, data))
        else:
            others.append((topic, time, data))

    source = _Source(take)
    contents = Contents(path)
    around = BEFORE * contents.T_ns
    if contents.timed and not found.damage:
        contents.read(source, start - around, end + around)
    else:
        for file in files_of(path):
            source.read(file)
    return sampled, others
