"""A block's parameters as ROS 2 parameters: declared from its dataclass, swapped in whole."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from pea_core import config, parameter_file
from pea_core.block import changed
from pea_core.config import (
    SECTIONS,
    NodeParams,
    Resolved,
    Source,
    absolute,
    allotted,
    check_sections,
    node_specs,
    resolve_axes,
    without_ros,
)
from pea_core.params import ParameterError, Schema, Spec, build, flatten, specs
from pea_ros.context import given

FOREIGN = ("use_sim_time", "start_type_description_service", "qos_overrides.")
"""Parameters that rclpy itself declares."""

SLIDER_MAX = 2**31 - 1
"""Largest end of a range that rqt_reconfigure can draw; it opens no node with a larger one."""


ONE = "launch_params_"
"""How the name of a file begins that a launch file has written for one node."""


def overrides(node: Node, own: Collection[str] = ()) -> dict[str, Any]:
    """Values given on the command line or in parameter files, before anything is declared.

    What a file says of other nodes is theirs; what no node would take is refused. The node must
    have been made with ``automatically_declare_parameters_from_overrides``.

    Parameters
    ----------
    node : rclpy.node.Node
    own : collection of str
        Parameters of a node that is no block.

    Raises
    ------
    ParameterError
        A value would not be in force, or not mean the same everywhere.
    """
    name, files, typed = node.get_fully_qualified_name(), given.files, given.values
    namespace = node.get_namespace().rstrip("/")
    for path, found in files.items():
        check_sections(path, found, SECTIONS, namespace)
    mine = {path: _allotted(path, name, own)[0] for path in files}
    values = parameter_file.values_of(parameter_file.merged(mine), name)
    for section, parameter, value in typed:
        if not parameter_file.matches(section, name):
            raise ParameterError(
                f"-p {section}:{parameter}: is of /{section}, not of {name}; leave {section}: out"
            )
        values[parameter] = value
    return without_ros(values)


def _allotted(
    path: Path, name: str, own: Collection[str]
) -> tuple[Mapping[str, Mapping[str, Any]], dict[str, str]]:
    """Sections of a file as they count for the node `name`, and what of them is of others."""
    found = given.files[path]
    if path.name.startswith(ONE):
        return found, {}
    return allotted(found, name.rpartition("/")[2], own)


def leave_out(node: Node, say: Callable[[str], object], own: Collection[str] = ()) -> None:
    """Forget what files say for all nodes and this one does not have; say whose it is.

    Parameters
    ----------
    node : rclpy.node.Node
    say : callable
    own : collection of str
        As in `overrides`.
    """
    for path in given.files:
        for name, other in _allotted(path, node.get_fully_qualified_name(), own)[1].items():
            say(f"{path}: {name}, for all nodes, is of the {other}, not of this one")
            if node.has_parameter(name):
                node.undeclare_parameter(name)


def sources(name: str, values: Mapping[str, object]) -> list[Source]:
    """The values of a node by where they come from: each file, and what stands after ``-p``.

    ROS lays them over each other, and a preset on the command line could not be told from one
    in a file, which it must replace.

    Parameters
    ----------
    name : str
        Full name of the node.
    values : mapping
        All of them, from `overrides`.
    """
    matches = parameter_file.matches
    typed = {parameter: v for section, parameter, v in given.values if matches(section, name)}
    found = [
        (parameter_file.values_of(sections, name), str(path), path.parent)
        for path, sections in given.files.items()
    ]
    everything: list[tuple[dict[str, Any], str, Path | None]] = [
        ({}, "", None),
        *found,
        (typed, "the command line", None),
    ]
    left = dict(values)
    for own, _, _ in reversed(everything):  # the strongest source of a name gives ROS's value
        for each in [n for n in own if n not in values]:
            del own[each]
        own |= {each: left.pop(each) for each in own.keys() & left.keys()}
    everything[0][0].update(left)
    return [
        Source(absolute(own, folder), place, typed=own is typed)
        for own, place, folder in everything
        if own
    ]


def descriptor(spec: Spec) -> ParameterDescriptor:
    """What `spec` says, for ``ros2 param describe`` and rqt_reconfigure.

    A real number has no step: any value between the ends is right.
    """
    unit = f" [{spec.unit}]" if spec.unit else ""
    described = ParameterDescriptor(
        description=spec.help + unit, read_only=spec.fixed, additional_constraints=spec.rule
    )
    if spec.low is not None and spec.high is not None:
        if spec.kind is int and spec.high <= SLIDER_MAX:
            described.integer_range = [
                IntegerRange(from_value=int(spec.low), to_value=int(spec.high), step=1)
            ]
        elif spec.kind is float:
            described.floating_point_range = [
                FloatingPointRange(from_value=spec.low, to_value=spec.high, step=0.0)
            ]
    return described


def ros_value(value: object) -> Any:
    """Value in a type that ROS takes."""
    return list(value) if isinstance(value, tuple) else value


def declare(node: Node, name: str, spec: Spec, value: object) -> None:
    """Declare one parameter with its range and description."""
    if node.has_parameter(name):
        node.undeclare_parameter(name)
    node.declare_parameter(name, ros_value(value), descriptor(spec), ignore_override=True)


class _Axis:
    """Parameters of one axis of a block."""

    def __init__(self, role: str, schema: Schema, resolved: Resolved, namespace: str) -> None:
        self.role = role
        self.schema = schema
        self.resolved = resolved
        self.params = resolved.params
        self.namespace = namespace

    @property
    def values(self) -> dict[str, Any]:
        """The block's parameters by dotted name."""
        return flatten(self.schema, self.params)

    @property
    def all(self) -> dict[str, Any]:
        """The block's parameters and the node's own, by dotted name."""
        return {**flatten(NodeParams, self.resolved.node), **self.values}

    def new(self, values: Mapping[str, Any]) -> Any:
        """Parameters with some values changed, and those of the preset of another type.

        Raises
        ------
        ParameterError
            They break a rule.
        """
        if not values:
            return self.params
        if values.get("type", self.values.get("type")) != self.values.get("type"):
            begun = config.begun(self.role, self.schema, values, self.namespace)
            values = {**begun, **values}
        return changed(self.schema, self.params, dict(values))

    def completed(self, params: Any, given: Collection[str]) -> dict[str, Any]:
        """What changes besides the `given` where `params` are of another type."""
        if type(params) is type(self.params):
            return {}
        before, now = self.values, flatten(self.schema, params)
        known, new = specs(self.schema, before), specs(self.schema, now)
        return {
            name: value
            for name, value in now.items()
            if name in known.keys() - given
            and not known[name].fixed
            and (value != before[name] or not (known[name].common or value == new[name].default))
        }


