r"""`precise` fitted to a stage: from an identified plant to gains, model and inverse hysteresis.

The preset `precise` is one compromise for the paper's actuator. On a stage that is known, what it
has to guess is put in its place:

1. Nominal model: K, zeta and omega_n of the stage, for law and observer alike.
2. Hysteresis: the exact inverse of the fitted one (`pea_controller.model.inverse`). Of a Preisach
   operator plays are fitted: a uniform density is, within its range, plays of evenly spread
   thresholds, so `PLAYS` of them leave what rounding of the branches to as many pieces leaves.
3. Gains: B_2 P, the bandwidth of q, is that of `precise`, so that margins stay what they are on
   the paper's actuator. The estimator is slower than that of `precise`, since little is left for
   it to follow: less noise.

Nothing here measures anything; identification hands in what it has found.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from pea_controller.model import inverse
from pea_core.nominal import NominalModel
from pea_core.params import ParameterError, build, nearest
from pea_plant.model import hysteresis
from pea_plant.model.hysteresis import prandtl_ishlinskii, preisach

PLAYS = 80
"""Play operators that stand for a hysteresis that is none of plays; the kinks of fewer excite a
mode of low damping."""

LOOPS = (1.0, 0.4, 0.2, 0.06, 0.02)
"""Sizes of the loops that plays are fitted to, as shares of the span."""

POINTS = 400
"""Samples of a loop."""

SMOOTH = 1e-3
"""Weight of the second differences of the plays' density beside the error of the loops."""

STEEPEST = 0.02
"""Least weight of the play of threshold 0: H must have an inverse."""

SLOPE = 9000.0
"""m of `precise` (1/s)."""

BANDWIDTH = 0.0017 * 0.142 * 5450.0**2
"""B_2 P of `precise` on the paper's actuator (1/s)."""

OMEGA_O = 5000.0
"""Bandwidth of the estimator (rad/s)."""

MODIFIED = "modified_prandtl_ishlinskii"
"""Plays behind a curve, as identification calls them."""


class Preset(NamedTuple):
    """Values of the nodes `observer` and `controller`, by dotted name."""

    observer: dict[str, Any]
    controller: dict[str, Any]

    @property
    def sets(self) -> list[str]:
        """The same as ``--set`` takes them."""
        nodes = {"observer": self.observer, "controller": self.controller}
        return [
            f"{node}.{name}={list(value) if isinstance(value, tuple) else value}"
            for node, values in nodes.items()
            for name, value in values.items()
        ]


def precise(
    model: NominalModel,
    type: str = "none",
    values: Mapping[str, object] | None = None,
    *,
    knots: Sequence[float] = (),
    slopes: Sequence[float] = (),
    span: float = 90.0,
) -> Preset:
    """The preset `precise` fitted to a stage.

    Parameters
    ----------
    model : NominalModel
        zeta, omega_n (rad/s) and K (um/V) of the stage, K so that H has about unity gain.
    type : str
        Fitted hysteresis: a type of ``plant.hysteresis``, or ``modified_prandtl_ishlinskii``.
    values : mapping, optional
        Its parameters, as the plant's parameter file names them.
    knots, slopes : sequence of float
        Of a modified one, the curve S^-1 in displacement (um): m + 1 knots, ends included, and m
        slopes.
    span : float
        Largest change of voltage (V) that the stage will see, for a hysteresis that plays are
        fitted to.

    Raises
    ------
    ParameterError
        An unknown type, or a hysteresis that has no inverse.
    """
    inverted = inverse_of(type, values or {}, span)
    if type == MODIFIED and len(slopes) > 1:
        inverted["knots"] = tuple(float(knot) / model.K for knot in knots[1:-1])
        inverted["slopes"] = tuple(map(float, slopes))
    build(inverse.Params, inverted, "inverse.")
    nominal = {"zeta": model.zeta, "omega_n": model.omega_n, "K": model.K}
    law = {
        "type": "predictive",
        **nominal,
        "m": SLOPE,
        "P": BANDWIDTH / (model.K * model.omega_n**2),
        "omega_o": OMEGA_O,
        "preview_samples": 0.5,
        "hysteresis_max": 0.0,
        **{f"inverse.{name}": value for name, value in inverted.items()},
    }
    return Preset({"type": "extended_state", **nominal}, law)


