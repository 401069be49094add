"""Parameters of blocks: declared once on a dataclass, checked everywhere alike.

A block's parameters are a frozen dataclass in the paper's units. Each field carries its unit,
range and meaning; ROS descriptors, command line errors and the documentation come from there.
Nested dataclasses give dotted names (``sensor.noise_nm``); a `Choice` gives a group whose fields
depend on its ``type`` (``hysteresis.type``).
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
import reprlib
import typing
from array import array
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any, TypeVar

from pea_core.printable import printable

Value = bool | int | float | str | tuple[float, ...] | tuple[str, ...]
Values = dict[str, Value]

T = TypeVar("T")


SHOWN_MAX = 80
"""Characters of a name or value that an error repeats."""


ERROR_MAX = 1000
"""Characters of an error."""


class ParameterError(ValueError):
    """A value that breaks a rule; the text names the value, the rule and what to do.

    The text is one line of printable characters, whatever the user typed.
    """

    def __init__(self, text: str) -> None:
        super().__init__(printable(text, ERROR_MAX))


def nearest(word: str, known: Iterable[str], where: str = "") -> str:
    """Name what is closest to `word` among `known`, or list all of them when nothing is close.

    `where` is put before a close name, so that it can be typed as it stands.
    """
    names = sorted(known)
    low = word.lower()
    close = (
        [name for name in names if name.lower() == low]
        or [name for name in names if name.lower().endswith("." + low)]
        or [name for name in names if len(low) > 2 and name.lower().startswith(low)]
        or difflib.get_close_matches(word, names, n=3, cutoff=0.5)
    )
    if close:
        return "did you mean " + " or ".join(where + name for name in close) + "?"
    return "known: " + ", ".join(names) if names else "it takes none"


NUMBER = re.compile(r"[+-]?(?:0|[1-9][0-9]*|(?=\.[0-9]))(?:\.[0-9]*)?(?:[eE][+-]?[0-9]+)?")
"""A number as it is written everywhere: decimal. 010 is 8 to some readers and 10 to others."""


INFINITE = re.compile(r"[+-]?\.?(?:inf|infinity|nan)", re.IGNORECASE)
"""What YAML and C write for numbers that are not finite."""


def number_of(text: str) -> int | float | None:
    """The number that `text` writes, on a command line or in a file alike; None where it is none.

    >>> number_of("10"), number_of("1e-8"), number_of("010"), number_of("0x10"), number_of("1_0")
    (10, 1e-08, None, None, None)
    """
    if not NUMBER.fullmatch(text):
        return None
    if text.lstrip("+-").isdigit() and len(text) <= INT_DIGITS:
        number = int(text)
        return number if -(2**63) <= number < 2**63 else float(number)
    return float(text)


TRUE = ("Y", "y", "yes", "Yes", "YES", "true", "True", "TRUE", "on", "On", "ON")
FALSE = ("N", "n", "no", "No", "NO", "false", "False", "FALSE", "off", "Off", "OFF")
"""Words for true and false in parameter files."""


class Text(str):
    """A value as somebody has typed it: the parameter that it is for says of which type it is."""

    def __repr__(self) -> str:
        return str(self) if number_of(self) is not None else super().__repr__()


def text_as(kind: type, text: str) -> Any:
    """A typed value as one of `kind`, or as it is where it is none of them."""
    if kind is bool and text in TRUE + FALSE:
        return text in TRUE
    if kind in (int, float):
        number = number_of(text)
        return text if number is None else float(number) if kind is float else number
    return str(text)


INT_DIGITS = 20
"""Digits, and sign, of the longest whole number that ROS reads as one; longer ones are floats."""


def typed(there: object, value: object) -> Any:
    """`value` as of the type of `there`, where YAML 1.1 has read what was typed as another.

    A whole number may stand for a float, and it reads on and off as true and false.
    """
    if isinstance(value, Text):
        return text_as(type(there), value)
    if isinstance(there, tuple) and isinstance(value, list):
        return [text_as(float, item) if isinstance(item, Text) else item for item in value]
    if isinstance(there, float) and type(value) is int:
        return float(value)
    if isinstance(there, str) and isinstance(value, bool):
        return "on" if value else "off"
    return value


def _short(text: str) -> str:
    return text if len(text) <= SHOWN_MAX else text[: SHOWN_MAX - 3] + "..."


_REPR = reprlib.Repr()
_REPR.maxlevel = 3
_REPR.maxlist = _REPR.maxtuple = _REPR.maxdict = 20
_REPR.maxstring = _REPR.maxlong = _REPR.maxother = 1000
"""A few of the items, a few levels down: aliases of YAML can stand for very many."""


def _shown(value: object) -> str:
    try:
        return _short(_REPR.repr(value))
    except ValueError:  # Python writes out no integer of more than 4300 digits
        return "a huge number"


def _number(x: float) -> str:
    text = f"{x:g}"
    return text if float(text) == x else str(x)


@dataclass(frozen=True)
class Spec:
    """What is known of one parameter besides its value.

    Attributes
    ----------
    unit : str
        Unit as shown to people, for example ``"um/V"``.
    low, high : float or None
        Inclusive range of numbers; None where a type has no range.
    choices : tuple of str
        Allowed texts; empty where any text will do.
    fixed : bool
        True where the value shapes the block, so that it cannot change while the loop runs.
    common : bool
        True where the value means the same in every type that has the parameter: it stays when
        another type is chosen. Any other begins at the new type's default.
    help : str
        One line for people.
    kind : type
        bool, int, float, str or tuple (of floats, or of texts where the default has texts).
    default : Value
        The value when nobody says otherwise.
    unusable : mapping of str to str
        Installed choices that cannot be used, and why.
    """

    unit: str = ""
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    fixed: bool = False
    help: str = ""
    kind: type = float
    default: Value = 0.0
    common: bool = False
    unusable: Mapping[str, str] = dataclasses.field(default_factory=dict, compare=False)

    @property
    def rule(self) -> str:
        """The range or the choices in words."""
        unit = f" {self.unit}" if self.unit else ""
        if self.choices:
            return "one of " + ", ".join(self.choices)
        if self.low is not None and self.high is not None:
            return f"{_number(self.low)} to {_number(self.high)}{unit}"
        if self.low is not None:
            return f"at least {_number(self.low)}{unit}"
        if self.high is not None:
            return f"at most {_number(self.high)}{unit}"
        words = {bool: "true or false", str: "text", int: f"a whole number{unit}"}
        kind = self.item if self.kind is tuple else self.kind
        return words.get(kind, f"a finite number{unit}")

    @property
    def item(self) -> type:
        """Of a list, the type of what it holds."""
        texts = isinstance(self.default, tuple) and any(isinstance(v, str) for v in self.default)
        return str if texts else float

    @property
    def items(self) -> str:
        """Of a list, what it holds, in a word."""
        return "names" if self.item is str else "numbers"

    def alike(self, other: Spec) -> bool:
        """Whether both take the same values: unit, range, choices and kind are the same."""
        same = dataclasses.replace(other, default=self.default, help=self.help, fixed=self.fixed)
        return self == same

    def check(self, name: str, value: object) -> Value:
        """Return `value` as this parameter's type.

        Raises
        ------
        ParameterError
            Wrong type, not finite, or outside the range.
        """
        if self.kind is tuple:
            if not isinstance(value, list | tuple | array):
                raise ParameterError(
                    f"{name} = {_shown(value)}: give a list of {self.items}, each {self.rule}"
                )
            each = dataclasses.replace(self, kind=self.item)
            items = [each.check(f"{name}[{i}]", v) for i, v in enumerate(value)]
            return tuple(typing.cast(list[float], items))
        if self.kind is bool:
            value = text_as(bool, value) if isinstance(value, Text) else value
            if isinstance(value, bool):
                return value
            raise ParameterError(f"{name} = {_shown(value)}: give true or false")
        if self.kind is str:
            if not self.choices and isinstance(value, int) and not isinstance(value, bool):
                value = str(value)  # an axis 1 is a name
            if (word := typed("", value)) in self.choices:
                value = word
            if not isinstance(value, str):
                quote = ""
                for word in self.choices:
                    if isinstance(value, bool) and word in (TRUE if value else FALSE):
                        quote = f"; YAML reads a bare {word} as {str(value).lower()}: quote it"
                raise ParameterError(f"{name} = {_shown(value)}: give {self.rule}{quote}")
            value = str(value)
            if why := self.unusable.get(value):
                raise ParameterError(f"{name} = {_shown(value)}: cannot be used: {why}")
            if self.choices and value not in self.choices:
                raise ParameterError(f"{name} = {_shown(value)}: {nearest(value, self.choices)}")
            return value
        return self._check_number(name, value)

    def _check_number(self, name: str, value: Any) -> Value:
        number = value
        if isinstance(value, str):  # quoted
            endless = INFINITE.fullmatch(value.strip())
            number = math.nan if endless else number_of(value.strip())
        real = isinstance(number, Real) and not isinstance(number, bool)
        if not real:
            decimal = ", decimal, without leading zeros" if str(value)[:1].isdigit() else ""
            raise ParameterError(f"{name} = {_shown(value)}: give a number, {self.rule}{decimal}")
        try:
            finite = math.isfinite(number)
        except OverflowError:  # an integer beyond the range of float
            finite = False
        if not finite:
            raise ParameterError(f"{name} = {_shown(value)}: must be finite, {self.rule}")
        if self.kind is int:
            if number != int(number):
                raise ParameterError(
                    f"{name} = {_shown(value)}: must be a whole number, {self.rule}"
                )
            number = int(number)
        else:
            number = float(number)
        if (self.low is not None and number < self.low) or (
            self.high is not None and number > self.high
        ):
            raise ParameterError(f"{name} = {_shown(value)}: must be {self.rule}")
        return number


def param(
    default: Value,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    *,
    help: str,
    choices: tuple[str, ...] = (),
    fixed: bool = False,
    common: bool = False,
) -> Any:
    """Declare a field of a parameter dataclass; see `Spec` for the arguments.

    Raises
    ------
    ParameterError
        The default breaks the rule that it is declared with.
    """
    spec = Spec(unit, low, high, choices, fixed, help, type(default), default, common)
    spec.check("default", default)
    return dataclasses.field(default=default, metadata={"spec": spec})


class Choice:
    """A group of parameters whose fields depend on its ``type``.

    Parameters
    ----------
    kinds : Mapping[str, type]
        Parameter dataclass of each type.
    default : str
        The type when nobody says otherwise.
    help : str
        One line for people.
    fixed : bool
        False where another type may be chosen while the loop runs.
    unusable : mapping of str to str, optional
        Types that cannot be used, and why.

    Raises
    ------
    ValueError
        Two types share one dataclass: `type_of` could not tell them apart.
    """

    def __init__(
        self,
        kinds: Mapping[str, type],
        default: str,
        help: str,
        fixed: bool = True,
        unusable: Mapping[str, str] | None = None,
    ) -> None:
        self.kinds = dict(kinds)
        if len(set(self.kinds.values())) < len(self.kinds):
            raise ValueError(f"{', '.join(self.kinds)}: each type needs a dataclass of its own")
        self.default = default
        self.spec = Spec(
            choices=tuple(self.kinds),
            fixed=fixed,
            help=help,
            kind=str,
            default=default,
            unusable=unusable or {},
        )

    def type_of(self, params: object) -> str:
        """Name of the type that `params` belongs to."""
        for name, kind in self.kinds.items():
            if kind is type(params):
                return name
        raise TypeError(f"{type(params)} is no type of {', '.join(self.kinds)}")


Schema = type | Choice


def choice(kinds: Mapping[str, type], default: str, *, help: str) -> Any:
    """Declare a field that is a `Choice`."""
    group = Choice(kinds, default, help)
    return dataclasses.field(default_factory=group.kinds[default], metadata={"group": group})


def group(kind: type) -> Any:
    """Declare a field that is a nested parameter dataclass."""
    return dataclasses.field(default_factory=kind, metadata={"group": kind})


def _under(values: Mapping[str, object], prefix: str) -> dict[str, Any]:
    names = [name for name in values if isinstance(name, str)]  # YAML reads `on:` as True
    return {name[len(prefix) :]: values[name] for name in names if name.startswith(prefix)}


def build(schema: Schema, values: Mapping[str, object], where: str = "") -> Any:
    """Make a parameter dataclass from flat dotted names; what is not named keeps its default.

    Parameters
    ----------
    schema : type or Choice
        The dataclass, or the choice of dataclasses.
    values : Mapping[str, Any]
        Dotted names and values, as from YAML.
    where : str
        Put before each name in errors, for example ``"controller."``.

    Raises
    ------
    ParameterError
        Unknown name, wrong type, out of range, or values that do not go together.
    """
    known = specs(schema, values, where)
    for name in values:
        if name not in known:
            advice = _advice(schema, values, str(name), known, where)
            raise ParameterError(f"unknown parameter {_short(where + str(name))}: {advice}")
    return _build(schema, values, where)


def _advice(
    schema: Schema, values: Mapping[str, object], name: str, known: Iterable[str], where: str
) -> str:
    """What to do about the unknown `name`."""
    members = [where + k for k in known if k.startswith(name + ".")]
    if members:
        choosers = [k for k in members if k == f"{where}{name}.type"]
        return "it is a group; give " + " or ".join(choosers or members)
    return _owner(schema, values, name, where) or nearest(name, known, where)


def _owner(schema: Schema, values: Mapping[str, object], name: str, where: str) -> str | None:
    """Which type of a choice knows `name`, where the chosen one does not."""
    if isinstance(schema, Choice):
        owners = [kind for kind in schema.kinds if name in specs(schema, {"type": kind})]
        if owners:
            chosen = values.get("type", schema.default)
            return f"it belongs to {where}type = {' or '.join(owners)}, and the type is {chosen}"
    for field in dataclasses.fields(_kind(schema, values, where)):
        prefix = field.name + "."
        if "group" in field.metadata and name.startswith(prefix):
            inner = _under(values, prefix)
            return _owner(field.metadata["group"], inner, name[len(prefix) :], where + prefix)
    return None


def _kind(schema: Schema, values: Mapping[str, object], where: str) -> type:
    if isinstance(schema, type):
        return schema
    if "type" not in values:
        return schema.kinds[schema.default]
    name = schema.spec.check(where + "type", values["type"])
    return schema.kinds[typing.cast(str, name)]


def _build(schema: Schema, values: Mapping[str, object], where: str) -> Any:
    kind = _kind(schema, values, where)
    arguments: dict[str, Any] = {}
    for field in dataclasses.fields(kind):
        prefix = field.name + "."
        if "group" in field.metadata:
            inner = _under(values, prefix)
            arguments[field.name] = _build(field.metadata["group"], inner, where + prefix)
        elif field.name in values:
            spec: Spec = field.metadata["spec"]
            arguments[field.name] = spec.check(where + field.name, values[field.name])
    try:
        return kind(**arguments)
    except ParameterError as error:
        raise ParameterError(where + str(error)) from None


def specs(schema: Schema, values: Mapping[str, object] | None = None, where: str = "") -> dict:
    """Dotted name and `Spec` of every parameter that applies, given the types in `values`."""
    values = values or {}
    kind = _kind(schema, values, where)
    found: dict[str, Spec] = {}
    if isinstance(schema, Choice):
        found["type"] = schema.spec
    for field in dataclasses.fields(kind):
        if "group" in field.metadata:
            prefix = field.name + "."
            inner = specs(field.metadata["group"], _under(values, prefix), where + prefix)
            found.update({prefix + name: spec for name, spec in inner.items()})
        else:
            found[field.name] = field.metadata["spec"]
    return found


def flatten(schema: Schema, params: Any) -> Values:
    """Dotted names and values of `params`: what `build` makes it from again."""
    flat: Values = {}
    if isinstance(schema, Choice):
        flat["type"] = schema.type_of(params)
    for field in dataclasses.fields(params):
        value = getattr(params, field.name)
        if "group" in field.metadata:
            inner = flatten(field.metadata["group"], value)
            flat.update({f"{field.name}.{name}": v for name, v in inner.items()})
        else:
            flat[field.name] = value
    return flat


def layer(
    schema: Schema,
    base: Mapping[str, object],
    new: Mapping[str, object],
    where: str = "",
    anew: bool = False,
) -> dict[str, Any]:
    """Lay the values `new` over `base`.

    Where `new` chooses another ``type``, the values that `base` gives to the old type are
    dropped, except those that are `common` to both types. Names that neither type has stay, for
    `build` to refuse.

    Parameters
    ----------
    schema : type or Choice
    base, new : mapping
        Dotted names and values.
    where : str
        Put before each name in errors.
    anew : bool
        `new` is a preset: also a ``type`` that is already chosen begins at its defaults.

    Raises
    ------
    ParameterError
        A ``type`` that does not exist.
    """
    merged = {**base, **new}
    left = _replaced(schema, base, new, where, anew)
    return {name: value for name, value in merged.items() if name in new or name not in left}


def _replaced(
    schema: Schema, base: Mapping[str, object], new: Mapping[str, object], where: str, anew: bool
) -> set[str]:
    """Names in `base` whose values belong to a type that `new` replaces."""
    merged = {**base, **new}
    if isinstance(schema, Choice):
        kind, other = (_kind(schema, values, where) for values in (base, merged))
        if kind is not other or (anew and "type" in new):
            old, now = specs(schema, base, where), specs(schema, merged, where)
            stay = {name for name in old if name in now and _stays(old[name], now[name])}
            return {*old} - stay
    found: set[str] = set()
    for field in dataclasses.fields(_kind(schema, merged, where)):
        if "group" in field.metadata:
            prefix = field.name + "."
            inner = _replaced(
                field.metadata["group"],
                _under(base, prefix),
                _under(new, prefix),
                where + prefix,
                anew,
            )
            found |= {prefix + name for name in inner}
    return found


def _stays(old: Spec, now: Spec) -> bool:
    return old.common and now.common and old.alike(now)
