"""Several axes: n x n rational models with common poles, chosen on data not fitted.

The model of one amplitude is a `Rational`. Of several amplitudes, `Scheduled` holds one for each
and goes from one to the next with the rms of the voltage: it knows its amplitude.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pea_core.params import ParameterError
from pea_identify import frequency_response as responses
from pea_identify import rational
from pea_identify.frequency_response import FrequencyResponse
from pea_identify.rational import Rational
from pea_identify.records import Periods, Record, grouped, parts_of

PAIRS = (6, 10, 14, 18, 22, 28)
"""Pole pairs that are tried."""

DIRECT = 3
"""Terms of the impulse response that no pole makes."""


@dataclass(frozen=True)
class Axes:
    """An identified n x n model at one amplitude.

    Attributes
    ----------
    rms : float
        Of the voltage (V).
    response : FrequencyResponse
    model : Rational
        Fitted to all realisations.
    nrmse : float
        Mean over outputs and realisations of error over standard deviation, on realisations
        that were not fitted.
    tried : tuple of (int, float)
        Pole pairs, and the NRMSE of each on realisations that were not fitted.
    """

    rms: float
    response: FrequencyResponse
    model: Rational
    nrmse: float
    tried: tuple[tuple[int, float], ...]


def nrmse(model: Any, group: Periods, lines: np.ndarray) -> float:
    """Mean NRMSE of a model, called with frequencies (Hz), on whole periods."""
    N = len(group.u)
    u, y = group.u.mean(axis=3), group.y.mean(axis=3)
    U, Y = np.fft.rfft(u, axis=0), np.fft.rfft(y, axis=0)
    Y[lines] -= np.einsum("fij,fjr->fir", model(lines / (N * group.T_s)), U[lines])
    Y[0] = 0.0
    error = np.fft.irfft(Y, N, axis=0)
    return float((np.sqrt(np.mean(error**2, axis=0)) / y.std(axis=0)).mean())


def part(group: Periods, which: slice) -> Periods:
    """Some of the realisations."""
    return group._replace(u=group.u[:, :, which], y=group.y[:, :, which])


def fitted(response: FrequencyResponse, group: Periods, pairs: int) -> Rational:
    """A model of one order; each output counts by its standard deviation."""
    f, T_s = response.f, response.T_s
    scale = group.y.std(axis=(0, 2, 3))
    weight = np.broadcast_to(1.0 / scale[:, None], response.G.shape[1:])[None]
    # poles begin where the response is large
    size = np.abs(response.G * weight).max(axis=(1, 2))
    share = np.cumsum(size) / size.sum()
    first, last = np.searchsorted(share, [0.02, 0.98])
    low, high = f[int(first)], f[min(int(last), len(f) - 1)]
    poles = rational.spread(float(low), float(high), pairs, T_s, reals=2)
    G_weight = np.broadcast_to(weight, response.G.shape)
    return rational.fit(f, response.G, G_weight, T_s, poles, DIRECT)


def of_group(group: Periods, pairs: Sequence[int] = PAIRS) -> Axes:
    """Identify one amplitude.

    Raises
    ------
    ParameterError
        Fewer than two blocks of realisations: nothing could be held out.
    """
    n_u, R = group.u.shape[1], group.u.shape[2]
    blocks = R // n_u
    if blocks < 2:
        raise ParameterError(
            f"{group.name}: {R} realisations of {n_u} inputs: give at least {2 * n_u}, half of "
            "them are held out"
        )
    held = n_u * (blocks // 2)
    whole = responses.from_periods(group.u, group.y, group.T_s)
    lines = np.round(whole.f * len(group.u) * group.T_s).astype(int)
    halves = part(group, slice(0, R - held)), part(group, slice(R - held, R))
    half = responses.from_periods(halves[0].u, halves[0].y, group.T_s, lines)
    tried = []
    for count in pairs:
        if 2 * count + 2 > len(lines) // 4:
            break
        tried.append((count, nrmse(fitted(half, halves[0], count), halves[1], lines)))
        if len(tried) > 2 and min(e for _, e in tried[-2:]) > 0.99 * min(e for _, e in tried[:-2]):
            break
    best = min(e for _, e in tried)
    chosen = next(count for count, e in tried if e <= 1.005 * best)
    error = dict(tried)[chosen]
    return Axes(group.rms, whole, fitted(whole, group, chosen), error, tuple(tried))


@dataclass(frozen=True)
class Scheduled:
    """One model for all amplitudes: rational models between which the rms of the voltage decides.

    Attributes
    ----------
    rms : (m,) array
        Amplitudes (V), rising.
    models : tuple of Rational
        One each.
    """

    rms: np.ndarray
    models: tuple[Rational, ...]

    @property
    def parameters(self) -> int:
        """Count of free real parameters, amplitudes included."""
        return len(self.rms) + sum(model.parameters for model in self.models)

    def shares(self, rms: float) -> list[tuple[float, Rational]]:
        """The models that count at an amplitude (V), and by how much."""
        w = np.interp(rms, self.rms, np.arange(len(self.rms)))
        low = min(int(w), len(self.models) - 1)
        share = float(w) - low
        above = [(share, self.models[low + 1])] if share > 0.0 else []
        return [(1.0 - share, self.models[low]), *above]

    def simulate(self, u: np.ndarray) -> np.ndarray:
        """Displacements (N, n_y) from voltages (N, n_u), from rest."""
        shares = self.shares(rms_of(u))
        return np.sum([share * model.simulate(u) for share, model in shares], axis=0)

    def steady(self, u: np.ndarray) -> np.ndarray:
        """Displacements (N, n_y) from one period (N, n_u) of a voltage that has always repeated."""
        U = np.fft.rfft(u, axis=0)
        shares = self.shares(rms_of(u))
        f = np.arange(len(U)) / (len(u) * shares[0][1].T_s)
        G = np.sum([share * model(f) for share, model in shares], axis=0)
        return np.asarray(np.fft.irfft(np.einsum("fij,fj->fi", G, U), len(u), axis=0))


def rms_of(u: np.ndarray) -> float:
    """Rms of the alternating voltages (N, n_u)."""
    return float(np.sqrt(np.mean((u - u.mean(axis=0)) ** 2)))


def loaded(there: Path) -> Scheduled:
    """The model that `numbers` was written of, from its JSON file.

    Raises
    ------
    ParameterError
        It is no such file.
    """
    try:
        rows = json.loads(there.read_text(encoding="utf-8"))["amplitudes"]
        models = tuple(
            Rational(
                np.array([complex(*p) for p in row["poles"]]),
                np.array(row["residues"], dtype=float),
                np.array(row["direct"], dtype=float),
                float(row["sample_period_s"]),
            )
            for row in rows
        )
        return Scheduled(np.array([float(row["rms_V"]) for row in rows]), models)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ParameterError(
            f"{there}: no model of several axes ({type(error).__name__}): give axes.json of pea "
            "identify"
        ) from None


def compared(model: Scheduled, records: Sequence[Record]) -> dict[str, Any]:
    """How far a model is from records of several axes: over whole periods, else from rest.

    Raises
    ------
    ParameterError
        Another sample period, or other numbers of voltages and displacements.
    """
    rows = []
    n_y, n_u = model.models[0].residues.shape[1:]
    for r in records:
        if (
            r.u.shape[1] != n_u
            or r.y.shape[1] != n_y
            or abs(r.T_s / model.models[0].T_s - 1) > 1e-6
        ):
            raise ParameterError(
                f"{r.name}: {r.u.shape[1]} voltages, {r.y.shape[1]} displacements every {r.T_s:g} "
                f"s; the model has {n_u} and {n_y} every {model.models[0].T_s:g} s"
            )
        for u, y, name in parts_of(r) if r.period else [(r.u[None], r.y[None], r.name)]:
            mean_u, mean_y = u.mean(axis=0), y.mean(axis=0)
            said = model.steady(mean_u) if r.period else model.simulate(mean_u)
            error = said - mean_y
            error = error - error.mean(axis=0)
            rows.append(
                {
                    "name": name,
                    "rms_V": rms_of(mean_u),
                    "rms_error_nm": (1e9 * np.sqrt(np.mean(error**2, axis=0))).tolist(),
                    "nrmse_percent": (100.0 * error.std(axis=0) / mean_y.std(axis=0)).tolist(),
                }
            )
    mean = float(np.mean([x for row in rows for x in row["nrmse_percent"]]))
    return {"mean_nrmse_percent": mean, "parameters": model.parameters, "records": rows}


def identify(records: Sequence[Record]) -> list[Axes]:
    """A model for each amplitude, rising.

    Raises
    ------
    ParameterError
        A record that is not periodic, or too few realisations.
    """
    other = next((r for r in records if not r.period), None)
    if other is not None:
        raise ParameterError(
            f"{other.name}: {other.kind}: several axes need whole periods of multisines that are "
            "orthogonal between realisations"
        )
    parts = [p for r in records for p in parts_of(r)]
    groups = sorted(grouped(parts, records[0].T_s), key=lambda group: group.rms)
    return [of_group(group) for group in groups]


def modes_of(model: Rational) -> list[dict[str, float]]:
    """Frequency (Hz), damping and largest gain (m/V) of each pair of poles."""
    found, row = [], 0
    for p in model.poles:
        if p.imag == 0.0:
            row += 1
            continue
        s = np.log(p) / model.T_s
        residue = model.residues[row] + 1j * model.residues[row + 1]
        found.append(
            {
                "frequency_hz": float(abs(s) / (2.0 * math.pi)),
                "damping": float(-s.real / abs(s)),
                "largest_gain_um_per_V": float(2e6 * np.abs(residue / (1.0 - p)).max()),
            }
        )
        row += 2
    return found


def numbers(several: Sequence[Axes]) -> dict[str, Any]:
    """All as plain numbers, for JSON."""
    scheduled = Scheduled(np.array([a.rms for a in several]), tuple(a.model for a in several))
    return {
        "amplitudes": [
            {
                "rms_V": a.rms,
                "held_out_nrmse_percent": 100.0 * a.nrmse,
                "pole_pairs_tried": [{"pairs": n, "nrmse_percent": 100.0 * e} for n, e in a.tried],
                "parameters": a.model.parameters,
                "modes": modes_of(a.model),
                "poles": [[float(p.real), float(p.imag)] for p in a.model.poles],
                "residues": a.model.residues.tolist(),
                "direct": a.model.direct.tolist(),
                "sample_period_s": a.model.T_s,
            }
            for a in several
        ],
        "parameters_of_all": scheduled.parameters,
        "not_determined": [
            "No plant file is written: the simulated plant has one axis.",
        ],
    }


def sentence(several: Sequence[Axes]) -> str:
    """A line for each amplitude."""
    return "\n".join(
        f"{a.rms:.4g} V rms: {len(a.model.poles)} poles or pairs, {a.model.parameters} parameters, "
        f"{100.0 * a.nrmse:.2f} % NRMSE on realisations not fitted"
        for a in several
    )
