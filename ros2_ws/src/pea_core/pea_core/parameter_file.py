"""ROS 2 parameter files, read as ROS reads them; what readers would read differently is refused.

The grammar is that of ``rcl_yaml_param_parser``: a section names nodes, ``/**`` and ``/*`` in it
stand for any names, and the text of a value says its type, by YAML 1.1's words for true and false.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from pea_core import paths
from pea_core.params import FALSE, TRUE, ParameterError, number_of

KEY = "ros__parameters"
"""What stands between the name of a node and its parameters."""

AMBIGUOUS = re.compile(
    r"[+-]?(?:0[0-9][0-9.]*(?:[eE][+-]?[0-9]+)?|0[xX][0-9a-fA-F.]+(?:[pP][+-]?[0-9]+)?|0[bB][01]+)"
    r"|[+-]?(?i:nan)\(.*\)"
)
"""What is a number to one reader and none, or another, to the next."""

ENDLESS = re.compile(
    r"[+-]?(?i:inf|infinity|nan)|[+-]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)", re.ASCII
)
"""Numbers that are not finite, as C and YAML write them."""

SECTION = re.compile(r"/?(?:\w+|\*\*?)(?:/(?:\w+|\*\*?))*", re.ASCII)
"""Names of nodes that a section may have."""

INNER = re.compile(r"[^\s:?#{}\[\],&*!|>'\"%@`]+(?: [^\s:?#{}\[\],&*!|>'\"%@`]+)*")
"""What every parser takes for text without quotes in a list."""

STR = "tag:yaml.org,2002:str"
"""The one tag that ROS reads."""

SIZE_MAX = 1 << 20
"""Bytes of a file."""

DEPTH = 16
"""Mappings inside each other in a file."""

LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""The parser that ROS uses, where it is built."""


def scalar(text: str) -> bool | int | float | str:
    """Value of a piece of text that is not quoted, as ROS reads it.

    Raises
    ------
    ParameterError
        Two readers would not agree.
    """
    if text in TRUE:
        return True
    if text in FALSE:
        return False
    if AMBIGUOUS.fullmatch(text):
        raise ParameterError(f"{text}: write a decimal number without leading zeros, or quote it")
    if ENDLESS.fullmatch(text):
        return float(text.replace(".", ""))
    number = number_of(text)
    if number is None or (isinstance(number, float) and not _ordinary(number, text)):
        return text
    return number


def _ordinary(number: float, text: str) -> bool:
    """Whether C reads it without saying that it is out of range."""
    if number == 0.0:
        return not re.search("[1-9]", re.split("[eE]", text)[0])
    return sys.float_info.min <= abs(number) <= sys.float_info.max


def text_of(value: str) -> bool:
    """Whether `value` stays text where it is written without quotes."""
    try:
        return isinstance(scalar(value), str)
    except ParameterError:
        return False


