"""Configuration files: ROS 2 parameter files, presets, and how sources of values add up.

One file serves both ways: ``ros2 run … --params-file FILE`` and ``pea run``. Values come from
sources, the weaker first: defaults, experiment, rig, command line. A source that names a preset
gives the preset's values and, over them, its own. So a preset on the command line replaces the
type and the gains of the experiment, and a preset in the experiment replaces neither a value
beside it nor one on the command line.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from pea_core import parameter_file
from pea_core.axes import AXES_MAX
from pea_core.params import (
    Choice,
    ParameterError,
    Schema,
    Spec,
    Text,
    Values,
    build,
    flatten,
    layer,
    nearest,
    param,
    specs,
)
from pea_core.paths import given
from pea_core.registry import points
from pea_core.units import NS, SECOND

NODES = ("plant", "observer", "controller", "reference")
"""The four blocks, in the order of the diagram."""

SECTIONS = (*NODES, "recorder", "experiment", "rig", "emulator")
"""What the sections of our files may be of, in a namespace."""

MODES = BATCH, COMPOSED, DISTRIBUTED = ("batch", "composed", "distributed")
"""How an experiment runs: see `pea_run.modes`."""

CLOCKS = UNPACED, WALL = ("unpaced", "wall")
"""What a mode keeps time by: nothing, or wall time."""

NAMESPACE = "/pea"
"""Namespace of the nodes where nobody gives another."""

DUMPED = "start_type_description_service"
"""Parameter that every node has and nobody sets: what holds it is a dump of a running node."""

ROS = ("use_sim_time", DUMPED)
"""Parameters that every ROS node has; what they say by default changes nothing here."""

PACED = ("clock",)
"""Parameters of a plant's process in wall time, which a dump of it holds: a run has ``--clock``."""

BLOCKS = "pea.blocks"
"""Entry point group in which each package of a block names the parameters of its block."""

FOLDERS = {"plant": "plants", "observer": "observers", "controller": "controllers"}
"""Folder of ``config/`` that holds the presets of a node."""


AXIS = "x"
"""Name of the axis where there is one and nobody names it."""

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
"""What an axis may be called."""


@dataclass(frozen=True)
class NodeParams:
    """What every node has besides its block's own parameters."""

    T_s: float = param(50e-6, "s", 1e-9, 10.0, help="sample period, whole ns", fixed=True)
    axes: tuple[str, ...] = param((AXIS,), help="names of the axes, 1 to 6", fixed=True)
    preset: str = param("", help="named set of values from config/, or a file", fixed=True)
    changed_by: str = param("", help="who changed parameters last: set it together with them")

    @property
    def T_ns(self) -> int:
        """Sample period in nanoseconds."""
        return round(self.T_s * SECOND)

    def __post_init__(self) -> None:
        if abs(self.T_s * SECOND - self.T_ns) > 1e-3 or self.T_ns < 1:
            raise ParameterError(
                f"T_s = {self.T_s!r}: must be a whole number of nanoseconds, nearest "
                f"{max(self.T_ns, 1) * NS:.9g}"
            )
        said = f"axes = {list(self.axes)}"
        if not 1 <= len(self.axes) <= AXES_MAX:
            raise ParameterError(f"{said}: give 1 to {AXES_MAX} names")
        if twice := [name for name in self.axes if self.axes.count(name) > 1]:
            raise ParameterError(f"{said}: {twice[0]!r} is named twice; give each axis once")
        if wrong := [name for name in self.axes if not NAME.fullmatch(name)]:
            raise ParameterError(
                f"{said}: {wrong[0]!r} is no name; write a letter, then letters, digits and _"
            )


class Resolved(NamedTuple):
    """Everything one node needs.

    Attributes
    ----------
    node : NodeParams
        Sample period and preset.
    params : dataclass
        The block's parameters.
    values : Values
        All of them by dotted name, as written to YAML and declared in ROS.
    given : frozenset of str
        Names whose values come from a source, not from a default.
    """

    node: NodeParams
    params: Any
    values: Values
    given: frozenset[str] = frozenset()

    @property
    def T_s(self) -> float:
        """Sample period (s)."""
        return self.node.T_ns * NS


