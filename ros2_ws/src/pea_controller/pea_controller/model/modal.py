r"""What the laws with a model of several modes share: feedforward, estimator, prediction.

The model is that of `pea_core.modal`: modes behind a delay. The whole delay is

.. math:: D = d_u + n + d_y

samples: d_u of the command, the whole samples n of V's delay n + f, and d_y of the sensor. Every
part of the law follows from the model.

1. The voltage v that the model needs to follow the reference, d_u + n + f + 1/2 samples ahead, by
   inversion of V (`pea_core.modal.inverse`): from w, w' and w'' there, and, if V has unstable
   zeros, from w'' of later samples. The inverse of the hysteresis is applied to v (`inverse`).
2. The displacement y_r of the model driven by v, held and delayed. The measured difference from it
   is the deviation, whatever the reference does,

   .. math:: y_k - y_{r,k} = C \delta_k, \quad
             \delta_{k+1} = \Phi \delta_k + \Gamma_0 \nu_{k-D} + \Gamma_1 \nu_{k-D-1}
             + \Gamma \varepsilon_{k+1},

   where nu is the applied voltage minus the voltage that was fed forward. So the estimator takes a
   limited or slewing voltage into account, and it is no error of the model.
3. The Kalman filter of [delta, eps, eps'] at the instant at which y was measured, d_y samples ago.
4. If `adaptation` is not 0, the share theta by which the gain of the stage differs from the model.
   It follows from the correlation of changes of v and of the estimate of eps,

   .. math:: u_{ff} = h^{-1}((1 + \vartheta)\,v), \quad
             \vartheta_{k+1} = \vartheta_k - a\,T_s
             \frac{d\,\Delta\hat\varepsilon}{\max d^2}, \quad d = \dot w\,T_s / K

   d depends on the reference only. The estimator is told how a change of theta changes u, so that
   theta responds to the stage only.
5. A prediction to the instant at which the command begins to act, D + f samples later. All commands
   that have not acted yet are known,

   .. math:: \tilde\delta = \Phi_f \Bigl(\Phi^D \hat\delta + \sum_{i=0}^{D-1} \Phi^{D-1-i}
             (\Gamma_0 \nu_{k-D+i} + \Gamma_1 \nu_{k-D+i-1})\Bigr) + \Gamma_f \nu_{k-1},

   and eps is predicted along its ramp. The prediction is linear in the estimate and these commands,
   so the law uses products with rows that are computed once (`Row`).
6. The learned correction on a periodic reference is added to the command and counted as fed
   forward, so that delta contains its whole effect (`harmonics`).

From the observer the law uses only x1, which must be the measured y: observer `measured`.

Inputs
    `Reference` W (m, m/s, m/s^2), the same previewed, `Estimate` (m, m/s, V).
Outputs
    v, y_r, the corrected estimate: see `Seen`.
State
    estimate, states of the model driven by v, the last commands, the future reference, the plays of
    the hysteresis, the state of the slew limit, the learned correction.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from pea_controller.model import harmonics, inverse, slew
from pea_controller.model.common import CommonParams
from pea_controller.model.harmonics import acts, blank, correction, learned
from pea_controller.model.inverse import centred, fed, moved
from pea_controller.model.slew import applied, at_rest, kept_back
from pea_core import modal
from pea_core.modal import DELAY_MAX, ModalModel, Noises, Sampled, varied
from pea_core.params import ParameterError, group, param
from pea_core.signals import Reference, between

ADAPTED_MAX = 0.5
"""Largest share by which the feedforward adapts."""

AHEAD = 40
"""Samples of the reference that these laws know beyond the plant's delay."""


