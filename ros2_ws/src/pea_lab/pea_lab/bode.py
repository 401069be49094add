"""Bode, Nyquist and sensitivity of an experiment's loop, as a figure."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from pea_core.params import ParameterError
from pea_experiment.experiment import Experiment
from pea_lab.check import response
from pea_lab.linear import Nonlinear, assemble, blocks
from pea_lab.plot import FORMATS, plt, save_as

POINTS = 2000
"""Frequencies of a curve."""

LOW = 1e-4
"""Lowest frequency as a share of the sample rate's half."""


def refuse(path: Path) -> None:
    """Refuse a name that cannot be written.

    Raises
    ------
    ParameterError
        It does not end as a figure does, or is there already.
    """
    if path.suffix not in FORMATS:
        raise ParameterError(f"--plot {path}: must end in {', '.join(FORMATS)}")
    if path.exists():
        raise ParameterError(f"--plot {path}: exists already; nothing is written over")


def responses(experiment: Experiment) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies (Hz), and the open loop there.

    Returns
    -------
    f : (n,) array
    L : (n,) complex array
        Of negative feedback: the loop is on the edge of stability where L = -1.

    Raises
    ------
    ParameterError
        The observer or the law is not linear.
    """
    try:
        loop = assemble(blocks(experiment))
    except Nonlinear as error:
        raise ParameterError(f"--plot: {error}; a frequency response is of a linear loop") from None
    omega_T = np.geomspace(LOW * math.pi, math.pi, POINTS)
    return omega_T / (2.0 * math.pi * experiment.T_s), -response(loop, omega_T)


def draw(path: Path, experiment: Experiment) -> None:
    """Draw gain and phase of L, the Nyquist curve, |S| and |T|.

    Raises
    ------
    ParameterError
        The observer or the law is not linear.
    FileExistsError
        The file is there already.
    """
    f, L = responses(experiment)
    S = 1.0 / (1.0 + L)
    plot, ((gain, curve), (phase, both)) = plt.subplots(2, 2, figsize=(10, 7), layout="constrained")
    plot.suptitle(experiment.name)
    gain.loglog(f, np.abs(L))
    gain.axhline(1.0, color="0.5", linewidth=0.8)
    gain.set(title="Open loop L", ylabel="gain", xlabel="frequency (Hz)")
    phase.semilogx(f, np.degrees(np.unwrap(np.angle(L))))
    phase.set(ylabel="phase (deg)", xlabel="frequency (Hz)")
    curve.plot(L.real, L.imag, label="L")
    curve.plot([-1.0], [0.0], "+", markersize=12, label="-1")
    peak = float(np.abs(S).max())
    turn = np.linspace(0.0, 2.0 * math.pi, 200)
    radius = 1.0 / peak
    curve.plot(
        radius * np.cos(turn) - 1.0, radius * np.sin(turn), ":", label=f"1/max |S| = {radius:.3g}"
    )
    curve.set(title="Nyquist", xlabel="real", ylabel="imaginary", xlim=(-3, 3), ylim=(-3, 3))
    curve.set_aspect("equal")
    both.loglog(f, np.abs(S), label=f"|S|, at most {peak:.3g}")
    both.loglog(f, np.abs(1.0 - S), "--", label="|T|")
    both.set(title="Sensitivity S and T = 1 - S", xlabel="frequency (Hz)", ylabel="gain")
    for axis in (gain, phase, curve, both):
        axis.grid(True, which="major", alpha=0.3)
    for axis in (curve, both):
        axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize="small")
    save_as(plot, path)