def parse(text: str) -> bool | str | list[Any]:
    """Value of what somebody has typed, as after ``--set name=``: a text, or a list of them.

    Of which type it is, its parameter says; true and false are no text without quotes.
    """
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    if text[:1] not in ("[", "'", '"'):
        return Text(text)
    try:
        found = yaml.load(text, yaml.BaseLoader)
    except (yaml.YAMLError, ValueError, RecursionError):
        return Text(text)
    if isinstance(found, list):
        return [Text(item) if isinstance(item, str) else item for item in found]
    return found if isinstance(found, str) else Text(text)


def config_dir() -> Path:
    """``config/`` folder: the installed one, or that of the sources where it is linked to them.

    There a new file is found as soon as it is written.
    """
    with suppress(ImportError, LookupError):
        from ament_index_python.packages import get_package_share_directory

        there = Path(get_package_share_directory("pea_bringup")) / "config"
        return (there / "fastdds.xml").resolve().parent
    beside = find_spec("pea_bringup")  # installed by pip, without a ROS workspace
    for folder in beside.submodule_search_locations or () if beside is not None else ():
        if (there := Path(folder) / "config").is_dir():
            return there
    raise ParameterError("config/ not found: run `make setup`, or source install/setup.bash")


def files(folder: str) -> dict[str, Path]:
    """Files of a folder of ``config/`` by name, then those that a lab's packages install.

    A package names itself in the entry point group ``pea.config``; it holds ``experiments/``,
    ``rigs/``, ``plants/`` and so on, as ``config/`` does. Of two files of one name this is the
    first, and `find` refuses it.
    """
    return {name: paths[0] for name, paths in _all_files(folder).items()}


def _all_files(folder: str) -> dict[str, list[Path]]:
    """Every file of each name, ours first."""
    places = [config_dir()]
    for point in points().select(group="pea.config"):
        with suppress(ImportError, ValueError):
            spec = find_spec(point.value)
            places += [Path(place) for place in (spec and spec.submodule_search_locations) or ()]
    found: dict[str, list[Path]] = {}
    for place in places:
        for path in sorted((place / folder).glob("*.yaml")):
            if path.exists():  # an installed link may lead to what was renamed
                same = found.setdefault(path.stem, [])
                if not any(path.samefile(other) for other in same):
                    same.append(path)
    return found


def described(folder: str, description: Callable[[str, Path], str]) -> dict[str, str]:
    """Names of a folder's files with a description, or with the reason why one cannot be used."""
    found = {}
    for name, paths in sorted(_all_files(folder).items()):
        try:
            found[name] = description(name, _only(paths, folder.removesuffix("s"), name))
        except ParameterError as error:
            found[name] = f"cannot be used: {error}"
    return found


def find(folder: str, name: str, what: str) -> Path:
    """Path of a named file in a folder of ``config/``, or of a file given by its path.

    Raises
    ------
    ParameterError
        There is none, and the text lists the nearest names; or a lab's package has one, too.
    """
    if name.endswith((".yaml", ".yml")):
        path = given(name, what)
        if path.is_file():
            return path
        raise ParameterError(f"{what} {name!r}: no such file")
    there = _all_files(folder)
    if name not in there:
        raise ParameterError(f"unknown {what} {name!r}: {nearest(name, there)}")
    return _only(there[name], what, name)


def _only(paths: Sequence[Path], what: str, name: str) -> Path:
    """The path of a name, where it has one alone."""
    first, *others = paths
    if others:
        raise ParameterError(
            f"{what} {name!r}: may be {first} or {others[0]}; rename the one that is yours, or "
            "give the whole path"
        )
    return first


def read(path: Path, nodes: Sequence[str], namespace: str = NAMESPACE) -> dict[str, dict[str, Any]]:
    """Values of each node in a ROS 2 parameter file.

    Parameters
    ----------
    path : Path
        File with sections that name nodes as ROS has it: ``/pea/plant``, ``/**/plant``, ``/**``.
    nodes : sequence of str
        Nodes that may appear, of `namespace`.
    namespace : str
        Where they are.

    Raises
    ------
    ParameterError
        Not YAML, not of that form, or with a section that counts for none of them.
    """
    found = parameter_file.sections(path)
    check_sections(path, found, nodes, namespace)
    return {node: _values(path, found, node, namespace) for node in nodes}


