"""``pea replay BAG --publish``: a recording on the ROS graph.

Exit status: 0 played, 2 bad input (one line), 3 somebody else has come, 130 interrupted.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from pea_cli.options import number
from pea_core.config import NAMESPACE
from pea_core.console import err, out
from pea_core.loop import LoopFault
from pea_core.params import ParameterError, nearest
from pea_core.units import NS, SECOND

OPTIONS = ("rate", "topics", "loop", "start", "duration", "wait", "force", "namespace")
"""Options of playing; the others of ``pea replay`` are for running blocks again."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options to those of ``pea replay``."""
    parser.add_argument("--publish", action="store_true", help="play it to the ROS graph instead")
    playing = parser.add_argument_group("with --publish")
    playing.add_argument("--rate", metavar="R", help="speed (default: 1, as recorded)")
    playing.add_argument(
        "--topics",
        metavar="TOPIC",
        nargs="+",
        help="only these; /pea/voltage (it moves a stage), /parameter_events: only if named",
    )
    playing.add_argument("--loop", action="store_true", help="repeat until Ctrl-C")
    playing.add_argument("--start", metavar="S", help="seconds of the recording to omit")
    playing.add_argument("--duration", metavar="S", help="seconds of the recording to play")
    playing.add_argument("--wait", action="store_true", help="wait for a first subscriber")
    playing.add_argument(
        "--namespace", help=f"of its topics, in place of {NAMESPACE}, where they were recorded"
    )
    playing.add_argument(
        "--force", action="store_true", help="play even if other nodes publish there"
    )


def check(arguments: argparse.Namespace, others: dict[str, object]) -> None:
    """Refuse options that go without, or only with, ``--publish``.

    Parameters
    ----------
    arguments : Namespace
    others : dict of str to Any
        Options of running the blocks again, and what they are where nobody gives them.

    Raises
    ------
    ParameterError
        Options that do not go together.
    """
    unlike = others if arguments.publish else dict.fromkeys(OPTIONS)
    for name, unset in unlike.items():
        if (getattr(arguments, name) or None) != unset:
            option = {"sets": "set"}.get(name, name).replace("_", "-")
            goes = "does not go with" if arguments.publish else "goes only with"
            raise ParameterError(f"--{option} {goes} --publish")


def publish(arguments: argparse.Namespace) -> int:
    """Play a recording."""
    from pea_cli.param import space
    from pea_record.messages import Messages

    namespace = space(arguments.namespace or NAMESPACE)
    rate = number("--rate", arguments.rate or "1", 1e-6, 1e9)
    skipped = number("--start", arguments.start or "0", 0.0, 1e9, "s")
    length = number("--duration", arguments.duration or "1e9", 1e-9, 1e9, "s")
    path: Path = arguments.bag
    with Messages(path) as bag:
        from pea_run.play import ACTS, CLOCK, obstacle, player

        for name in arguments.topics or ():
            if name not in bag.channels:
                raise ParameterError(
                    f"--topics {name}: not in {path}: {nearest(name, sorted(bag.channels))}"
                )
        named = arguments.topics or [name for name in bag.channels if name not in ACTS]
        left = {
            name: "only when named" for name in bag.channels if name in ACTS and name not in named
        }
        for name in named:
            why = "is told by the player" if name == CLOCK else obstacle(name, bag.channels[name])
            if why:
                left[name] = why
        topics = [name for name in named if name not in left]
        said = "; ".join(f"{name} ({why})" for name, why in left.items())
        if not topics:
            raise ParameterError(f"{path}: nothing to play: {said}")
        start = bag.start + round(skipped * SECOND)
        if start >= bag.end:
            seconds = (bag.end - bag.start) * NS
            raise ParameterError(f"--start {arguments.start}: the recording has {seconds:g} s")
        end = min(bag.end, start + round(length * SECOND))
        console = err if arguments.json else out
        if said:
            console.print(f"not played: {said}", highlight=False, markup=False)
        with player(bag, topics, arguments.force, namespace) as playing:
            playing.look(arguments.wait)
            return _play(arguments, playing, rate, start, end)


def _play(arguments: argparse.Namespace, playing: Any, rate: float, start: int, end: int) -> int:
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    console = err if arguments.json else out
    reached = start
    passes = messages = 0
    took = late = 0.0
    progress = Progress(
        TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=console
    )
    task = progress.add_task("", total=end - start)

    def tell(stamp: int) -> None:
        nonlocal reached
        reached = stamp
        progress.update(task, completed=stamp - start, description=f"{stamp * NS:.3f} s")

    status = 0
    try:
        with progress:
            while True:
                played = playing.play(rate, start, end, tell)
                passes += 1
                messages += played.messages
                took += played.took
                late = max(late, played.late)
                if not arguments.loop:
                    break
        playing.deliver()
    except KeyboardInterrupt:
        status = 130
        err.print(f"interrupted at {reached * NS:.3f} s", highlight=False, markup=False)
    except LoopFault as error:
        err.print(f"pea: {error}", highlight=False, markup=False)
        status = 3
    figures = {
        "bag": str(arguments.bag),
        "topics": sorted(playing.full_name(name) for name in playing.publishers),
        "messages": messages,
        "passes": passes,
        "wall_s": took,
        "latest_ms": late * 1e3,
    }
    if arguments.json and status == 0:
        print(json.dumps(figures), flush=True)
    elif passes:
        console.print(
            f"{messages} messages of {len(playing.publishers)} topics in {took:.3f} s, "
            f"the latest {late * 1e3:.1f} ms late",
            highlight=False,
            markup=False,
        )
    return status