class BlockParameters:
    """Parameters of one node, kept equal to the dataclass of its block, or of each axis's.

    With several axes the parameters of the axis x are declared as ``x.NAME``. To set ``NAME`` sets
    it for every axis.

    Parameters
    ----------
    node : rclpy.node.Node
        Made with ``automatically_declare_parameters_from_overrides``.
    role : str
        One of `pea_core.config.NODES`.
    schema : type or Choice
        Parameters of the block.
    given : sequence of Source
        From `sources`, without the values of the shell.

    Attributes
    ----------
    axes : tuple of str
        Names of the axes.
    live : set of str
        Names that somebody has set since the node began.

    Raises
    ------
    ParameterError
        A given value is unknown or breaks a rule.
    """

    def __init__(self, node: Node, role: str, schema: Schema, given: Sequence[Source]) -> None:
        self.node = node
        self.schema = schema
        self.role = role
        self.namespace = node.get_namespace().rstrip("/")
        found = resolve_axes(role, schema, given, self.namespace)
        self._each = [_Axis(role, schema, resolved, self.namespace) for resolved in found]
        self.axes = found[0].node.axes
        self._try: Callable[[Any], None] = lambda params: None
        self._swap: Callable[[Any], None] = lambda params: None
        self._declaring = self._following = False
        self.live: set[str] = set()
        for name in [name for source in given for name in source.values if self._of_all(name)]:
            if node.has_parameter(name):  # it is declared of each axis
                node.undeclare_parameter(name)
        values = self.all
        for name, spec in self._specs().items():
            declare(node, name, spec, values[name])
        node.add_pre_set_parameters_callback(self._complete)
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._apply)

    def connect(self, check: Callable[[Any], None], swap: Callable[[Any], None]) -> None:
        """Say who checks new parameters beyond their ranges, and who takes them.

        Parameters
        ----------
        check : callable
            Raises `ParameterError` for parameters that cannot be used.
        swap : callable
            Takes them, between two samples.
        """
        self._try, self._swap = check, swap

    def adopt(self, values: Mapping[str, object]) -> None:
        """Set values that a neighbour knows better than the defaults.

        Raises
        ------
        ParameterError
            They break a rule.
        """
        now = self.values
        names = {name for name, value in values.items() if now[name] != value}
        if not names:
            return
        merged = {**now, **values}
        new = [build(self.schema, self._own(axis, merged)) for axis in self.axes]
        self._try(self._joined(new))
        for each, params in zip(self._each, new, strict=True):
            each.params = params
        self._declare(names)  # anew: what is fixed while the loop runs is read-only
        self._swap(self.params)

    def follow(self, values: Mapping[str, object]) -> None:
        """Set values as a neighbour has changed them while the loop runs; the change is told.

        Raises
        ------
        ParameterError
            They break a rule.
        """
        now = self.values
        new = [
            Parameter(name, value=ros_value(value))
            for name, value in values.items()
            if now[name] != value
        ]
        if not new:
            return
        self._following = True
        try:
            result = self.node.set_parameters_atomically(new)
        finally:
            self._following = False
        if not result.successful:
            raise ParameterError(result.reason)

    @property
    def resolved(self) -> Resolved:
        """What the node began with; of several axes, that of the first."""
        return self._each[0].resolved

    @property
    def given(self) -> frozenset[str]:
        """Names whose values come from a source, not from a default."""
        own = [dict.fromkeys(each.resolved.given) for each in self._each]
        return frozenset(config.flat(self.axes, own))

    @property
    def params(self) -> Any:
        """The block's parameters; a tuple of each axis's where there are several."""
        return self._joined([each.params for each in self._each])

    @property
    def values(self) -> dict[str, Any]:
        """The parameters of the block by dotted name."""
        return config.flat(self.axes, [each.values for each in self._each])

    @property
    def all(self) -> dict[str, Any]:
        """The parameters of the block and the node's own, by dotted name."""
        return config.flat(self.axes, [each.all for each in self._each])

    @property
    def changed_by(self) -> str:
        """Who has changed parameters last, as far as they say."""
        return str(self.node.get_parameter("changed_by").value)

    def _joined(self, each: Sequence[Any]) -> Any:
        return each[0] if len(each) == 1 else tuple(each)

    def _of_all(self, name: str) -> bool:
        """Whether a name is of the block of every axis."""
        return name not in config.spread(self.axes, {name: None})

    def _own(self, axis: str, values: Mapping[str, Any]) -> dict[str, Any]:
        """Values of an axis's block."""
        found = config.own_of(self.axes, axis, values)
        return {name: value for name, value in found.items() if name not in specs(NodeParams)}

    def _specs(self) -> dict[str, Spec]:
        """Every parameter of the node."""
        return config.flat(self.axes, [node_specs(self.schema, each.all) for each in self._each])

    def _asked(self, parameters: list[Parameter]) -> dict[str, Any]:
        """Values of the block that somebody asks for, by dotted name."""
        values = {p.name: p.value for p in parameters if not p.name.startswith(FOREIGN)}
        values = {
            name: tuple(value) if hasattr(value, "tolist") or isinstance(value, list) else value
            for name, value in values.items()
        }
        return config.spread(self.axes, values)

    def _new(self, asked: Mapping[str, Any]) -> list[Any]:
        """Parameters of each axis with what is asked for."""
        found = []
        for axis, each in zip(self.axes, self._each, strict=True):
            try:
                found.append(each.new(self._own(axis, asked)))
            except ParameterError as error:
                where = f"{axis}: " if len(self.axes) > 1 else ""
                raise ParameterError(f"{where}{error}") from None
        return found

    def _complete(self, parameters: list[Parameter]) -> list[Parameter]:
        """Add to another ``type`` the values that change with it, so that all are told at once.

        What is asked of all axes is asked of each.
        """
        if self._declaring:
            return parameters
        asked = self._asked(parameters)
        try:
            new = self._new(asked)
        except ParameterError:  # `_check` refuses it
            return parameters
        more = [
            each.completed(params, self._own(axis, asked))
            for axis, each, params in zip(self.axes, self._each, new, strict=True)
        ]
        own = [
            parameter
            for parameter in parameters
            if parameter.name.startswith(FOREIGN) or not self._of_all(parameter.name)
        ]
        kept = {parameter.name for parameter in own}
        found = {**asked, **config.flat(self.axes, more)}
        return own + [
            Parameter(name, value=ros_value(value))
            for name, value in found.items()
            if name not in kept
        ]

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        if self._declaring:
            return SetParametersResult(successful=True)
        try:
            without_ros({p.name: p.value for p in parameters if p.name.startswith(FOREIGN)})
            asked = self._asked(parameters)
            new = self._new(asked)
            if any(self._own(axis, asked) for axis in self.axes):
                self._try(self._joined(new))
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, parameters: list[Parameter]) -> None:
        if self._declaring:
            return
        asked = self._asked(parameters)
        if not any(self._own(axis, asked) for axis in self.axes):
            return
        if not self._following:
            self.live |= asked.keys()
        before = self._specs()
        another = False
        for each, params in zip(self._each, self._new(asked), strict=True):
            another = another or type(params) is not type(each.params)
            each.params = params
        if another:
            self._declare_others(before)
        self._swap(self.params)

    def _declare_others(self, known: Mapping[str, Spec]) -> None:
        """Declare what another type has, instead of what the type before had."""
        now = self._specs()
        self._withdraw(known.keys() - now.keys())
        self._declare({n for n, spec in now.items() if n not in known or not known[n].alike(spec)})
        presets = []
        for axis, each in zip(self.axes, self._each, strict=True):
            if each.resolved.node.preset and type(each.params) is not type(each.resolved.params):
                node = dataclasses.replace(each.resolved.node, preset="")  # of the type before
                each.resolved = each.resolved._replace(node=node)
                presets.append("preset" if self.axes == (config.AXIS,) else f"{axis}.preset")
        self._withdraw(presets)
        with self._quietly():
            for name in presets:
                declare(self.node, name, specs(NodeParams)["preset"], "")

    def _withdraw(self, names: Iterable[str]) -> None:
        """Undeclare, also what is read-only, which rclpy has no call for."""
        for name in names:
            self.node._parameters.pop(name, None)
            self.node._descriptors.pop(name, None)

    def _declare(self, names: Collection[str]) -> None:
        """Declare parameters of the block anew, as they are."""
        values = self.values
        self._withdraw(names)
        with self._quietly():
            for name, spec in self._specs().items():
                if name in names:
                    declare(self.node, name, spec, values[name])

    @contextlib.contextmanager
    def _quietly(self) -> Iterator[None]:
        """Declare without a change of the block."""
        self._declaring = True
        try:
            yield
        finally:
            self._declaring = False