def _values(
    path: Path, found: Mapping[str, Mapping[str, object]], node: str, namespace: str
) -> dict[str, Any]:
    """Values of a node; what is no node, a run for example, must be named."""
    if node not in NODES:
        found = {section: values for section, values in found.items() if section[-1] != "*"}
    try:
        values = parameter_file.values_of(allotted(found, node)[0], f"{namespace}/{node}")
        dumped = DUMPED in values
        return {n: v for n, v in without_ros(values).items() if not (dumped and n in PACED)}
    except ParameterError as error:
        raise ParameterError(f"{path}: {node}.{error}") from None


def allotted(
    found: Mapping[str, Mapping[str, object]], node: str, own: Collection[str] = ()
) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
    """Sections as they count for one node: of those for all nodes, what its block has.

    Parameters
    ----------
    found : mapping
        Sections of a file.
    node : str
    own : collection of str
        Parameters of a node that is no block.

    Returns
    -------
    dict
        The sections; a name that no block has is left in them, for the node to refuse.
    dict
        Names that were left out, and the node that has each.
    """
    sections = {section: dict(values) for section, values in found.items()}
    others: dict[str, str] = {}
    for section, values in sections.items():
        if section[-1] == "*":
            for name in [*values]:
                having = _having(name)
                if having and node not in having and name not in own:
                    others[name] = having[0]
                    del values[name]
    return sections, others


def without_ros(values: Mapping[str, object]) -> dict[str, Any]:
    """Values without those that every ROS node has.

    Raises
    ------
    ParameterError
        One would not be in force.
    """
    if values.get("use_sim_time", False) is not False:
        raise ParameterError(
            "use_sim_time = true: loop time is counted in samples on every clock; omit it"
        )
    if alien := [name for name in values if name.startswith("qos_overrides.")]:
        raise ParameterError(f"{alien[0]}: the QoS of a topic is fixed, see docs/topics.md")
    dumped = DUMPED in values  # all values stand there: where they came from says nothing more
    left = (*ROS, "preset", "changed_by") if dumped else ROS
    return {name: value for name, value in values.items() if name not in left}


