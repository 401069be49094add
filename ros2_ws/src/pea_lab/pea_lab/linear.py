r"""The loop as one linear sampled system, taken from the blocks themselves.

A linear block is its own definition: one tick of it, output and update, is linear in state and
signals, so its matrices are found by moving one of them at a time from rest,

.. math:: x_{k+1} = A x_k + B v_k, \quad z_k = C x_k + D v_k

exact to rounding. Any observer and any law that is linear in what is fed back works, those to come
included; whether a block is linear is tried with random signals of the size of the noise
(superposition). What a law does with the reference need not be linear: it is in no loop. What it
learns from period to period is left out.

The plant here is the nominal one: V, the lags of amplifier and sensor, and all delays. Hysteresis
is taken as v = u; creep and load, which the lumped unknown input stands for, are left out, and so
are noise, limits and everything quantised.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from pea_controller import model as controllers
from pea_core.signals import Estimate, Measurement, Reference
from pea_core.step import step_of
from pea_experiment.experiment import Experiment
from pea_observer import model as observers
from pea_plant.model import actuator, creep, hysteresis, load

STEP = 1e-9
"""How far (m, m/s, V) a signal or state is moved: within any boundary layer."""

SIZES = {"x1": 1e-9, "x2": 1e-4, "w_ddot": 1.0, "V": 0.1}
"""Size of displacements (m), velocities (m/s), accelerations and voltages of the noise's order."""

STATES_MAX = 500
"""Numbers of memory that a block is linearised with at most."""

TRIES = 40
"""Samples of random signals with which linearity is tried."""

MEASUREMENT = (SIZES["x1"], SIZES["x2"], SIZES["V"])
REFERENCE = (SIZES["x1"], SIZES["x2"], SIZES["w_ddot"])
ESTIMATE = MEASUREMENT


class Nonlinear(Exception):
    """A block that has no poles or margins; the text names it."""


MANY = 64
"""States from which on a response at more angles than states goes by a triangular matrix."""

NUMBERS = 2_000_000
"""Numbers of the matrices that are solved at a time: bounds the memory."""

NEGLIGIBLE = 1e-8
"""Share of the largest Hankel singular value below which a state is left out, see `reduced`."""


