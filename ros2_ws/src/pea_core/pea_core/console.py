"""Where the commands speak: standard output and standard error."""

from __future__ import annotations

import os
from copy import copy
from dataclasses import replace
from typing import IO, Any

from rich.console import Console as RichConsole
from rich.measure import Measurement
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Column, Table
from rich.text import Text

from pea_core.printable import printable

FOLDED = 24
"""Characters (at least) of a column whose words may be folded."""


class Console(RichConsole):
    """Shows names as they are typed, and goes on when nobody reads any more.

    Tables break no word and no number. One that is too wide becomes several, each with its first
    column; only a word that is longer than the terminal goes beyond it.

    Text is text: square brackets are no markup, and what a terminal would obey is written out. A
    style is given by `rich.text.Text`.
    """

    def render_str(self, text: str, **options: object) -> Text:
        """Text as it is shown, in a line or in a table's cell."""
        shown = "\n".join(map(printable, text.split("\n")))
        plain: Any = {**options, "markup": False, "emoji": False, "highlight": False}
        return super().render_str(shown, **plain)

    def print(self, *objects: Any, **options: Any) -> None:
        """Print, tables with each word whole."""
        shown: list[Any] = []
        for each in objects:
            shown += self._fitting(each) if isinstance(each, Table) else [each]
        super().print(*shown, **options)

    def _fitting(self, table: Table) -> list[Table]:
        """A table, or its columns in several that fit the terminal."""
        self._keep_words(table)
        parts: list[Table] = []
        rest = table.columns[1:]
        while rest or not parts:
            n = len(rest)
            while (
                len(table.columns) > WHOLE
                and n > 1
                and self._needed(_part(table, rest[:n])) > self.width
            ):
                n -= 1
            part, rest = _part(table, rest[:n]), rest[n:]
            needed = self._needed(part)
            part.width = needed if needed > self.width else part.width
            part.title = None if parts else part.title
            parts.append(part)
        return parts

    def _needed(self, table: Table) -> int:
        """How wide a table must be for every word to be whole."""
        return Measurement.get(self, self.options.update(width=10_000), table).minimum

    def _keep_words(self, table: Table) -> None:
        """Have no column break a word."""
        for column in table.columns:
            if column.width is not None or column.min_width is not None:
                continue
            parts = (column.header, *column.cells)
            room = self.options.update(width=10_000)
            sizes = [Measurement.get(self, room, part) for part in parts]
            longest = max(size.minimum for size in sizes)
            if column.overflow == "fold":
                column.min_width = min(longest, FOLDED)
            else:
                column.min_width = longest
                column.no_wrap = longest == max(size.maximum for size in sizes)

    def on_broken_pipe(self) -> None:
        """Say no more."""
        silence(self.file)


WHOLE = 3
"""Columns of a table that stays one, however wide: a name, its value, its unit."""


def _part(table: Table, columns: list[Column]) -> Table:
    """A table of the first column and some others."""
    part = copy(table)
    chosen = (*table.columns[:1], *columns)
    part.columns = [replace(column, _index=i) for i, column in enumerate(chosen)]
    return part


def bar(console: RichConsole, transient: bool = False) -> Progress:
    """How far something is: what, a bar, how much of how much, and how long it has taken."""
    what = TextColumn("{task.description}", markup=False)
    columns = (what, BarColumn(), MofNCompleteColumn())
    return Progress(*columns, TimeElapsedColumn(), console=console, transient=transient)


def silence(stream: IO[str]) -> None:
    """Let a stream that nobody reads take what it gets."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


out = Console(soft_wrap=True, emoji=False, markup=False, highlight=False)
err = Console(stderr=True, soft_wrap=True, emoji=False, markup=False, highlight=False)
