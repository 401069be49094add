r"""Several actuators on one stage: cross-talk, and matrices between sensors, axes, actuators.

Each of n actuators has H, F_c and V of its own, and each of n sensors looks at all of them,

.. math:: y_i = C_{ii}\,x_i + \sum_{j \ne i} X_{ij}\,C_{jj}\,x_j
          \quad \text{or} \quad
          y_i = \sum_j \sum_m K_{ijm}\,q_{jm}

with X the static cross-talk, or with K_ijm the gain of mode m (um/V) from actuator j to sensor i:
every path has the modes that `vibration.modal` lists for its actuator. What an axis does is a
combination of sensors, and a command of an axis is shared out among the actuators,

.. math:: y_{axes} = S\,y, \quad u_{actuators} = A\,u_{axes},

so that tip, tilt and piston come from three points. A may be a filter of N taps, which decouples
the dynamics too,

.. math:: u_{actuators, k} = \sum_{m=0}^{N-1} A_m\,u_{axes, k - m}.

The voltage applied is told per axis, by the inverse of A from what the actuators got; limits, gate,
DAC and slew are the actuators' own. Noise, delay and resolution are the sensors' own.

When one actuator's gate trips, all do, at the same sample; so they do where the axes leave the
area that is permitted.

Inputs
    command of each axis (V), white noise of each sensor.
Outputs
    `Measurement` of each axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from pea_core.axes import by_identity, each_axis
from pea_core.block import Model
from pea_core.matrix_filter import SLOWEST, combine, later, remember, slowest
from pea_core.params import ParameterError, param
from pea_core.signals import Measurement
from pea_plant.gate import ACTIVE, FAULT, OTHER_AXIS, PERMITTED_AREA, tripped
from pea_plant.model.actuator import State as ActuatorState
from pea_plant.model.actuator import Truth, linear


@dataclass(frozen=True)
class Params:
    """What several actuators share; matrices row by row, empty: each axis is its own."""

    cross_talk: tuple[float, ...] = param(
        (), "m/m", -10.0, 10.0, help="share of each actuator's displacement at each sensor",
        fixed=True,
    )  # fmt: skip
    modes_K: tuple[float, ...] = param(
        (), "um/V", -1e3, 1e3, help="gain of each mode, by sensor, actuator, mode", fixed=True
    )
    sensors_to_axes: tuple[float, ...] = param(
        (), "", -1e3, 1e3, help="matrix from sensors to axes", fixed=True
    )
    axes_to_actuators: tuple[float, ...] = param(
        (), "", -1e3, 1e3, help="matrix from axes to actuators, or taps of it", fixed=True
    )
    specimen: str = param(
        "", help="sample signal of the simulated stage: a formula of x, y (um), or a picture",
        fixed=True,
    )  # fmt: skip
    specimen_um: tuple[float, ...] = param(
        (), "um", -1e6, 1e6, help="what its picture covers: x, y of the middle, width, height",
        fixed=True,
    )  # fmt: skip
    permitted_um: tuple[float, ...] = param(
        (), "um", -1e6, 1e6, help="corners x, y of where the first two axes may be", fixed=True
    )


class Coupling(NamedTuple):
    """C (3, n, n, states): what sensor i sees of x, x', x'' from actuator j's states.

    D (n, n): of its input at x''.  S and its inverse (n, n).  A (N, n, n): its taps; A_inverse
    (n, n): of the first.  corners (m, 2): of the permitted area (m).  gated: whether a gate may
    trip.
    """

    C: np.ndarray
    D: np.ndarray
    S: np.ndarray
    S_inverse: np.ndarray
    A: np.ndarray
    A_inverse: np.ndarray
    corners: np.ndarray
    gated: bool


class Coefficients(NamedTuple):
    """Those of each actuator, and what couples them."""

    each: tuple[Any, ...]
    coupling: Coupling


def matrix(values: tuple[float, ...], n: int, name: str) -> np.ndarray:
    """An (n, n) matrix that can be inverted; the identity where none is given.

    Raises
    ------
    ParameterError
        Another number of values, or singular.
    """
    if not values:
        return np.eye(n)
    found = _square(values, n, name)
    if not np.linalg.cond(found) < 1e8:
        raise ParameterError(
            f"stage.{name} = {list(values)}: is singular, so an axis cannot be moved alone; "
            "give a matrix that has an inverse"
        )
    return found


def taps(values: tuple[float, ...], n: int) -> np.ndarray:
    """Taps (N, n, n) of the filter from axes to actuators; one, which is a matrix, as a rule.

    Raises
    ------
    ParameterError
        As `matrix`; nobody can tell from the voltages of the actuators what the axes got.
    """
    name = "axes_to_actuators"
    if len(values) <= n * n or len(values) % (n * n):
        return matrix(values, n, name)[np.newaxis]
    found = np.array(values).reshape(-1, n, n)
    matrix(tuple(found[0].ravel().tolist()), n, name)
    if not (pole := slowest(found)) < SLOWEST:
        raise ParameterError(
            f"stage.{name}: {len(found)} taps, whose inverse has a pole of {pole:.4g}, so nobody "
            f"can tell what each axis got; make it with pea decouple (below {SLOWEST:g})"
        )
    return found


def area(values: tuple[float, ...], n: int) -> np.ndarray:
    """Corners (m, 2) of the permitted area (m), counter-clockwise.

    Raises
    ------
    ParameterError
        No polygon, not convex, or less than two axes.
    """
    if not values:
        return np.zeros((0, 2))
    said = f"stage.permitted_um = {list(values)}"
    if n < 2 or len(values) % 2 or len(values) < 6:
        raise ParameterError(f"{said}: give x and y of three corners or more, for two axes or more")
    corners = np.array(values).reshape(-1, 2) * 1e-6
    edges = np.roll(corners, -1, axis=0) - corners
    after = np.roll(edges, -1, axis=0)
    turns = edges[:, 0] * after[:, 1] - edges[:, 1] * after[:, 0]
    once = abs(np.angle(np.exp(1j * np.diff(np.unwrap(np.arctan2(*edges.T[::-1])))))).sum()
    if not (np.all(turns > 0.0) or np.all(turns < 0.0)) or once > 2.0 * np.pi:
        raise ParameterError(f"{said}: is not convex; give the corners in order round the area")
    return corners if turns[0] > 0.0 else corners[::-1].copy()


def couple(params: Params, each: tuple[Any, ...], of_each: tuple[Any, ...]) -> Coupling:
    """What couples actuators of coefficients `each` and parameters `of_each`.

    Raises
    ------
    ParameterError
        As `matrix` and `area`; cross-talk that is given twice, that does not fit the modes, or
        that a sensor with a bandwidth would not see.
    """
    n = len(each)
    size = max(len(c.C_1) for c in each)
    C, D = np.zeros((3, n, n, size)), np.zeros((n, n))
    if params.cross_talk and params.modes_K:
        raise ParameterError("stage.cross_talk and stage.modes_K: give one of them")
    shares = np.zeros((n, n))
    if params.cross_talk:
        shares = _square(params.cross_talk, n, "cross_talk")
        if any(own not in (0.0, 1.0) for own in np.diag(shares)):
            raise ParameterError(
                f"stage.cross_talk = {list(params.cross_talk)}: the diagonal is an axis's own; "
                "write 0 there"
            )
    if (params.cross_talk or params.modes_K) and any(p.sensor.bandwidth_hz for p in of_each):
        raise ParameterError(
            "stage.cross_talk: a sensor with bandwidth_hz sees its own actuator alone; set "
            "sensor.bandwidth_hz to 0"
        )
    for j, c in enumerate(each):
        seen = np.array([c.C_1, c.C_2, c.C_3])
        for i in range(n):
            if i != j and params.modes_K:
                C[:, i, j, : len(c.C_1)], D[i, j] = _by_modes(params, of_each[j], c, i, j, n)
            elif i != j:
                C[:, i, j, : len(c.C_1)], D[i, j] = shares[i, j] * seen, shares[i, j] * c.D_3
    A = taps(params.axes_to_actuators, n)
    S = matrix(params.sensors_to_axes, n, "sensors_to_axes")
    corners = area(params.permitted_um, n)
    return Coupling(
        C=C,
        D=D,
        S=S,
        S_inverse=np.linalg.inv(S) if params.sensors_to_axes else S,
        A=A,
        A_inverse=np.linalg.inv(A[0]) if params.axes_to_actuators else A[0],
        corners=corners,
        gated=len(corners) > 0 or any(c.gate.on for c in each),
    )


def _square(values: tuple[float, ...], n: int, name: str) -> np.ndarray:
    """An (n, n) matrix.

    Raises
    ------
    ParameterError
        Another number of values.
    """
    if len(values) != n * n:
        raise ParameterError(
            f"stage.{name}: {len(values)} values: give {n * n}, row by row, for {n} axes"
        )
    return np.array(values).reshape(n, n)


def _by_modes(
    params: Params, actuator: Any, c: Any, i: int, j: int, n: int
) -> tuple[np.ndarray, float]:
    """What sensor i sees of the modes of actuator j: rows for x, x', x''; and of its input.

    Raises
    ------
    ParameterError
        Its V has no modes, or another number of them.
    """
    own = getattr(actuator.vibration, "K", None)
    modes = len(own) if isinstance(own, tuple) else 0
    if not modes or len(params.modes_K) != n * n * modes:
        raise ParameterError(
            f"stage.modes_K: {len(params.modes_K)} values: give {n} x {n} x "
            f"{modes or 'modes'}, for vibration.type = 'modal' on each axis"
        )
    K = np.array(params.modes_K).reshape(n, n, modes)
    assert isinstance(own, tuple)
    if np.any((K[j, j] != 0.0) & (K[j, j] != np.array(own))):
        raise ParameterError(
            f"stage.modes_K: of sensor {j + 1} and actuator {j + 1} it is {K[j, j].tolist()}, and "
            f"vibration.K is {list(own)}: write the same, or 0 there"
        )
    shares = np.where(np.array(own) != 0.0, K[i, j] / np.where(own, own, 1.0), 0.0)
    A, B, C = linear(actuator)
    C = C.copy()
    C[0, : 2 * modes] *= np.repeat(shares, 2)
    rows = np.zeros((3, len(c.C_1)))
    rows[:, : len(A)] = *C, *C @ A, *C @ A @ A
    return rows, float((C @ A @ B)[0, 0])


def inside(corners: np.ndarray, x: float, y: float) -> bool:
    """Whether a point (m) is in a convex area, or on its edge."""
    m = len(corners)
    for i in range(m):
        a, b = corners[i], corners[(i + 1) % m]
        if (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) < 0.0:
            return False
    return True


def beside(coupling: Coupling, order: int, i: int, x: Any) -> float:
    """What sensor i sees of the actuators beside its own: x, x' or x'' (order 0 to 2)."""
    total = 0.0
    for j in range(len(x)):
        if j != i:
            row = coupling.C[order, i, j]
            for k in range(x[j].size):
                total += row[k] * x[j][k]
    return total


