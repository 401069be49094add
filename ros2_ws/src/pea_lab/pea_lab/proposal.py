r"""Gains of a law on modes, proposed from the model over a set of stages around it.

The set holds the model, the corners of the stated spread of every frequency and of the gain, and
the model at a lower gain, which the local slope of a hysteresis gives. With C(z) the law and its
estimator from y to u and P_i(z) a stage, S_i = 1 / (1 - C P_i). Of all candidates that keep

- the modulus margin, the least distance 1 / max |S| of the loop from -1, on the model, and a
  smaller one on every stage of the set,
- a decay of every closed-loop pole on every stage, at least `DECAY` times that of the slowest mode,
- the stated bandwidth, the frequency up to which |T| = |1 - S| stays above -3 dB on the model,

the one with the best rejection is taken: the least of

- the largest |S_i| at f_1/74, f_1/15 and f_1/7.4, relative to the slope that an integral and a half
  gives,
- the largest |S_i P_i| over the gain of the model: what a voltage, as what is left of a hysteresis
  that is fed forward, does at a resonance. An undamped mode has 1 / 2 zeta there.

Nelder and Mead's method looks for it from the best of a coarse grid. Nothing is drawn: the same
model gives the same gains.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from pea_controller.model import pidsmc_modal, state_feedback
from pea_controller.model.modal import ModalParams, Row, controller, output_row, response
from pea_controller.model.pidsmc_modal import gains
from pea_core import modal
from pea_core.modal import ModalModel, varied
from pea_core.params import ParameterError

DECAY = 0.25
"""Least decay of a closed-loop pole, in that of the slowest mode of the model."""

PLACES = np.array([1.0 / 74.0, 1.0 / 15.0, 1.0 / 7.4])
"""Where the rejection counts, in the first natural frequency."""

WANTED = np.array([0.034, 0.127, 0.25])
"""Sensitivities there that count alike."""

DAMPED = 4.0
"""Largest |S P| over the gain of P that counts like `WANTED`."""

SLOPE = 0.55
"""Least local slope of a hysteresis that a loop must stand."""


class ProposalGoal(NamedTuple):
    """What is wanted.

    Attributes
    ----------
    bandwidth : float
        Frequency (Hz) up to which |T| of the model must stay above -3 dB; 0: as far as it goes.
    modulus : float
        Least modulus margin on the model.
    modulus_set : float
        The same on every stage of the set.
    voltage : float
        Most noise of the voltage, rms of K u in that of the sensor's noise. More of it moves the
        hysteresis where nothing has asked for it.
    frequency, gain : float
        Spread of every natural frequency and of the gain, as a share.
    """

    bandwidth: float = 0.0
    modulus: float = 0.5
    modulus_set: float = 0.27
    voltage: float = 1.5
    frequency: float = 0.03
    gain: float = 0.1


class Figures(NamedTuple):
    """A candidate on the set.

    modulus, modulus_set : margins.  largest : largest |z| of the set.  S (3) : largest |S| at
    `PLACES`.  resonance : largest |S P| over the gain of the model.  bandwidth (Hz).  noise : rms
    of x1 in that of the sensor.  voltage : rms of K u likewise.  allowed : bound of `largest`.
    """

    modulus: float
    modulus_set: float
    largest: float
    S: np.ndarray
    resonance: float
    bandwidth: float
    noise: float
    voltage: float
    allowed: float


@dataclass(frozen=True)
class Proposal:
    """Gains that keep the goal, their figures, and in words what limits them."""

    values: dict[str, float]
    figures: Figures
    limit: str


class NoProposal(Exception):
    """No candidate keeps the goal; the text says which part of it is missed, and by how much."""


class SampledStage(NamedTuple):
    """A stage of the set with its sampled form."""

    model: ModalModel
    of: modal.Sampled


def stages(model: ModalModel, goal: ProposalGoal, T_s: float) -> list[SampledStage]:
    """The set: the model first, then the corners, then lower gains."""
    n = len(model.omega_n)
    found = [model]
    for signs in itertools.product((-1.0, 1.0), repeat=n):
        shares = [1.0 + goal.frequency * sign for sign in signs]
        found += [varied(model, shares, 1.0 + goal.gain * sign) for sign in (-1.0, 1.0)]
        if len(set(signs)) == 1:
            found.append(varied(model, shares, (1.0 - goal.gain) * SLOPE))
    return [SampledStage(each, modal.sampled(each, T_s)) for each in found]


class Problem:
    """A law on a model, evaluated for candidates.

    Parameters
    ----------
    params : ModalParams
        The law; its gains are what is looked for.
    goal : ProposalGoal
    T_s : float
        Sample period (s).
    """

    def __init__(self, params: ModalParams, goal: ProposalGoal, T_s: float) -> None:
        self.params, self.goal, self.T_s = params, goal, T_s
        self.model = params.modes
        self.set = stages(self.model, goal, T_s)
        late = params.delay_samples + params.sensor_delay_samples
        self.late = late + self.set[0].of.whole
        first = min(self.model.omega_n) / (2.0 * math.pi)
        half = 0.5 / T_s
        near = [o / (2.0 * math.pi) * (1.0 + np.linspace(-0.06, 0.06, 60)) for o in
                self.model.omega_n]  # fmt: skip
        f = np.concatenate([np.geomspace(1e-3 * first, 0.999 * half, 160), *near, first * PLACES])
        self.f = np.unique(f[f < half])
        self.z = np.exp(2j * np.pi * self.f * T_s)
        self.P = np.array([response(each.model, late, self.z, T_s) for each in self.set])
        self.places = np.searchsorted(self.f, first * PLACES)
        slowest = min(z * o for z, o in zip(self.model.zeta, self.model.omega_n, strict=True))
        self.allowed = math.exp(-DECAY * min(slowest, 0.1 * min(self.model.omega_n)) * T_s)

    def law(self, values: dict[str, float]) -> tuple[np.ndarray, Row]:
        """Gain of the estimator and row of the command."""
        noises = dataclasses.replace(
            self.params.estimator,
            eps_rate_walk=values["estimator.eps_rate_walk"],
            input_noise=values["estimator.input_noise"],
        )
        if "effort" in values:
            g = modal.optimal_gain(self.model, values["effort"], self.T_s)
        else:
            g = gains(self.model, values["m"], values["P"] * 1e6, 1.0)
        return modal.kalman(self.model, noises, self.T_s), output_row(self.params, g, self.T_s)

    def estimator(self, L: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(I - L C) F, and (I - L C) on both parts of Gamma."""
        of = self.set[0].of
        F, _ = modal.extended(of.F, of.G, self.T_s)
        left = np.eye(len(F)) - np.outer(L, np.append(of.C, [0.0, 0.0]))
        none = [0.0, 0.0]
        return left @ F, left @ np.append(of.G_0, none), left @ np.append(of.G_1, none)

    def controller(self, L: np.ndarray, row: Row) -> np.ndarray:
        """C(z) from y to u."""
        return controller(self.params, L, lambda z: [(row, 1.0)], self.z, self.T_s)

    def closed(self, stage: SampledStage, L: np.ndarray, row: Row) -> np.ndarray:
        """State matrix of the loop: stage, commands on the way, estimate."""
        of, late = stage.of, self.late + stage.of.whole - self.set[0].of.whole
        F, G_0, G_1 = self.estimator(L)
        n, m, N = len(of.F), len(F), late + 2
        A = np.zeros((n + N + m, n + N + m))
        x, way, hat = slice(0, n), n, slice(n + N, None)
        y = np.zeros(n + N + m)
        y[x] = of.C
        e = np.zeros((m, n + N + m))
        e[:, hat] = F
        e[:, way + self.late], e[:, way + self.late + 1] = G_0, G_1
        e += np.outer(L, y)
        u = -np.append(row.x, [row.eps, row.eps_dot]) @ e
        for j, h in enumerate(row.net):
            u[way + j] -= h
        A[x, x] = of.F
        for G, lag in ((of.G_0, late), (of.G_1, late + 1)):
            if lag:
                A[x, way + lag - 1] += G
            else:
                A[x] += np.outer(G, u)
        A[way] = u
        for j in range(1, N):
            A[way + j, way + j - 1] = 1.0
        A[hat] = e
        return A

    def figures(self, values: dict[str, float]) -> Figures:
        """Margins and rejection of a candidate; ParameterError where it cannot be designed."""
        L, row = self.law(values)
        C = self.controller(L, row)
        S = np.abs(1.0 / (1.0 - C * self.P))
        largest = max(
            float(np.abs(np.linalg.eigvals(self.closed(stage, L, row))).max()) for stage in self.set
        )
        T = S[0] * np.abs(C * self.P[0])
        below = np.flatnonzero(math.sqrt(0.5) > T)
        noise = math.sqrt(float(np.trapezoid(T**2, self.f)) * 2.0 * self.T_s)
        u = S[0] * np.abs(C) * abs(self.model.gain)
        voltage = math.sqrt(float(np.trapezoid(u**2, self.f)) * 2.0 * self.T_s)
        return Figures(
            modulus=float(1.0 / S[0].max()),
            modulus_set=float(1.0 / S.max()),
            largest=largest,
            S=S[:, self.places].max(axis=0),
            resonance=float((S * np.abs(self.P)).max() / abs(self.model.gain)),
            bandwidth=float(self.f[below[0]] if below.size else self.f[-1]),
            noise=noise,
            voltage=voltage,
            allowed=self.allowed,
        )

    def missed(self, found: Figures) -> dict[str, float]:
        """By how much each part of the goal is missed, as a share; 0 where it is kept."""
        goal = self.goal
        return {
            "modulus margin of the model": max(1.0 - found.modulus / goal.modulus, 0.0),
            "modulus margin of the set": max(1.0 - found.modulus_set / goal.modulus_set, 0.0),
            "decay of the set": max((found.largest - found.allowed) / (1.0 - found.allowed), 0.0),
            "bandwidth": max(1.0 - found.bandwidth / goal.bandwidth, 0.0)
            if goal.bandwidth
            else 0.0,
            "noise": max(found.noise - 1.0, 0.0),
            "noise of the voltage": max(found.voltage / goal.voltage - 1.0, 0.0),
        }

    def cost(self, values: dict[str, float], damped: float = DAMPED) -> float:
        """What Nelder and Mead's method lowers; `damped` may take the place of `DAMPED`."""
        try:
            found = self.figures(values)
        except (ParameterError, np.linalg.LinAlgError):
            return 1e3
        if not math.isfinite(found.largest):
            return 1e3
        rejection = max(float((found.S / WANTED).max()), found.resonance / damped)
        return math.log(rejection) + 10.0 * sum(
            min(part, 10.0) for part in self.missed(found).values()
        )


