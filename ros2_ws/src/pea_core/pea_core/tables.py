"""Time series in text files: two columns, time and a value, whichever program wrote them.

Understood are

- comma, semicolon, tab or spaces between the columns; a decimal point, or a decimal comma where
  that leaves two columns; fields in double quotes;
- UTF-8 and UTF-16 with or without byte order mark, and cp1252;
- empty lines, and comments that begin with ``#``;
- a head: one line or several of names and units before the first numbers, or the last comment
  there. ``Time (ms)``, ``t [us]``, ``w / nm``, ``pos_um``, and a line of units alone, all give the
  unit of their column. A column without one has the unit that is assumed.

What has two meanings is refused: the error names the line and what to write. Times are read as
decimal numbers, and the first is subtracted before they become floats, so that a time of day
loses nothing.
"""

from __future__ import annotations

import csv
import functools
import math
import re
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pea_core.params import SHOWN_MAX, ParameterError
from pea_core.paths import bytes_of

_MICRO = ("u", "\N{MICRO SIGN}", "\N{GREEK SMALL LETTER MU}")


class Quantity(NamedTuple):
    """What a column holds.

    Attributes
    ----------
    name : str
        As errors name it.
    unit : str
        Unit that it is converted to, and assumed where the head gives none.
    units : dict of str to Decimal
        How many of `unit` each unit is.
    """

    name: str
    unit: str
    units: dict[str, Decimal]

    def scale(self, unit: str) -> Decimal | None:
        """How many of its own unit a unit of a head is; None where it is none."""
        found = self.units.get(unit)
        if found is None and (len(unit) > 2 or unit.isupper()):
            found = {name.lower(): scale for name, scale in self.units.items()}.get(unit.lower())
        return found


def _prefixed(base: str, words: Sequence[str], **scales: str) -> dict[str, Decimal]:
    """Units of one base: symbol and words with each prefix."""
    prefixes = {
        "": ("",),
        "m": ("milli",),
        "u": ("micro",),
        "n": ("nano",),
        "k": ("kilo",),
    }
    units = {}
    for symbol, scale in scales.items():
        prefix = "" if symbol == "one" else symbol
        for short in _MICRO if prefix == "u" else (prefix,):
            units[short + base] = Decimal(scale)
        for long in prefixes[prefix]:
            units |= {long + word: Decimal(scale) for word in words}
    return units


TIME = Quantity(
    "time",
    "s",
    {
        **_prefixed("s", ("second", "seconds", "sec"), one="1", m="1e-3", u="1e-6", n="1e-9"),
        "msec": Decimal("1e-3"),
        "usec": Decimal("1e-6"),
        "nsec": Decimal("1e-9"),
    },
)
LENGTH = Quantity(
    "w",
    "um",
    {
        **_prefixed(
            "m", ("meter", "meters", "metre", "metres"), one="1e6", m="1e3", u="1", n="1e-3"
        ),
        "micron": Decimal(1),
        "microns": Decimal(1),
    },
)
VOLTAGE = Quantity("value", "V", _prefixed("V", ("volt", "volts"), one="1", m="1e-3", k="1e3"))
FORCE = Quantity("value", "N", _prefixed("N", ("newton", "newtons"), one="1", m="1e-3", k="1e3"))

QUANTITIES = (TIME, LENGTH, VOLTAGE, FORCE)

TIMES = ("t", "time", "times", "timestamp", "stamp", "zeit", "temps")
"""Names of a column of time."""

SEPARATORS = {",": "comma", ";": "semicolon", "\t": "tab", "": "spaces"}
"""Between columns, and what people call them."""

_NUMBER = {
    ".": re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf(inity)?)", re.I),
    ",": re.compile(r"[+-]?(\d+(,\d+)?|,\d+)([eE][+-]?\d+)?|[+-]?(nan|inf(inity)?)", re.I),
}
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+")
_ENDED = re.compile(r"[\[({<]\s*([^\])}>]*?)\s*[\])}>]\s*$")
_OVER = re.compile(r"(?:/\s*|\sin\s+)(\S*)$")
_DIALECTS = tuple((separator, point) for separator in SEPARATORS for point in _NUMBER)


class Table(NamedTuple):
    """A time series.

    Attributes
    ----------
    time : (n,) array
        Time since the first line (s), rising.
    stamp : (n,) array
        Time as the file has it (s); a time of day loses precision here.
    value : (n,) array
        In the unit of its quantity.
    understood : str
        One line for people: how the file was read.
    """

    time: np.ndarray
    stamp: np.ndarray
    value: np.ndarray
    understood: str


