r"""H from slow motion: four models fitted to the same data, chosen on data not fitted.

Where the motion is slow, or the linear dynamics are known, displacement follows from voltage as

.. math:: y = y_0 + K\,L\{H(u)\}

with L the unit-gain dynamics (V with its delay, F_c), or 1. Prandtl-Ishlinskii is linear in its
weights,

.. math:: y = y_0 + \sum_i w_i\,L\{P_{r_i}(u)\}, \quad w_i \ge 0

and so a quadratic programme with bounds. Its modified form bends the output by a memoryless
curve S; with S^{-1} piecewise linear, of slope s_j > 0 between knots, one of them 1, the same
programme gives weights and slopes at once (error stated in S^{-1}(y), which is y up to the bend):

.. math:: y_{(c)} = y_0 + \sum_i w_i P_{r_i}(u) - \sum_{j \ne c} s_j\,y_{(j)}

with y_(j) the part of y between knots j and j + 1. The thresholds of the plain form are fitted,
too (`pea_identify.plays`). Preisach and Bouc-Wen have few parameters and are fitted by nonlinear
least squares.

Source: K. Kuhnen, European Journal of Control 9(4), 2003 (both programmes).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pea_core.block import Block
from pea_core.params import ParameterError
from pea_identify.intervals import Z_95, inverse_of_normal
from pea_identify.plays import PlaysProblem, least_weight, moved, plays, thresholds
from pea_identify.slow import Data, crept, thinned
from pea_plant.model.hysteresis import MODELS

COUNTS = (4, 8, 12, 16, 24)
"""Numbers of play operators tried."""

KNOTS = (3, 5, 7)
"""Numbers of pieces of S tried: odd, so that one is in the middle."""

FINE = 0.001
"""Per cent of the stroke that makes no difference between two models."""

NOTHING = 0.03
"""Per cent of the stroke up to which a straight line is H: what a lightly damped mode rings after
the corners of a triangle is as large, and a model of it would change the gain of small signals."""

STEEPEST, FLATTEST = 20.0, 0.05
"""Slopes of S^{-1} between which the programme looks, beside 1 in the middle."""


@dataclass(frozen=True)
class HysteresisFit:
    """A fitted model of H.

    Attributes
    ----------
    type : str
        Model of `pea_plant.model.hysteresis`, or ``modified_prandtl_ishlinskii``.
    K : float
        Gain (m/V): H then has about unity gain.
    offset : float
        y_0 (m).
    values : dict
        Parameters of the model, as the plant's parameter file names them.
    fitted, held_out : float
        Rms error (m) on the data fitted, and on those not fitted (NaN where there are none). Where
        creep is known, it is without what is left of creep, which is fitted to both (`judged`).
    stroke : float
        Peak to peak of y (m).
    intervals : dict of str to float or tuple
        Half width of the 95 % interval of each free parameter that has one.
    knots, slopes : (m + 1,), (m,) arrays
        Of S^{-1}, in m; empty where S is a straight line.
    parameters : int
        Count of free parameters.
    operators : int
        Play operators that the programme began with.
    moved : bool
        Whether the thresholds were fitted, too.
    """

    type: str
    K: float
    offset: float
    values: dict[str, Any]
    fitted: float
    held_out: float
    stroke: float
    intervals: dict[str, Any]
    knots: np.ndarray
    slopes: np.ndarray
    parameters: int
    operators: int = 0
    moved: bool = False

    @property
    def percent(self) -> float:
        """Error on data not fitted, or else on the data fitted, in per cent of the stroke."""
        error = self.fitted if np.isnan(self.held_out) else self.held_out
        return 100.0 * error / self.stroke

    @property
    def slope(self) -> float:
        """Slope dv/du of H for small changes after a turn, without S."""
        values = self.values
        if self.type == "none":
            return 1.0
        if self.type == "bouc_wen":
            return 1.0 - float(values["alpha"])
        if self.type == "preisach":
            from pea_plant.model.hysteresis import preisach

            return float(preisach.design(preisach.Params(**values), 1.0).reversible)
        r, w = np.array(values["thresholds"]), np.array(values["weights"])
        return float(w[r <= 1e-9 * max(float(r.max()), 1.0)].sum())

    def voltage(self, u: np.ndarray) -> np.ndarray:
        """Output v (N,) in V of H along u (N,) in V from rest, without S."""
        if self.type.endswith("prandtl_ishlinskii"):
            return plays(u, np.array(self.values["thresholds"])) @ np.array(self.values["weights"])
        return driven(self.type, self.values, u)

    def displacement(self, v: np.ndarray) -> np.ndarray:
        """y (m) that belongs to v (V), once dynamics have acted on it."""
        if len(self.slopes):
            return curve(self.K * v + self.offset, self.knots, self.slopes)
        return self.K * v + self.offset


def pieces(y: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """Parts (N, m) of y between each two of the knots (m + 1); beyond the ends they go on."""
    low, high = knots[:-1].copy(), knots[1:].copy()
    first = low[0]
    low[0], high[-1] = -np.inf, np.inf
    parts = np.clip(y[:, None], low, high)
    parts -= np.concatenate([[first], knots[1:-1]])
    return parts


def curve(v: np.ndarray, knots: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """S (N,) of v: the inverse of the piecewise linear S^{-1}."""
    at = np.concatenate([[0.0], np.cumsum(slopes * np.diff(knots))])
    inner = np.searchsorted(at[1:-1], v)
    return knots[inner] + (v - at[inner]) / slopes[inner]


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def bounded(A: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Least squares of A x = b between bounds, columns scaled to one size."""
    from scipy.optimize import lsq_linear

    scale = np.maximum(np.abs(A).max(axis=0), 1e-300)
    found = lsq_linear(
        A / scale, b, (low * scale, high * scale), method="bvls" if A.shape[1] < 60 else "trf"
    )
    return np.asarray(found.x / scale)