@dataclass(frozen=True)
class ModalParams(CommonParams):
    """Model, estimator and hysteresis, in the paper's units."""

    eps_compensation: bool = param(True, help="the law's own eps is always subtracted")
    model: ModalModel = group(ModalModel)
    estimator: Noises = group(Noises)
    inverse: inverse.Params = group(inverse.Params)
    learning: harmonics.Params = group(harmonics.Params)
    adaptation: float = param(
        0.0, "1/s", 0.0, 1e3, help="a: how fast the feedforward adapts to the stage's gain; 0: not"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("feedforward", "eps_compensation"):
            if not getattr(self, name):
                raise ParameterError(
                    f"{name} = False: this law rests on it; leave it true, or take type pidsmc"
                )

    @property
    def preview(self) -> float:
        """How far ahead the feedforward looks (samples)."""
        return float(AHEAD + self.delay_samples)

    @property
    def modes(self) -> ModalModel:
        """The model; if no modes are given, the mode of zeta, omega_n and K."""
        return self.model.or_one(self)


class Row(NamedTuple):
    """A row r of r delta~ as products: with the estimate (n), eps, eps', and commands (D + 1)."""

    x: np.ndarray
    eps: float
    eps_dot: float
    net: np.ndarray


class Coefficients(NamedTuple):
    """The model and its estimator in SI.

    F (n, n), G, G_0, G_1 (n): see `pea_core.modal.Sampled`.  C (n).  L (n), l_eps, l_dot: gain.
    adaptation: a T_s.  late: D.  ahead: samples between the target of the feedforward and the
    newest reference known; theta: fraction of the target; lead: its distance from this sample (s).
    a_0, a_1, a_2, p, c, backward, future: see `pea_core.modal.Inverse`.
    inverse: see `inverse`.  actuator: see `slew`.  learning: see `harmonics`.
    """

    F: np.ndarray
    G: np.ndarray
    G_0: np.ndarray
    G_1: np.ndarray
    C: np.ndarray
    L: np.ndarray
    l_eps: float
    l_dot: float
    adaptation: float
    late: int
    ahead: int
    theta: float
    lead: float
    a_0: float
    a_1: float
    a_2: float
    p: np.ndarray
    c: np.ndarray
    backward: np.ndarray
    future: int
    T_s: float
    inverse: inverse.Coefficients
    actuator: slew.Coefficients
    learning: harmonics.Coefficients


class State(NamedTuple):
    """k: sample number.  x (n), eps (V), eps_dot (V/s): estimate after the last correction.

    x_r (n): states of the model driven by v.  net, v (D + 2): nu and v of the last commands, the
    oldest first (V).  taught (D + 2): learned corrections in them (V).  pace, turned (D + 2): d of
    the adaptation (V), and the change of the feedforward by a change of theta (V).  theta,
    theta_before, steepest (V^2): present share, that of the last command, largest recent d^2.
    eta (m, 2): filters of the inverse.  w_ddot: of the last target (m/s^2).
    coming (N, 3): ring of the reference previewed.  inverse: see `inverse`.  actuator: see `slew`.
    learning: see `harmonics`.
    """

    k: int
    x: np.ndarray
    eps: float
    eps_dot: float
    x_r: np.ndarray
    net: np.ndarray
    v: np.ndarray
    pace: np.ndarray
    turned: np.ndarray
    taught: np.ndarray
    theta: float
    theta_before: float
    steepest: float
    eta: np.ndarray
    w_ddot: float
    coming: np.ndarray
    inverse: inverse.State
    actuator: slew.State
    learning: harmonics.State


def row(params: ModalParams, g: np.ndarray, g_eps: float, g_dot: float, T_s: float) -> Row:
    """The row [g, g_eps, g_dot] of the predicted [delta, eps, eps'] as a `Row`."""
    of = modal.sampled(params.modes, T_s)
    late = lateness(params, of)
    F, _ = modal.extended(of.F, of.G, T_s)
    n, f = len(of.F), of.fraction * T_s
    partly = np.eye(n + 2)
    partly[:n, :n] = of.F_f
    partly[:n, n], partly[:n, n + 1] = of.G_f, f * of.G_f
    partly[n, n + 1] = f
    ahead = np.concatenate([g, [g_eps, g_dot]]) @ partly  # times F^j, from here on
    net = np.zeros(late + 1)
    net[0] = float(g @ of.G_f)
    for j in range(late):
        net[j] += float(ahead[:n] @ of.G_0)
        net[j + 1] += float(ahead[:n] @ of.G_1)
        ahead = ahead @ F
    return Row(ahead[:n].copy(), float(ahead[n]), float(ahead[n + 1]), net)


def lateness(params: ModalParams, of: Sampled) -> int:
    """D (samples).

    Raises
    ------
    ParameterError
        More than `DELAY_MAX`.
    """
    late = params.delay_samples + of.whole + params.sensor_delay_samples
    if late > DELAY_MAX:
        raise ParameterError(f"model.delay: {late} samples of delay in all: at most {DELAY_MAX}")
    return late


Rows = Callable[[np.ndarray], list[tuple[Row, Any]]]
"""The command -u of a law at frequencies z (G): rows, each with a weight, of shape (G) or a number.
"""


def controller(
    params: ModalParams, L: np.ndarray, rows: Rows, z: np.ndarray, T_s: float
) -> np.ndarray:
    """C(z) (G) from y to u of a law whose estimator has the gain L."""
    of = modal.sampled(params.modes, T_s)
    F, _ = modal.extended(of.F, of.G, T_s)
    left, none = np.eye(len(F)) - np.outer(L, np.append(of.C, [0.0, 0.0])), [0.0, 0.0]
    F, late = left @ F, lateness(params, of)
    G_0, G_1 = left @ np.append(of.G_0, none), left @ np.append(of.G_1, none)
    told = G_0 * z[:, None] ** -(1.0 + late) + G_1 * z[:, None] ** -(2.0 + late)
    right = np.stack([told, np.broadcast_to(L.astype(complex), told.shape)], axis=2)
    found = np.linalg.solve(np.eye(len(F)) - F / z[:, None, None], right)
    above, below = np.zeros(z.size, complex), np.ones(z.size, complex)
    for of_row, weight in rows(z):
        a = np.append(of_row.x, [of_row.eps, of_row.eps_dot])
        above += weight * (found[:, :, 1] @ a)
        way = sum(h * z ** -(1.0 + j) for j, h in enumerate(of_row.net))
        below += weight * (way + found[:, :, 0] @ a)
    return np.asarray(-above / below)


def response(model: ModalModel, late: int, z: np.ndarray, T_s: float) -> np.ndarray:
    """Frequency response (G) from u to y, `late` samples besides the delay of V."""
    of = modal.sampled(model, T_s)
    values, vectors = np.linalg.eig(of.F)
    modes = (of.C @ vectors) / (z[:, None] - values)
    G_0, G_1 = (np.linalg.solve(vectors, G.astype(complex)) for G in (of.G_0, of.G_1))
    held = modes @ G_0 + (modes @ G_1) / z
    return np.asarray(held * z ** -float(late + of.whole))


def design(params: ModalParams, T_s: float, rows: Rows) -> Coefficients:
    """Discretise and invert the model, solve Riccati's equation for the estimator.

    Parameters
    ----------
    params : ModalParams
    T_s : float
        Sample period (s).
    rows : callable
        The command of the law, of which learning follows.

    Raises
    ------
    ParameterError
        The delay of V is longer than the reference is known, or the estimator cannot be designed.
    """
    model = params.modes
    of, along = modal.sampled(model, T_s), modal.inverse(model, T_s)
    gain = modal.kalman(model, params.estimator, T_s)
    n = len(of.F)
    target = of.whole + of.fraction + 0.5
    whole = math.floor(target)

    def respond(f: np.ndarray, factors: Sequence[tuple[float, float]]) -> np.ndarray:
        z = np.exp(2j * np.pi * f * T_s)
        C = controller(params, gain, rows, z, T_s)
        late = params.delay_samples + params.sensor_delay_samples
        each = [varied(model, [o] * len(model.K), K) for o, K in factors]
        P = np.array([response(one, late, z, T_s) for one in each])
        return np.asarray(P / (1.0 - C * P))

    if whole + 2 > AHEAD:
        raise ParameterError(
            f"model.delay = {model.delay:g}: must be below {(AHEAD - 2) * T_s:g} s at this sample "
            "period, as far as the reference is known ahead"
        )
    return Coefficients(
        F=of.F,
        G=of.G,
        G_0=of.G_0,
        G_1=of.G_1,
        C=of.C,
        L=gain[:n].copy(),
        l_eps=float(gain[n]),
        l_dot=float(gain[n + 1]),
        adaptation=params.adaptation * T_s,
        late=lateness(params, of),
        ahead=AHEAD - whole,
        theta=target - whole,
        lead=(params.delay_samples + target) * T_s,
        a_0=along.a_0,
        a_1=along.a_1,
        a_2=along.a_2,
        p=along.p,
        c=along.c,
        backward=along.backward,
        future=min(along.ahead, AHEAD - whole - 2),
        T_s=T_s,
        inverse=inverse.design(params.inverse),
        actuator=params.actuator(T_s),
        learning=harmonics.design(params.learning, respond, T_s),
    )


def begun(c: Coefficients) -> State:
    """At rest."""
    n = c.C.size
    return State(
        k=0,
        x=np.zeros(n),
        eps=0.0,
        eps_dot=0.0,
        x_r=np.zeros(n),
        net=np.zeros(c.late + 2),
        v=np.zeros(c.late + 2),
        pace=np.zeros(c.late + 2),
        turned=np.zeros(c.late + 2),
        taught=np.zeros(c.late + 2),
        theta=0.0,
        theta_before=0.0,
        steepest=0.0,
        eta=np.zeros((c.c.shape[0], 2)),
        w_ddot=0.0,
        coming=np.zeros((AHEAD + 1, 3)),
        inverse=centred(c.inverse),
        actuator=at_rest(c.actuator),
        learning=blank(c.learning),
    )


class Seen(NamedTuple):
    """v (V).  u_ff (V): with the hysteresis and what is learned.  w_ddot: of its target (m/s^2).

    r (m): innovation.  eps (V), eps_dot (V/s): corrected.
    """

    v: float
    u_ff: float
    w_ddot: float
    r: float
    eps: float
    eps_dot: float


def stepped(c: Coefficients, i: int, x: np.ndarray, newer: float, older: float) -> float:
    """State i after Phi x + Gamma_0 newer + Gamma_1 older."""
    first = i - i % 2  # Phi has a block for each mode
    moved = c.F[i, first] * x[first] + c.F[i, first + 1] * x[first + 1]
    return float(moved + c.G_0[i] * newer + c.G_1[i] * older)


def prior(c: Coefficients, s: State) -> float:
    """Unknown input (V) before the correction: its ramp, and what the adaptation has changed."""
    return s.eps + c.T_s * s.eps_dot + s.turned[1]


def corrected(c: Coefficients, s: State, i: int, eps: float, r: float) -> float:
    """State i of the estimate, corrected with the innovation r (m)."""
    return stepped(c, i, s.x, s.net[1], s.net[0]) + c.G[i] * eps + c.L[i] * r


def along(c: Coefficients, s: State, W: Reference, W_ff: Reference) -> tuple[float, float]:
    """v (V), and w'' of its target (m/s^2)."""
    N = s.coming.shape[0]
    if s.k < c.ahead:  # what was previewed does not reach back to the target yet
        t = c.lead
        w_dot = W.w_dot + t * W.w_ddot
        v = c.a_0 * (W.w + t * (W.w_dot + 0.5 * t * W.w_ddot)) + c.a_1 * w_dot
        return v + c.a_2 * W.w_ddot, W.w_ddot
    i = s.k - c.ahead  # newest is s.k, which is not in the ring yet
    a = Reference(s.coming[i % N, 0], s.coming[i % N, 1], s.coming[i % N, 2])
    b = W_ff
    if c.ahead > 1:
        j = (i + 1) % N
        b = Reference(s.coming[j, 0], s.coming[j, 1], s.coming[j, 2])
    at = between(a, b, c.theta, c.T_s)
    v = c.a_0 * at.w + c.a_1 * at.w_dot + c.a_2 * at.w_ddot
    for m in range(c.c.shape[0]):
        p_re, p_im = c.p[m, 0], c.p[m, 1]
        if c.backward[m] > 0.0:
            re, im = 0.0, 0.0
            scale = 1.0 / (p_re * p_re + p_im * p_im)
            for j in range(c.future, 0, -1):
                # eta = (eta - step) / p
                re -= bent(c, s, i + j, W_ff) - bent(c, s, i + j - 1, W_ff)
                re, im = (re * p_re + im * p_im) * scale, (im * p_re - re * p_im) * scale
        else:
            step = at.w_ddot - s.w_ddot
            re = p_re * s.eta[m, 0] - p_im * s.eta[m, 1] + step
            im = p_im * s.eta[m, 0] + p_re * s.eta[m, 1]
        v += c.c[m, 0] * re - c.c[m, 1] * im
    return v, at.w_ddot


def bent(c: Coefficients, s: State, i: int, W_ff: Reference) -> float:
    """w'' (m/s^2) at the fraction theta after the previewed sample i."""
    N = s.coming.shape[0]
    here = s.coming[i % N, 2]
    after = W_ff.w_ddot if i + 1 >= s.k else s.coming[(i + 1) % N, 2]
    return float(here + c.theta * (after - here))


def seen(c: Coefficients, s: State, W: Reference, W_ff: Reference, y: float) -> Seen:
    """Feedforward of this sample, and what y (m) tells of the deviation."""
    v, w_ddot = along(c, s, W, W_ff)
    eps = prior(c, s)
    r = y
    for i in range(c.C.size):
        if c.C[i] != 0.0:
            x = stepped(c, i, s.x, s.net[1], s.net[0]) + c.G[i] * eps
            r -= c.C[i] * (x + stepped(c, i, s.x_r, s.v[1], s.v[0]))
    return Seen(
        v,
        fed(c.inverse, s.inverse, (1.0 + s.theta) * v) + correction(c.learning, s.learning),
        w_ddot,
        r,
        eps + c.l_eps * r,
        s.eps_dot + c.l_dot * r,
    )


def product(c: Coefficients, s: State, of: Row, now: Seen) -> float:
    """A row times the predicted deviation."""
    eps = prior(c, s)
    total = of.eps * now.eps + of.eps_dot * now.eps_dot
    for i in range(c.C.size):
        total += of.x[i] * corrected(c, s, i, eps, now.r)
    last = c.late + 1
    for j in range(c.late + 1):
        total += of.net[j] * s.net[last - j]
    return float(total)


def committed(
    c: Coefficients, s: State, W: Reference, W_ff: Reference, y: float, u: float
) -> State:
    """Keep the estimate, what the limits leave of u, and the reference."""
    now = seen(c, s, W, W_ff, y)
    eps, e = prior(c, s), y
    for i in range(0, c.C.size, 2):
        x1, x2 = corrected(c, s, i, eps, now.r), corrected(c, s, i + 1, eps, now.r)
        r1 = stepped(c, i, s.x_r, s.v[1], s.v[0])
        r2 = stepped(c, i + 1, s.x_r, s.v[1], s.v[0])
        s.x[i], s.x[i + 1], s.x_r[i], s.x_r[i + 1] = x1, x2, r1, r2
        e -= c.C[i] * r1 + c.C[i + 1] * r2
    theta, steepest = s.theta, s.steepest
    if c.adaptation > 0.0:
        rise = s.pace[1]
        steepest = max(rise * rise, steepest * (1.0 - 0.1 * c.adaptation))
        if steepest > 0.0:
            # what learning has taken off is part of what theta answers
            step = now.eps - s.eps - s.turned[1] - (s.taught[1] - s.taught[0])
            theta -= c.adaptation * rise * step / steepest
            theta = min(max(theta, -ADAPTED_MAX), ADAPTED_MAX)
    for i in range(c.late + 1):
        s.net[i], s.v[i], s.pace[i] = s.net[i + 1], s.v[i + 1], s.pace[i + 1]
        s.turned[i], s.taught[i] = s.turned[i + 1], s.taught[i + 1]
    s.turned[c.late + 1] = (s.theta - s.theta_before) * now.v
    s.net[c.late + 1] = applied(c.actuator, s.actuator, u) - now.u_ff
    s.v[c.late + 1] = now.v
    s.pace[c.late + 1] = c.a_0 * c.T_s * (W.w_dot + c.lead * W.w_ddot)
    if s.k >= c.ahead:
        for m in range(c.c.shape[0]):
            re = c.p[m, 0] * s.eta[m, 0] - c.p[m, 1] * s.eta[m, 1] + now.w_ddot - s.w_ddot
            im = c.p[m, 1] * s.eta[m, 0] + c.p[m, 0] * s.eta[m, 1]
            if c.backward[m] == 0.0:
                s.eta[m, 0], s.eta[m, 1] = re, im
    corrected_by = correction(c.learning, s.learning)
    s.taught[c.late + 1] = corrected_by
    memory, eps_now = learned(c.learning, s.learning, W, e), now.eps
    if c.learning.on and acts(s.learning) and not acts(memory):
        # the correction ends: eps takes it over, so that u does not step
        eps_now -= corrected_by
        for i in range(c.late + 2):
            s.net[i] += corrected_by
            s.taught[i] = 0.0
    slot = s.k % s.coming.shape[0]
    s.coming[slot, 0], s.coming[slot, 1], s.coming[slot, 2] = W_ff.w, W_ff.w_dot, W_ff.w_ddot
    return State(
        s.k + 1,
        s.x,
        eps_now,
        now.eps_dot,
        s.x_r,
        s.net,
        s.v,
        s.pace,
        s.turned,
        s.taught,
        theta,
        s.theta,
        steepest,
        s.eta,
        now.w_ddot,
        s.coming,
        moved(c.inverse, s.inverse, (1.0 + s.theta) * now.v),
        kept_back(c.actuator, s.actuator, u),
        memory,
    )


def absorbed(s: State, gap: float) -> State:
    """The state with which u is higher by `gap` (V): eps takes it, the commands are counted so."""
    return s._replace(eps=s.eps - gap, net=s.net + gap)


def output_row(params: ModalParams, g: np.ndarray, T_s: float) -> Row:
    """The row of u = -g delta - eps, eps that of the interval in which u acts."""
    return row(params, g, 1.0, T_s, T_s)


def unlearned(params: ModalParams) -> ModalParams:
    """The law without what it learns from period to period."""
    return replace(params, learning=replace(params.learning, method="none"))
