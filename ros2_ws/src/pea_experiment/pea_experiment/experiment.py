"""One experiment: what the four blocks are, and how long they run; of one axis or of several."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import ModuleType
from typing import Any, TypeVar

import numpy as np

from pea_controller import model as controller
from pea_core import config
from pea_core.axes import Several, laws, observers, references
from pea_core.block import Signal
from pea_core.config import AXIS, NODES, Resolved
from pea_core.live import LAW, OBSERVER, Live
from pea_core.loop import Loop
from pea_core.nominal import NominalModel
from pea_core.params import ParameterError, Schema, param
from pea_core.units import SECOND
from pea_engine.compiled import CompiledLoop
from pea_experiment.metrics import metrics, transient
from pea_experiment.scoring import Move, Segment, of_round
from pea_observer import model as observer
from pea_plant.drivers.simulated import Simulated
from pea_plant.model import load as loads
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