def creeping(data: Data, fit: HysteresisFit) -> tuple[np.ndarray, np.ndarray]:
    """What creep has H do along slow motion, and how much of each explains y best.

    The step that creep comes from has moved through H as well; slow motion tells its weights apart
    from H better than the step does, and shows creep that is slower.

    Returns
    -------
    columns : (N, n) array
        H through creep as it is known, one, the operators of creep, and the integral of H, which
        is an operator much slower than the record.
    shares : (n,) array
        Fitted on the data that are not held out.
    """
    from scipy.integrate import cumulative_trapezoid

    v = fit.voltage(data.u)[:, None]
    operators = [
        crept(v, data.t, data.tau[i : i + 1], np.ones(1)) - v for i in range(len(data.tau))
    ]
    slower = cumulative_trapezoid(v, data.t, axis=0, initial=0.0)
    A = np.hstack([data.through(v), np.ones_like(v), *operators, slower])
    scale = np.abs(A).max(axis=0)
    x = np.linalg.lstsq((A / scale)[data.fitted], data.y[data.fitted], rcond=None)[0]
    return A, x / scale


def without_creep(data: Data, fit: HysteresisFit) -> Data:
    """Data without what is left of creep, once H is known."""
    A, x = creeping(data, fit)
    return replace(data, y=data.y - A[:, 2:] @ x[2:])


def judged(data: Data, fit: HysteresisFit) -> HysteresisFit:
    """A fit with its errors but for those of creep, which would hide what H is.

    Creep is fitted to all data: what is held out judges H, and creep would be extrapolated there.
    """
    if not len(data.tau) or len(fit.slopes):
        return fit
    A, x = creeping(replace(data, fitted=data.fitted | data.held_out), fit)
    error = A @ x - data.y
    apart = rms(error[data.held_out]) if data.held_out.any() else math.nan
    return replace(fit, fitted=rms(error[data.fitted]), held_out=apart)


def scaled(data: Data, raw: np.ndarray, r: np.ndarray) -> tuple[float, dict[str, Any]]:
    """K (m/V), and the plant's parameters of weights `raw` (m/V) whose H has about unity gain."""
    kept = raw > 1e-9 * raw.max()
    r, raw = r[kept], raw[kept]
    u_max = float(np.abs(data.u).max())
    y_max = float(raw @ np.maximum(u_max - r, 0.0))
    K = y_max / u_max
    values = {
        "thresholds": tuple(r.tolist()),
        "weights": tuple((raw / K).tolist()),
        "u_max": u_max,
        "v_max": u_max,
    }
    return K, values


def straight(data: Data) -> HysteresisFit:
    """No hysteresis: a straight line."""
    A = np.column_stack([data.through(data.u[:, None])[:, 0], np.ones(len(data.u))])
    x = np.linalg.lstsq(A[data.fitted], data.y[data.fitted], rcond=None)[0]
    if not x[0] > 0.0:
        raise ParameterError(
            f"displacement falls by {-x[0] * 1e6:.4g} um/V where the voltage rises: change the "
            "sign of one of them"
        )
    error = A @ x - data.y
    width = half_widths(A[data.fitted], error[data.fitted])
    intervals = {"K": float(width[0]), "offset": float(width[1])}
    return made("none", data, float(x[0]), float(x[1]), {}, error, intervals, 2)


