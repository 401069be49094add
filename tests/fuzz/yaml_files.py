"""Parameter files: experiments, presets, rigs, what stands behind ``--set``."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

from pea_fuzz import SPECIAL, mutated, one_line

SHARE = 3.0

PIECES = (
    *SPECIAL,
    b"&a [",
    b"*a",
    b"<<: *a\n",
    b"!!python/object:os.system {}",
    b"!!binary x",
    b"!!timestamp x",
    b"!!set {a}",
    b"- ",
    b"? ",
    b": ",
    b"| \n",
    b"%YAML 1.1\n---\n",
    b"\n...\n---\n",
    b"[" * 2000,
    b"{a: " * 500,
    b"2001-01-01",
    b"1_000",
    b"0b1",
    b"ros__parameters:\n",
    b"/pea/plant:\n",
    b"/**:\n",
    b"preset: recommended\n",
    b"type: sine\n",
)


def _bombs(draw: random.Random) -> bytes:
    """Aliases of aliases: little text, much meaning."""
    width, depth = draw.randrange(2, 12), draw.randrange(2, 14)
    kind = draw.choice(("[{}]", "{{k: [{}]}}"))
    lines = ["a0: &a0 x"]
    lines += [
        f"a{i}: &a{i} " + kind.format(", ".join([f"*a{i - 1}"] * width)) for i in range(1, depth)
    ]
    body = "\n    ".join(lines)
    return f"/pea/plant:\n  ros__parameters:\n    {body}\n".encode()


def fuzz(seed: int, n: int) -> Iterator[bytes]:
    """Files of ``config/``, changed."""
    from pea_core import config

    draw = random.Random(seed)
    known = [path.read_bytes() for path in sorted(config.config_dir().glob("*/*.yaml"))]
    for _ in range(n):
        yield _bombs(draw) if draw.random() < 0.02 else mutated(draw, draw.choice(known), PIECES)


def attempt(data: bytes) -> None:
    """Read it as every kind of file."""
    from pea_core import config
    from pea_core.params import ParameterError
    from pea_experiment import experiments, rig
    from pea_record import origin

    path = Path("mine.yaml")
    path.write_bytes(data)
    for read in (
        lambda: config.read(path, ("experiment", *config.NODES)),
        lambda: rig.read("mine.yaml"),
        lambda: config.preset_values("controller", "mine.yaml"),
        lambda: experiments.load("mine.yaml"),
        lambda: experiments.parse_set([f"plant.K={data[:4000].decode(errors='replace')}"]),
    ):
        try:
            read()
        except ParameterError as error:
            one_line(error)
    origin.mapping(data.decode(errors="replace"))
