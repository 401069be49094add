"""Runs of a sweep in groups that one kernel can take side by side."""

from __future__ import annotations

import dataclasses
import os
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from numbers import Real
from typing import Any, NamedTuple

import numpy as np

from pea_controller import model as controller
from pea_controller.model.common import limits, within
from pea_core.config import NODES
from pea_core.loop import PREVIEW_MAX
from pea_core.params import ParameterError, build, flatten, specs
from pea_engine import lanes
from pea_engine.compiled import SWITCH
from pea_engine.kernels import reference_kernel
from pea_experiment import score
from pea_experiment.checks import within_reach
from pea_experiment.experiment import SCHEMAS, Experiment
from pea_experiment.scoring import scored
from pea_lab.guard import altered
from pea_lab.settling import called, unheld
from pea_observer import model as observer
from pea_plant.model.actuator import actuator, steady_state_gain
from pea_plant.model.sensor import Noise
from pea_reference import model as reference
from pea_reference import shaped

MODELS = {
    "observer": (observer.CHOICE, observer.MODELS),
    "controller": (controller.CHOICE, controller.MODELS),
    "reference": (reference.CHOICE, reference.MODELS),
}

_kernels: dict[Any, Callable[..., Any]] = {}
_making = threading.Lock()


class Made(NamedTuple):
    """A block of a run: its parameters and coefficients."""

    params: Any
    c: Any


class Course(NamedTuple):
    """Where a reference goes.

    Attributes
    ----------
    points : (n, 3) array
        In SI.
    counts : (samples,) array of bool
        Which samples are scored.
    amplitude : float
        Half its stroke over those (m).
    span : tuple of float
        Least and greatest displacement of all (m).
    """

    points: np.ndarray
    counts: np.ndarray
    amplitude: float
    span: tuple[float, float]


@dataclass
class Group:
    """Runs that one kernel can take side by side.

    Attributes
    ----------
    base : Experiment
        What they have in common.
    models : dict of str to model
        Of plant, observer and controller.
    preview : float
        How far the controllers look ahead (samples).
    runs : list of int
    made : dict of int to dict of str to Made
        Every block of each run.
    courses : Callable
        The course of a reference's parameters.
    """

    base: Experiment
    models: dict[str, Any]
    preview: float
    courses: Callable[[Any], Course]
    each: bool
    runs: list[int] = field(default_factory=list)
    made: dict[int, dict[str, Made]] = field(default_factory=dict)

    def coefficients(self, run: int) -> tuple[Any, ...]:
        """Of plant, observer, controller and score."""
        made = self.made[run]
        plant = made["plant"].params
        scoring = score.design(made["observer"].params, plant.voltage_min, plant.voltage_max)
        return (*(made[node].c for node in NODES[:3]), scoring)

    def states(self, c: tuple[object, ...]) -> tuple[Any, ...]:
        """Of plant, observer, controller and score before sample 0."""
        starts = [*(self.models[node].start for node in NODES[:3]), score.start]
        return tuple(start(each) for start, each in zip(starts, c, strict=True))

    @cached_property
    def like(self) -> tuple[Any, Any]:
        """`Like` of the coefficients and states; those of all its runs are alike."""
        from pea_engine.cells import Like

        c = self.coefficients(self.runs[0])
        return Like(lanes.example(c, True)), Like(lanes.example(self.states(c)))

    def kernel(self, traced: bool) -> Callable[..., Any]:
        """What carries the runs through; made once in a process."""
        from pea_engine.lanes_native import lanes_kernel

        key = tuple(id(self.models[node]) for node in NODES[:3]), self.each, traced
        with _making:
            if key not in _kernels:
                plant, observer, law = (self.models[node] for node in NODES[:3])
                _kernels[key] = lanes_kernel(plant, observer, law, score, self.each, traced)
            return _kernels[key]

    def noise(self, run: int) -> Noise | None:
        """Where the run's sensor noise comes from; None where there is none."""
        params = self.made[run]["plant"].params
        return Noise(params.seed) if params.sensor.noise_nm else None


