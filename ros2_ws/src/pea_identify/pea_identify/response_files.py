"""Frequency responses from files: what `pea identify` and `pea measure response` leave."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from pea_core.params import ParameterError
from pea_identify.frequency_response import FrequencyResponse

LEAST_LINES = 16
"""Frequencies that a response must have."""


def read(path: Path, T_s: float) -> FrequencyResponse:
    """Read a response of a stage that is sampled with T_s (s).

    A CSV file has the columns f (Hz), real and imaginary part (m/V), and may have the variances
    from noise and in all (m²/V²). A JSON file is the `measurement.json` of ``pea measure``.

    Raises
    ------
    ParameterError
        The file cannot be read, or holds no frequency response.
    """
    try:
        rows = of_json(path) if path.suffix == ".json" else of_csv(path)
    except OSError as error:
        raise ParameterError(f"{path}: {error.strerror or error}") from None
    except (ValueError, KeyError, TypeError):
        raise ParameterError(
            f"{path}: holds no frequency response: give columns of Hz, real and imaginary part in "
            "m/V, or the measurement.json of pea measure response"
        ) from None
    f = rows[:, 0]
    if len(f) < LEAST_LINES:
        raise ParameterError(f"{path}: {len(f)} frequencies: give at least {LEAST_LINES}")
    if not np.isfinite(rows[:, :3]).all():
        raise ParameterError(f"{path}: a number is not finite: remove that frequency")
    if f[0] <= 0.0 or (np.diff(f) <= 0.0).any() or f[-1] >= 0.5 / T_s:
        raise ParameterError(
            f"{path}: frequencies of {f[0]:g} to {f[-1]:g} Hz: must rise, from above 0 to below "
            f"half the sample rate, {0.5 / T_s:g} Hz"
        )
    G = (rows[:, 1] + 1j * rows[:, 2])[:, None, None]
    noise, total = (rows[:, i][:, None, None] for i in (3, 4))
    return FrequencyResponse(f, G, noise, total, np.full((len(f), 1), np.nan), T_s)


def of_csv(path: Path) -> np.ndarray:
    """Rows (F, 5); variances that are not there are NaN."""
    rows = np.genfromtxt(path, delimiter=",", comments="#", skip_header=1, ndmin=2)
    if rows.shape[1] not in (3, 5):
        raise ValueError
    return np.hstack([rows, np.full((len(rows), 5 - rows.shape[1]), np.nan)])


def of_json(path: Path) -> np.ndarray:
    """The same of a measurement of the stage."""
    table = json.loads(path.read_text(encoding="utf-8"))["curves"]["P_m_per_V"]
    noise, more = (
        np.array([np.nan if x is None else x for x in table[name]], dtype=float)
        for name in ("noise_variance", "nonlinear_variance")
    )
    columns = [table[name] for name in ("f_hz", "real", "imag")]
    return np.column_stack([*columns, noise, noise + more])
