"""What a recorded measurement shows: figures for people and JSON, and the curves drawn."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from pea_core.injection import Plan, signal
from pea_core.units import NM_PER_M
from pea_experiment.experiment import Experiment
from pea_lab.check import check
from pea_lab.linear import Nonlinear
from pea_measure import loop_response, motion, still, theory
from pea_measure.loop_response import ResponseCurve
from pea_measure.plans import PlannedMeasurement
from pea_reference.model import levels

MARGINS = {
    "gain_upper": ("gain margin, up", ""),
    "gain_lower": ("gain margin, down", ""),
    "phase_deg": ("phase margin", "deg"),
    "delay_samples": ("delay margin", "samples"),
    "modulus": ("modulus margin", ""),
    "crossover_hz": ("crossover", "Hz"),
    "bandwidth_hz": ("bandwidth of T", "Hz"),
}
"""Names and units of the margins."""

LAGS = 24
"""Samples that a command takes to act, at most."""

MISSED = 1e-3
"""Share of the largest change of the voltage beyond which another one acted than was commanded."""

BANDWIDTHS = (10.0, 100.0, 1000.0)
"""Bandwidths (Hz) for which a resolution is predicted."""


def finite(value: object) -> Any:
    """A value with every number that is none as None, for JSON."""
    if isinstance(value, dict):
        return {name: finite(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [finite(each) for each in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def times(experiment: Experiment) -> tuple[np.ndarray, np.ndarray, int]:
    """First sample of each move, first at each level, end; of the reference `levels`."""
    return levels.times(experiment.nodes["reference"].params, experiment.T_s)


def of(measurement: PlannedMeasurement, samples: np.ndarray) -> dict[str, Any]:
    """What a recorded measurement shows.

    Parameters
    ----------
    measurement : PlannedMeasurement
    samples : (n,) array of `SAMPLE`

    Raises
    ------
    ParameterError
        The record is too short.
    """
    kind = measurement.kind
    from pea_measure import acceptance

    more = {
        "repeatability": acceptance.of_repeatability,
        "increments": acceptance.of_staircases,
    }
    found: dict[str, Any] = {**ANALYSES, **more}[kind](measurement, samples)
    long = ("steps", "minor", "approaches", "stairs")
    settings = {n: v for n, v in measurement.settings.items() if n not in long}
    head = {
        "kind": kind,
        "experiment": measurement.experiment.name,
        "sample_period_ns": measurement.experiment.T_ns,
        "reference_sensor": "the displacement sensor of the stage itself",
        "settings": settings,
    }
    if measurement.experiment.nodes["controller"].params.inject.where != "off":
        head["commands_that_did_not_act"] = applied(samples)[1]
    return dict(finite({**head, **found}))


def by_stamps(samples: np.ndarray, stamps: np.ndarray, T_ns: int) -> tuple[np.ndarray, int]:
    """Samples so that sample k stands at row k, from stamp 0 on, and how many were not recorded.

    A row that was not recorded repeats the one before: the injection goes on by stamps.
    """
    k = np.rint((stamps - min(int(stamps[0]), 0)) / T_ns).astype(int)
    whole = np.arange(int(k[-1]) + 1)
    if len(whole) == len(samples):
        return samples, 0
    rows = np.maximum(np.searchsorted(k, whole, side="right") - 1, 0)
    return samples[rows], len(whole) - len(samples)


def lag_of(samples: np.ndarray) -> int:
    """Stamps from a command to the voltage that acted for it.

    u_applied is of the interval before its stamp, so the least is 1; between command and device
    lies a delay of whole samples.
    """
    u, told = samples["u"], samples["u_applied"]
    n = max(len(u) - LAGS, 1)
    apart = [np.abs(told[lag : lag + n] - u[:n]) for lag in range(1, min(LAGS, len(u)))]
    return 1 + int(np.argmin([float(np.median(a)) + 1e-3 * float(a.mean()) for a in apart]))


def applied(samples: np.ndarray) -> tuple[np.ndarray, int]:
    """Voltage (V) that acted for the command of each sample, and how many commands did not act.

    A command that came late or not at all is one for which another voltage acted.
    """
    u, told = samples["u"], samples["u_applied"]
    lag, n = lag_of(samples), max(len(u) - LAGS, 1)
    acted = np.append(told[lag:], np.repeat(told[-1], lag))
    late = np.abs(told[lag : lag + n] - u[:n]) > MISSED * max(float(np.ptp(u)), 1e-300)
    return acted, int(np.count_nonzero(late))


def _spectra(
    measurement: PlannedMeasurement, samples: np.ndarray
) -> tuple[Plan, np.ndarray, ResponseCurve, ResponseCurve, ResponseCurve]:
    """Plan and signal of an injection; the responses to it of u, of the voltage that acted, of y.

    S is u over d. The stage is y over the voltage that acted: commands that did not are no part
    of it.
    """
    experiment = measurement.experiment
    plan, d = signal(experiment.nodes["controller"].params, experiment.T_s)
    outputs = np.array([samples["u"], applied(samples)[0], samples["y"]])
    start = measurement.settings["start"]
    U, V, Y = loop_response.curves(plan, d, outputs, experiment.T_s, start)
    return plan, d, U, V, Y


def response(measurement: PlannedMeasurement, samples: np.ndarray) -> dict[str, Any]:
    """From voltage to displacement of the stage alone."""
    plan, _, _, V, Y = _spectra(measurement, samples)
    P = loop_response.quotient(Y, V)
    size = np.abs(P.G)
    peak, low = int(np.argmax(size)), loop_response.low_gain(P)
    return {
        "gain_um_per_V": low * 1e6,
        "peak_hz": P.f[peak],
        "peak_over_lowest": size[peak] / low,
        "minus_3_dB_hz": loop_response.bandwidth(P),
        "lines": len(P.f),
        "blocks": plan.blocks,
        "periods": plan.periods,
        "median_coherence": float(np.nanmedian(P.coherence)) if plan.blocks > 1 else None,
        "noise_share": _share(P, P.noise),
        "nonlinear_share": _share(P, P.nonlinear),
        "curves": {"P_m_per_V": loop_response.as_table(P)},
    }


def _share(curve: ResponseCurve, variance: np.ndarray) -> float:
    """Median of a standard deviation over the size."""
    known = variance[np.isfinite(variance)]
    if not known.size:
        return math.nan
    return float(np.median(np.sqrt(variance) / np.abs(curve.G)))


def loop(measurement: PlannedMeasurement, samples: np.ndarray) -> dict[str, Any]:
    """T, S and L of the running loop, margins measured beside margins predicted."""
    experiment = measurement.experiment
    plan, _, U, V, Y = _spectra(measurement, samples)
    T_s = experiment.T_s
    told: dict[str, Any] = {"where": experiment.nodes["controller"].params.inject.where}
    P = loop_response.quotient(Y, V)
    curves = {"P_m_per_V": P}
    predicted = check(experiment)
    told["predicted_by"] = predicted["note"] or "pea check, nominal plant"
    S = U if told["where"] == "voltage" else None
    if told["where"] == "reference":
        curves["T_w"] = Y
        told["bandwidth_w_hz"] = loop_response.bandwidth(Y)
        S = through_plant(experiment, P)
        follows = theory.following(experiment, Y.f) if predicted["linear"] else None
        told["largest_T_w"] = float(np.abs(Y.G).max())
        if follows is not None:
            curves["T_w_nominal"] = _exact(Y.f, follows)
    if S is None:
        told["margins"] = {}
    else:
        curves |= {
            "S": S,
            "T": loop_response.complement(S),
            "L": loop_response.open_loop(S),
        }
        told["margins"] = _margins(
            experiment, samples, S, predicted, T_s, curves, plan, measurement.settings["start"]
        )
        told["median_coherence"] = float(np.nanmedian(S.coherence))
        told["noise_share"], told["nonlinear_share"] = (
            _share(S, S.noise),
            _share(S, S.nonlinear),
        )
    return {**told, "curves": {n: loop_response.as_table(c) for n, c in curves.items()}}


def _exact(f: np.ndarray, G: np.ndarray) -> ResponseCurve:
    none = np.zeros(len(f))
    return ResponseCurve(f, G, none, none, np.ones(len(f)))


def through_plant(experiment: Experiment, P: ResponseCurve) -> ResponseCurve | None:
    """S by the measured response of the stage and the law as it is, which is known exactly.

    None where the observer or the law is not linear.
    """
    from pea_lab import linear

    try:
        parts = linear.blocks(experiment)
    except Nonlinear:
        return None
    law, _ = theory.around(parts, P.f, experiment.T_s)
    S = theory.sensitivity(parts, P.f, experiment.T_s, measured=P.G)
    z = np.exp(2j * math.pi * P.f * experiment.T_s)
    by_P = np.abs(np.einsum("fi,fi->f", law, theory.at(parts.observer, z)[:, :, 0]) * S**2) ** 2
    return ResponseCurve(P.f, S, P.noise * by_P, P.total * by_P, P.coherence)


def _margins(
    experiment: Experiment,
    samples: np.ndarray,
    S: ResponseCurve,
    predicted: dict[str, object],
    T_s: float,
    curves: dict[str, ResponseCurve],
    plan: Plan,
    start: int,
) -> dict[str, Any]:
    """Each margin: measured with its interval, and predicted."""
    measured = loop_response.intervals(S, T_s)
    rows: dict[str, Any] = {
        name: {"measured": x, "low_95": low, "high_95": high}
        for name, (x, low, high) in measured.items()
    }
    if not predicted["linear"] or not predicted["stable"]:
        return rows
    nominal = theory.nominal(experiment, S.f)
    by_lines = loop_response.margins(S.f, nominal, T_s)
    exact = {
        "gain_upper": predicted["gain_margin_upper"],
        "gain_lower": predicted["gain_margin_lower"] or None,
        "delay_samples": predicted["delay_margin_samples"],
    }
    around, slope = theory.of_plant(experiment, S.f, plan, samples["u"], start)
    at_slope = loop_response.margins(S.f, around, T_s)
    curves["S_nominal"], curves["S_plant"] = _exact(S.f, nominal), _exact(S.f, around)
    for name, row in rows.items():
        row["predicted"] = exact.get(name, by_lines[name])
        row["predicted_plant"] = at_slope[name]
    rows["gain_upper"]["hysteresis_slope"] = slope
    inside = np.abs(S.G - around) <= S.radius
    rows["modulus"]["lines_within_95"] = float(inside.mean())
    return rows


def steps(measurement: PlannedMeasurement, samples: np.ndarray) -> dict[str, Any]:
    """Rise, settling, overshoot of each size, with statistics over the repeats."""
    experiment = measurement.experiment
    first, _, end = times(experiment)
    T_s, y, w = experiment.T_s, samples["y"], samples["w"]
    groups: dict[float, list[motion.StepFigures]] = {}
    for index, size in measurement.settings["steps"]:
        k = int(first[index])
        stop = int(first[index + 1]) if index + 1 < len(first) else end
        before = float(y[max(k - max((stop - k) // 5, 1), 0) : k].mean())
        found = motion.step(
            y[k:stop], before, float(w[stop - 1]), T_s, measurement.settings.get("band_m")
        )
        groups.setdefault(size, []).append(found)
    rows = []
    for size, made in groups.items():
        columns: tuple[tuple[str, list[float]], ...] = (
            ("height_um", [s.height * 1e6 for s in made]),
            ("rise_ms", [s.rise * 1e3 for s in made]),
            ("settling_ms", [s.settling * 1e3 for s in made]),
            ("overshoot_percent", [s.overshoot * 100.0 for s in made]),
            ("error_nm", [s.error * NM_PER_M for s in made]),
        )
        told = {name: motion.statistics(values) for name, values in columns}
        rows.append({"size_um": size, "repeats": len(made), **told})
    return {"steps": rows}


def hysteresis(measurement: PlannedMeasurement, samples: np.ndarray) -> dict[str, Any]:
    """Width of major and minor loops, linearity, slope."""
    first, there, _ = times(measurement.experiment)
    u, y = samples["u_applied"], samples["y"]
    rows = []
    for up, down in measurement.settings["major"][1:]:
        part = slice(int(first[up]), int(there[down]) + 1)
        width, stroke = motion.loop_width(u[part], y[part], int(there[up] - first[up]))
        slope, off = motion.linearity(u[part], y[part])
        rows.append((width, stroke, slope, off))
    width, stroke, slope, off = np.mean(rows, axis=0)
    minor = {}
    for up, share in measurement.settings["minor"]:
        part = slice(int(first[up - 1]), int(there[up]) + 1)
        turn = int(there[up - 1] - first[up - 1])
        narrow, way = motion.loop_width(-u[part], -y[part], turn)
        minor[share] = {
            "stroke_um": way * 1e6,
            "width_nm": narrow * NM_PER_M,
            "percent_of_own": 100.0 * narrow / way,
        }
    return {
        "stroke_um": stroke * 1e6,
        "hysteresis_nm": width * NM_PER_M,
        "hysteresis_percent": 100.0 * width / stroke,
        "linearity_percent": 100.0 * off,
        "slope_um_per_V": slope * 1e6,
        "loops": len(rows),
        "minor_loops": [{"share": share, **told} for share, told in minor.items()],
    }


def creep(measurement: PlannedMeasurement, samples: np.ndarray) -> dict[str, Any]:
    """Creep after the step."""
    first, there, end = times(measurement.experiment)
    index = measurement.settings["step"]
    k, T_s = int(first[index]), measurement.experiment.T_s
    stop = int(first[index + 1]) if index + 1 < len(first) else end
    y = samples["y"]
    before = float(y[k - max(round(0.05 / T_s), 1) : k].mean())
    told = motion.creeping(y[int(there[index]) : stop] - before, T_s)
    return {"step_um": measurement.settings["size_um"], **told}


def standing(measurement: PlannedMeasurement, samples: np.ndarray) -> slice:
    """Samples of a noise measurement in which the stage stands still."""
    first, there, end = times(measurement.experiment)
    index = measurement.settings["still"]
    begin = int(there[index]) + round(measurement.settings["begin_s"] / measurement.experiment.T_s)
    return slice(begin, int(first[index + 1]) if index + 1 < len(first) else end)


def noise(measurement: PlannedMeasurement, samples: np.ndarray) -> dict[str, Any]:
    """Density, cumulative rms, Allan deviation, resolution."""
    T_s = measurement.experiment.T_s
    found = still.noise(samples["y"][standing(measurement, samples)], T_s)
    best = int(np.argmin(found.allan))
    return {
        "rms_nm": found.rms * NM_PER_M,
        "drift_nm_per_s": found.drift * NM_PER_M,
        "median_density_nm_per_rtHz": float(np.median(found.density)) * NM_PER_M,
        "least_allan_nm": float(found.allan[best]) * NM_PER_M,
        "least_allan_at_s": float(found.tau[best]),
        "resolution": [
            {
                "bandwidth_hz": B,
                "rms_nm": still.rms_within(found, B) * NM_PER_M,
                "peak_to_peak_nm": still.resolution(found, B) * NM_PER_M,
            }
            for B in BANDWIDTHS
            if 0.5 / T_s > B
        ],
        "curves": {
            "f_hz": found.f.tolist(),
            "density_nm_per_rtHz": (found.density * NM_PER_M).tolist(),
            "cumulative_nm": (found.cumulative * NM_PER_M).tolist(),
            "tau_s": found.tau.tolist(),
            "allan_nm": (found.allan * NM_PER_M).tolist(),
        },
    }


ANALYSES = {
    "loop": loop,
    "response": response,
    "steps": steps,
    "hysteresis": hysteresis,
    "creep": creep,
    "noise": noise,
}


def table(found: dict[str, object]) -> list[tuple[str, str, str]]:
    """Figures as lines: name, value, unit."""
    from pea_experiment.metrics import unit

    rows = []
    for name, value in found.items():
        if isinstance(value, float | int) and not isinstance(value, bool):
            told = f"{value:.5g}" if isinstance(value, float) else str(value)
            rows.append((name, told, unit(name)))
    return rows


def _number(x: float | None) -> str:
    return "–" if x is None else f"{x:.4g}"


def margin_table(found: dict[str, Any]) -> list[tuple[str, ...]]:
    """Margins: name, measured, 95 % interval, predicted, with the plant's hysteresis, unit."""
    rows: list[tuple[str, ...]] = []
    for name, row in found.get("margins", {}).items():
        title, told = MARGINS[name]
        low, high = row["low_95"], row["high_95"]
        between = "–" if low is None else f"{low:.4g} to {high:.4g}"
        predicted = _number(row.get("predicted")), _number(row.get("predicted_plant"))
        rows.append((title, _number(row["measured"]), between, *predicted, told))
    return rows


def step_table(found: dict[str, Any]) -> list[tuple[str, ...]]:
    """Steps: size, repeats, then mean and standard deviation of each figure."""
    rows = []
    for row in found.get("steps", ()):
        cells = [f"{row['size_um']:.4g}", str(row["repeats"])]
        for name in ("rise_ms", "settling_ms", "overshoot_percent", "error_nm"):
            mean, std = row[name]["mean"], row[name]["std"]
            cells.append(_number(mean) + ("" if std is None else f" ± {std:.2g}"))
        rows.append(tuple(cells))
    return rows


def draw(
    path: Path, measurement: PlannedMeasurement, found: dict[str, object], samples: np.ndarray
) -> None:
    """Draw a measurement as PNG."""
    from pea_measure.figures import figure

    figure(path, measurement, found, samples)
