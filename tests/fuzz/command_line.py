"""The command line: words that nobody meant, of every command."""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import random
import shutil
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from pea_fuzz import SPECIAL, mcap_files

from pea_core.config import NODES
from pea_core.params import ParameterError

STATUSES = (0, 1, 2, 3, 130)
"""Exit statuses that commands have."""

VALUES = (
    *("0", "1", "-1", "0.001", "1e-6", "nan", "inf", "1e309", "x", "", "true", "[1]", "2,3", "1:2"),
    *("fig9_hysteresis_10hz", "sine_series", "recommended", "pid", "kalman", "mine.yaml", "there"),
    *("run.mcap", "none", "/", "/dev/null", "/dev/zero", ".", "..", "~", "~nosuch/x", "new"),
    *("plant.K=0.1", "controller.P=1", "T_s=1e-3", "reference.type=sine", "observer.preset=x"),
    *("reference.type=file", "reference.path=/dev/zero", "experiment.name=../x", "plant.seed=1"),
    *("plant.K", "controller.preset=precise", "plant.voltage_max=120", "batch", "wall", "100MB"),
    *("controller", "plant", "observer", "P", "P=0.1", "P=x", "K=[1", "type=pid", "/stage1", "gcs"),
    *("e727_200hz_emulated", "noise_nm=1", "delay=0.1", "garbage@1", "8642", "65535", "::1", "csv"),
    *("/pea/displacement", "0.01", "0.02", "composed", "distributed", "unpaced", "startup"),
)


@cache
def _options() -> dict[str, list[str]]:
    """Options of each command."""
    from pea_cli.cli import parser

    found: dict[str, list[str]] = {}

    def collect(words: str, parser: Any) -> None:
        options = [o for action in parser._actions for o in action.option_strings]
        found[words] = options
        for action in parser._actions:
            if isinstance(action.choices, dict):
                for name, inner in action.choices.items():
                    collect(f"{words} {name}".strip(), inner)

    collect("", parser())
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


class _Nobody:
    """A node that is not there."""

    context = SimpleNamespace(get_domain_id=lambda: 0)

    def get_namespace(self) -> str:
        return "/pea"

    def get_fully_qualified_name(self) -> str:
        return "/pea/fuzz"


@contextlib.contextmanager
def _client(name: Any = None, namespace: str = "/pea", says: Any = None) -> Iterator[Any]:
    """A client of nodes that have the parameters of the presets, and take none."""
    from pea_experiment import experiments
    from pea_ros.param_client import Client

    sections = experiments.load("fig9_hysteresis_10hz").sections()
    known = {node: sections[node] for node in NODES}

    class Told(Client):
        def there(self, wanted: Any = (), patience: Any = None) -> list[str]:
            return list(known)

        def names(self, role: str) -> list[str]:
            return sorted(known[role])

        def get(self, role: str, names: Any = ()) -> dict[str, Any]:
            for name in names:
                if name not in known[role]:
                    raise ParameterError(f"unknown parameter {role}.{name}")
            return {each: known[role][each] for each in names or known[role]}

        def _of(self, role: str) -> Any:
            raise KeyboardInterrupt

    yield Told(_Nobody())  # type: ignore[arg-type]


@cache
def _harmless() -> None:
    """Let no command start a process, join a graph, serve a port or compute for long."""
    import socket

    from pea_cli import dashboard as command
    from pea_dashboard import child, desk, stop_server
    from pea_lab import compare, tune
    from pea_plant import drivers
    from pea_ros import graph, param_client
    from pea_run import doctor, modes, play

    def nothing(*_: object, **__: object) -> Any:
        raise KeyboardInterrupt

    for name in ("composed", "distributed"):
        modes.MODES[name] = nothing
    compare.run = tune.tune = nothing
    doctor.measure = nothing
    tune.Cluster = tune.Processes = nothing
    os.execv = nothing
    graph.check_domain = lambda: None
    param_client.client = _client
    play.player = nothing
    desk.Desk = nothing
    command.stay = child.keep_off = lambda *_: None
    child.domain = lambda: (1, socket.socket())
    stop_server.listen = lambda host, port: socket.socket()
    for part in ("batch", "composed", "distributed", "memory", "recorder", "startup"):
        importlib.import_module(f"pea_bench.{part}").measure = nothing
    for module in drivers.MODULES.values():
        with contextlib.suppress(ModuleNotFoundError):
            importlib.import_module(f"{module.__name__}.emulator").make = nothing
    real = modes.MODES["batch"]

    def short(experiment: Any, *arguments: Any, **options: Any) -> Any:
        if experiment.samples > 2000:
            raise KeyboardInterrupt
        return real(experiment, *arguments, **options)

    modes.MODES["batch"] = short


KEPT = ("mine.yaml", "there", "run.mcap")


def _furnish(here: Path) -> None:
    """Have a parameter file, an empty folder and a recording, and nothing else."""
    for path in here.iterdir():
        if path.name not in KEPT:
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()
    (here / "mine.yaml").write_text("/pea/controller:\n  ros__parameters:\n    P: 1.0\n")
    (here / "there").mkdir(exist_ok=True)
    if not (here / "run.mcap").exists():
        (here / "run.mcap").write_bytes(mcap_files.whole())


def attempt(data: bytes) -> None:
    """Run it; see that it ends with a status, and says at most a line where it refuses."""
    from pea_cli import cli

    _harmless()
    here = Path.cwd()
    _furnish(here)
    try:
        status = cli.main(json.loads(data))
    except SystemExit as end:  # --help
        status = end.code
    finally:
        os.chdir(here)
        os.environ.pop("ROS_DOMAIN_ID", None)
    assert status in STATUSES, status
