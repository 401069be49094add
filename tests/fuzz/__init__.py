"""Inputs that nobody meant: what reads foreign text, files, bytes, is given very many of them.

A target is a module of this folder, `run.py` finds it by its file:

    SHARE = 1.0                                           optional: its part of all inputs
    def fuzz(seed: int, n: int) -> Iterator[bytes]: ...   n inputs, always the same of a seed
    def attempt(data: bytes) -> None: ...                 read one; refuse it by the right error

What `attempt` raises is a fault, and so is an input that takes longer than the limit, ends the
process, or has it print a traceback. An input is bytes, so that it can be kept in a file and
tried again; the working directory is an empty one of its own, and everything but the messages of
the test itself is swallowed. Targets that need more import it when they are called.
"""

from __future__ import annotations

import random
from collections.abc import Sequence

SPECIAL: tuple[bytes, ...] = (
    b"",
    b"\0",
    b"\n",
    b"\x1b[2J\x1b]0;x\x07",
    b"[/red]",
    b"[bold]",
    rb"$\bad$",
    b"\xed\xa0\x80",
    b"\xff\xfe",
    "\u202e\u2028é中\U0001f600".encode(),
    b"~nosuch/x",
    b"../../x",
    b"/dev/zero",
    b"9" * 5000,
    b"-1",
    b"0",
    b"1e309",
    b"nan",
    b".inf",
    b"-0.0",
    b"010",
    b"0x10",
    b"1:30",
    b"true",
    b"null",
    b"{}",
    b"[]",
    b"x" * 300,
    b"%s%n",
)
"""Pieces that have a meaning to somebody."""


def mutated(draw: random.Random, data: bytes, pieces: Sequence[bytes] = SPECIAL) -> bytes:
    """`data` with one to six things changed: bytes, spans, pieces put in, numbers at their ends."""
    found = bytearray(data)
    for _ in range(draw.choice((1, 1, 1, 2, 3, 6))):
        at = draw.randrange(len(found) + 1)
        end = min(len(found), at + draw.choice((1, 1, 2, 4, 8, 64, 1024)))
        kind = draw.randrange(8)
        if kind == 0:
            found[at:end] = draw.randbytes(end - at)
        elif kind == 1:
            del found[at:end]
        elif kind == 2:
            found[at:at] = found[at:end] * draw.choice((1, 2, 50))
        elif kind == 3:
            found[at:at] = draw.choice(pieces)
        elif kind == 4:
            found[at:end] = draw.choice(pieces)
        elif kind == 5 and at < len(found):
            found[at] ^= 1 << draw.randrange(8)
        elif kind == 6:
            size = draw.choice((1, 2, 4, 8))
            number = draw.choice((0, 1, -1, 2**31 - 1, -(2**31), 2**63 - 1, -(2**63), 255, 256))
            found[at : at + size] = (number % 256**size).to_bytes(size, "little")
        else:
            del found[at:]
    return bytes(found)


def one_line(error: BaseException) -> None:
    """See that a refusal can be printed as one line."""
    text = str(error)
    assert text
    assert text.isprintable(), text
    text.encode()
