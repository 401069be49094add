"""An experiment: one YAML file that says what the four blocks are and how long they run."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import numpy as np

from pea_controller import model as controller
from pea_controller.model.common import following, limits, within
from pea_core import config
from pea_core.axes import Several, laws, observers, references
from pea_core.block import Signal
from pea_core.config import AXIS, NODES, Resolved, Source
from pea_core.live import LAW, OBSERVER, Live
from pea_core.loop import Loop
from pea_core.nominal import NominalModel
from pea_core.params import Choice, ParameterError, Schema, build, nearest, param
from pea_core.units import SECOND
from pea_engine.compiled import CompiledLoop
from pea_experiment import rig as rigs
from pea_experiment.metrics import Move, Segment, metrics, of_round, transient
from pea_experiment.switches import idle
from pea_observer import model as observer
from pea_plant import drivers, specimen
from pea_plant.drivers.simulated import Simulated
from pea_plant.model import hysteresis
from pea_plant.model import load as loads
from pea_plant.model.actuator import steady_state_gain
from pea_plant.plant import Params as PlantParams
from pea_plant.stage import Stage
from pea_reference import model as reference
from pea_reference import shaped

B = TypeVar("B", Simulated, Live, Signal)

SCHEMAS: dict[str, Schema] = {
    "plant": PlantParams,
    "observer": observer.CHOICE,
    "controller": controller.CHOICE,
    "reference": reference.CHOICE,
}
"""Parameters of each node's block."""

SECTION = "experiment"
"""Section of the file that is of the experiment, not of a node."""

PARAMS = "params.yaml"
"""File beside a run that holds the resolved experiment: it runs again with ``pea run FILE``."""

HYSTERESIS: Choice = hysteresis.CHOICE
"""Types that stand for a plant where one is named by a word."""

LOOKS = 10_000
"""Samples at which a long reference is compared with the stroke."""


@dataclass(frozen=True)
class ExperimentParams:
    """What the experiment says besides its blocks."""

    name: str = param("", help="name of the experiment; else that of the file")
    description: str = param("", help="one line for people")
    figure: str = param("", help="figure of the paper")
    duration: float = param(1.0, "s", 0.0, 1e6, help="how long the loop runs")


@dataclass(frozen=True)
class Experiment:
    """Everything a run needs, checked.

    Attributes
    ----------
    name : str
        Name of the experiment.
    about : ExperimentParams
        Description, figure of the paper, duration (s).
    nodes : dict of str to Resolved
        Parameters of each of `NODES`.
    told : tuple of str
        Where each type that was typed alone begins, and what was typed and has no effect.
    axis : str
        Name of the axis.
    """

    name: str
    about: ExperimentParams
    nodes: dict[str, Resolved]
    told: tuple[str, ...] = ()
    axis: str = AXIS

    @property
    def axes(self) -> tuple[str, ...]:
        """Name of its axis, as `MultiAxis` has several."""
        return (self.axis,)

    @property
    def each(self) -> tuple[Experiment, ...]:
        """The experiment of each axis: itself."""
        return (self,)

    @property
    def T_ns(self) -> int:
        """Sample period (ns)."""
        return self.nodes["plant"].node.T_ns

    @property
    def T_s(self) -> float:
        """Sample period (s)."""
        return self.nodes["plant"].T_s

    @property
    def samples(self) -> int:
        """Length of the run."""
        return round(self.about.duration * SECOND / self.T_ns)

    @property
    def nominal(self) -> NominalModel:
        """Nominal model of the observer, Eq 2."""
        model = self.nodes["observer"].params
        assert isinstance(model, NominalModel)
        return model

    @property
    def segments(self) -> list[Segment]:
        """Parts of the reference that repeat themselves, in the last whole round of the run."""
        return self.segments_in(self.samples)

    def segments_in(self, samples: int) -> list[Segment]:
        """The same where only so many samples were run."""
        segments = getattr(self._reference, "segments", None)
        found = segments(self.nodes["reference"].params) if segments else ()
        T_s = self.T_s
        first = [
            Segment(start / T_s, end / T_s, period / T_s, float(f"{1.0 / period:.12g}"))
            for start, end, period in found
        ]
        return of_round(first, samples)

    @property
    def move(self) -> Move | None:
        """The reference's last change of level; None where it never rests."""
        move = getattr(self._reference, "move", None)
        if move is None:
            return None
        start, level = move(self.nodes["reference"].params)
        return Move(round(start / self.T_s), level)

    def figures(
        self, samples: np.ndarray, true: np.ndarray | None, begin: int = 0
    ) -> dict[str, Any]:
        """Figures that follow from the samples of a run alone; parameters as of `metrics`."""
        plant = self.nodes["plant"].params
        moved = samples["y"] if true is None else true["x1"]
        return {
            **metrics(samples, true, self.segments, plant.voltage_min, plant.voltage_max, begin),
            **transient(moved, self.move, self.T_s),
        }

    @property
    def scan_events(self) -> Callable[[int, int], np.ndarray] | None:
        """Events of the scan that begin at samples first to last - 1; None where it is none."""
        return reference.events_of(self.nodes["reference"].params, self.T_s)

    @property
    def notes(self) -> list[str]:
        """One line on each type that was typed, on what has no effect, on how a file was read."""
        plant = self.nodes["plant"].params
        models = {
            "reference": (self._reference, self.nodes["reference"].params),
            "plant.load": (loads.MODELS[loads.CHOICE.type_of(plant.load)], plant.load),
        }
        files = [
            f"{name}: {model.understood(params)}"
            for name, (model, params) in models.items()
            if hasattr(model, "understood")
        ]
        return [*self.told, *files]

    @property
    def _reference(self) -> ModuleType:
        return reference.MODELS[reference.CHOICE.type_of(self.nodes["reference"].params)]

    def plant(self) -> Simulated:
        """A new plant, at rest."""
        return self._made("plant", Simulated)

    def loop(self, compiled: bool = False) -> Loop:
        """A new loop of new blocks, compiled or plain Python: the same to the bit."""
        make = CompiledLoop if compiled else Loop
        return make(self.plant(), *self.blocks(), self.T_s)

    def blocks(self) -> tuple[Live, Live, Signal]:
        """New blocks of observer, controller and reference."""
        return (
            self._made("observer", partial(Live, observer.MODELS, role=OBSERVER)),
            self._made("controller", partial(Live, controller.MODELS, role=LAW)),
            self._made("reference", partial(shaped.signal, self._reference)),
        )

    def _made(self, node: str, make: Callable[..., B]) -> B:
        """A node's block, new; an error of its design names the node."""
        try:
            return make(params=self.nodes[node].params, T_s=self.T_s)
        except ParameterError as error:
            kind = self.nodes[node].values.get("type")
            named = kind is None or " = " in str(error).split(":")[0]
            where = f"{node}." if named else f"{node}.type = {kind!r}: "
            raise ParameterError(f"{where}{error}") from None

    def sections(self) -> dict[str, Mapping[str, Any]]:
        """The resolved experiment as it is written beside a run: every value, so no preset."""
        return sections((self,))