def with_gate(s: ActuatorState, reason: int) -> ActuatorState:
    """State of an actuator whose gate trips for a reason that it does not see, if it is active."""
    gate = s.gate
    if gate.state == ACTIVE:
        gate = tripped(gate, reason)
    return ActuatorState(
        s.k, s.h, s.x, s.x_next, s.v, s.u_applied, s.waiting, s.u_a, s.on_way, s.past, gate
    )


class Kind(NamedTuple):
    """What a stage has: it shapes the compiled model."""

    crossed: bool
    sensed: bool
    shared: bool
    filtered: bool
    gated: bool
    area: bool


def kind_of(params: Params, coupling: Coupling) -> Kind:
    """What a stage has."""
    return Kind(
        bool(params.cross_talk or params.modes_K),
        bool(params.sensors_to_axes),
        bool(params.axes_to_actuators),
        len(coupling.A) > 1,
        coupling.gated,
        bool(params.permitted_um),
    )


@by_identity
def stage(models: tuple[Model, ...], kind: Kind) -> SimpleNamespace:
    """The model (`pea_core.block`) of a stage with actuators of these models.

    One function, because its kernels close over `kind`: what a stage has not is not compiled.
    """
    n = len(models)
    crossed, sensed, shared, filtered, gated, area = kind

    def write(arguments: str, body: str, **parts: Any) -> Any:
        return each_axis(n, arguments, body, **parts)

    states = write("s", "s[@].x")
    inputs = write("s", "s[@].v")
    nothing = write("", "0.0")
    cross = write("coupling, order, x", "beside(coupling, order, @, x)", beside=beside)
    told = write(
        "c, s, noise, more, more_dot",
        "one_@(c[@], s[@], noise[@], more[@], more_dot[@])",
        one=tuple(model.told for model in models),
    )
    committed = write(
        "c, s, measured, u, more",
        "one_@(c[@], s[@], measured[@], u[@], more[@])",
        one=tuple(model.commit for model in models),
    )
    true_of_each = write("c, s", "one_@(c[@], s[@])", one=tuple(model.truth for model in models))
    ys, y_dots = write("measured", "measured[@].y"), write("measured", "measured[@].y_dot")
    voltages = write("measured", "measured[@].u_applied")
    combined = write("M, values", "combine(M[@], values)", combine=combine)
    of_later = write("A, past", "later(A, past, @)", later=later)
    past_of = each_axis(1, "s", f"s[{n}]", "return {}")
    measurements = write(
        "y, y_dot, u", "Measurement(y[@], y_dot[@], u[@])", Measurement=Measurement
    )
    x1s, x2s, x2_dots = (write("true", f"true[@].{name}") for name in Truth._fields)
    added, less = write("a, b", "a[@] + b[@]"), write("a, b", "a[@] - b[@]")
    truths = write("x1, x2, x2_dot", "Truth(x1[@], x2[@], x2_dot[@])", Truth=Truth)
    faults = each_axis(n, "s", "s[@].gate.state == FAULT", "return {}", " or ", FAULT=FAULT)
    tripped_all = write("s, reason", "with_gate(s[@], reason)", with_gate=with_gate)

    def output(c: Coefficients, s: Any, noise: Any) -> Any:
        more, more_dot = nothing(), nothing()
        if crossed:
            x = states(s)
            more, more_dot = cross(c.coupling, 0, x), cross(c.coupling, 1, x)
        measured = told(c.each, s, noise, more, more_dot)
        if sensed or shared:
            y, y_dot, u = ys(measured), y_dots(measured), voltages(measured)
            if sensed:
                y, y_dot = combined(c.coupling.S, y), combined(c.coupling.S, y_dot)
            if filtered:
                u = less(u, of_later(c.coupling.A, past_of(s).told))
            if shared:
                u = combined(c.coupling.A_inverse, u)
            measured = measurements(y, y_dot, u)
        return measured

    def update(c: Coefficients, s: Any, noise: Any, measured: Any, u: Any) -> Any:
        more, own = nothing(), measured
        u_axes, before = u, s
        if crossed:
            more = cross(c.coupling, 0, states(s))
        if sensed and gated:  # an actuator's gate looks at its own sensor
            y, y_dot = combined(c.coupling.S_inverse, ys(measured)), y_dots(measured)
            own = measurements(y, y_dot, voltages(measured))
        if shared:
            u = combined(c.coupling.A[0], u)
        if filtered:
            u = added(u, of_later(c.coupling.A, past_of(before).u))
        s = committed(c.each, s, own, u, more)
        if gated:
            if area and not inside(c.coupling.corners, measured[0].y, measured[1].y):
                s = tripped_all(s, PERMITTED_AREA)
            if faults(s):
                s = tripped_all(s, OTHER_AXIS)
        if filtered:
            remember(past_of(before).u, u_axes)
            remember(past_of(before).told, voltages(measured))
            return (*s, past_of(before))
        return s

    def truth(c: Coefficients, s: Any) -> Any:
        true = true_of_each(c.each, s)
        if crossed or sensed:
            x1, x2, x2_dot = x1s(true), x2s(true), x2_dots(true)
            if crossed:
                x = states(s)
                x1, x2 = added(x1, cross(c.coupling, 0, x)), added(x2, cross(c.coupling, 1, x))
                x2_dot = added(x2_dot, cross(c.coupling, 2, x))
                x2_dot = added(x2_dot, combined(c.coupling.D, inputs(s)))
            if sensed:
                x1, x2 = combined(c.coupling.S, x1), combined(c.coupling.S, x2)
                x2_dot = combined(c.coupling.S, x2_dot)
            true = truths(x1, x2, x2_dot)
        return true

    return SimpleNamespace(models=models, axes=n, output=output, update=update, truth=truth)
