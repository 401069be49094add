"""An experiment: one YAML file that says what the four blocks are and how long they run."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from pea_controller.model.common import following, limits, within
from pea_core import config
from pea_core.config import NODES, Resolved, Source
from pea_core.params import Choice, ParameterError, build, nearest
from pea_experiment import rig as rigs
from pea_experiment.checks import admit, of_one_scan, within_stroke
from pea_experiment.experiment import (
    SCHEMAS,
    SECTION,
    AnyExperiment,
    Experiment,
    ExperimentParams,
    MultiAxis,
)
from pea_experiment.switches import idle
from pea_plant import drivers
from pea_plant.model import hysteresis
from pea_plant.plant import Params as PlantParams

PARAMS = "params.yaml"
"""File beside a run that holds the resolved experiment: it runs again with ``pea run FILE``."""

HYSTERESIS: Choice = hysteresis.CHOICE
"""Types that stand for a plant where one is named by a word."""


def parse_set(
    texts: Sequence[str], options: Mapping[str, Any] | None = None
) -> dict[str, dict[str, Any]]:
    """Values of ``--set NODE.PARAM=VALUE``; ``T_s=`` and ``axes=VALUE`` count for all nodes.

    Of two for one parameter the later counts.

    Parameters
    ----------
    texts : sequence of str
    options : mapping, optional
        Other options that set a parameter: the option's name to (node, parameter, value).

    Raises
    ------
    ParameterError
        Not of that form, no such node, or another value than that of an option.
    """
    values: dict[str, dict[str, Any]] = {SECTION: {}, **{node: {} for node in NODES}}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise ParameterError(f"--set {text!r}: write NODE.PARAM=VALUE")
        parsed = config.parse(value)
        node, dot, rest = name.strip().partition(".")
        if name.strip() in ("T_s", "axes"):
            for each in NODES:
                values[each][name.strip()] = parsed
        elif not dot or node not in values:
            raise ParameterError(
                f"--set {text!r}: unknown node {node!r}: {nearest(node, values)}"
                if dot
                else f"--set {text!r}: write NODE.PARAM=VALUE, NODE one of {', '.join(NODES)}"
            )
        else:
            values[node][rest] = parsed
    for option, (node, name, value) in (options or {}).items():
        if not _same(values[node].setdefault(name, value), value):
            raise ParameterError(
                f"{option} {value:g} and --set {node}.{name}={values[node][name]}: two values for "
                "one parameter; give one of them"
            )
    return values


def _same(one: Any, other: Any) -> bool:
    """Whether two values that somebody has typed are the same value."""
    try:
        return float(one) == float(other)
    except (TypeError, ValueError, OverflowError):
        return type(one) is type(other) and bool(one == other)


def load(
    name: str,
    sets: Sequence[str] = (),
    duration: float | None = None,
    seed: float | None = None,
    others: Mapping[str, str] | None = None,
    rig: str | None = None,
) -> Experiment:
    """Read an experiment of one axis, see `load_axes`.

    Raises
    ------
    ParameterError
        As `load_axes`; it has several axes.
    """
    found = load_axes(name, sets, duration, seed, others, rig)
    if isinstance(found, Experiment):
        return found
    raise ParameterError(
        f"{name}: has the axes {', '.join(found.axes)}, and this takes one: write "
        f"{name}@{found.axes[0]}"
    )


def shortened(experiment: AnyExperiment, samples: int) -> AnyExperiment:
    """The same experiment of so many samples, as where a run was interrupted."""
    about = dataclasses.replace(experiment.about, duration=samples * experiment.T_s)
    each = tuple(dataclasses.replace(one, about=about) for one in experiment.each)
    return each[0] if len(each) == 1 else MultiAxis(each)


def alone(experiment: Experiment) -> Experiment:
    """One axis of several as an experiment of its own."""
    axes = (experiment.axis,)
    nodes = {
        node: resolved._replace(
            node=dataclasses.replace(resolved.node, axes=axes),
            values={**resolved.values, "axes": axes},
        )
        for node, resolved in experiment.nodes.items()
    }
    return dataclasses.replace(experiment, nodes=nodes)


def elsewhere(axes: Sequence[str], axis: str, sets: Sequence[str]) -> dict[str, str]:
    """Those of `sets` that say nothing of one axis alone, and what each is of instead."""
    found = {}
    for text in sets:
        name = text.partition("=")[0].partition(".")[2]
        head = name.partition(".")[0]
        if head in axes and head != axis:
            found[text] = f"the axis {head}"
        elif name.startswith(config.STAGE):
            found[text] = "all axes together"
    return found


def one_of(experiment: AnyExperiment, axis: str, sets: Sequence[str]) -> Experiment:
    """One axis of several as an experiment of its own, which `sets` were laid over.

    Raises
    ------
    ParameterError
        One of `sets` would not be in force: it is of another axis of the file, or couples them.
    """
    if not any(text.startswith("axes=") for text in sets):  # else they describe all axes
        for text, of in elsewhere(experiment.axes, axis, sets).items():
            raise ParameterError(
                f"--set {text}: is of {of}, and this is the axis {axis} alone; omit it"
            )
    return alone(experiment.each[experiment.axes.index(axis)])


def load_axes(
    name: str,
    sets: Sequence[str] = (),
    duration: float | None = None,
    seed: float | None = None,
    others: Mapping[str, str] | None = None,
    rig: str | None = None,
    untold: Collection[str] = (),
) -> AnyExperiment:
    """Read an experiment of any number of axes, or one axis of it: ``NAME@AXIS``.

    Parameters
    ----------
    name : str
        Name in ``config/experiments/``, or path of a file; @ and the name of an axis may follow.
    sets, duration, seed, others, rig, untold
        What is laid over it, see `_load`.

    Raises
    ------
    ParameterError
        As `_load`; it has no such axis.
    """
    file, at, axis = name.rpartition("@")
    if not at or Path(name).exists():
        file, axis = name, ""
    found = _load(file, sets, duration, seed, others, rig, untold)
    if not axis:
        return found
    if axis not in found.axes:
        known = nearest(axis, found.axes, f"{file}@")
        raise ParameterError(f"{name!r}: {file} has no axis {axis!r}: {known}")
    return one_of(found, axis, sets)


def _load(
    name: str,
    sets: Sequence[str] = (),
    duration: float | None = None,
    seed: float | None = None,
    others: Mapping[str, str] | None = None,
    rig: str | None = None,
    untold: Collection[str] = (),
) -> AnyExperiment:
    """Read an experiment, lay the command line over it, and check all of it.

    Parameters
    ----------
    name : str
        Name in ``config/experiments/``, or path of a file.
    sets : sequence of str
        ``NODE.PARAM=VALUE`` each.
    duration : float, optional
        Replaces the experiment's duration (s).
    seed : float, optional
        Replaces the plant's seed.
    others : mapping of str to str, optional
        Presets or types to take in place of what the experiment says of a node, see `exchanged`.
    rig : str, optional
        Name in ``config/rigs/``, or path of a file. Plant, observer and controller that it
        describes replace those of the experiment whole; its sample period counts for all nodes.
    untold : collection of str, optional
        Nodes that the file says nothing of, since they were not ours and do not run again. Their
        sample period is that of the others; nothing is checked against them.

    Raises
    ------
    ParameterError
        Anything unknown, out of range, or that does not go together.
    """
    each = _resolved(name, sets, duration, seed, others, rig, untold)
    for experiment in each:
        _check(experiment, untold)
    if len(each) == 1:
        return each[0]
    found = MultiAxis(each)
    _check_together(found)
    return found


def _resolved(
    name: str,
    sets: Sequence[str] = (),
    duration: float | None = None,
    seed: float | None = None,
    others: Mapping[str, str] | None = None,
    rig: str | None = None,
    untold: Collection[str] = (),
) -> tuple[Experiment, ...]:
    """Each axis of an experiment, every value of it checked for itself, see `_load`."""
    path = config.find("experiments", name, "experiment")
    file = config.read(path, (SECTION, *NODES))
    options = {
        "--duration": (SECTION, "duration", duration),
        "--seed": ("plant", "seed", seed),
    }
    command = parse_set(sets, {n: o for n, o in options.items() if o[2] is not None})
    about = build(ExperimentParams, {**file[SECTION], **command[SECTION]}, f"{SECTION}.")
    of_file = {node: Source(config.absolute(file[node], path.parent), str(path)) for node in NODES}
    if untold:
        period = next(of_file[node].values["T_s"] for node in NODES if node not in untold)
        of_file |= {node: Source({"T_s": period}, "another node") for node in untold}
    sources = _sources(of_file, others or {}, rig, command)
    axes = _axes(sources)
    plants = config.resolve_axes("plant", PlantParams, sources["plant"])
    resolved = {"plant": plants}
    following_plant = config.flat(axes, [following(plant.values) for plant in plants])
    sources["controller"].insert(0, Source(following_plant, "the plant"))
    for node in NODES[1:]:
        resolved[node] = config.resolve_axes(node, SCHEMAS[node], sources[node])
    each = []
    for i, axis in enumerate(axes):
        nodes = {node: resolved[node][i] for node in NODES}
        typed = {node: _typed(command[node], axis) for node in NODES}
        told = [_begun(node, nodes[node]) for node in NODES[1:3] if _alone(typed[node])]
        for node in NODES:
            told += idle(node, typed[node], nodes[node].values)
        each.append(Experiment(about.name or path.stem, about, nodes, tuple(told), axis))
    return tuple(each)


def _sources(
    of_file: Mapping[str, Source],
    others: Mapping[str, str],
    rig: str | None,
    command: Mapping[str, Mapping[str, Any]],
) -> dict[str, list[Source]]:
    """Values of each node from each place; a later source overrides those before it."""
    sources = {node: [source] for node, source in of_file.items()}
    for node, choice in others.items():
        if given := sorted({"preset", "type"} & command[node].keys()):
            raise ParameterError(
                f"--set {node}.{given[0]}={command[node][given[0]]}: the command line asks for "
                f"{node} {choice!r} too; give one of them"
            )
        wanted = exchanged(node, choice)
        sources[node].append(Source(wanted, "the command line", anew=True, typed=True))
    if rig:
        place = rigs.path_of(rig).parent
        for node, values in rigs.read(rig).items():
            if node in NODES:
                if node != "reference" and values.keys() - {"T_s"}:
                    sources[node].clear()  # a rig is another stage: it describes a node whole
                sources[node].append(Source(config.absolute(values, place), f"rig {rig}"))
    for node in NODES:
        typed = config.absolute(command[node])
        sources[node].append(Source(typed, "the command line", typed=True))
    return sources


def _axes(sources: dict[str, list[Source]]) -> tuple[str, ...]:
    """Axes of an experiment; a node whose source names none has those of the plant.

    Raises
    ------
    ParameterError
        Two nodes have other axes.
    """
    axes = config.axes_of("plant", sources["plant"])
    for node in NODES[1:]:
        sources[node].insert(0, Source({"axes": axes}, "the plant"))
        own = config.axes_of(node, sources[node])
        if own != axes:
            raise ParameterError(
                f"{node}.axes = {list(own)}: differs from plant.axes = {list(axes)}; set it for "
                "all nodes with --set axes=VALUE"
            )
    return axes


def _check_together(experiment: MultiAxis) -> None:
    """Check what concerns more than one axis: the plant designs, or says why it cannot."""
    drivers.together(experiment.axes, [one.nodes["plant"].params for one in experiment.each])
    experiment.plant()
    of_one_scan(experiment.each)


def _typed(typed: Mapping[str, Any], axis: str) -> dict[str, Any]:
    """What somebody has typed of a node, as one axis sees it."""
    prefix = f"{axis}."
    own = {n.removeprefix(prefix): v for n, v in typed.items() if n.startswith(prefix)}
    return {**typed, **own}


def _alone(typed: Mapping[str, Any]) -> bool:
    """Whether somebody has typed a type and no preset."""
    return "type" in typed and "preset" not in typed


def _begun(node: str, found: Resolved) -> str:
    """Where a type that was typed alone begins."""
    kind, preset = found.values["type"], found.node.preset
    begins = f"begins at its preset {preset}" if preset else "has no preset: it begins at defaults"
    return f"{node}: type {kind} {begins}"


def exchanged(node: str, choice: str) -> dict[str, Any]:
    """Values that choose another preset or type of a node; of a plant, of its hysteresis.

    Raises
    ------
    ParameterError
        Neither a preset nor a type.
    """
    kinds: Choice = HYSTERESIS if node == "plant" else SCHEMAS[node]  # type: ignore[assignment]
    known = presets(node)
    if choice in known or choice.endswith((".yaml", ".yml")):
        return {"preset": choice}
    if choice in kinds.kinds:
        return {"hysteresis.type" if node == "plant" else "type": choice}
    advice = nearest(choice, {*known, *kinds.kinds})
    raise ParameterError(f"unknown {node} {choice!r}: {advice}")


def _check(experiment: Experiment, untold: Collection[str]) -> None:
    """Check what concerns more than one node, of those that are told."""
    nodes = experiment.nodes
    plant = nodes["plant"].params
    for node in NODES:
        if nodes[node].node.T_ns != experiment.T_ns:
            raise ParameterError(
                f"{node}.T_s = {nodes[node].node.T_s:g}: differs from plant.T_s = "
                f"{nodes['plant'].node.T_s:g}; set it for all nodes with --set T_s=VALUE"
            )
    if experiment.samples < 1:
        raise ParameterError(
            f"{SECTION}.duration = {experiment.about.duration:g}: must be at least one sample, "
            f"{experiment.T_s:g} s"
        )
    if "plant" not in untold:
        try:
            within(nodes["controller"].params, limits(nodes["plant"].values))
        except ParameterError as error:
            raise ParameterError(f"controller.{error}") from None
        admit(experiment)
    loop = experiment.loop()  # every block designs, or says why it cannot
    inject = nodes["controller"].params.inject
    beyond = inject.amplitude_um * 1e-6 if inject.where == "reference" else 0.0
    if not {"plant", "reference"} & {*untold}:
        within_stroke(loop.reference, experiment.samples, plant, beyond)


def names() -> dict[str, str]:
    """Every experiment in ``config/experiments/``, and those of a lab's packages.

    With its description, or with the reason why its file cannot be used.
    """

    def description(name: str, path: Path) -> str:
        return _resolved(str(path))[0].about.description

    return config.described("experiments", description)


def presets(node: str) -> list[str]:
    """Names of a node's presets in ``config/``."""
    return sorted(config.files(config.FOLDERS.get(node, node)))