def read(path: Path, where: str, quantity: Quantity) -> Table:
    """Read a file.

    Parameters
    ----------
    path : Path
    where : str
        The parameter that names the file, at the head of an error.
    quantity : Quantity
        What the second column holds.

    Raises
    ------
    ParameterError
        It cannot be read, a line is no pair of finite numbers, time does not rise, or something
        has two meanings.
    """
    try:
        stat = path.stat()
        return _read(path, stat.st_mtime_ns, stat.st_size, where, quantity.name + quantity.unit)
    except OSError as error:
        raise ParameterError(f"{where}: {error.strerror}") from None
    except csv.Error:
        raise ParameterError(f"{where}: is no text of separated values") from None


@functools.lru_cache(maxsize=8)
def _read(path: Path, changed_ns: int, size: int, where: str, key: str) -> Table:
    quantity = next(q for q in QUANTITIES if q.name + q.unit == key)
    text, encoding = _decoded(bytes_of(path, what=where), where)
    return _Reader(where, quantity, encoding).table(text)


def _decoded(data: bytes, where: str) -> tuple[str, str]:
    """Text of a file, and its encoding."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        encodings = ["utf-16"]
    else:
        encodings = ["utf-8", "cp1252"]
        data = data.removeprefix(b"\xef\xbb\xbf")
    for encoding in encodings:
        try:
            text = data.decode(encoding)
        except UnicodeDecodeError:
            continue
        if "\0" not in text:
            return text, {"utf-8": "UTF-8"}.get(encoding, encoding)
    raise ParameterError(f"{where}: is no text of separated values")


def _cells(line: str, separator: str) -> list[str]:
    if not separator:
        return line.split()
    if '"' in line:
        (row,) = csv.reader([line], delimiter=separator)
    else:
        row = line.split(separator)
    return [cell.strip() for cell in row]


class _Dialect(NamedTuple):
    separator: str
    point: str

    def numbers(self, line: str) -> list[Decimal | None]:
        """Each field of a line as a number; None where it is none."""
        return [
            Decimal(cell.replace(",", ".")) if _NUMBER[self.point].fullmatch(cell) else None
            for cell in _cells(line, self.separator)
        ]

    def __str__(self) -> str:
        return SEPARATORS[self.separator] + (", decimal comma" if self.point == "," else "")


class _Unit(NamedTuple):
    """A unit, how many of its column's own it is, and the text that gives it."""

    name: str
    scale: Decimal
    text: str


Lines = list[tuple[int, str]]


