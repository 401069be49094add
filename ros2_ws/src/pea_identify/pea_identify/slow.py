"""Slow motion as data for H: few samples of it, and what of them is fitted and held out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pea_core.params import ParameterError
from pea_identify.plays import turns
from pea_identify.records import Record

POINTS = 4000
"""Samples that a nonlinear fit uses at most; the motion is slow."""


@dataclass(frozen=True)
class Data:
    """Slow motion, with what counts for fitting and what for choosing.

    Attributes
    ----------
    u, y : (N,) arrays
        Voltage (V) and displacement (m), from rest at 0 V or after a full cycle.
    fitted, held_out : (N,) arrays of bool
    t : (N,) array
        Time (s); empty where no creep acts.
    tau, weights : (n,) arrays
        Creep that acts on the output of H.
    """

    u: np.ndarray
    y: np.ndarray
    fitted: np.ndarray
    held_out: np.ndarray
    t: np.ndarray = field(default_factory=lambda: np.empty(0))
    tau: np.ndarray = field(default_factory=lambda: np.empty(0))
    weights: np.ndarray = field(default_factory=lambda: np.empty(0))

    def through(self, v: np.ndarray) -> np.ndarray:
        """v (N, n) with the creep of it."""
        return crept(v, self.t, self.tau, self.weights) if len(self.tau) else v


def crept(v: np.ndarray, t: np.ndarray, tau: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """v (N, n) at times t (N), straight between them, plus first-order operators of it."""
    from scipy.linalg import solve_banded

    out = v.copy()
    dt = np.diff(t)
    for tau_i, w_i in zip(tau, weights, strict=True):
        a = np.exp(-dt / tau_i)
        ramp = 1.0 - (1.0 - a) * tau_i / dt  # what the change within an interval has grown to
        inputs = (1.0 - a)[:, None] * v[:-1] + ramp[:, None] * np.diff(v, axis=0)
        # grown[k] = a[k] grown[k - 1] + inputs[k], as a system of equations
        bands = np.stack([np.ones(len(a)), -np.append(a[1:], 0.0)])
        out[1:] += w_i * solve_banded((1, 0), bands, inputs)
    return out


def prepared(
    records: Sequence[Record], delay: float, tau: np.ndarray, weights: np.ndarray, hold_out: bool
) -> Data:
    """Slow records as `Data`, less than `POINTS` samples of each, turns of u included.

    The vibration delays a slow motion by `delay` (s) and does nothing else to it. A record that
    begins at rest counts from its start; of any other one the way through a full cycle is left
    out, as nothing says what came before. The last third of each record is held out.
    """
    parts = [thin(r, delay) for r in records]
    if len(parts) > 1 and len(tau):
        raise ParameterError("creep and several slow records: give one slow record, or no step")
    t, u, y, fitted, held = (np.concatenate(column) for column in zip(*parts, strict=True))
    if not hold_out:
        fitted, held = fitted | held, np.zeros(len(u), dtype=bool)
    return Data(u, y, fitted, held, t, tau, weights)


def thin(r: Record, delay: float) -> tuple[np.ndarray, ...]:
    """Times, delayed voltage, displacement, and what is fitted and held out, of one record."""
    u, y = r.u[:, 0], r.y[:, 0]
    k = np.arange(len(u))
    late = np.interp(k - delay / r.T_s, k, u)
    stride = max(1, math.ceil(len(u) / POINTS))
    places = np.arange(0, len(u), stride)
    at = turns(late)
    if len(at) < POINTS // 2:
        places = np.union1d(places, at)
        y = averaged(y, late, stride // 2)
    span = float(np.ptp(u))
    from_rest = abs(u[0]) < 0.01 * span
    first = 0
    if not from_rest:
        highest, lowest = u >= u.max() - 0.02 * span, u <= u.min() + 0.02 * span
        first = max(int(np.argmax(highest)), int(np.argmax(lowest)))
        first = first if first < 0.5 * len(u) else 0
    last = first + (len(u) - first) * 2 // 3
    return (
        places * r.T_s,
        late[places],
        y[places],
        *(
            (places >= first) & (places < last),
            places >= last,
        ),
    )


def averaged(y: np.ndarray, u: np.ndarray, half: int) -> np.ndarray:
    """y (N,) averaged over `half` samples on each side, fewer where u (N,) turns, stops or starts.

    On a straight line nothing but noise is lost, and between these slow motion is one.
    """
    k = np.arange(len(y))
    at = 1 + np.flatnonzero(np.diff(np.sign(np.diff(u))))
    at = np.concatenate([[0], at, [len(y) - 1]])
    after = np.searchsorted(at, k)
    beside = np.minimum(at[after] - k, k - at[np.maximum(after - 1, 0)])
    reach = np.clip(beside - 1, 0, half)
    sums = np.concatenate([[0.0], np.cumsum(y - y[0])])
    return np.asarray((sums[k + reach + 1] - sums[k - reach]) / (2 * reach + 1) + y[0])


def thinned(data: Data) -> Data:
    """Data with a third of the samples, turns kept, for fits that step a model sample by sample."""
    if len(data.u) < POINTS // 2:
        return data
    keep = np.arange(0, len(data.u), 3)
    at = turns(data.u)
    if len(at) < POINTS // 2:
        keep = np.union1d(keep, at)
    return replace(
        data,
        u=data.u[keep],
        y=data.y[keep],
        fitted=data.fitted[keep],
        held_out=data.held_out[keep],
        t=data.t[keep] if len(data.t) else data.t,
    )
