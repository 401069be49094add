"""The command line: words that nobody meant, of every command."""

from __future__ import annotations

import contextlib
import json
import random
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from pea_fuzz import SPECIAL

STATUSES = (0, 1, 2, 3, 130)
"""Exit statuses that commands have."""

VALUES = (
    *("0", "1", "-1", "0.001", "1e-6", "nan", "inf", "1e309", "x", "", "true", "[1]", "2,3", "1:2"),
    *("fig9_hysteresis_10hz", "sine_series", "recommended", "pid", "kalman", "mine.yaml", "there"),
    *("run.mcap", "none", "/", "/dev/null", "/dev/zero", ".", "..", "~", "~nosuch/x", "new"),
    *("plant.K=0.1", "controller.P=1", "T_s=1e-3", "reference.type=sine", "observer.preset=x"),
    *("reference.type=file", "reference.path=/dev/zero", "experiment.name=../x", "plant.seed=1"),
    *("plant.K", "controller.preset=precise", "plant.voltage_max=120", "batch", "wall", "100MB"),
)


@cache
def _options() -> dict[str, list[str]]:
    """Options of each command."""
    from pea_cli.cli import _parser

    found: dict[str, list[str]] = {}

    def collect(words: str, parser: Any) -> None:
        options = [o for action in parser._actions for o in action.option_strings]
        found[words] = options
        for action in parser._actions:
            if isinstance(action.choices, dict):
                for name, inner in action.choices.items():
                    collect(f"{words} {name}".strip(), inner)

    collect("", _parser())
    return found


def _word(draw: random.Random, options: list[str]) -> str:
    kind = draw.random()
    if kind < 0.35 and options:
        return draw.choice(options)
    if kind < 0.85:
        return draw.choice(VALUES)
    piece = draw.choice(SPECIAL).replace(b"\0", b"")
    if draw.random() < 0.5:
        piece = draw.choice(VALUES).encode() + piece
    return piece.decode(errors="surrogateescape")


def fuzz(seed: int, n: int) -> Iterator[bytes]:
    """Command lines, as a list in JSON."""
    draw = random.Random(seed)
    commands = _options()
    for _ in range(n):
        words = draw.choice(list(commands)).split()
        options = commands[" ".join(words)]
        line = words + [_word(draw, options) for _ in range(draw.randrange(7))]
        yield json.dumps(line).encode()


@cache
def _harmless() -> None:
    """Let no command start a process, join a graph, serve a port or compute for long."""
    from pea_cli import cli
    from pea_lab import compare, tune
    from pea_ros import graph
    from pea_run import doctor, modes

    def nothing(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    for name in ("composed", "distributed"):
        modes.MODES[name] = nothing
    compare.run = tune.tune = nothing
    doctor.measure = nothing
    tune.Cluster = tune.Processes = nothing
    graph.check_domain = nothing
    cli.os.execv = nothing
    real = modes.MODES["batch"]

    def short(experiment: Any, *arguments: Any, **options: Any) -> Any:
        if experiment.samples > 2000:
            raise KeyboardInterrupt
        return real(experiment, *arguments, **options)

    modes.MODES["batch"] = short
    from pea_cli import bench as bench_cli
    from pea_cli import dashboard as dashboard_cli
    from pea_cli import emulate as emulate_cli

    for part, command in (
        (bench_cli, "bench"),
        (dashboard_cli, "dashboard"),
        (emulate_cli, "emulate"),
    ):
        part.COMMANDS[command] = nothing


def attempt(data: bytes) -> None:
    """Run it; see that it ends with a status, and says at most a line where it refuses."""
    import os

    from pea_cli import cli

    _harmless()
    if not Path("mine.yaml").exists():
        Path("mine.yaml").write_text("/pea/controller:\n  ros__parameters:\n    P: 1.0\n")
        Path("there").mkdir()
    here = os.getcwd()
    try:
        status = cli.main(json.loads(data))
    except SystemExit as end:  # --help
        status = end.code
    finally:
        os.chdir(here)
        with contextlib.suppress(OSError):
            for path in Path("runs").iterdir():
                if path.is_dir() and not path.is_symlink():
                    import shutil

                    shutil.rmtree(path)
    assert status in STATUSES, status