class Runs:
    """Makes the blocks of the runs of one base experiment, each only once."""

    def __init__(self, base: Experiment) -> None:
        self.base = base
        if base.nodes["plant"].values.get("driver.type", "simulated") != "simulated":
            raise ParameterError("plant.driver.type: a sweep takes the simulated plant")
        self.flat = {n: flatten(SCHEMAS[n], base.nodes[n].params) for n in NODES}
        self.known: dict[Any, Any] = {}

    def _once(self, key: object, make: Callable[[], object]) -> Any:
        found = self.known.get(key)  # a key is a tree of parameters: slow to hash
        if found is None:
            found = self.known[key] = make()
        return found

    def params(self, node: str, changes: Mapping[str, object]) -> Any:
        """Parameters of a node with some values changed."""
        if not changes:
            return self.base.nodes[node].params
        known = self._once(("specs", node), lambda: specs(SCHEMAS[node], self.flat[node]))
        if not changes.keys() <= known.keys():
            build(SCHEMAS[node], {**self.flat[node], **changes}, f"{node}.")  # says what is wrong
        checked = {name: known[name].check(f"{node}.{name}", v) for name, v in changes.items()}
        return replaced(self.base.nodes[node].params, checked, f"{node}.")

    def made(self, node: str, params: Any) -> tuple[Any, Any]:
        """Model of a node, and its coefficients."""
        T_s = self.base.T_s
        if node == "plant":
            params = dataclasses.replace(params, seed=0)  # of no concern to the design

            def make() -> tuple[Any, Any]:
                model = actuator(params)
                return model, model.design(params, T_s)
        else:
            choice, models = MODELS[node]
            model = models[choice.type_of(params)]
            if node == "reference":
                model = shaped.model_of(model, params)

            def make() -> tuple[Any, Any]:
                return model, model.design(params, T_s)

        try:
            found: tuple[Any, Any] = self._once((node, params), make)
        except ParameterError as error:
            raise ParameterError(f"{node}.{error}") from None
        return found

    def gain(self, plant: Any) -> float:
        """Steady-state gain of a plant (um/V)."""
        key = plant.K, plant.zeta, plant.omega_n, plant.vibration
        return float(self._once(key, lambda: steady_state_gain(plant)))

    def course(self, params: object) -> Course:
        """Where a reference with these parameters goes."""
        found: Course = self._once(("course", params), lambda: self._course(params))
        return found

    def _course(self, params: object) -> Course:
        samples = self.base.samples
        model, c = self.made("reference", params)
        points = np.empty((samples + PREVIEW_MAX + 1, 3))
        if os.environ.get(SWITCH) == "0":
            points[:] = [model.output(c, k) for k in range(len(points))]
        else:
            reference_kernel(model)(c, 0, points)
        told = self.base.nodes["reference"]._replace(params=params)
        experiment = dataclasses.replace(self.base, nodes={**self.base.nodes, "reference": told})
        counts = np.zeros(samples, bool)
        for part in scored(samples, experiment.segments).values():
            counts[part] = True
        w = points[:samples, 0]
        span = float(w.min()), float(w.max())
        return Course(points, counts, float(np.ptp(w[counts])) / 2.0, span)

    def check(self, plant: Any, law: Any, course: Course) -> None:
        """Refuse limits of the controller beyond the plant's, and references out of reach.

        Raises
        ------
        ParameterError
            One of them.
        """
        try:
            within(law, limits(flatten(SCHEMAS["plant"], plant)))
        except ParameterError as error:
            raise ParameterError(f"controller.{error}") from None
        if law.inject.where != "off":
            raise ParameterError(
                f"controller.inject.where = {law.inject.where!r}: a sweep injects nothing; "
                "leave it off, or use pea run"
            )
        within_reach(*course.span, plant, self.gain(plant))

    def held(self, params: Mapping[str, Any]) -> None:
        """Refuse a law that does not hold a raw step through its slew limit.

        Raises
        ------
        ParameterError
            It leaves too much.
        """
        if params["controller"].slew_rate == 0.0:
            return
        plant = dataclasses.replace(params["plant"], seed=0)
        key = tuple({**params, "plant": plant}.values())
        run = altered(self.base, params)
        refuse_unheld(run, self._once(("held", key), lambda: unheld(run)))


def refuse_unheld(experiment: Experiment, text: str) -> None:
    """Refuse a run by what `unheld` says of it."""
    if text:
        raise ParameterError(
            f"{called(experiment)}: {text}, or run it all the same with force=True"
        )


def replaced(params: Any, values: Mapping[str, object], where: str) -> Any:
    """Parameters with some values in place of others, by dotted names."""
    own = {name: value for name, value in values.items() if "." not in name}
    for group in {name.partition(".")[0] for name in values.keys() - own.keys()}:
        inner = {
            name.partition(".")[2]: value
            for name, value in values.items()
            if name.startswith(f"{group}.")
        }
        own[group] = replaced(getattr(params, group), inner, f"{where}{group}.")
    try:
        return dataclasses.replace(params, **own)
    except ParameterError as error:
        raise ParameterError(f"{where}{error}") from None


def plain_number(value: object) -> bool:
    """Whether a value is one number, which a kernel can take as it is."""
    return isinstance(value, Real) and not isinstance(value, bool)


def text_of_value(value: object) -> str:
    """A value as after ``--set``."""
    return str(list(value)) if isinstance(value, tuple) else str(value)