class System(NamedTuple):
    """A (n, n), B (n, r), C (p, n), D (p, r) of a sampled linear system."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray


Tick = Callable[[Any, np.ndarray], tuple[tuple[float, ...], Any]]
"""From state and inputs to outputs and the next state."""


def numbers(state: object) -> list[float]:
    """Every float of a state, arrays element by element; counters are none."""
    if isinstance(state, np.ndarray):
        return state.ravel().tolist() if state.dtype.kind == "f" else []
    if isinstance(state, tuple):
        return [number for part in state for number in numbers(part)]
    return [float(state)] if isinstance(state, float) else []


def filled(state: object, values: Iterator[float]) -> Any:
    """A copy of a state with its floats from `values`, in the order of `numbers`."""
    if isinstance(state, np.ndarray):
        if state.dtype.kind != "f":
            return state.copy()
        flat = [next(values) for _ in range(state.size)]
        return np.array(flat, state.dtype).reshape(state.shape)
    if isinstance(state, tuple):
        parts = [filled(part, values) for part in state]
        return tuple(parts) if type(state) is tuple else type(state)(*parts)
    return next(values) if isinstance(state, float) else state


def linearise(tick: Tick, start: object, inputs: int) -> System:
    """Matrices of a block, by moving one state or input at a time.

    Parameters
    ----------
    tick : Tick
        One sample of the block.
    start : NamedTuple
        Its state at rest.
    inputs : int
        Number of inputs.

    Raises
    ------
    Nonlinear
        More than `STATES_MAX` states.
    """
    rest = np.array(numbers(start))
    n = rest.size
    if n > STATES_MAX:
        raise Nonlinear(f"a memory of {n} numbers is too long for its poles to be computed")

    def response(x: np.ndarray, v: np.ndarray) -> np.ndarray:
        outputs, after = tick(filled(start, iter(x.tolist())), v)
        return np.array([*numbers(after), *outputs])

    still = response(rest, np.zeros(inputs))
    columns = [
        response(rest + STEP * move[:n], STEP * move[n:]) - still for move in np.eye(n + inputs)
    ]
    M = np.array(columns).reshape(n + inputs, -1).T / STEP
    return System(M[:n, :n], M[:n, n:], M[n:, :n], M[n:, n:])


def superposes(tick: Tick, start: object, sizes: tuple[float, ...], scale: float = 1.0) -> bool:
    """Whether the block answers a sum of random signals with the sum of its answers.

    Parameters
    ----------
    tick : Tick
        One sample of the block.
    start : NamedTuple
        Its state at rest.
    sizes : tuple of float
        Size of each input.
    scale : float
        Factor of all sizes.
    """
    rng = np.random.default_rng(1)
    a, b = rng.uniform(-1.0, 1.0, (2, TRIES, len(sizes))) * np.array(sizes) * scale

    def answer(signals: np.ndarray) -> np.ndarray:
        state, rows = filled(start, iter(numbers(start))), []
        for v in signals:
            outputs, state = tick(state, v)
            rows.append(outputs)
        return np.array(rows)

    rest = answer(0.0 * a)
    of_a = answer(a) - rest
    size = np.abs(of_a).max(axis=0) + 1e-300
    summed = np.abs(answer(a + b) - rest - of_a - (answer(b) - rest))
    return bool((summed <= 1e-6 * size).all())


def observer_tick(experiment: Experiment) -> tuple[Tick, Any]:
    """Tick of the observer, (y, y', u_applied) -> (x1, x2, eps), and its state at rest."""
    params = experiment.nodes["observer"].params
    model = observers.MODELS[observers.CHOICE.type_of(params)]
    c = model.design(params, experiment.T_s)

    both = step_of(model).both

    def tick(s: object, v: np.ndarray) -> tuple[tuple[float, ...], Any]:
        return both(c, s, (Measurement(*v.tolist()),))

    return tick, model.start(c)


def learns(experiment: Experiment) -> bool:
    """Whether the law learns from period to period, which by default none does."""
    params = experiment.nodes["controller"].params
    return bool(unlearned(params) != params)


def unlearned(params: object) -> Any:
    """Parameters of a law without what it learns from period to period."""
    model = controllers.MODELS[controllers.CHOICE.type_of(params)]
    return model.unlearned(params) if hasattr(model, "unlearned") else params


def controller_tick(experiment: Experiment) -> tuple[Tick, Any]:
    """Tick of the law, (x1, x2, eps, w, w', w'', previewed the same) -> u, and its state.

    Where there are three inputs only, the reference is at rest at zero.
    """
    given = experiment.nodes["controller"].params
    unlimited = {"voltage_min": -math.inf, "voltage_max": math.inf, "slew_rate": 0.0}
    params = dataclasses.replace(unlearned(given), **unlimited)
    model = controllers.MODELS[controllers.CHOICE.type_of(params)]
    c = model.design(params, experiment.T_s)
    both = step_of(model).both

    def tick(s: object, v: np.ndarray) -> tuple[tuple[float, ...], Any]:
        values = [*v.tolist(), *[0.0] * (9 - v.size)]
        signals = Reference(*values[3:6]), Reference(*values[6:]), Estimate(*values[:3])
        u, s = both(c, s, signals)
        return (u,), s

    return tick, model.start(c)


def nominal(params: actuator.Params) -> actuator.Params:
    """The actuator without what is nonlinear and without creep, load and noise."""
    return dataclasses.replace(
        params,
        x10_um=0.0,
        x20_um_s=0.0,
        hysteresis=hysteresis.none.Params(),
        creep=creep.linear.Params(enabled=False),
        load=load.none.Params(),
        amplifier=dataclasses.replace(params.amplifier, slew_rate=0.0, dac_bits=0),
        sensor=dataclasses.replace(
            params.sensor, noise_nm=0.0, quantisation_nm=0.0, delay_samples=0, ideal=True
        ),
        voltage_min=-math.inf,
        voltage_max=math.inf,
    )


def plant(experiment: Experiment, creeps: bool = False) -> System:
    """The nominal plant, with its creep if asked for: u -> (y, y', u_applied, x1)."""
    given = experiment.nodes["plant"].params
    params = nominal(given)
    if creeps:
        params = dataclasses.replace(params, creep=given.creep)
    model = actuator.actuator(params)
    c = model.design(params, experiment.T_s)
    compute, commit, _ = step_of(model)

    def tick(s: object, v: np.ndarray) -> tuple[tuple[float, ...], Any]:
        measured = compute(c, s, (0.0,))
        x1 = model.truth(c, s).x1
        return (*measured, x1), commit(c, s, (0.0,), measured, (float(v[0]),))

    return minimal(late(linearise(tick, model.start(c), 1), given.sensor.delay_samples))


def late(system: System, samples: int, output: int = 0) -> System:
    """The system with one of its outputs told some samples later."""
    A, B, C, D = system
    row = slice(output, output + 1)
    for _ in range(samples):
        n = len(A)
        A = np.block([[A, np.zeros((n, 1))], [C[row], np.zeros((1, 1))]])
        B = np.vstack([B, D[row]])
        C = np.hstack([C, np.zeros((len(C), 1))])
        C[output], D[output] = np.eye(n + 1)[n], 0.0
    return System(A, B, C, D)


def minimal(system: System) -> System:
    """The system without states that no input moves, or that no output sees."""
    A, B, C, D = system

    def spread(first: np.ndarray, links: np.ndarray) -> np.ndarray:
        kept = first
        for _ in range(len(A)):
            kept = kept | links[:, kept].any(axis=1)
        return kept

    moved = spread((B != 0.0).any(axis=1), A != 0.0)
    seen = spread((C != 0.0).any(axis=0), (A != 0.0).T)
    kept = moved & seen
    return System(A[np.ix_(kept, kept)], B[kept], C[:, kept], D)


def at(system: System, z: np.ndarray) -> np.ndarray:
    """C (z I - A)^-1 B at each z: (k, outputs, inputs) array; D is left out."""
    A, B, C, _ = system
    if MANY < len(A) < len(z):
        return _by_schur(A, B, C, z)
    found = []
    for part in np.array_split(z, 1 + len(z) * len(A) ** 2 // NUMBERS):
        x = np.linalg.solve(part[:, None, None] * np.eye(len(A)) - A, B[None] + 0j)
        found.append(C @ x)
    return np.concatenate(found)


def _by_schur(A: np.ndarray, B: np.ndarray, C: np.ndarray, z: np.ndarray) -> np.ndarray:
    """The same with A made triangular once: n^2 operations for each z, not n^3."""
    from scipy.linalg import schur  # slow to import

    T, Q = schur(A, output="complex")
    b, n = Q.conj().T @ B, len(A)
    x = np.empty((n, len(z), B.shape[1]), complex)
    for i in reversed(range(n)):
        rest = np.tensordot(T[i, i + 1 :], x[i + 1 :], 1)
        x[i] = (b[i] + rest) / (z - T[i, i])[:, None]
    found: np.ndarray = np.moveaxis(np.tensordot(C @ Q, x, 1), 1, 0)
    return found


def reduced(system: System) -> System:
    """A stable system without states that matter to no output: balanced truncation.

    What is left out is below `NEGLIGIBLE` of each output's rms under white inputs. Poles that zeros
    cancel go.
    """
    from scipy.linalg import eigh, solve_discrete_lyapunov, svd  # slow to import

    A, B, C, D = balanced(system)

    def root(P: np.ndarray) -> np.ndarray:
        values, vectors = eigh((P + P.T) / 2.0)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))

    P = solve_discrete_lyapunov(A, B @ B.T)
    size = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", C, P, C), 0.0))
    C_1 = C / np.where(size > 0.0, size, 1.0)[:, None]
    L, M = root(P), root(solve_discrete_lyapunov(A.T, C_1.T @ C_1))
    U, s, V = svd(M.T @ L)
    kept = s > NEGLIGIBLE * s[0]
    T = L @ V[kept].T / np.sqrt(s[kept])
    T_inverse = (U[:, kept] / np.sqrt(s[kept])).T @ M.T
    return System(T_inverse @ A @ T, T_inverse @ B, C @ T, D)