def inverse_of(type: str, values: Mapping[str, object], span: float) -> dict[str, Any]:
    """Parameters of `inverse` that undo a hysteresis; see `precise`.

    Raises
    ------
    ParameterError
        An unknown type.
    """
    kinds = hysteresis.CHOICE.kinds
    if type != MODIFIED and type not in kinds:
        raise ParameterError(f"hysteresis {type!r}: {nearest(type, {*kinds, MODIFIED})}")
    if type == "none":
        return {}
    known = "prandtl_ishlinskii" if type == MODIFIED else type
    params = build(kinds[known], values, "hysteresis.")
    if known == "bouc_wen":
        return {"alpha": params.alpha, "beta": params.beta, "gamma": params.gamma}
    if known == "prandtl_ishlinskii" and params.thresholds[0] == 0.0:
        factor = prandtl_ishlinskii.scaled(params)
        return {
            "thresholds": params.thresholds,
            "weights": tuple(factor * weight for weight in params.weights),
        }
    thresholds, weights = plays(known, params, span)
    return {"thresholds": tuple(thresholds.tolist()), "weights": tuple(weights.tolist())}


def plays(type: str, params: object, span: float) -> tuple[np.ndarray, np.ndarray]:
    """Thresholds (V) and weights of `PLAYS` plays that follow the loops of a hysteresis.

    Fitted is the shape of the settled loops from 0 up, or from as much below as they need to stay
    in the range that a Preisach operator has, by least squares with weights that are not
    negative and a density that is smooth; where the middle of a loop lies is left to feedback.

    Parameters
    ----------
    type : str
        Of ``plant.hysteresis``.
    params : dataclass
        Its parameters.
    span : float
        Height of the largest loop (V).
    """
    from scipy.optimize import lsq_linear  # slow to import

    model = hysteresis.MODELS[type]
    c = model.design(params, 1.0)
    low = 0.0
    if isinstance(params, preisach.Params):  # beyond its range it is saturated
        span = min(span, params.range_max - params.range_min)
        low = max(min(0.0, params.range_max - span), params.range_min)
    r = 0.55 * span * (np.arange(PLAYS) / PLAYS) ** 1.5
    moved, wanted = [], []
    for share in LOOPS:
        u = 0.5 * share * span * (1.0 - np.cos(2.0 * np.pi * np.arange(3 * POINTS) / POINTS))
        u += low
        s, z = model.start(c), np.zeros(PLAYS)
        v, P = np.empty(u.size), np.empty((u.size, PLAYS))
        for k, u_k in enumerate(u.tolist()):
            s = model.update(c, s, u_k)
            z = np.clip(z, u_k - r, u_k + r)
            v[k], P[k] = model.output(c, s), z
        v, P = v[-POINTS:], P[-POINTS:]
        weight = float(np.ptp(v)) ** -0.75  # between equal in volts and equal in shares of a loop
        moved.append((P - P.mean(axis=0)) * weight)
        wanted.append((v - v.mean()) * weight)
    A, b = np.vstack(moved), np.concatenate(wanted)
    width = np.gradient(r)
    bend = np.zeros((PLAYS - 3, PLAYS))
    for i in range(PLAYS - 3):
        bend[i, i + 1 : i + 4] = np.array([1.0, -2.0, 1.0]) / width[i + 1 : i + 4]
    bend *= SMOOTH * width[1:].mean() * np.linalg.norm(A) / np.sqrt(PLAYS)
    least = np.append(STEEPEST, np.zeros(PLAYS - 1))
    found = lsq_linear(
        np.vstack([A, bend]), np.append(b, np.zeros(PLAYS - 3)), (least, np.full(PLAYS, np.inf))
    )
    return r, np.asarray(found.x)
