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
    check_sections,
    node_specs,
    resolve,
    without_ros,
)
from pea_core.params import ParameterError, Schema, Spec, build, flatten, specs
from pea_ros.context import given

FOREIGN = ("use_sim_time", "start_type_description_service", "qos_overrides.")
"""Parameters that rclpy itself declares."""

SLIDER_MAX = 2**31 - 1
"""Largest end of a range that rqt_reconfigure can draw; it opens no node with a larger one."""


def overrides(node: Node) -> dict[str, Any]:
    """Values given on the command line or in parameter files, before anything is declared.

    What a file says of other nodes is theirs; what no node would take is refused. The node must
    have been made with ``automatically_declare_parameters_from_overrides``.

    Raises
    ------
    ParameterError
        A value would not be in force, or not mean the same everywhere.
    """
    name, files, typed = node.get_fully_qualified_name(), given.files, given.values
    namespace = node.get_namespace().rstrip("/")
    for path, found in files.items():
        check_sections(path, found, SECTIONS, namespace)
    values = parameter_file.values_of(parameter_file.merged(files), name)
    for section, parameter, value in typed:
        if not parameter_file.matches(section, name):
            raise ParameterError(
                f"-p {section}:{parameter}: is of /{section}, not of {name}; leave {section}: out"
            )
        values[parameter] = value
    return without_ros(values)


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


class BlockParameters:
    """Parameters of one node, kept equal to a block's dataclass.

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
        self.resolved: Resolved = resolve(role, schema, given, self.namespace)
        self.params = self.resolved.params
        self._try: Callable[[Any], None] = lambda params: None
        self._swap: Callable[[Any], None] = lambda params: None
        self._declaring = False
        values = self.resolved.values
        for name, spec in node_specs(schema, values).items():
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

    def adopt(self, values: dict[str, object]) -> None:
        """Set values that a neighbour knows better than the defaults.

        Raises
        ------
        ParameterError
            They break a rule.
        """
        names = {name for name, value in values.items() if self.values[name] != value}
        if names:
            params = build(self.schema, {**self.values, **values})
            self._try(params)
            self.params = params
            self._declare(names)  # anew: what is fixed while the loop runs is read-only
            self._swap(params)

    @property
    def values(self) -> dict[str, Any]:
        """The block's parameters by dotted name."""
        return flatten(self.schema, self.params)

    @property
    def all(self) -> dict[str, Any]:
        """The block's parameters and the node's own, by dotted name."""
        return {**flatten(NodeParams, self.resolved.node), **self.values}

    @property
    def changed_by(self) -> str:
        """Who has changed parameters last, as far as they say."""
        return str(self.node.get_parameter("changed_by").value)

    def _new(self, parameters: list[Parameter]) -> Any:
        values = {
            p.name: p.value
            for p in parameters
            if not p.name.startswith(FOREIGN) and p.name not in specs(NodeParams)
        }
        if not values:
            return None
        values = {
            name: tuple(value) if hasattr(value, "tolist") or isinstance(value, list) else value
            for name, value in values.items()
        }
        return changed(self.schema, self.params, self._named(values))

    def _named(self, values: dict[str, object]) -> dict[str, Any]:
        """The values, and those of the preset that another type comes with."""
        if values.get("type") == self.values.get("type"):
            return values
        return {**config.begun(self.role, self.schema, values, self.namespace), **values}

    def _complete(self, parameters: list[Parameter]) -> list[Parameter]:
        """Add to another ``type`` the values that change with it, so that all are told at once."""
        if self._declaring:
            return parameters
        try:
            params = self._new(parameters)
        except ParameterError:  # `_check` refuses it
            return parameters
        if params is None or type(params) is type(self.params):
            return parameters
        before, now = self.values, flatten(self.schema, params)
        known, new = specs(self.schema, before), specs(self.schema, now)
        given = {parameter.name for parameter in parameters}
        return parameters + [
            Parameter(name, value=ros_value(value))
            for name, value in now.items()
            if name in known.keys() - given
            and not known[name].fixed
            and (value != before[name] or not (known[name].common or value == new[name].default))
        ]

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        if self._declaring:
            return SetParametersResult(successful=True)
        try:
            without_ros({p.name: p.value for p in parameters if p.name.startswith(FOREIGN)})
            params = self._new(parameters)
            if params is not None:
                self._try(params)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, parameters: list[Parameter]) -> None:
        if self._declaring:
            return
        params = self._new(parameters)
        if params is not None:
            before = self.values
            another = type(params) is not type(self.params)
            self.params = params
            if another:
                self._declare_others(before)
            self._swap(params)

    def _declare_others(self, before: dict[str, object]) -> None:
        """Declare what another type has, instead of what the type before had."""
        known, now = specs(self.schema, before), specs(self.schema, self.values)
        self._withdraw(known.keys() - now.keys())
        self._declare({n for n, spec in now.items() if n not in known or not known[n].alike(spec)})
        if self.resolved.node.preset:  # it was of the type before
            node = dataclasses.replace(self.resolved.node, preset="")
            self.resolved = self.resolved._replace(node=node)
            self._withdraw(["preset"])
            with self._quietly():
                declare(self.node, "preset", specs(NodeParams)["preset"], "")

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
            for name, spec in specs(self.schema, values).items():
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