@dataclass(frozen=True)
class MultiAxis:
    """An experiment of several axes: one of each, which share a plant and the time.

    Attributes
    ----------
    each : tuple of Experiment
        Two or more, in the order of the axes.
    """

    each: tuple[Experiment, ...]

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes."""
        return tuple(one.axis for one in self.each)

    @property
    def name(self) -> str:
        """Name of the experiment."""
        return self.each[0].name

    @property
    def about(self) -> ExperimentParams:
        """Description, figure of the paper, duration (s)."""
        return self.each[0].about

    @property
    def T_ns(self) -> int:
        """Sample period (ns)."""
        return self.each[0].T_ns

    @property
    def T_s(self) -> float:
        """Sample period (s)."""
        return self.each[0].T_s

    @property
    def samples(self) -> int:
        """Length of the run."""
        return self.each[0].samples

    @property
    def notes(self) -> list[str]:
        """Those of each axis, each once."""
        return list(dict.fromkeys(note for one in self.each for note in one.notes))

    @property
    def scan_events(self) -> Callable[[int, int], np.ndarray] | None:
        """Events of the scan that the axes make together, see `Experiment.scan_events`."""
        return next((e for e in (one.scan_events for one in self.each) if e is not None), None)

    def plant(self) -> Stage:
        """A new plant of all axes, at rest."""
        return Stage([one.plant() for one in self.each], self.axes)

    def loop(self, compiled: bool = False) -> Loop:
        """A new loop of new blocks, compiled or plain Python: the same to the bit."""
        make = CompiledLoop if compiled else Loop
        observer, law, reference = zip(*(one.blocks() for one in self.each), strict=True)
        return make(
            self.plant(),
            Several(observer, observers),
            Several(law, laws),
            Several(reference, references),
            self.T_s,
        )

    def sections(self) -> dict[str, Mapping[str, Any]]:
        """The resolved experiment as it is written beside a run, see `Experiment.sections`."""
        return sections(self.each)


AnyExperiment = Experiment | MultiAxis


def sections(each: Sequence[Experiment]) -> dict[str, Mapping[str, Any]]:
    """Sections of a parameter file that holds the experiments of some axes."""
    first = each[0]
    axes = tuple(one.axis for one in each)
    about = {**dataclasses.asdict(first.about), "name": first.name}
    nodes = {
        node: config.flat(axes, [{**one.nodes[node].values, "preset": ""} for one in each])
        for node in NODES
    }
    return {SECTION: about, **nodes}


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
    for experiment in each:
        _check(experiment, untold)
    if len(each) == 1:
        return each[0]
    found = MultiAxis(tuple(each))
    _check_together(found)
    return found


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


def of_one_scan(each: Sequence[Experiment]) -> None:
    """Refuse axes of one scan that do not follow the same one.

    Raises
    ------
    ParameterError
        A parameter of the scan differs between two axes, or two have the same part of it.
    """
    scans: dict[str, dict[str, tuple[str, dict[str, Any]]]] = {}
    for one in each:
        params = one.nodes["reference"].params
        kind = reference.CHOICE.type_of(params)
        if (scan := getattr(reference.MODELS[kind], "scan", None)) is None:
            continue
        parts, own = scans.setdefault(kind, {}), scan(params)
        for axis, shared in parts.values():
            for name, value in own.items():
                if value != shared[name]:
                    raise ParameterError(
                        f"reference.{one.axis}.{name} = {_told(value)}: differs from "
                        f"reference.{axis}.{name} = {_told(shared[name])}; a {kind} has one for "
                        f"all its axes: give reference.{name}"
                    )
        if params.part in parts:
            raise ParameterError(
                f"reference.{one.axis}.part = {params.part!r}: the axis {parts[params.part][0]} "
                f"has this part of the {kind} already; give it another"
            )
        parts[params.part] = one.axis, own


def _told(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else repr(value)


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


def refuse_driver(experiment: AnyExperiment) -> None:
    """Refuse a device whose driver cannot be made, before a node starts; nothing is opened.

    Raises
    ------
    ParameterError
        A parameter of the driver is wrong, or a Python package that it needs is missing.
    """
    drivers.check(tuple(one.nodes["plant"].params for one in experiment.each), experiment.T_s)


def refuse_specimen(experiment: AnyExperiment) -> None:
    """Refuse a specimen that is none, before anything runs.

    A recording names its specimen, too, and is read without it.

    Raises
    ------
    ParameterError
        It is no formula, and no picture that can be read.
    """
    specimen.of([one.nodes["plant"].params for one in experiment.each])


def admit(experiment: Experiment) -> None:
    """Refuse an observer that needs what the sensor does not tell.

    Raises
    ------
    ParameterError
        It needs the true velocity.
    """
    nodes = experiment.nodes
    plant = nodes["plant"].params
    type_ = observer.CHOICE.type_of(nodes["observer"].params)
    if getattr(observer.MODELS[type_], "NEEDS_VELOCITY", False) and not plant.sensor.ideal:
        raise ParameterError(
            f"observer.type = {type_!r}: needs the true velocity; add "
            "--set plant.sensor.ideal=true, or choose another observer"
        )


def within_stroke(signal: Signal, samples: int, plant: PlantParams, beyond: float = 0.0) -> None:
    """Refuse a reference that the actuator cannot reach with its voltages.

    `beyond` (m) is what else is added to it, either sign.

    Long references are looked at `LOOKS` times, at samples drawn at random once and for all.

    Raises
    ------
    ParameterError
        It leaves voltage_min K to voltage_max K.
    """
    looks: Sequence[int] = range(samples)
    if samples > LOOKS:
        looks = np.random.default_rng(0).integers(0, samples, LOOKS).tolist()
    w = [signal.at(k).w for k in looks]
    within_reach(min(w) - beyond, max(w) + beyond, plant, steady_state_gain(plant))


def within_reach(least: float, most: float, plant: PlantParams, K: float) -> None:
    """Refuse displacements (m) that a plant of gain K (um/V) cannot reach with its voltages.

    Raises
    ------
    ParameterError
        They leave voltage_min K to voltage_max K.
    """
    least, most = least * 1e6, most * 1e6
    low, high = plant.voltage_min * K, plant.voltage_max * K
    slack = 1e-9 * (high - low)
    if not (least >= low - slack and most <= high + slack):  # nor a number that is none
        raise ParameterError(
            f"reference from {least:.4g} to {most:.4g} um: outside the stroke of {low:.4g} to "
            f"{high:.4g} um, which is {plant.voltage_min:g} to {plant.voltage_max:g} V times "
            f"{K:.4g} um/V; give it less amplitude or another offset"
        )


def too_small(experiment: Experiment, figures: Mapping[str, object]) -> str | None:
    """Warning where a switching gain eta is below the eps that a run has met (Eq 13), or None.

    Parameters
    ----------
    experiment : Experiment
    figures : mapping
        The run's metrics.
    """
    params = experiment.nodes["controller"].params
    eta = getattr(params, "eta", None)
    what = "eps_left_max_V" if params.eps_compensation else "eps_max_V"
    bound = figures[what]
    if eta is None or bound is None or eta >= bound:
        return None
    name = "eps - eps_hat" if params.eps_compensation else "eps"
    return (
        f"controller.eta = {eta:g} V: below |{name}| of up to {bound:.3g} V in this run, so the "
        "sliding surface is left; give eta above that bound"
    )


def names() -> dict[str, ExperimentParams]:
    """Every experiment in ``config/experiments/``, and those of a lab's packages."""
    found = {}
    for name, path in sorted(config.files("experiments").items()):
        values = config.read(path, (SECTION, *NODES))
        found[name] = build(ExperimentParams, values[SECTION], f"{name}: ")
    return found


def presets(node: str) -> list[str]:
    """Names of a node's presets in ``config/``."""
    return sorted(config.files(config.FOLDERS.get(node, node)))
