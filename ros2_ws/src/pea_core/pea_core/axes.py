"""Several axes side by side: the blocks, models and signals of each, as one.

Everything but the plant is per axis. What a signal is for one axis is a tuple for several, in the
order of their names; one axis is no tuple, and takes none of what stands here. In rows of a trace
the columns of an axis follow those of the axis before.

The functions here are compiled into kernels, so each is written out for its number of axes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from pea_core import signals
from pea_core.block import Model
from pea_core.signals import COLUMNS, SAMPLE, Reference, between

AXES_MAX = 6
"""Most axes of one loop."""

POINT = len(Reference._fields)
"""Columns of an axis in an array of reference points."""

WIDTH = len(COLUMNS)
"""Columns of an axis in a row."""


def each(block: Any) -> tuple[Any, ...]:
    """The blocks of one axis each that a block consists of."""
    return block.blocks if isinstance(block, Several) else (block,)


def number_of_axes(block: Any) -> int:
    """Number of axes of a block."""
    return len(each(block))


def per_axis(values: Any) -> tuple[Any, ...]:
    """Values of each axis, where one axis has a value and several have a tuple of them."""
    return values if type(values) is tuple else (values,)


def of_each(kind: Callable[..., Any], fields: Sequence[Any]) -> Any:
    """A signal from its fields: of numbers one, of tuples of numbers one an axis."""
    if type(fields[0]) is not tuple:
        return kind(*fields)
    return tuple(kind(*own) for own in zip(*fields, strict=True))


def in_fields(signal: Any) -> Sequence[Any]:
    """The fields of a signal, the reverse of `of_each`."""
    return tuple(zip(*signal, strict=True)) if type(signal) is tuple else signal


def shape(samples: int, axes: int) -> int | tuple[int, int]:
    """Shape of an array of `SAMPLE`: (n,) for one axis, (n, axes) for several."""
    return samples if axes == 1 else (samples, axes)


def one_axis(samples: np.ndarray, axis: int) -> np.ndarray:
    """The samples of one axis: (n,) array of `SAMPLE`."""
    if samples.ndim == 1:
        return samples
    column: np.ndarray = samples[:, axis]
    return column


def table(samples: np.ndarray) -> np.ndarray:
    """The same as (n, axes) array, also of one axis."""
    return samples[:, np.newaxis] if samples.ndim == 1 else samples


def preview_of(params: Any) -> Any:
    """Preview (samples) of a law, or of each axis's."""
    if type(params) is tuple:
        return tuple(one.preview for one in params)
    return params.preview


def split(preview: Any) -> tuple[Any, Any]:
    """Whole samples of a preview, and the fraction that is left; of each axis's."""
    if isinstance(preview, tuple):
        return tuple(int(one) for one in preview), tuple(one - int(one) for one in preview)
    return int(preview), preview - int(preview)


# Written out for a number of axes --------------------------------------------------------------


def each_axis(
    count: int,
    arguments: str,
    body: str,
    form: str = "return ({},)",
    join: str = ", ",
    **parts: Any,
) -> Any:
    """Write out a function for so many axes: `body` for each, in which @ is its number.

    Compiled code can neither make a tuple in a loop nor go through one of several types.

    Parameters
    ----------
    count : int
    arguments : str
        Of the function.
    body : str
        An expression; it may name `parts`.
    form, join : str
        How the bodies become the function's: by default a tuple of them.
    **parts
        What all axes use; a tuple has one for each, ``NAME_@``.
    """
    names: dict[str, Any] = {"__name__": __name__}
    for name, part in parts.items():
        if type(part) is tuple:
            names |= {f"{name}_{i}": one for i, one in enumerate(part)}
        else:
            names[name] = part
    whole = form.format(join.join(body.replace("@", str(i)) for i in range(count)))
    exec(compile(f"def written({arguments}):\n    {whole}", __file__, "exec"), names)
    return names["written"]


# Rows and points -------------------------------------------------------------------------------


def previewed(
    points: np.ndarray, k: int, mask: int, ahead: int, theta: float, T_s: float
) -> Reference:
    """Reference at k + ahead + theta samples; row k of `points` is row k & mask."""
    W_ff = signals.reference_of(points, (k + ahead) & mask)
    if theta != 0.0:
        W_after = signals.reference_of(points, (k + ahead + 1) & mask)
        W_ff = between(W_ff, W_after, theta, T_s)
    return W_ff


def finite(u: float) -> bool:
    """Whether a command is a finite number."""
    return math.isfinite(u)


def noise_of(noise: np.ndarray, i: int) -> float:
    """Noise of a sample."""
    return noise[i]


class Rows(NamedTuple):
    """How the signals of a sample lie in arrays, for some number of axes.

    ``points`` (n, axes x 3) hold the reference, ``rows`` (n, axes x `COLUMNS`) all signals,
    ``noise`` (n,) or (n, axes) that of the sensors.
    """

    axes: int
    reference: Callable[..., Any]
    previewed: Callable[..., Any]
    measurement: Callable[..., Any]
    estimate: Callable[..., Any]
    command: Callable[..., Any]
    noise: Callable[..., Any]
    finite: Callable[..., Any]
    pack: Callable[..., Any]
    pack_reference: Callable[..., Any]
    pack_estimate: Callable[..., Any]
    pack_command: Callable[..., Any]


