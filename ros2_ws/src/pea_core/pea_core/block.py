"""What a block is: a model file, bound to its parameters and its state.

Each file in a ``model/`` folder is one model and offers, beside its equation,

``Params``
    Frozen dataclass in the paper's units (`pea_core.params`).
``design(params, T_s)``
    Coefficients in SI units: a NamedTuple of floats and arrays. Raises `ParameterError`.
``start(c)``
    The state before sample 0: a NamedTuple.
``output(c, s, *signals)``
    The output of this sample. Pure: it changes nothing.
``update(c, s, *signals, output, *realised)``
    The next state, given this sample's output and what came of it. Scalars of the state are
    replaced; arrays in it are owned by the block and may be overwritten.

What a model may offer besides, so that it can be changed while the loop runs without a step of
its output, stands in `pea_core.live`.

Signals by role: an observer's output is ``Measurement -> Estimate``; a controller's is
``Reference, Reference previewed, Estimate -> u``; the actuator's ``noise -> Measurement``, and
its update is told the command u. A reference has no state: ``output(c, k)``, see `Signal`.

These functions take and give numbers, NamedTuples and arrays only, so that the same text runs
as plain Python and compiled.
"""

from __future__ import annotations

from types import ModuleType, SimpleNamespace
from typing import Any

from pea_core.params import ParameterError, Schema, Values, build, flatten, layer, specs
from pea_core.signals import Reference

Model = ModuleType | SimpleNamespace
"""A model file, or functions that are made from one."""


class Designed:
    """A model with its parameters and the coefficients that follow from them.

    Parameters
    ----------
    model : module
        A model file; see the head of this module.
    params : dataclass
        An instance of the model's ``Params``.
    T_s : float
        Sample period (s).
    """

    __slots__ = ("T_s", "c", "model", "params")

    def __init__(self, model: Model, params: Any, T_s: float) -> None:
        self.model = model
        self.T_s = T_s
        self.c = model.design(params, T_s)
        self.params = params

    def try_design(self, params: Any) -> None:
        """See whether the model can be designed with `params`.

        Raises
        ------
        ParameterError
            It cannot.
        """
        self.designed(params)

    def designed(self, params: object) -> Any:
        """Coefficients of the model with `params`; errors as `try_design`."""
        return self.model.design(params, self.T_s)

    @property
    def planned(self) -> Any:
        """Parameters that it has, or will have."""
        return self.params

    def retune(self, params: object) -> None:
        """Swap in new parameters between two samples, whole or not at all.

        Raises
        ------
        ParameterError
            The model cannot be designed with them; the old ones stay.
        """
        self.adopt(params, self.designed(params))

    def adopt(self, params: object, c: object) -> None:
        """Swap in parameters with the coefficients `c` that are designed from them."""
        self.c, self.params = c, params


class Block(Designed):
    """A model with its parameters, coefficients and state; see `Designed`."""

    __slots__ = ("out", "s", "signals")

    coming: Any = None
    """What it will be, see `pea_core.live`."""

    def __init__(self, model: Model, params: Any, T_s: float) -> None:
        super().__init__(model, params, T_s)
        self.s = model.start(self.c)
        self.signals: tuple[Any, ...] | None = None
        self.out: Any = None

    def output(self, *signals: object) -> Any:
        """Output of this sample; remembers the signals for `update`."""
        self.signals = signals
        self.out = self.model.output(self.c, self.s, *signals)
        return self.out

    def update(self, *realised: object) -> None:
        """Commit the sample whose output was last computed; `realised` is what came of it."""
        assert self.signals is not None
        self.s = self.model.update(self.c, self.s, *self.signals, self.out, *realised)


class Signal(Designed):
    """A reference model with its parameters: a function of the sample number.

    The model offers ``Params``, ``design`` and ``output(c, k)``; see `Designed`.
    """

    __slots__ = ()

    def due(self, k: int) -> Any:
        """Coefficients for the samples from k on."""
        return self.c

    def at(self, k: int) -> Reference:
        """Reference at sample k."""
        point: Reference = self.model.output(self.due(k), k)
        return point


def changed(schema: Schema, params: object, values: Values) -> Any:
    """`params` with some dotted names changed, checked as a whole.

    Where they change a ``type``, what the old one alone knows is left out.

    Raises
    ------
    ParameterError
        As `build`, or a parameter that is fixed while the loop runs.
    """
    flat = flatten(schema, params)
    known = specs(schema, flat)
    for name, value in values.items():
        if name not in known or not known[name].fixed:
            continue
        if known[name].check(name, value) != flat[name]:
            raise ParameterError(
                f"{name} = {flat[name]!r} is fixed while the loop runs: stop the loop to change it"
            )
    return build(schema, layer(schema, flat, values))
