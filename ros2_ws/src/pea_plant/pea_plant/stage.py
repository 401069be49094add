"""A simulated stage: actuators of several axes, what couples them, one gate that trips all."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from pea_core.axes import Several, in_fields
from pea_core.matrix_filter import at_rest
from pea_core.params import ParameterError
from pea_core.signals import Measurement
from pea_plant import gate as safety_gate
from pea_plant.drivers.simulated import Simulated, Unconnected
from pea_plant.gate import REASONS, Transition
from pea_plant.model import stage as model
from pea_plant.model.actuator import Truth


class Stage(Several):
    """Plant of a loop of several axes.

    Parameters
    ----------
    actuators : sequence of Simulated
        One an axis.
    axes : sequence of str
        Their names.

    Raises
    ------
    ParameterError
        What couples them does not fit, see `pea_plant.model.stage`.
    """

    signals: Any = None
    out: Any = None

    def __init__(self, actuators: Sequence[Simulated], axes: Sequence[str]) -> None:
        self.axes = tuple(axes)
        self.identity = f"simulated stage of {len(actuators)} axes"
        super().__init__(actuators, lambda models: model.stage(models, self._kind))
        self._couple()
        self._past = at_rest(self._coupling.A)

    def _couple(self) -> None:
        """Find what couples the actuators as they are."""
        self._coupling = self._coupled([block.c for block in self.blocks], self.params)
        self._kind = model.kind_of(self.params[0].stage, self._coupling)

    def _coupled(self, c: Sequence[Any], params: Sequence[Any]) -> model.Coupling:
        if any(one.stage != params[0].stage for one in params):
            raise ParameterError("stage: is one for all axes; give it without the name of an axis")
        return model.couple(params[0].stage, tuple(c), tuple(params))

    @property
    def c(self) -> model.Coefficients:
        """Coefficients of the actuators, and of what couples them."""
        each = tuple(block.c for block in self.blocks)
        if self._kind.gated:  # a gate without limits of its own trips with the others
            each = tuple(c._replace(gate=c.gate._replace(on=True)) for c in each)
        return model.Coefficients(each, self._coupling)

    @property
    def s(self) -> tuple[Any, ...]:
        """State of each actuator, and of what couples them if that has one."""
        return (*super().s, *([self._past] if self._kind.filtered else []))

    @s.setter
    def s(self, states: Iterable[Any]) -> None:
        each = list(states)
        if self._kind.filtered:
            self._past = each.pop()
        for block, state in zip(self.blocks, each, strict=True):
            block.s = state

    def restart(self) -> None:
        """Start anew, at rest."""
        super().restart()
        self._past = at_rest(self._coupling.A)

    def try_design(self, params: Sequence[Any]) -> None:
        """See whether it can be designed with `params`; errors as `designed`."""
        super().try_design(params)
        self.designed(params)

    def designed(self, params: Sequence[Any]) -> tuple[Any, ...]:
        """Coefficients with `params`.

        Raises
        ------
        ParameterError
            There are none, or a limit would be looser.
        """
        c = super().designed(params)
        self._coupled(c, params)
        return c

    def adopt(self, params: Sequence[Any], c: Sequence[Any]) -> None:
        """Swap in parameters with the coefficients that are designed from them."""
        super().adopt(params, c)
        self._couple()

    def output(self, *signals: Any) -> Any:
        """Measurements of this sample."""
        self.signals = signals
        self.out = self.model.output(self.c, self.s, *signals)
        return self.out

    def read(self) -> Any:
        """Measure at this sample."""
        return self.output(tuple(next(block.noises) for block in self.blocks))

    def write(self, u: Sequence[float]) -> None:
        """Apply the commands u (V) and go on to the next sample.

        Raises
        ------
        UnsafeCommand
            One is not finite.
        """
        for one in u:
            safety_gate.check(one, self.s[0].k)
        assert self.signals is not None
        self.s = self.model.update(self.c, self.s, *self.signals, self.out, tuple(u))

    def noise(self, samples: int) -> np.ndarray:
        """The sensors' noise of the next samples: (n, axes) array."""
        return np.stack([block.noise(samples) for block in self.blocks], axis=1)

    def ahead(self, samples: int) -> np.ndarray:
        """The same, which stay the next."""
        return np.stack([block.ahead(samples) for block in self.blocks], axis=1)

    @property
    def transition(self) -> Transition | None:
        """How the gate has tripped: the axis that was first; None where it has not."""
        found = [
            (name, block.transition, block.s.gate.reason)
            for name, block in zip(self.axes, self.blocks, strict=True)
            if block.transition is not None
        ]
        if not found:
            return None
        own = [each for each in found if REASONS[each[2]] != "other_axis"] or found
        name, transition, _ = own[0]
        return transition._replace(cause=f"{name}: {transition.cause}")

    @property
    def trip(self) -> str | None:
        """Why and at which sample the gate has tripped; None where it has not."""
        return self.transition and self.transition.cause

    @property
    def truth(self) -> tuple[Truth, ...]:
        """What no sensor tells: true states of each axis at this sample."""
        true: tuple[Truth, ...] = self.model.truth(self.c, self.s)
        return true


class Channels(Unconnected):
    """A simulated stage in place of a device of several channels; its gate is the rig's.

    Parameters
    ----------
    stage : Stage
    """

    def __init__(self, stage: Stage) -> None:
        self.identity = stage.identity
        self._stage = stage
        self.designed, self.retune = stage.designed, stage.retune

    def read(self) -> Measurement:
        """Measure at this sample: of each field a tuple, one value a channel."""
        return Measurement(*in_fields(self._stage.read()))

    def exchange(self, u: Sequence[float]) -> Measurement:
        """Measure, then apply the commands u (V) and go on to the next sample."""
        measured = self.read()
        self._stage.write(u)
        return measured
