"""What a run was worth: `metrics.json`.

Scoring rule. Errors are rms(x1 - w) over the last whole periods of the reference that lie in
the second half of the run, at least one; without a period, over the second half. x1 is the true
displacement where the plant is simulated, else the measured one.
"""

from __future__ import annotations

import hashlib
import math
from typing import Any

import numpy as np

from pea_core.nominal import NominalModel
from pea_core.signals import TRUTH
from pea_plant.drivers.simulated import Simulated

TRACE = ("y", "x1_hat", "x2_hat", "eps_hat", "u", "u_applied")
"""Arrays of `trace_sha256`, in order."""


def trace_sha256(samples: np.ndarray) -> str:
    """Digest of the float64 little-endian arrays of `TRACE`, one after the other."""
    digest = hashlib.sha256()
    for name in TRACE:
        digest.update(np.ascontiguousarray(samples[name], "<f8").tobytes())
    return digest.hexdigest()


def truth(plant: Simulated, samples: np.ndarray, nominal: NominalModel) -> np.ndarray | None:
    """True states of a simulated run, by driving a new plant with the recorded commands.

    Parameters
    ----------
    plant : Simulated
        At rest, with the run's parameters.
    samples : (n,) array of `SAMPLE`
        The run.
    nominal : NominalModel
        Eq 2, which defines eps: (x2' - A21 x1 - A22 x2) / B2 - u_applied, with x2' and
        u_applied of the interval that ended at the sample.

    Returns
    -------
    (n,) array of `TRUTH`, or None
        None where the plant does not repeat the recorded y bit by bit: its parameters were
        changed during the run, so what is recorded does not tell the truth.
    """
    found = np.empty(len(samples), TRUTH)
    A21, A22, B2 = nominal.A21, nominal.A22, nominal.B2
    for i, (u, y, u_applied) in enumerate(samples[["u", "y", "u_applied"]].tolist()):
        if plant.read().y != y:
            return None
        x1, x2, x2_dot = plant.truth
        found[i] = (x1, x2, (x2_dot - A21 * x1 - A22 * x2) / B2 - u_applied)
        plant.write(u)
    return found


def scored(samples: int, period: float | None) -> slice:
    """Samples over which a run is scored.

    Parameters
    ----------
    samples : int
        Length of the run.
    period : float or None
        Period of the reference in samples.
    """
    if period is None or period > samples:
        return slice(samples // 2, samples)
    periods = max(int(samples / 2 / period + 1e-9), 1)
    return slice(samples - round(periods * period), samples)


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(math.sqrt(float(np.mean(np.square(values)))))


def metrics(
    samples: np.ndarray,
    true: np.ndarray | None,
    period: float | None,
    voltage_min: float,
    voltage_max: float,
) -> dict[str, Any]:
    """Figures of a run that follow from its samples alone.

    Parameters
    ----------
    samples : (n,) array of `SAMPLE`
        The run, n > 0.
    true : (n,) array of `TRUTH` or None
        From `truth`.
    period : float or None
        Period of the reference in samples.
    voltage_min, voltage_max : float
        What the actuator can apply (V).
    """
    part = scored(len(samples), period)
    w = samples["w"]
    x1 = samples["y"] if true is None else true["x1"]
    error = (x1 - w)[part]
    amplitude = float(np.ptp(w[part])) / 2.0
    u = samples["u"]
    figures: dict[str, Any] = {
        "rms_error_nm": rms(error) * 1e9,
        "max_error_nm": float(np.abs(error).max()) * 1e9,
        "rms_error_percent": 100.0 * rms(error) / amplitude if amplitude > 0.0 else None,
        "rms_voltage_step_V": rms(np.diff(u)[part]) if len(u) > 1 else 0.0,
        "saturated_samples": int(np.count_nonzero((u < voltage_min) | (u > voltage_max))),
        "scored_from_sample": part.start,
    }
    for name, field in (("x1", "x1_hat"), ("x2", "x2_hat"), ("eps", "eps_hat")):
        key = f"observer_rms_{name}_" + {"x1": "nm", "x2": "um_s", "eps": "V"}[name]
        if true is None:
            figures[key] = None
        else:
            scale = {"x1": 1e9, "x2": 1e6, "eps": 1.0}[name]
            figures[key] = rms((samples[field] - true[name])[part]) * scale
    figures["trace_sha256"] = trace_sha256(samples)
    return figures