def made(
    type: str,
    data: Data,
    K: float,
    offset: float,
    values: dict[str, object],
    error: np.ndarray,
    intervals: dict[str, Any],
    parameters: int,
    bend: tuple[np.ndarray, np.ndarray] = (np.empty(0), np.empty(0)),
) -> HysteresisFit:
    """A `HysteresisFit` with its errors."""
    return HysteresisFit(
        type=type,
        K=K,
        offset=offset,
        values=values,
        fitted=rms(error[data.fitted]),
        held_out=rms(error[data.held_out]) if data.held_out.any() else float("nan"),
        stroke=float(np.ptp(data.y)),
        intervals=intervals,
        knots=bend[0],
        slopes=bend[1],
        parameters=parameters,
    )


def correlated(error: np.ndarray) -> float:
    """Samples that count as one: the autocorrelation of an error, summed to its first zero."""
    e = error - error.mean()
    power = np.abs(np.fft.rfft(e, 2 * len(e))) ** 2
    r = np.fft.irfft(power)[: len(e)]
    if r[0] <= 0.0:
        return 1.0
    r = r / r[0]
    below = np.flatnonzero(r <= 0.0)
    return float(1.0 + 2.0 * r[1 : below[0] if len(below) else len(r)].sum())


def prandtl_ishlinskii(data: Data, count: int, bends: int = 0) -> HysteresisFit:
    """Weights of `count` play operators, and a curve of `bends` pieces where it is given."""
    r = thresholds(data.u, count)
    P = data.through(plays(data.u, r))
    one, use = np.ones((len(P), 1)), data.fitted
    least = np.zeros(count)
    least[0] = least_weight(data)
    if not bends:
        A = np.hstack([P, one])
        low = np.concatenate([least, [-np.inf]])
        x = bounded(A[use], data.y[use], low, np.full(count + 1, np.inf))
        error = A @ x - data.y
        K, values = scaled(data, x[:count], r)
        active = x[:count] > 1e-9 * x[:count].max()
        spread = covariance(A[use][:, np.append(active, True)], error[use])
        intervals = of_plays(spread, r[active], x[:count][active], data.u)
        free = int(active.sum()) + 1
        fit = made("prandtl_ishlinskii", data, K, float(x[count]), values, error, intervals, free)
        return replace(fit, operators=count)
    knots = np.linspace(data.y[use].min(), data.y[use].max(), bends + 1)
    parts, middle = pieces(data.y, knots), bends // 2
    A = np.hstack([P, one, -np.delete(parts, middle, axis=1)])[use]
    low = np.concatenate([least, [-np.inf], np.full(bends - 1, FLATTEST)])
    high = np.concatenate([np.full(count + 1, np.inf), np.full(bends - 1, STEEPEST)])
    x = bounded(A, parts[use, middle], low, high)
    slopes = np.insert(x[count + 1 :], middle, 1.0)
    offset = float(x[count])
    error = curve(P @ x[:count] + offset, knots, slopes) - data.y
    K, values = scaled(data, x[:count], r)
    free = int((x[:count] > 0.0).sum()) + bends
    bend = knots, slopes
    active = x[:count] > 1e-9 * x[:count].max()
    inside = (x[count + 1 :] > 1.001 * FLATTEST) & (x[count + 1 :] < 0.999 * STEEPEST)
    columns = np.concatenate([active, [True], inside])
    spread = covariance(A[:, columns], A @ x - parts[use, middle])
    intervals = of_plays(spread, r[active], x[:count][active], data.u)
    widths = np.zeros(bends - 1)  # 0: held at a bound
    widths[inside] = Z_95 * np.sqrt(np.diag(spread)[int(active.sum()) + 1 :])
    intervals["slopes"] = tuple(np.insert(widths, middle, 0.0).tolist())
    fit = made("modified_prandtl_ishlinskii", data, K, offset, values, error, intervals, free, bend)
    return replace(fit, operators=count)


