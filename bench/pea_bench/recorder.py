"""Messages a second into MCAP: whole blocks of samples, beside one object at a time."""

from __future__ import annotations

import importlib
import io
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer

from pea_bench.batch import T_S
from pea_bench.plan import Plan
from pea_bench.rows import Job, Part, Row, Tick, best, interleaved, ratio
from pea_core.units import SECOND
from pea_record.definitions import schema_text
from pea_record.mcap import McapWriter
from pea_wire import convert
from pea_wire.topics import JOINT_STATE

TOPICS = ("/bench/a", "/bench/b", "/bench/c", "/bench/d")
T_NS = 50_000
BLOCK = 400
"""Samples written at a time: 20 ms."""


def samples(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (ns) and three signals that are as hard to compress as measured ones: (3, n)."""
    t = np.arange(count) * T_S
    noise = np.random.default_rng(1).standard_normal((3, count))
    return np.arange(count, dtype=np.int64) * T_NS, np.sin(2.0 * np.pi * 10.0 * t) + 1e-3 * noise


class Blocks:
    """Our recorder: four topics of JointState into a file."""

    def __init__(self, path: Path) -> None:
        self.file = io.FileIO(path, "w")
        self.mcap = McapWriter(self.file, "pea bench")
        schema = self.mcap.schema(JOINT_STATE, schema_text(JOINT_STATE))
        self.channels = [self.mcap.channel(topic, schema, {}) for topic in TOPICS]

    def write(self, stamps: np.ndarray, signals: np.ndarray) -> None:
        """Record some samples on every topic."""
        for channel in self.channels:
            self.mcap.messages(channel, stamps, convert.forms().state.encode_many(stamps, *signals))

    def close(self) -> None:
        """Complete the file."""
        self.mcap.finish()
        self.file.close()


def blocks(count: int) -> float:
    """Time (us) of a message in blocks, the closing of the file included."""
    stamps, signals = samples(count // len(TOPICS))
    with tempfile.TemporaryDirectory() as there:
        started = time.perf_counter()
        ours = Blocks(Path(there) / "bag.mcap")
        for k in range(0, len(stamps), BLOCK):
            ours.write(stamps[k : k + BLOCK], signals[:, k : k + BLOCK])
        ours.close()
        return (time.perf_counter() - started) * 1e6 / (len(stamps) * len(TOPICS))


def objects(count: int) -> float:
    """Time (us) of a message as an object, serialised and added by itself."""
    message_type: Any = importlib.import_module("sensor_msgs.msg").JointState
    serialize = importlib.import_module("rclpy.serialization").serialize_message
    stamps, signals = samples(count // len(TOPICS))
    values = signals.T.tolist()
    with tempfile.TemporaryDirectory() as there, open(Path(there) / "bag.mcap", "wb") as file:
        started = time.perf_counter()
        writer = Writer(file)
        writer.start("ros2", "pea bench")
        text = schema_text(JOINT_STATE).encode()
        schema = writer.register_schema(JOINT_STATE, "ros2msg", text)
        channels = [writer.register_channel(topic, "cdr", schema) for topic in TOPICS]
        for stamp, (position, velocity, effort) in zip(stamps.tolist(), values):
            for channel in channels:
                message = message_type(
                    name=["x"], position=[position], velocity=[velocity], effort=[effort]
                )
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, SECOND)
                writer.add_message(channel, stamp, serialize(message), stamp)
        writer.finish()
        return (time.perf_counter() - started) * 1e6 / (len(stamps) * len(TOPICS))


def lost(path: Path, count: int) -> int:
    """Samples of a file of `Blocks` that another reader does not find, over all topics."""
    last = dict.fromkeys(TOPICS, -T_NS)
    found = 0
    with open(path, "rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            found += message.log_time == last[channel.topic] + T_NS
            last[channel.topic] = message.log_time
    return count * len(TOPICS) - found


def paced(seconds: float) -> tuple[float, int]:
    """Record 80 000 messages/s in wall time: share of a core, and messages lost."""
    count = round(seconds / T_S)
    stamps, signals = samples(count)
    with tempfile.TemporaryDirectory() as there:
        path = Path(there) / "bag.mcap"
        ours = Blocks(path)
        used, started = time.process_time(), time.monotonic()
        for k in range(0, count, BLOCK):
            due = started + (k + BLOCK) * T_S
            time.sleep(max(due - time.monotonic(), 0.0))
            ours.write(stamps[k : k + BLOCK], signals[:, k : k + BLOCK])
        ours.close()
        share = (time.process_time() - used) / (time.monotonic() - started)
        return share, lost(path, count)


def steps(plan: Plan) -> int:
    """How often `measure` tells that it goes on."""
    return 2 * plan.rounds + 1


def measure(plan: Plan, tick: Tick) -> Part:
    """Measure blocks, objects, and the recording in wall time."""
    jobs: dict[str, Job] = {
        "blocks": lambda: blocks(plan.messages),
        "objects": lambda: objects(plan.naive_messages),
    }
    found = interleaved({n: partial(best, job) for n, job in jobs.items()}, plan.rounds, tick)
    ours, naive = found["blocks"], found["objects"]
    share, missing = paced(plan.paced_s)
    tick()
    rates = tuple(1e6 / us for us in ours)
    rows = [
        Row("recorder.messages_per_s", "blocks of samples, compressed", "1/s", rates),
        Row("recorder.naive_us_per_message", "object, serialize, add_message", "us", naive),
        Row("recorder.ratio_vs_naive", "blocks : naive", "", ratio(naive, ours), ">= 40"),
        Row("recorder.lost", f"lost of 80 000/s in {plan.paced_s:g} s", "", (missing,), "<= 0"),
        Row("recorder.core_share_at_80k", "of a core at 80 000/s", "", (share,), "<= 0.1"),
    ]
    return Part(rows, {}, [])