def balanced(system: System) -> System:
    """The same system with its states in units in which they are of one size."""
    from scipy.linalg import matrix_balance  # slow to import

    A, B, C, D = system
    if not len(A):
        return system
    A, (scale, _) = matrix_balance(A, permute=False, separate=True)
    return System(A, B / scale[:, None], C * scale, D)


class LinearBlocks(NamedTuple):
    """The three blocks of the loop.

    plant : u -> y, y', u_applied, x1.  observer : y, y', u_applied -> x1, x2, eps.
    controller : x1, x2, eps -> u.
    everywhere : False where a block is linear for small signals only.
    """

    plant: System
    observer: System
    controller: System
    everywhere: bool


def blocks(experiment: Experiment) -> LinearBlocks:
    """The matrices of each block.

    Raises
    ------
    Nonlinear
        The observer or the law is not linear, not even for small signals.
    """
    found: dict[str, System] = {}
    everywhere = True
    for node, (tick, start), sizes in (
        ("observer", observer_tick(experiment), MEASUREMENT),
        ("controller", controller_tick(experiment), ESTIMATE),
    ):
        if not superposes(tick, start, sizes):
            type_ = experiment.nodes[node].values["type"]
            raise Nonlinear(f"{node}.type = {type_} is not linear: it has no poles and no margins")
        everywhere = everywhere and superposes(tick, start, sizes, 1e4)
        found[node] = minimal(linearise(tick, start, len(sizes)))
    return LinearBlocks(plant(experiment), found["observer"], found["controller"], everywhere)