def moved_plays(data: Data, count: int) -> HysteresisFit:
    """Weights and thresholds of plays, from the programme of `count` of them on."""
    began = prandtl_ishlinskii(data, count)
    r = np.array(began.values["thresholds"])
    if len(r) < 2 or r[0] > 0.0:
        return began
    found = moved(data, r, began.K * np.array(began.values["weights"]), began.offset)
    active = found.w > 1e-9 * found.w.max()
    r, w, use = found.r[active], found.w[active], data.fitted
    problem = PlaysProblem(data, len(r), float(w.sum()))
    p = np.concatenate([np.log(r[1:]), w / problem.K, [found.offset / problem.size]])
    error = problem.error(p)
    scale = np.concatenate([np.ones(len(r) - 1), np.full(len(r), problem.K), [problem.size]])
    spread = covariance((problem.columns(p) / scale)[use], error[use])
    own = spread[len(r) - 1 :, len(r) - 1 :]
    intervals = of_plays(own, r, w, data.u)
    of_r = np.sqrt(np.maximum(np.diag(spread)[: len(r) - 1], 0.0))
    intervals["thresholds"] = (0.0, *(Z_95 * r[1:] * of_r).tolist())
    K, values = scaled(data, w, r)
    fit = made("prandtl_ishlinskii", data, K, found.offset, values, error, intervals, 2 * len(r))
    return replace(fit, operators=count, moved=True)