class _Reader:
    """Reads one file."""

    def __init__(self, where: str, quantity: Quantity, encoding: str) -> None:
        self.where = where
        self.columns = (TIME, quantity)
        self.encoding = encoding
        self.dialects = [_Dialect(s, point) for s in SEPARATORS for point in _NUMBER]

    def table(self, text: str) -> Table:
        """All of the file."""
        head, comment, rows = self.parts(text)
        if not rows:
            raise ParameterError(f"{self.where}: has no line of two numbers")
        dialect, numbers = self.parsed(rows)
        units = self.units(head, comment, dialect)
        time, value = self.checked(rows, numbers, units[0].name)
        scales = [unit.scale for unit in units]
        first = time[0] * scales[0]
        named = " and ".join(
            f"{column.name} in {unit.name} ({repr(unit.text) if unit.text else 'assumed'})"
            for column, unit in zip(self.columns, units)
        )
        said = f"{len(rows)} lines of {named}; {dialect}, {self.encoding}"
        if first:
            said += f"; time counts from {first.normalize():f} s"
        return Table(
            np.array([float(t * scales[0] - first) for t in time]),
            np.array([float(t * scales[0]) for t in time]),
            np.array([float(v if scales[1] == 1 else v * scales[1]) for v in value]),
            said,
        )

    def parts(self, text: str) -> tuple[Lines, Lines, Lines]:
        """Lines of the head, the last comment before the numbers, and lines of numbers."""
        head: Lines = []
        rows: Lines = []
        comment: Lines = []
        for number, line in enumerate(re.split(r"\r\n|\n|\r", text), 1):
            if number == 1 and re.fullmatch(r"sep=[,;\t]", line):  # what Excel writes
                self.dialects = [d for d in self.dialects if d.separator == line[4]]
            elif line.lstrip().startswith("#"):
                comment = comment if rows else [(number, line.lstrip("# \t"))]
            elif not line.strip(' \t,;"'):
                continue
            elif rows or any(
                number is not None for dialect in self.dialects for number in dialect.numbers(line)
            ):
                rows.append((number, line))
            else:
                head.append((number, line))
        return head, comment, rows

    def parsed(self, rows: Lines) -> tuple[_Dialect, list[tuple[Decimal, Decimal]]]:
        """The dialect that every line is written in, and the numbers.

        Raises
        ------
        ParameterError
            None fits, or two that give other numbers.
        """
        found: list[tuple[_Dialect, list[Any]]] = []
        furthest = 0
        for dialect in self.dialects:
            pairs = []
            for at, (_, line) in enumerate(rows):
                numbers = dialect.numbers(line)
                if len(numbers) != 2 or None in numbers:
                    furthest = max(furthest, at)
                    break
                pairs.append((numbers[0], numbers[1]))
            else:
                found.append((dialect, pairs))
        if not found:
            number, line = rows[furthest]
            time, value = self.columns
            raise self.wrong(
                number,
                f"must be two numbers, time ({time.unit}) and {value.name} ({value.unit})",
                line,
            )
        for other, pairs in found[1:]:
            if repr(pairs) != repr(found[0][1]):
                raise ParameterError(
                    f"{self.where}: may be separated by {found[0][0]} or by {other}: "
                    "write semicolons between the columns"
                )
        self.unmistakable(found[0][0], rows)
        return found[0]

    def unmistakable(self, dialect: _Dialect, rows: Lines) -> None:
        """Refuse decimal commas that may all separate thousands."""
        if dialect.point != ",":
            return
        cells = [(n, c) for n, line in rows for c in _cells(line, dialect.separator) if "," in c]
        if cells and all(_THOUSANDS.fullmatch(cell) for _, cell in cells):
            number, cell = cells[0]
            raise self.wrong(
                number, f"has {cell}: a decimal comma or thousands? Write a decimal point"
            )

    def checked(
        self, rows: Lines, numbers: list[tuple[Decimal, Decimal]], unit: str
    ) -> tuple[list[Decimal], list[Decimal]]:
        """Times and values, finite and rising."""
        before: Decimal | None = None
        for (number, _), (time, value) in zip(rows, numbers):
            if not (math.isfinite(time) and math.isfinite(value)):
                raise self.wrong(number, "is not finite")
            if before is not None and time <= before:
                raise ParameterError(
                    f"{self.where}: time must rise from line to line, but line {number} has "
                    f"{time} {unit} after {before} {unit}"
                )
            before = time
        return [t for t, _ in numbers], [v for _, v in numbers]

    def units(self, head: Lines, comment: Lines, dialect: _Dialect) -> list[_Unit]:
        """Unit of each column.

        Raises
        ------
        ParameterError
            A line of the head is not of two columns, has other units, or contradicts another.
        """
        found = [_Unit(column.unit, Decimal(1), "") for column in self.columns]
        for number, line in (*comment, *head):
            loose = (number, line) in comment
            cells = _named(line, dialect.separator)
            if cells is None:
                if loose:
                    continue
                raise self.wrong(number, "must be two names, or two numbers", line)
            given = [_unit(column, cell) for column, cell in zip(self.columns, cells)]
            if loose and not any(unit and unit.text for unit in given):
                continue
            for i, (column, cell, unit) in enumerate(zip(self.columns, cells, given)):
                if unit is None:
                    known = ", ".join(name for name in column.units if len(name) < 3)
                    raise self.wrong(number, f"has a {column.name} in none of {known}", cell)
                if unit.text and found[i].text and found[i].scale != unit.scale:
                    raise self.wrong(number, f"contradicts {found[i].text!r} above it", cell)
                found[i] = unit if unit.text else found[i]
            first, second = (re.split(r"[^a-z]", cell.lower())[0] for cell in cells)
            if second in TIMES and first not in TIMES:
                raise self.wrong(number, "has time second: it must be the first column", line)
        return found

    def wrong(self, number: int, rule: str, found: str = "") -> ParameterError:
        """The error of a line."""
        return ParameterError(
            f"{self.where}: line {number} {rule}" + (f", not {_shown(found)}" if found else "")
        )


def _shown(text: str) -> str:
    return repr(text if len(text) <= SHOWN_MAX else text[: SHOWN_MAX - 3] + "...")


def _named(line: str, separator: str) -> list[str] | None:
    """Both fields of a line of a head, which may be separated otherwise than the numbers."""
    for each in (separator, *SEPARATORS):
        cells = _cells(line.strip(), each)
        if len(cells) == 2:
            return cells
    cells = re.findall(r"\S+\s*[\[({<][^\])}>]*[\])}>]", line)
    return cells if len(cells) == 2 else None


def _unit(column: Quantity, cell: str) -> _Unit | None:
    """Unit in a field of the head: empty if the field has none, None if the unit is unknown."""
    text = cell.strip().strip('"').strip()
    for pattern in (_ENDED, _OVER):
        if found := pattern.search(text):
            scale = column.scale(found[1])
            return None if scale is None else _Unit(found[1], scale, text)
    last = re.split(r"[\s_.:-]", text)[-1]
    scale = column.scale(last)
    return _Unit("", Decimal(1), "") if scale is None else _Unit(last, scale, text)