class LinearLoop(NamedTuple):
    """The loop, cut where the voltage u enters the plant.

    x+ = A x + B u + E n,  u_command = C x + F n,  x1 = C_1 x, n the sensor's noise (m).
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    E: np.ndarray
    F: float
    C_1: np.ndarray

    def closed(self, gain: float = 1.0) -> np.ndarray:
        """State matrix with u = gain * u_command."""
        return self.A + gain * np.outer(self.B, self.C)


def assemble(parts: LinearBlocks, gain: float = 1.0) -> LinearLoop:
    """The three blocks as one loop; the reference is at rest at zero.

    Parameters
    ----------
    parts : LinearBlocks
        From `blocks`.
    gain : float
        Of the actuator, relative to its own; the voltage told to the observer is not changed.
    """
    P, O, K = parts.plant, parts.observer, parts.controller  # noqa: E741
    n_p, n_o, n_k = len(P.A), len(O.A), len(K.A)
    C_m = P.C[:3] * np.array([[gain], [gain], [1.0]])  # y, y', u_applied
    from_y = np.array([1.0, 0.0, 0.0])
    # rows: what plant, observer and law do with x_p, x_o, x_k and the noise in y
    estimate = np.hstack([O.D @ C_m, O.C, np.zeros((3, n_k))])
    A = np.vstack(
        [
            np.hstack([P.A, np.zeros((n_p, n_o + n_k))]),
            np.hstack([O.B @ C_m, O.A, np.zeros((n_o, n_k))]),
            K.B @ estimate + np.hstack([np.zeros((n_k, n_p + n_o)), K.A]),
        ]
    )
    B = np.concatenate([P.B[:, 0], np.zeros(n_o + n_k)])
    C = (K.D @ estimate)[0] + np.concatenate([np.zeros(n_p + n_o), K.C[0]])
    noisy = O.D @ from_y
    E = np.concatenate([np.zeros(n_p), O.B @ from_y, K.B @ noisy])
    C_1 = np.concatenate([gain * P.C[3], np.zeros(n_o + n_k)])
    return LinearLoop(A, B, C, E, float((K.D @ noisy)[0]), C_1)


def systems(experiment: Experiment) -> dict[str, Any]:
    """The linear parts as `control.StateSpace` systems of python-control, dt = T_s.

    Take margins from a frequency response, ``control.stability_margins(L, method="frd")``: the
    polynomials of its other method lose too many digits at 20 kHz.

    Returns
    -------
    dict
        plant : u -> y, y_dot, u_applied, x1
        observer : y, y_dot, u_applied -> x1_hat, x2_hat, eps_hat
        controller : x1_hat, x2_hat, eps_hat -> u; where the law is linear in the reference too,
            also w, w_dot, w_ddot, and these previewed, w_ff, w_ff_dot, w_ff_ddot
        loop : u -> u_command, all three in a row, cut at u; 1 - loop decides on stability
        noise : noise of y -> x1, u, the loop closed

    Raises
    ------
    Nonlinear
        The observer or the law is not linear.
    ImportError
        python-control is not installed.
    """
    import control

    parts = blocks(experiment)
    cut = assemble(parts)
    law = parts.controller
    signals: tuple[str, ...] = ("x1_hat", "x2_hat", "eps_hat")
    tick, start = controller_tick(experiment)
    if superposes(tick, start, ESTIMATE + REFERENCE + REFERENCE):
        law = minimal(linearise(tick, start, 9))
        signals += ("w", "w_dot", "w_ddot", "w_ff", "w_ff_dot", "w_ff_ddot")
    names = {
        "plant": (("u",), ("y", "y_dot", "u_applied", "x1")),
        "observer": (("y", "y_dot", "u_applied"), ("x1_hat", "x2_hat", "eps_hat")),
        "controller": (signals, ("u",)),
        "loop": (("u",), ("u_command",)),
        "noise": (("n",), ("x1", "u")),
    }
    matrices: dict[str, System] = {
        "plant": parts.plant,
        "observer": parts.observer,
        "controller": law,
        "loop": System(cut.A, cut.B[:, None], cut.C[None, :], np.zeros((1, 1))),
        "noise": System(
            cut.closed(),
            (cut.E + cut.B * cut.F)[:, None],
            np.vstack([cut.C_1, cut.C]),
            np.array([[0.0], [cut.F]]),
        ),
    }
    return {
        name: control.ss(
            *balanced(matrices[name]), experiment.T_s, inputs=inputs, outputs=outputs, name=name
        )
        for name, (inputs, outputs) in names.items()
    }