class _Reader:
    """One pass over the events of a file."""

    def __init__(self, text: str) -> None:
        self._events: Iterator[Any] = yaml.parse(text, Loader=LOADER)
        self.sections: dict[str, dict[str, Any]] = {}

    def next(self) -> Any:
        event = next(self._events)
        if isinstance(event, yaml.AliasEvent):
            raise ParameterError(f"*{event.anchor}: ROS reads no aliases; write the value out")
        return event

    def file(self) -> None:
        """Read all of it into `sections`."""
        self.next()  # the stream
        if not isinstance(self.next(), yaml.DocumentStartEvent) or not isinstance(
            self.next(), yaml.MappingStartEvent
        ):
            raise ParameterError(f"must map /pea/<node> to {KEY}")
        self.names("", 1)
        self.next()  # the document's end
        if not isinstance(self.next(), yaml.StreamEndEvent):
            raise ParameterError("must be one YAML document")

    def keys(self) -> Iterator[str]:
        """Names in a mapping that has begun; what belongs to each is read in between."""
        while not isinstance(event := self.next(), yaml.MappingEndEvent):
            if not isinstance(event, yaml.ScalarEvent) or not event.value:
                raise ParameterError("a name must be text")
            yield event.value

    def names(self, where: str, depth: int) -> None:
        """Read nodes, by their names or one namespace after the other."""
        found: set[bool] = set()
        for key in self.keys():
            event = self.next()
            name = f"{where}/{key}" if where else key
            ours = key == KEY and bool(where)
            if found and (ours or True in found):
                raise _mixed(where)
            found.add(ours)
            if ours:
                self.parameters(where, event)
            elif key == KEY or not isinstance(event, yaml.MappingStartEvent):
                raise _mixed(name)
            elif depth > DEPTH:
                raise ParameterError(f"{name}: too many names inside each other")
            else:
                self.names(name, depth + 1)
        if not found and where:
            raise _mixed(where)

    def parameters(self, section: str, event: object) -> None:
        """Read the parameters of the nodes that `section` names."""
        if not SECTION.fullmatch(section):
            raise ParameterError(f"{section}: is no name of a node")
        values = self.sections.setdefault(section, {})
        if not isinstance(event, yaml.MappingStartEvent):
            raise ParameterError(f"{section}: {KEY} must hold names and values")
        try:
            self.values(values, "", 1)
        except ParameterError as error:
            raise ParameterError(f"{section}: {error}") from None

    def values(self, values: dict[str, object], prefix: str, depth: int) -> None:
        """Read names and values, dotted where they stand inside each other."""
        for key in self.keys():
            name = prefix + key
            event = self.next()
            if isinstance(event, yaml.MappingStartEvent):
                if depth > DEPTH:
                    raise ParameterError(f"{name}: too many names inside each other")
                count = len(values)
                self.values(values, f"{name}.", depth + 1)
                if len(values) == count:
                    raise ParameterError(f"{name} = {{}}: give names and values")
                continue
            if name in values:
                raise ParameterError(f"{name} is given twice")
            try:
                values[name] = self.value(event)
            except ParameterError as error:
                raise ParameterError(f"{name} = {error}") from None

    def value(self, event: object, inside: bool = False) -> Any:
        """A value that begins with `event`: text, a number, true or false, or a list of one."""
        if isinstance(event, yaml.SequenceStartEvent) and not inside:
            items = []
            while not isinstance(event := self.next(), yaml.SequenceEndEvent):
                items.append(self.value(event, inside=True))
            if {bool, str} == {type(item) for item in items}:
                raise ParameterError(
                    f"{_shown(items)}: YAML reads y, n, on and off as true and false; write names "
                    "in quotes, as 'y'"
                )
            if len({type(item) for item in items}) > 1:
                raise ParameterError(
                    f"{_shown(items)}: ROS lists hold one type; write 1.0 for 1 among floats"
                )
            return items
        if not isinstance(event, yaml.ScalarEvent):
            raise ParameterError("a list: must hold plain values" if inside else "no value")
        if event.tag not in (None, STR):
            raise ParameterError(f"{event.tag} {event.value}: ROS reads no such tag; omit it")
        quoted = event.style in ("'", '"')
        if not event.value and not quoted:
            raise ParameterError("nothing: give a value")
        if inside and not (quoted or INNER.fullmatch(event.value)):
            raise ParameterError(f"{event.value}: quote it in a list")
        return event.value if quoted or event.tag == STR else scalar(event.value)


def _shown(items: list[object]) -> str:
    text = str(items)
    return text if len(text) < 60 else f"{text[:60]}..."


def _mixed(section: str) -> ParameterError:
    return ParameterError(f"{section}: must hold {KEY} and nothing else")


def sections(path: Path) -> dict[str, dict[str, Any]]:
    """Sections of a parameter file: dotted names and values of each, in its order.

    Raises
    ------
    ParameterError
        It cannot be read, or does not mean the same to every reader.
    """
    text = paths.text_of(path, SIZE_MAX)
    try:
        reader = _Reader(text.removeprefix("\ufeff"))
        reader.file()
    except ParameterError as error:
        raise ParameterError(f"{path}: {error}") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ParameterError(f"{path}: not YAML: {' '.join(str(error).split())}") from None
    return reader.sections


def value(text: str) -> Any:
    """Value of ``-p name:=text``.

    Raises
    ------
    ParameterError
        ROS reads no value there, or not every reader the same.
    """
    reader = _Reader(text)
    try:
        reader.next(), reader.next()
        found = reader.value(reader.next())
        reader.next()
        if not isinstance(reader.next(), yaml.StreamEndEvent):
            raise ParameterError(f"{text}: give one value")
    except ParameterError:
        raise
    except (yaml.YAMLError, ValueError, RecursionError, StopIteration):
        raise ParameterError(f"{text}: is no value in YAML") from None
    return found


def matches(section: str, node: str) -> bool:
    """Whether a section counts for a node, by its full name."""
    pattern = "/" + section.removeprefix("/")
    return bool(re.fullmatch(pattern.replace("/*", r"(/\w+)"), node, re.ASCII))


def merged(files: Mapping[Path, Mapping[str, Mapping[str, object]]]) -> dict[str, dict[str, Any]]:
    """Sections of several files: a later file replaces values of the section of the same name."""
    found: dict[str, dict[str, Any]] = {}
    for each in files.values():
        for section, values in each.items():
            found.setdefault(section, {}).update(values)
    return found


def values_of(sections: Mapping[str, Mapping[str, object]], node: str) -> dict[str, Any]:
    """Values that count for a node, by its full name: those of a later section over earlier."""
    found: dict[str, Any] = {}
    for section, values in sections.items():
        if matches(section, node):
            found.update(values)
    return found