STARTS: dict[type, dict[str, Callable[[ModalModel], Sequence[float]]]] = {
    state_feedback.Params: {
        "estimator.eps_rate_walk": lambda model: (3e2, 3e3, 3e4),
        "estimator.input_noise": lambda model: (0.02, 0.2, 2.0),
        "effort": lambda model: (1.0, 500.0),
    },
    pidsmc_modal.Params: {
        "estimator.eps_rate_walk": lambda model: (1e3, 3e4),
        "estimator.input_noise": lambda model: (0.02, 0.5),
        "m": lambda model: (0.05 * min(model.omega_n), 0.5 * min(model.omega_n)),
        "P": lambda model: [
            share / (model.gain * 1e6 * min(model.omega_n)) for share in (0.02, 0.3)
        ],
    },
}
"""Where the gains of each law are first looked for."""

TOLERANCE = 2e-3
"""Share of a goal that may be missed, as its methods end."""


def propose(params: ModalParams, goal: ProposalGoal, T_s: float, tries: int = 140) -> Proposal:
    """Look for gains of a law.

    Parameters
    ----------
    params : ModalParams
        `state_feedback` or `pidsmc_modal`, with its model and delays.
    goal : ProposalGoal
    T_s : float
        Sample period (s).
    tries : int
        Candidates that each of five searches looks at.

    Raises
    ------
    NoProposal
        No candidate keeps the goal.
    ParameterError
        The law has no gains that can be proposed.
    """
    from scipy.optimize import minimize  # slow to import

    if type(params) not in STARTS:
        raise ParameterError("gains are proposed for state_feedback and pidsmc_modal; take one")
    problem = Problem(params, goal, T_s)
    ways = STARTS[type(params)]
    names = tuple(ways)

    def values(x: np.ndarray) -> dict[str, float]:
        return dict(zip(names, np.exp(np.clip(x, -40.0, 20.0)).tolist(), strict=True))

    grid = [np.log(p) for p in itertools.product(*(way(problem.model) for way in ways.values()))]

    def search(damped: float) -> dict[str, float]:
        def cost(x: np.ndarray) -> float:
            return problem.cost(values(x), damped)

        best: Any = None
        for start in sorted(grid, key=cost)[:5]:
            simplex = np.vstack([start, start + np.eye(len(start))])
            options = {"maxfev": tries, "initial_simplex": simplex, "xatol": 1e-3, "fatol": 1e-4}
            found = minimize(cost, start, method="Nelder-Mead", options=options)
            best = found if best is None or found.fun < best.fun else best
        return {name: float(f"{value:.4g}") for name, value in values(best.x).items()}

    for damped in (DAMPED, math.inf):  # what leaves a resonance undamped may still keep the goal
        chosen = search(damped)
        figures = problem.figures(chosen)
        missed = {name: part for name, part in problem.missed(figures).items() if part > TOLERANCE}
        if not missed:
            break
    else:
        worst = max(missed, key=missed.__getitem__)
        raise NoProposal(f"no candidate keeps the {worst}: missed by {missed[worst]:.1%}")
    return Proposal(chosen, figures, limit(figures, goal))


def limit(found: Figures, goal: ProposalGoal) -> str:
    """In words, what keeps the rejection from being better."""
    close = {
        "modulus margin of the model": found.modulus / goal.modulus,
        "modulus margin of the set": found.modulus_set / goal.modulus_set,
        "decay of the set": (1.0 - found.largest) / (1.0 - found.allowed),
        "noise": 1.0 / max(found.noise, 1e-3),
        "noise of the voltage": goal.voltage / max(found.voltage, 1e-3),
    }
    return min(close, key=close.__getitem__)