def spaced(text: str, name: str) -> str:
    """A namespace as ROS has it; `name` is what was given.

    Raises
    ------
    ParameterError
        It is none.
    """
    if not re.fullmatch(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", text, re.ASCII):
        raise ParameterError(f"{name} {text!r}: write names with / between, as /stage1")
    return "/" + text.strip("/")


def check_sections(
    path: Path, found: Iterable[str], nodes: Sequence[str], namespace: str = NAMESPACE
) -> None:
    """Refuse a file with a section that no node takes, where it was meant for one.

    Sections of other namespaces are of others, unless the file names no node of that name here.

    Raises
    ------
    ParameterError
        It is named, with what to write.
    """
    known = [*nodes, *(node for node in NODES if node not in nodes)]
    matches = parameter_file.matches
    taken = {n for n in known if any(matches(section, f"{namespace}/{n}") for section in found)}
    by_name = [section for section in found if section[-1] != "*"]
    named = {n for n in known if any(matches(section, f"{namespace}/{n}") for section in by_name)}
    for section in found:
        if any(matches(section, f"{namespace}/{node}") for node in known):
            continue
        space, _, last = f"/{section.removeprefix('/')}".rpartition("/")
        if last in known and last not in named:
            raise ParameterError(
                f"{path}: {section}: is {space}/{last} to ROS, not {namespace}/{last}: write "
                f"{namespace}/{last}:, or /**/{last}: for every namespace"
            )
        if matches(f"{space}/*", f"{namespace}/x"):
            raise ParameterError(f"{path}: unknown node {section!r}: {nearest(last, known)}")
    if not taken:
        raise ParameterError(f"{path}: has no section for a node of {namespace}")


def preset_values(node: str, name: str, namespace: str = NAMESPACE) -> dict[str, Any]:
    """Values that a preset gives to a node.

    Raises
    ------
    ParameterError
        No such preset, or one of another node.
    """
    path = find(FOLDERS.get(node, node), name, f"{node}.preset")
    values = absolute(read(path, NODES, namespace)[node], path.parent)
    if not values:
        raise ParameterError(
            f"{node}.preset = {name!r}: {path} has no section for {namespace}/{node}"
        )
    if inner := values.get("preset"):  # as in a dump of what runs: its values are written beside it
        under = read(find(FOLDERS.get(node, node), inner, f"{node}.preset"), NODES, namespace)[node]
        if under.get("preset"):
            raise ParameterError(
                f"{node}.preset = {name!r}: {path} names {inner!r}, which names a preset itself; "
                "write out its values"
            )
        types = [each["type"] for each in (values, under) if "type" in each]
        if len(set(types)) > 1:
            raise ParameterError(
                f"{node}.preset = {name!r}: {path} names type {types[0]!r} and preset {inner!r}, "
                f"which is of type {types[1]!r}; give one of them"
            )
        values = {**under, **values}
    return {name: value for name, value in values.items() if name not in ("preset", "changed_by")}


def own_preset(schema: Schema, values: Mapping[str, object]) -> str:
    """Preset that the ``type`` in `values` comes with where somebody types it without a preset.

    The ``Params`` of a type name it, as ``PRESET``. Empty where there is none, or where every value
    is given beside it.
    """
    if not isinstance(schema, Choice) or "type" not in values or "preset" in values:
        return ""
    kind = schema.kinds.get(str(values["type"]))
    if kind is None or specs(schema, values).keys() <= values.keys():
        return ""
    return str(vars(kind).get("PRESET", ""))


def begun(
    node: str, schema: Schema, values: Mapping[str, object], namespace: str = NAMESPACE
) -> dict[str, Any]:
    """Block values of the preset that a named ``type`` comes with; empty where there is none.

    Raises
    ------
    ParameterError
        There is no such preset any more.
    """
    preset = own_preset(schema, values)
    return dict(_of_preset(node, preset, namespace)) if preset else {}


@cache
def _of_preset(node: str, preset: str, namespace: str) -> dict[str, Any]:
    return split(preset_values(node, preset, namespace))[1]


class Source(NamedTuple):
    """Values of one node from one place.

    Attributes
    ----------
    values : mapping
        Dotted names and values.
    name : str
        The place as an error names it: a file, "the command line".
    anew : bool
        A ``type`` begins anew, also one that is chosen already with values of its own.
    typed : bool
        Somebody types it: a ``type`` without a preset comes with its own, see `own_preset`.
    """

    values: Mapping[str, Any]
    name: str = ""
    anew: bool = False
    typed: bool = False


def resolve(
    node: str,
    schema: Schema,
    sources: Sequence[Source | Mapping[str, object]],
    namespace: str = NAMESPACE,
    axes: Sequence[str] = (AXIS,),
    axis: str = AXIS,
) -> Resolved:
    """Add up the sources of one node, or of one of its axes, and check the result.

    Parameters
    ----------
    node : str
        One of `NODES`.
    axes, axis : sequence of str, str
        Axes of the node, and the one that it is about; see `resolve_axes`.
    schema : type or Choice
        Parameters of the block.
    sources : sequence of Source or mapping
        The weaker first.
    namespace : str
        Where the node is.

    Raises
    ------
    ParameterError
        Unknown names, wrong types, values out of range or that do not go together; a preset and
        a type from one source that differ.
    """
    several = tuple(axes) != (AXIS,)
    where = f"{node}.{axis}." if several else f"{node}."
    shell: dict[str, Any] = {}
    merged: dict[str, Any] = {}
    single: dict[str, Any] = {}  # what sources give one by one, not in a preset
    bundled: set[str] = set()  # what the preset in force gives, and nobody one by one
    preset = kind = ""
    for each in sources:
        source = each if isinstance(each, Source) else Source(each)
        own, block = split(source.values)
        implied = own_preset(schema, source.values) if source.typed else ""
        if "preset" in own:
            preset = build(NodeParams, own, where).preset
        if implied or (preset and "preset" in own):
            preset = implied or preset
            of_preset = preset_values(node, preset, namespace)
            if several:
                common, own_part = seen_by(node, of_preset, axes, axis)
                of_preset = {**common, **own_part}
            given, found = split(of_preset)
            if not implied:
                _agree(node, schema, preset, found, source)
                merged = {n: v for n, v in merged.items() if n not in bundled}
                shell = {n: v for n, v in shell.items() if n not in bundled}
            same = implied and not source.anew and block["type"] == _type(schema, merged)
            stay = single if same else {}
            found = {**{n: v for n, v in block.items() if n == "type"}, **found}
            merged = layer(schema, merged, found, where, anew=True) | stay
            single = {n: v for n, v in single.items() if n in merged and n not in found} | stay
            kind = merged.get("type", "")
            bundled = {*found, *given} - {"type"}  # a preset may leave the type to what is there
            shell.update(given)
        shell.update(own)
        bundled -= {*source.values}
        anew = source.anew and not implied
        merged = layer(schema, merged, block, where, anew)
        single = {n: v for n, v in {**single, **block}.items() if n in merged}
        if kind != merged.get("type", "") or (anew and "type" in block):
            preset = ""  # a type has replaced it
    params = build(schema, merged, where)
    node_params: NodeParams = build(NodeParams, {**shell, "preset": preset}, where)
    values = {**flatten(NodeParams, node_params), **flatten(schema, params)}
    return Resolved(node_params, params, values, frozenset(merged))


def axes_of(
    node: str, sources: Sequence[Source | Mapping[str, object]], namespace: str = NAMESPACE
) -> tuple[str, ...]:
    """Axes that the sources of a node name, the strongest of them.

    Raises
    ------
    ParameterError
        They are no names, too many, or named twice.
    """
    found: Any = (AXIS,)
    for each in sources:
        values = each.values if isinstance(each, Source) else each
        if values.get("preset"):
            preset = preset_values(node, str(values["preset"]), namespace)
            found = preset.get("axes", found)
        found = values.get("axes", found)
    params: NodeParams = build(NodeParams, {"axes": found}, f"{node}.")
    return params.axes


def resolve_axes(
    node: str,
    schema: Schema,
    sources: Sequence[Source | Mapping[str, object]],
    namespace: str = NAMESPACE,
) -> tuple[Resolved, ...]:
    """Add up the sources of each axis of a node, see `resolve`.

    Of what one source says, ``x.NAME`` counts for the axis x alone, and goes before ``NAME``,
    which counts for all.

    Raises
    ------
    ParameterError
        As `resolve`; an axis has the name of a parameter.
    """
    axes = axes_of(node, sources, namespace)
    if axes == (AXIS,):
        return (resolve(node, schema, sources, namespace),)
    taken = _heads(schema)
    if clash := [axis for axis in axes if axis in taken]:
        raise ParameterError(
            f"{node}.axes = {list(axes)}: {clash[0]!r} is a parameter of the {node}; give "
            "the axis another name"
        )
    for each in sources:
        _check_axes(node, each.values if isinstance(each, Source) else each, axes, taken)
    found = []
    for axis in axes:
        own = [part for each in sources for part in _of_axis(node, each, axes, axis)]
        found.append(resolve(node, schema, own, namespace, axes, axis))
    assert len({(r.node.T_s, r.node.axes) for r in found}) == 1
    return tuple(found)


def _heads(schema: Schema) -> set[str]:
    """What names of a node's parameters begin with, whatever its type."""
    kinds = schema.kinds if isinstance(schema, Choice) else ("",)
    names = {n for kind in kinds for n in specs(schema, {"type": kind} if kind else {})}
    return {name.partition(".")[0] for name in (*names, *specs(NodeParams))}


@cache
def _blocks() -> dict[str, frozenset[str]]:
    """The installed blocks, and what the names of their parameters begin with."""
    found = {p.name: _heads(p.load()) for p in points().select(group=BLOCKS)}
    return {
        node: frozenset(found[node] | ({*PACED} if node == "plant" else set()))
        for node in NODES
        if node in found
    }


def _having(name: str) -> list[str]:
    """Blocks that may have a parameter, whatever their types and axes."""
    blocks = _blocks()
    head, _, rest = name.partition(".")
    if rest and not any(head in heads for heads in blocks.values()):
        head = rest.partition(".")[0]  # after the name of an axis
    return [node for node, heads in blocks.items() if head in heads]


def _check_axes(
    node: str, values: Mapping[str, object], axes: Sequence[str], taken: Collection[str]
) -> None:
    """Refuse the name of an axis that is not there, and an axis without a parameter."""
    for name, value in values.items():
        head, dot, rest = str(name).partition(".")
        if name in axes:
            raise ParameterError(
                f"{node}.{name} = {value!r}: {name} is an axis; name a parameter of it, "
                f"{node}.{name}.NAME"
            )
        if dot and head not in axes and head not in taken and rest.partition(".")[0] in taken:
            known = ", ".join(f"{node}.{axis}.{rest}" for axis in axes)
            raise ParameterError(
                f"unknown parameter {node}.{name}: no axis {head!r}; give one of {known}"
            )


def _of_axis(
    node: str, each: Source | Mapping[str, object], axes: Sequence[str], axis: str
) -> list[Source]:
    """A source for one axis: its values for all axes, overridden by its values for this axis."""
    source = each if isinstance(each, Source) else Source(each)
    parts = seen_by(node, source.values, axes, axis)
    return [source._replace(values=values) for values in parts if values]


def seen_by(
    node: str, values: Mapping[str, Any], axes: Sequence[str], axis: str
) -> tuple[dict[str, Any], dict[str, Any]]:
    """What values of a node say of all axes, and what of one axis alone.

    Raises
    ------
    ParameterError
        A parameter that is one for all axes is given for one.
    """
    common, own = {}, {}
    for name, value in values.items():
        head, dot, rest = str(name).partition(".")
        if not dot or head not in axes:
            common[name] = value
        elif rest in SHARED:
            raise ParameterError(
                f"{node}.{name} = {value!r}: {rest} is one for all axes; give {node}.{rest}"
            )
        elif head == axis:
            own[rest] = value
    return common, own


SHARED = ("T_s", "axes", "changed_by")
"""Parameters of `NodeParams` that a node has once, whatever its axes."""

STAGE = "stage."
"""How the names of parameters begin that say what several axes share."""


def shared(name: str) -> bool:
    """Whether a node has a parameter once, whatever its axes."""
    return name in SHARED or name.startswith(STAGE)


def flat(axes: Sequence[str], each: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Values of a node from those of its axes: as they are for one axis, else ``x.NAME``."""
    if tuple(axes) == (AXIS,):
        return dict(each[0])
    found = {name: value for name, value in each[0].items() if shared(name)}
    for axis, values in zip(axes, each, strict=True):
        found |= {f"{axis}.{n}": v for n, v in values.items() if not shared(n)}
    return found


def own_of(axes: Sequence[str], axis: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Values of one axis from those of its node, the reverse of `flat`."""
    if tuple(axes) == (AXIS,):
        return dict(values)
    prefix = f"{axis}."
    common = {name: value for name, value in values.items() if shared(name)}
    own = {n.removeprefix(prefix): v for n, v in values.items() if n.startswith(prefix)}
    return {**common, **own}


def spread(axes: Sequence[str], values: Mapping[str, Any]) -> dict[str, Any]:
    """Values of a node in which a value for all axes stands once for each axis, see `flat`."""
    if tuple(axes) == (AXIS,):
        return dict(values)
    found = {}
    for name, value in values.items():
        if shared(name) or name.partition(".")[0] in axes:
            found[name] = value
        else:
            found |= {f"{axis}.{name}": value for axis in axes if f"{axis}.{name}" not in values}
    return found


def _type(schema: Schema, values: Mapping[str, object]) -> str:
    return str(values.get("type", schema.default)) if isinstance(schema, Choice) else ""


def split(values: Mapping[str, object]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Values of a node that are the node's own (`NodeParams`), and those of its block."""
    own = specs(NodeParams)
    return (
        {name: value for name, value in values.items() if name in own},
        {name: value for name, value in values.items() if name not in own},
    )


def replaced(node: str, schema: Schema, values: Mapping[str, object], name: str = "") -> Values:
    """Block values that a source puts in force where it is laid over a running node.

    Its own and its preset's; beside a preset also the defaults of whatever else belongs to the
    preset's type.

    Parameters
    ----------
    node : str
    schema : type or Choice
    values : mapping
        Of the source; may name a preset.
    name : str
        The source in errors.

    Raises
    ------
    ParameterError
        As `resolve`.
    """
    resolved = resolve(node, schema, [Source(values, name)])
    block = specs(schema, split(resolved.values)[1])
    anew = isinstance(schema, Choice) and bool(resolved.node.preset)
    return {
        n: resolved.values[n]
        for n, spec in block.items()
        if n in resolved.given or (anew and not spec.common)
    }


def _agree(
    node: str, schema: Schema, preset: str, found: Mapping[str, object], source: Source
) -> None:
    """Refuse a preset beside a type or a list of values that leaves nothing of it in force."""
    beside = source.values
    place = f", both from {source.name}" if source.name else ""
    types = [values["type"] for values in (beside, found) if "type" in values]
    if isinstance(schema, Choice) and len(set(types)) > 1:
        raise ParameterError(
            f"{node}.type = {str(types[0])!r} and {node}.preset = {preset!r}{place}: the preset "
            f"is of type {types[1]}; give one of them"
        )
    known = specs(schema, beside)
    if known.keys() <= beside.keys():
        for name in known.keys() & found.keys():
            given, value = (known[name].check(f"{node}.{name}", v[name]) for v in (found, beside))
            if given != value:
                raise ParameterError(
                    f"{node}.preset = {preset!r} gives {name} = {given!r}, and every parameter of "
                    f"{node} has a value beside it, {name} = {value!r}{place}: the preset would "
                    "have no effect; give one of them"
                )


PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".npy")
"""Endings by which a picture is told from a formula."""


def absolute(values: Mapping[str, object], folder: Path | None = None) -> dict[str, Any]:
    """Name files so that they are found from everywhere, and after runs/latest has moved on.

    Parameters
    ----------
    values : mapping
        Of a node.
    folder : Path, optional
        Directory of the file that the values come from: names begin there, or in the current one.

    Raises
    ------
    ParameterError
        Both have such a file, and they are not the same.
    """
    return {
        name: _located(name, str(value), folder) if _names_file(name, value) else value
        for name, value in values.items()
    }


def _names_file(name: str, value: object) -> bool:
    """Whether a value is the path of a file: a `path`, a preset that is no name, a picture."""
    last = name.rpartition(".")[2]
    if not isinstance(value, str) or not value:
        return False
    if last == "specimen":
        return value.lower().endswith(PICTURES)
    return last == "path" or (last == "preset" and value.endswith((".yaml", ".yml")))


def _located(name: str, value: str, folder: Path | None) -> str:
    here = given(value, name)
    there = here if folder is None else folder / here
    if there.exists() and here.exists() and not there.samefile(here):
        raise ParameterError(
            f"{name} = {value!r}: may be {here.resolve()} or {there.resolve()}; give the whole path"
        )
    return str((there if there.exists() else here).resolve())


def node_specs(schema: Schema, values: Mapping[str, object]) -> dict[str, Spec]:
    """Every parameter of a node: its own and its block's."""
    return {**specs(NodeParams), **specs(schema, split(values)[1])}


def specs_of_axes(schema: Schema, values: Mapping[str, Any]) -> dict[str, Spec]:
    """The same of a node with several axes, as `values` name them."""
    axes = tuple(values.get("axes") or (AXIS,))
    own = [{n: v for n, v in own_of(axes, a, values).items() if v is not None} for a in axes]
    return flat(axes, [node_specs(schema, each) for each in own])


class _Dumper(yaml.SafeDumper):
    """Writes YAML that ROS, too, reads as it was: what looks like something else is quoted."""


def _text(dumper: _Dumper, text: str) -> Any:
    # halves of a character that UTF-16 splits belong together; one alone stands in no file
    text = text.encode("utf-16", "surrogatepass").decode("utf-16", "replace")
    style = None if parameter_file.text_of(text) else "'"
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style)


_Dumper.add_representer(str, _text)
_Dumper.ignore_aliases = lambda self, data: True


def dump(sections: Mapping[str, Mapping[str, object]], namespace: str = NAMESPACE) -> str:
    """Text of a ROS 2 parameter file that reads back to the same bits."""
    tree: dict[str, Any] = {}
    for node, values in sections.items():
        body: dict[str, Any] = {}
        for name, value in values.items():
            *groups, last = name.split(".")
            inner = body
            for key in groups:
                inner = inner.setdefault(key, {})
            inner[last] = list(value) if isinstance(value, tuple) else value
        tree[f"{namespace}/{node}"] = {"ros__parameters": body}
    return yaml.dump(tree, Dumper=_Dumper, sort_keys=False, allow_unicode=True)


def write(
    path: Path, sections: Mapping[str, Mapping[str, object]], namespace: str = NAMESPACE
) -> None:
    """Write a ROS 2 parameter file that reads back to the same bits."""
    path.write_text(dump(sections, namespace), encoding="utf-8")
