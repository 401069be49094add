"""Messages of other nodes: CDR that is valid, damaged, or none, for every decoder."""

from __future__ import annotations

import random
import struct
from collections.abc import Iterator

from pea_fuzz import mutated


def _valid() -> tuple[bytes, ...]:
    import numpy as np

    from pea_wire import convert, events

    forms = convert.forms()
    state = forms.state.encode(50_000, 1.0, 2.0, 3.0)
    return (
        state,
        forms.voltage.encode(50_000, 1.0),
        forms.displacement.encode(50_000, 1.0, 2.0),
        forms.reference.encode(50_000, 50_000, np.zeros((3, 3))),
        convert.encode_time(50_000),
        convert.encode_block(len(state), state * 3),
        events.encode(50_000, "/pea/controller", {"P": 1.0, "type": "pid", "K": (1.0, 2.0)}),
    )


def fuzz(seed: int, n: int) -> Iterator[bytes]:
    """Messages, damaged and whole, and bytes of no sense."""
    draw, valid = random.Random(seed), _valid()
    counts = tuple(struct.pack("<I", c) for c in (0, 1, 2, 4097, 2**31, 2**32 - 1))
    pieces = (*counts, struct.pack("<d", float("nan")), struct.pack("<d", 1e308), b"\0\0\0\0")
    for _ in range(n):
        yield mutated(draw, draw.choice(valid), pieces)


def attempt(data: bytes) -> None:
    """Give the bytes to every decoder: a value, or the one error."""
    from pea_wire import convert, events

    forms = convert.forms()
    for decode in (
        forms.state.receive,
        forms.voltage.decode,
        forms.decode_displacement,
        forms.reference.receive,
        convert.stamp,
        convert.decode_time,
        lambda block: convert.find(block, 50_000),
        events.decode,
    ):
        try:
            decode(data)
        except convert.ConversionError as error:
            if not error.field or "\n" in str(error):
                raise
