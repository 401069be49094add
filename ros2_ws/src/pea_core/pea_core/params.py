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
import typing
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

Value = bool | int | float | str | tuple[float, ...]
Values = dict[str, Value]

T = TypeVar("T")


class ParameterError(ValueError):
    """A value that breaks a rule; the text names the value, the rule and what to do."""


def nearest(word: str, known: Iterable[str]) -> str:
    """Name what is closest to `word` among `known`, or list all of them when nothing is close."""
    names = sorted(known)
    close = difflib.get_close_matches(word, names, n=3, cutoff=0.5)
    if close:
        return "did you mean " + " or ".join(close) + "?"
    return "known: " + ", ".join(names) if names else "it takes none"


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
    help : str
        One line for people.
    kind : type
        bool, int, float, str or tuple (of floats).
    default : Value
        The value when nobody says otherwise.
    """

    unit: str = ""
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    fixed: bool = False
    help: str = ""
    kind: type = float
    default: Value = 0.0

    @property
    def rule(self) -> str:
        """The range or the choices in words."""
        unit = f" {self.unit}" if self.unit else ""
        if self.choices:
            return "one of " + ", ".join(self.choices)
        if self.low is not None and self.high is not None:
            return f"{self.low:g} to {self.high:g}{unit}"
        return {bool: "true or false", str: "text"}.get(self.kind, f"a finite number{unit}")

    def check(self, name: str, value: Any) -> Value:
        """Return `value` as this parameter's type.

        Raises
        ------
        ParameterError
            Wrong type, not finite, or outside the range.
        """
        if self.kind is tuple:
            if not isinstance(value, list | tuple):
                raise ParameterError(f"{name} = {value!r}: give a list of numbers")
            items = [
                dataclasses.replace(self, kind=float).check(f"{name}[{i}]", v)
                for i, v in enumerate(value)
            ]
            return tuple(typing.cast(list[float], items))
        if self.kind is bool:
            if isinstance(value, bool):
                return value
            raise ParameterError(f"{name} = {value!r}: give true or false")
        if self.kind is str:
            if not isinstance(value, str):
                raise ParameterError(f"{name} = {value!r}: give {self.rule}")
            if self.choices and value not in self.choices:
                raise ParameterError(f"{name} = {value!r}: {nearest(value, self.choices)}")
            return value
        return self._check_number(name, value)

    def _check_number(self, name: str, value: Any) -> Value:
        number = value
        if isinstance(value, str):  # YAML 1.1 reads 1e-8 as text
            try:
                number = float(value)
            except ValueError:
                number = None
        if isinstance(number, bool) or not isinstance(number, int | float):
            raise ParameterError(f"{name} = {value!r}: give a number, {self.rule}")
        if not math.isfinite(number):
            raise ParameterError(f"{name} = {value}: must be finite, {self.rule}")
        if self.kind is int:
            if number != int(number):
                raise ParameterError(f"{name} = {value}: must be a whole number, {self.rule}")
            number = int(number)
        else:
            number = float(number)
        if (self.low is not None and number < self.low) or (
            self.high is not None and number > self.high
        ):
            raise ParameterError(f"{name} = {value}: must be {self.rule}")
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
) -> Any:
    """Declare a field of a parameter dataclass; see `Spec` for the arguments."""
    spec = Spec(unit, low, high, choices, fixed, help, type(default), default)
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
    """

    def __init__(self, kinds: Mapping[str, type], default: str, help: str) -> None:
        self.kinds = dict(kinds)
        self.default = default
        self.spec = Spec(
            choices=tuple(self.kinds), fixed=True, help=help, kind=str, default=default
        )

    def type_of(self, params: object) -> str:
        """Name of the type that `params` belongs to."""
        return next(name for name, kind in self.kinds.items() if kind is type(params))


Schema = type | Choice


def choice(kinds: Mapping[str, type], default: str, *, help: str) -> Any:
    """Declare a field that is a `Choice`."""
    group = Choice(kinds, default, help)
    return dataclasses.field(default_factory=group.kinds[default], metadata={"group": group})


def group(kind: type) -> Any:
    """Declare a field that is a nested parameter dataclass."""
    return dataclasses.field(default_factory=kind, metadata={"group": kind})


def _under(values: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    return {k[len(prefix) :]: v for k, v in values.items() if k.startswith(prefix)}


def build(schema: Schema, values: Mapping[str, Any], where: str = "") -> Any:
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
    unknown = [name for name in values if name not in specs(schema, values, where)]
    if unknown:
        known = specs(schema, values, where)
        raise ParameterError(f"unknown parameter {where}{unknown[0]}: {nearest(unknown[0], known)}")
    return _build(schema, values, where)


def _kind(schema: Schema, values: Mapping[str, Any], where: str) -> type:
    if isinstance(schema, type):
        return schema
    name = schema.spec.check(where + "type", values.get("type", schema.default))
    return schema.kinds[typing.cast(str, name)]


def _build(schema: Schema, values: Mapping[str, Any], where: str) -> Any:
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


def specs(schema: Schema, values: Mapping[str, Any] | None = None, where: str = "") -> dict:
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


def layer(schema: Schema, base: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    """Lay the values `new` over `base`.

    Where `new` chooses another ``type``, what `base` said of the old type alone is dropped:
    it would be an unknown parameter of the new one.
    """
    merged = {**base, **new}
    changed = [
        name[: -len("type")]
        for name in new
        if (name == "type" or name.endswith(".type")) and base.get(name, new[name]) != new[name]
    ]
    if changed:
        known = specs(schema, merged)
        for prefix in changed:
            for name in [n for n in base if n.startswith(prefix) and n not in known]:
                if name not in new:
                    del merged[name]
    return merged