ONE = Rows(
    1,
    signals.reference_of,
    previewed,
    signals.measurement_of,
    signals.estimate_of,
    signals.command_of,
    noise_of,
    finite,
    signals.pack,
    signals.pack_reference,
    signals.pack_estimate,
    signals.pack_command,
)


@cache
def rows_of(axes: int) -> Rows:
    """`Rows` for so many axes: signals of several are tuples."""
    if axes == 1:
        return ONE
    first, points = range(axes), "points[:, p_@:q_@]"
    own: dict[str, Any] = {
        "p": tuple(POINT * i for i in first),
        "q": tuple(POINT * (i + 1) for i in first),
        "a": tuple(WIDTH * i for i in first),
        "b": tuple(WIDTH * (i + 1) for i in first),
    }

    def write(arguments: str, body: str, one: Any, **how: str) -> Any:
        return each_axis(axes, arguments, body, one=one, **own, **how)

    done = {"form": "{}", "join": "; "}
    row, rows = "row[a_@:b_@]", "rows[:, a_@:b_@]"
    ahead = f"one({points}, k, mask, ahead[@], theta[@], T_s)"
    sample = f"one({rows}, r, W[@], measured[@], estimate[@], u[@])"
    return Rows(
        axes,
        write("points, i", f"one({points}, i)", ONE.reference),
        write("points, k, mask, ahead, theta, T_s", ahead, ONE.previewed),
        write("row", f"one({row})", ONE.measurement),
        write("row", f"one({row})", ONE.estimate),
        write("row", f"one({row})", ONE.command),
        write("noise, i", "noise[i, @]", None),
        write("u", "one(u[@])", ONE.finite, form="return {}", join=" and "),
        write("rows, r, W, measured, estimate, u", sample, ONE.pack, **done),
        write("points, i, W", f"one({points}, i, W[@])", ONE.pack_reference, **done),
        write("row, estimate", f"one({row}, estimate[@])", ONE.pack_estimate, **done),
        write("row, u", f"one({row}, u[@])", ONE.pack_command, **done),
    )


# Models ----------------------------------------------------------------------------------------


def by_identity(combine: Callable[..., SimpleNamespace]) -> Callable[..., SimpleNamespace]:
    """Have `combine` answer the same models, and whatever is told besides, with the same object."""
    made: dict[tuple[Any, ...], SimpleNamespace] = {}

    def combined(models: tuple[Model, ...], *more: Any) -> SimpleNamespace:
        key = (*map(id, models), *more)
        if key not in made:
            made[key] = combine(models, *more)  # holds the models, so that no id comes again
        return made[key]

    return combined


def _beside(models: tuple[Model, ...], signals: str) -> SimpleNamespace:
    """Models side by side, as one: `signals` names what they take, one of each axis."""
    own = "".join(f", {name}[@]" for name in signals.split(", "))

    def write(arguments: str, name: str, more: str) -> Any:
        functions = tuple(getattr(model, name) for model in models)
        return each_axis(len(models), arguments, f"one_@(c[@], s[@]{own}{more})", one=functions)

    return SimpleNamespace(
        models=models,
        axes=len(models),
        output=write(f"c, s, {signals}", "output", ""),
        update=write(f"c, s, {signals}, out", "update", ", out[@]"),
    )


@by_identity
def observers(models: tuple[Model, ...]) -> SimpleNamespace:
    """Observers side by side, as one model: measurements in, estimates out."""
    return _beside(models, "measured")


@by_identity
def laws(models: tuple[Model, ...]) -> SimpleNamespace:
    """Laws side by side, as one model: references and estimates in, commands out."""
    return _beside(models, "W, W_ff, estimate")


@by_identity
def references(models: tuple[Model, ...]) -> SimpleNamespace:
    """References side by side, as one model: a sample number in, a point of each axis out."""
    outputs = tuple(model.output for model in models)
    output = each_axis(len(models), "c, k", "one_@(c[@], k)", one=outputs)
    return SimpleNamespace(models=models, axes=len(models), output=output)


# Blocks -------------------------------------------------------------------------------------


