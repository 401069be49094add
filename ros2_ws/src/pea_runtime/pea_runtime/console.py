"""Where the commands speak: standard output and standard error."""

from __future__ import annotations

import os
from typing import IO

from rich.console import Console as RichConsole
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn


class Console(RichConsole):
    """Shows names as they are typed, and goes on when nobody reads any more."""

    def on_broken_pipe(self) -> None:
        """Say no more."""
        silence(self.file)


def bar(console: RichConsole, transient: bool = False) -> Progress:
    """How far something is: what, a bar, how much of how much, and how long it has taken."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    return Progress(*columns, TimeElapsedColumn(), console=console, transient=transient)


def silence(stream: IO[str]) -> None:
    """Let a stream that nobody reads take what it gets."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


out = Console(soft_wrap=True, emoji=False)
err = Console(stderr=True, soft_wrap=True, emoji=False)