def covariance(A: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Covariance of the coefficients of a linear fit, with the correlation of its error."""
    return np.asarray(inverse_of_normal(A) * float(np.mean(error**2)) * correlated(error))


def half_widths(A: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Half width of the 95 % interval of each coefficient of a linear fit."""
    return np.asarray(Z_95 * np.sqrt(np.maximum(np.diag(covariance(A, error)), 0.0)))


def of_plays(
    spread: np.ndarray, r: np.ndarray, raw: np.ndarray, u: np.ndarray
) -> dict[str, float | tuple[float, ...]]:
    """Half widths of K (m/V), of the weights of H, and of y_0 (m).

    `spread` is the covariance of the weights `raw` (m/V) of the thresholds r (V), and of y_0 next.
    """
    n, u_max = len(raw), float(np.abs(u).max())
    to_K = np.maximum(u_max - r, 0.0) / u_max
    K = float(to_K @ raw)
    to_weights = (np.eye(n) - np.outer(raw / K, to_K)) / K
    own = spread[:n, :n]
    return {
        "K": Z_95 * math.sqrt(max(float(to_K @ own @ to_K), 0.0)),
        "weights": tuple(
            (Z_95 * np.sqrt(np.maximum(np.diag(to_weights @ own @ to_weights.T), 0.0))).tolist()
        ),
        "offset": Z_95 * math.sqrt(max(float(spread[n, n]), 0.0)),
    }


def nonlinear(
    type: str,
    data: Data,
    names: tuple[str, ...],
    starts: Sequence[tuple[float, ...]],
    low: tuple[float, ...],
    high: tuple[float, ...],
    values_of: Callable[[np.ndarray], dict[str, object]],
) -> HysteresisFit:
    """Least squares of a model with few parameters; K and y_0 follow linearly."""
    from scipy.optimize import least_squares

    use = data.fitted

    def columns(x: np.ndarray) -> np.ndarray:
        v = data.through(driven(type, values_of(x), data.u)[:, None])[:, 0]
        return np.column_stack([v, np.ones(len(v))])

    def linear(A: np.ndarray) -> np.ndarray:
        return np.linalg.lstsq(A[use], data.y[use], rcond=None)[0]

    stroke = float(np.ptp(data.y))

    def left(x: np.ndarray) -> np.ndarray:
        A = columns(x)
        return (A @ linear(A) - data.y)[use] / stroke

    ranked = sorted(starts, key=lambda x: float(np.sum(left(np.array(x)) ** 2)))
    found = [
        least_squares(left, x, bounds=(low, high), x_scale="jac", max_nfev=60) for x in ranked[:2]
    ]
    best = min(found, key=lambda f: f.cost)
    A = columns(best.x)
    K, offset = linear(A)
    error = A @ np.array([K, offset]) - data.y
    width = half_widths(np.hstack([best.jac * stroke, A[use]]), error[use])
    intervals = dict(zip(names, width.tolist(), strict=False))
    intervals["K"], intervals["offset"] = width[len(names) :].tolist()
    free = len(names) + 2
    return made(type, data, float(K), float(offset), values_of(best.x), error, intervals, free)


def bouc_wen(data: Data) -> HysteresisFit:
    """alpha, beta and gamma of Bouc-Wen; the interval of gamma is of gamma over beta."""
    reach = float(np.abs(data.u).max())

    def values_of(x: np.ndarray) -> dict[str, Any]:
        beta = float(np.exp(x[1]))
        return {"alpha": float(x[0]), "beta": beta, "gamma": float(x[2]) * beta}

    starts = [
        (alpha, float(np.log(b / reach)), g)
        for alpha in (0.2, 0.5)
        for b in (1.0, 4.0, 12.0)
        for g in (-0.4, 0.0, 0.7)
    ]
    low = (0.0, float(np.log(max(1e-9, 1e-3 / reach))), -1.0)
    high = (1.0, float(np.log(min(10.0, 1e3 / reach))), 1.0)
    fit = nonlinear(
        "bouc_wen", data, ("alpha", "log beta", "gamma over beta"), starts, low, high, values_of
    )
    widths = dict(fit.intervals)
    beta, gamma = fit.values["beta"], fit.values["gamma"]
    widths["beta"] = widths.pop("log beta") * beta
    relative = widths.pop("gamma over beta") * beta
    widths["gamma"] = float(np.hypot(relative, widths["beta"] * gamma / beta))
    return replace(fit, intervals=widths)


def preisach(data: Data) -> HysteresisFit:
    """Saturation and irreversible share of Preisach with a uniform density."""
    bottom, top = float(data.u.min()), float(data.u.max())
    span = top - bottom
    u_max = max(abs(bottom), abs(top))

    def values_of(x: np.ndarray) -> dict[str, Any]:
        return {
            "range_min": float(x[0]),
            "range_max": float(x[1]),
            "share": float(x[2]),
            "u_max": u_max,
            "v_max": u_max,
        }

    starts = [
        (min(bottom, 0.0) - a * span, max(top, 1e-3) + b * span, share)
        for a in (0.1, 0.5)
        for b in (-0.4, 0.1, 0.5)  # below 0: the voltage goes beyond saturation
        for share in (0.2, 0.5)
    ]
    low = (min(bottom, 0.0) - 10.0 * span, 0.3 * max(top, 1e-2), 0.0)
    high = (0.0, max(top, 1e-2) + 10.0 * span, 0.999)
    names = ("range_min", "range_max", "share")
    return nonlinear("preisach", data, names, starts, low, high, values_of)


def choose(data: Data, types: tuple[str, ...] = ()) -> tuple[HysteresisFit, list[HysteresisFit]]:
    """The model whose error on data not fitted is smallest, and all that were tried.

    Of models within 5 % of the smallest error, and within `FINE`, the one with the fewest
    parameters. Where none is asked for, a straight line within `NOTHING` whatever else was tried.

    Parameters
    ----------
    data : Data
    types : tuple of str
        Models to try; all where it is empty.
    """
    tried = [straight(data)]
    wanted = types or ("prandtl_ishlinskii", "modified_prandtl_ishlinskii", "preisach", "bouc_wen")
    if "prandtl_ishlinskii" in wanted:
        tried += [prandtl_ishlinskii(data, count) for count in COUNTS]
        tried.append(moved_plays(data, COUNTS[-1]))
    if "modified_prandtl_ishlinskii" in wanted:
        plain = [fit for fit in tried if fit.type == "prandtl_ishlinskii"]
        count = 12
        if plain:
            best = min(plain, key=lambda fit: fit.percent)
            count = best.operators
        tried += [prandtl_ishlinskii(data, c, b) for c in {12, count} for b in KNOTS]
    if data.u[0] == 0.0 or "bouc_wen" in types:
        coarse = thinned(data)
        if "preisach" in wanted:
            tried.append(preisach(coarse))
        if "bouc_wen" in wanted:
            tried.append(bouc_wen(coarse))
    tried = [judged(data, fit) for fit in tried]
    least = min(fit.percent for fit in tried)
    near = [fit for fit in tried if fit.percent <= 1.05 * least + FINE]
    if tried[0].percent <= NOTHING and not types:
        near = tried[:1]
    return min(near, key=lambda fit: fit.parameters), tried


def again(fit: HysteresisFit, data: Data) -> HysteresisFit:
    """The model of `fit`, of the same size, fitted to other data."""
    if fit.type == "none":
        return straight(data)
    if fit.type == "bouc_wen":
        return bouc_wen(thinned(data))
    if fit.type == "preisach":
        return preisach(thinned(data))
    if fit.moved:
        return moved_plays(data, fit.operators)
    return prandtl_ishlinskii(data, fit.operators, len(fit.slopes))


def driven(type: str, values: dict[str, object], u: np.ndarray) -> np.ndarray:
    """Output (N,) of a plant's model of H along u (N), from rest."""
    from pea_plant.model.hysteresis import CHOICE

    params = CHOICE.kinds[type](**values)
    block = Block(MODELS[type], params, 1.0)
    model, c, s = MODELS[type], block.c, block.s
    out = np.empty(len(u))
    for k, u_k in enumerate(u.tolist()):
        s = model.update(c, s, u_k)
        out[k] = model.output(c, s)
    return out