class Several:
    """The blocks of one role, one an axis, as one block.

    Parameters and signals are tuples, one an axis. A change of parameters changes the axes alone
    whose parameters differ.

    Parameters
    ----------
    blocks : sequence of Block or Signal
        Two or more.
    combine : callable
        `observers`, `laws`, `references`, or a plant's own: takes their models.

    Attributes
    ----------
    blocks : tuple
        One an axis.
    """

    def __init__(self, blocks: Sequence[Any], combine: Callable[[tuple[Model, ...]], Any]) -> None:
        self.blocks = tuple(blocks)
        self.combine = combine
        self.T_s: float = blocks[0].T_s

    @property
    def model(self) -> Any:
        """The models side by side; the same object for the same models."""
        return self.combine(tuple(block.model for block in self.blocks))

    @property
    def c(self) -> tuple[Any, ...]:
        """Coefficients."""
        return tuple(block.c for block in self.blocks)

    @property
    def s(self) -> tuple[Any, ...]:
        """State."""
        return tuple(block.s for block in self.blocks)

    @s.setter
    def s(self, states: Iterable[Any]) -> None:
        for block, state in zip(self.blocks, states, strict=True):
            block.s = state

    @property
    def params(self) -> tuple[Any, ...]:
        """Parameters."""
        return tuple(block.params for block in self.blocks)

    @property
    def planned(self) -> tuple[Any, ...]:
        """Parameters that they have, or will have."""
        return tuple(block.planned for block in self.blocks)

    @property
    def coming(self) -> tuple[Any, ...] | None:
        """What blocks will be, see `pea_core.live`; None while no change is under way."""
        found = tuple(block.coming for block in self.blocks if block.coming is not None)
        return found or None

    @property
    def signals(self) -> tuple[Any, ...] | None:
        """Signals of the last sample, each a tuple of all axes."""
        own = [block.signals for block in self.blocks]
        return None if None in own else tuple(zip(*own, strict=True))

    @signals.setter
    def signals(self, values: tuple[Any, ...] | None) -> None:
        for i, block in enumerate(self.blocks):
            block.signals = None if values is None else tuple(value[i] for value in values)

    @property
    def out(self) -> tuple[Any, ...]:
        """Outputs of the last sample."""
        return tuple(block.out for block in self.blocks)

    @out.setter
    def out(self, values: Sequence[Any]) -> None:
        for block, value in zip(self.blocks, values, strict=True):
            block.out = value

    def try_design(self, params: Sequence[Any]) -> None:
        """See whether the models can be designed with `params`; errors as `Designed`."""
        for block, one in zip(self.blocks, params, strict=True):
            block.try_design(one)

    def designed(self, params: Sequence[Any]) -> tuple[Any, ...]:
        """Coefficients with `params`; errors as `try_design`."""
        return tuple(block.designed(one) for block, one in zip(self.blocks, params, strict=True))

    def retune(self, params: Sequence[Any]) -> None:
        """Swap in new parameters between two samples, whole or not at all; errors as `designed`."""
        self.adopt(params, self.designed(params))

    def adopt(self, params: Sequence[Any], c: Sequence[Any]) -> None:
        """Swap in parameters with the coefficients that are designed from them."""
        for block, one, designed in zip(self.blocks, params, c, strict=True):
            if one != block.planned:
                block.adopt(one, designed)

    def rest(self, params: Sequence[Any], c: Sequence[Any]) -> tuple[Any, Any, Any]:
        """Model, coefficients and state at rest that they would have with `params`."""
        parts = zip(self.blocks, params, c, strict=True)
        models, coefficients, states = zip(
            *(block.rest(one, designed) for block, one, designed in parts), strict=True
        )
        return self.combine(models), coefficients, states

    def restart(self) -> None:
        """Start anew, at rest."""
        for block in self.blocks:
            block.restart()

    def foresee(self, *signals: Sequence[Any]) -> None:
        """Tell what is coming its own signals of this sample."""
        for i, block in enumerate(self.blocks):
            if block.coming is not None:
                block.foresee(*(signal[i] for signal in signals))

    def output(self, *signals: Sequence[Any]) -> tuple[Any, ...]:
        """Outputs of this sample."""
        return tuple(
            block.output(*(signal[i] for signal in signals)) for i, block in enumerate(self.blocks)
        )

    def update(self, *realised: Sequence[Any]) -> None:
        """Commit the sample whose outputs were last computed."""
        for i, block in enumerate(self.blocks):
            block.update(*(value[i] for value in realised))

    def due(self, k: int) -> tuple[Any, ...]:
        """Of references: coefficients for the samples from k on."""
        return tuple(block.due(k) for block in self.blocks)

    def at(self, k: int) -> tuple[Reference, ...]:
        """Of references: the points of sample k."""
        return tuple(block.at(k) for block in self.blocks)


def references_of(points: np.ndarray) -> list[Any]:
    """Rows of an array (n, axes x 3) as references, of each axis where there are several."""
    if points.shape[1] == POINT:
        return [Reference(*row) for row in points.tolist()]
    own = points.reshape(len(points), -1, POINT).tolist()
    return [tuple(Reference(*point) for point in row) for row in own]


def side_by_side(blocks: Sequence[Any], combine: Callable[..., Any]) -> Any:
    """One block as it is, several as one."""
    return blocks[0] if len(blocks) == 1 else Several(blocks, combine)


def samples_of(rows: np.ndarray, axes: int) -> np.ndarray:
    """An array (n, axes x `COLUMNS`) of numbers as one of `SAMPLE`, see `shape`."""
    return np.ascontiguousarray(rows).reshape(-1).view(SAMPLE).reshape(shape(len(rows), axes))
