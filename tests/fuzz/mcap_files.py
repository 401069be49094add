"""Recordings: MCAP files of ours with changed bytes, records, chunks."""

from __future__ import annotations

import contextlib
import random
import shutil
import struct
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from pea_fuzz import SPECIAL, mutated, one_line

SHARE = 2.0
SAMPLES = 40

CHUNK = 6
_RECORD = struct.Struct("<BQ")


@cache
def whole() -> bytes:
    """A recording of a short run."""
    import tempfile

    from pea_experiment import experiments
    from pea_run.modes import batch

    sets = ["T_s=1e-3"]
    experiment = experiments.load("fig9_hysteresis_10hz", sets, duration=SAMPLES * 1e-3)
    with tempfile.TemporaryDirectory() as there:
        batch.run(experiment, Path(there) / "run", lambda k: None)
        (made,) = (Path(there) / "run").glob("*.mcap")
        return made.read_bytes()


def _records(data: bytes) -> list[bytes]:
    found, at = [], 8
    while at + _RECORD.size <= len(data) - 8:
        _, length = _RECORD.unpack_from(data, at)
        found.append(data[at : at + _RECORD.size + length])
        at += _RECORD.size + length
    return found


def _inside(draw: random.Random, records: list[bytes]) -> list[bytes]:
    """Change what is in a chunk, and pack it again."""
    import zstandard

    chunks = [i for i, record in enumerate(records) if record[0] == CHUNK]
    i = draw.choice(chunks)
    body = records[i][_RECORD.size :]
    (named,) = struct.unpack_from("<I", body, 28)
    at = 32 + named
    data = mutated(draw, zstandard.decompress(body[at + 8 :], 1 << 26))
    packed = zstandard.compress(data)
    head = body[:16] + struct.pack("<QI", len(data), 0) + body[28:at]
    whole = head + struct.pack("<Q", len(packed)) + packed
    return [*records[:i], _RECORD.pack(CHUNK, len(whole)) + whole, *records[i + 1 :]]


def fuzz(seed: int, n: int) -> Iterator[bytes]:
    """A recording, changed: anywhere, in one record, in the order of records, inside a chunk."""
    draw = random.Random(seed)
    data = whole()
    records = _records(data)
    for _ in range(n):
        kind = draw.randrange(5)
        found = list(records)
        if kind == 0:
            yield mutated(draw, data, SPECIAL)
            continue
        i = draw.randrange(len(found))
        if kind == 1:
            body = mutated(draw, found[i][_RECORD.size :])
            found[i] = _RECORD.pack(found[i][0], len(body)) + body
        elif kind == 2:
            draw.shuffle(found)
        elif kind == 3:
            del found[i : i + draw.choice((1, 2, 10))]
        else:
            found = _inside(draw, found)
        yield data[:8] + b"".join(found) + data[-8:]


def attempt(data: bytes) -> None:
    """Read it in every way."""
    import pea
    from pea_core.params import ParameterError
    from pea_record.contents import Contents
    from pea_record.copy import lacks, recover
    from pea_record.messages import Messages, diagnostics
    from pea_record.read import load
    from pea_record.recording import BagError
    from pea_report import recorded

    path = Path("mine.mcap")
    path.write_bytes(data)
    shutil.rmtree("copy", ignore_errors=True)

    def loaded() -> None:
        recording = load(path)
        lacks(recording)
        with contextlib.suppress(recorded.Untold):
            recorded.experiment_of(recording, path)

    def every() -> None:
        with Messages(path) as bag:
            for _ in bag.between(tuple(bag.channels), bag.start, bag.end):
                pass

    def part() -> None:
        Contents(path).part(0, 10**9)

    for read in (
        loaded,
        every,
        part,
        lambda: list(diagnostics(path)),
        lambda: recover(path, Path("copy")),
        lambda: pea.load(path),
    ):
        try:
            read()
        except (BagError, ParameterError) as error:
            one_line(error)
