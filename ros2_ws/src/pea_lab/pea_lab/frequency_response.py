r"""Frequency response of the actuator, measured at the lines of a multisine.

Over whole periods N of the excitation, with U and Y the discrete Fourier transforms of the voltage
applied from each sample on and of y,

.. math:: \frac{Y(f)}{U(f)} = \sum_n H_0(f_n) V(f_n), \quad f_n = f - n/T_s, \quad
          H_0(f) = \frac{\sin(\pi f T_s)}{\pi f T_s} e^{-j \pi f T_s}

H_0 is what holding the voltage over a sample does: at 867 Hz it turns the phase by 7.8 degrees.
The terms n != 0 are aliases of the staircase, 0.02 % of the first at 867 Hz, 1.6 % at 4 kHz; they
are taken from the nominal model, so that

.. math:: V(f) = \frac{1}{H_0(f)} \Bigl(\frac{Y(f)}{U(f)} - \sum_{n \ne 0} H_0(f_n) V_{nominal}(f_n)
          \Bigr)
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from pea_core.nominal import NominalModel
from pea_experiment.experiment import Experiment
from pea_experiment.scoring import scored
from pea_reference import model as references

ALIASES = 50
"""Aliases that count, to either side; they fall with the third power of their number."""


class Response(NamedTuple):
    """Lines (n) in Hz, and the complex response (n) in m/V at each."""

    f: np.ndarray
    V: np.ndarray


def hold(f: np.ndarray, T_s: float) -> np.ndarray:
    """H_0 of a zero-order hold of T_s (s) at frequencies f (Hz)."""
    return np.sinc(f * T_s) * np.exp(-1j * math.pi * f * T_s)


def model(nominal: NominalModel, f: np.ndarray) -> np.ndarray:
    """V(j 2 pi f) of Eq 2 in m/V."""
    s = 2j * math.pi * f
    return nominal.B2 / (s * s - nominal.A22 * s - nominal.A21)


def aliases(nominal: NominalModel, f: np.ndarray, T_s: float) -> np.ndarray:
    """Sum of H_0 V (m/V) over the aliases of the frequencies f (Hz)."""
    n = np.concatenate([np.arange(-ALIASES, 0), np.arange(1, ALIASES + 1)])
    f_n = f[:, None] - n / T_s
    return np.asarray((hold(f_n, T_s) * model(nominal, f_n)).sum(axis=1))


def measured(
    y: np.ndarray, u: np.ndarray, f: np.ndarray, T_s: float, nominal: NominalModel
) -> Response:
    """Response from the voltage u (n) held over each sample to y (n), the hold taken out.

    Parameters
    ----------
    y : (n,) array
        Displacement (m) at the samples; n holds whole periods of every line.
    u : (n,) array
        Voltage (V) from each sample to the next.
    f : (m,) array
        Lines (Hz) that the excitation holds.
    T_s : float
        Sample period (s).
    nominal : NominalModel
        Tells the aliases.
    """
    turns = np.exp(-2j * math.pi * np.outer(f, np.arange(len(y)) * T_s))
    sampled = (turns @ y) / (turns @ u)
    return Response(f, (sampled - aliases(nominal, f, T_s)) / hold(f, T_s))


def of_run(experiment: Experiment, samples: np.ndarray) -> Response | None:
    """Response measured by a run; None where the reference has no lines of a common period.

    Two lines at least. None too where the scored period begins with the run: no voltage was applied
    before its first sample.

    Parameters
    ----------
    experiment : Experiment
    samples : (n,) array of `SAMPLE`
    """
    params = experiment.nodes["reference"].params
    parts = scored(len(samples), experiment.segments)
    model = references.MODELS[references.CHOICE.type_of(params)]
    f = np.sort(model.lines(params)) if hasattr(model, "lines") else np.empty(0)
    if f.size < 2 or None in parts:
        return None
    (part,) = parts.values()
    if part.start < 1:
        return None
    y = samples["y"][part.start - 1 : part.stop - 1]
    u = samples["u_applied"][part]  # of the interval that ended there
    return measured(y, u, f, experiment.T_s, experiment.nominal)


def crossing(f: np.ndarray, V: np.ndarray, above: Callable[[complex], float]) -> float | None:
    """First frequency (Hz) at which a function of 1/V falls to 0; None where no two lines hold it.

    Between two lines 1/V is that of a second-order actuator through both: its real part and its
    imaginary part over f are straight lines over f^2. So two lines about the frequency are enough.

    Parameters
    ----------
    f : (n,) array
        Lines (Hz), rising.
    V : (n,) array
        Response (m/V).
    above : callable
        Takes 1/V.
    """
    from scipy.optimize import brentq  # slow to import

    parts = np.array([(1.0 / V).real, (1.0 / V).imag / f])

    def at(x: float, i: int) -> float:
        share = (x * x - f[i] ** 2) / (f[i + 1] ** 2 - f[i] ** 2)
        real, slope = parts[:, i] + share * (parts[:, i + 1] - parts[:, i])
        return above(complex(real, slope * x))

    values = np.array([above(each) for each in 1.0 / V])
    falls = np.flatnonzero((values[:-1] > 0.0) & (values[1:] <= 0.0))
    if not falls.size:
        return None
    i = int(falls[0])
    return float(brentq(at, f[i], f[i + 1], (i,), xtol=1e-9))


def figures(response: Response, nominal: NominalModel) -> dict[str, Any]:
    """Where the gain is 3 dB below that at rest and the phase -90 degrees; errors.

    The gain at rest is that of the second-order actuator through the two lowest lines. The errors
    are the largest differences from the nominal model.
    """
    f_0, f_1 = response.f[:2] ** 2
    first, second = (1.0 / response.V[:2]).real
    rest = first - (second - first) * f_0 / (f_1 - f_0)
    ratio = response.V / model(nominal, response.f)
    return {
        "minus_3_dB_hz": crossing(response.f, response.V, lambda Q: 2.0 * rest**2 - abs(Q) ** 2),
        "minus_90_degrees_hz": crossing(response.f, response.V, lambda Q: Q.real),
        "gain_error_dB": float(np.abs(20.0 * np.log10(np.abs(ratio))).max()),
        "phase_error_deg": float(np.abs(np.degrees(np.angle(ratio))).max()),
    }
