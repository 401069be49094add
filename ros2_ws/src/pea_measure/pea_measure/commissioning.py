"""From measurements of a stage to a model, a set of plants about it, and gains checked on them.

What the data determine replaces what the rig's file says; what they do not determine stays, and a
sentence says so.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from pea_core.params import ParameterError
from pea_experiment.experiments import Experiment
from pea_identify import hysteresis, modes
from pea_identify.frequency_response import FrequencyResponse
from pea_lab.guard import margins
from pea_measure import plans
from pea_measure.plans import Base, Measurement

MEASURED = ("response", "hysteresis", "creep", "noise")
"""Measurements that are identified from, in their order."""

UNSURE = 0.2
"""Share of a parameter by which its 95 % interval may be wide and still determine it."""

POINTS = 3000
"""Samples of a slow loop that H is fitted to at most."""

PLAYS = 10
"""Play operators of the fitted H."""

MARGIN = 1.3
"""Least gain margin on every plant of the set."""


def measurements(base: Base, at: float | None, amplitude: float | None) -> dict[str, Measurement]:
    """What is measured, by name.

    Raises
    ------
    ParameterError
        One of them would leave what the stage allows.
    """
    T_s = base.load(["reference.type=constant"]).T_s
    signal = {} if amplitude is None else {"amplitude_V": amplitude}
    slow = max(2.0, 400.0 * T_s)
    made = (
        plans.injected(base, "response", at, signal),
        plans.hysteresis(base, None, None, slow, 1),
        plans.creep(base, at, None, 2.0 * slow),
        plans.noise(base, at, max(1.0, 300.0 * T_s), True),
    )
    return dict(zip(MEASURED, made, strict=True))


def identified(
    base: Base, found: dict[str, dict[str, Any]], slow: tuple[np.ndarray, np.ndarray]
) -> dict[str, Any]:
    """A model of the stage from its measurements.

    Parameters
    ----------
    base : Base
    found : dict
        Figures of `MEASURED`.
    slow : (u, y)
        Voltage (V) and displacement (m) of the hysteresis measurement.

    Returns
    -------
    dict
        sets : settings of plant, observer and law.  plants : settings of each plant about it.
        parameters : value and 95 % half width of each.  sentences : what was not determined.
    """
    experiment = base.load(["reference.type=constant"])
    T_s, plant = experiment.T_s, experiment.nodes["plant"].params
    sentences: list[str] = []
    fit = fitted_hysteresis(*slow)
    K = float(found["hysteresis"]["slope_um_per_V"])
    local = float(found["response"]["gain_um_per_V"])
    parameters: dict[str, Any] = {
        "K_um_per_V": {"value": K, "half_width_95": None},
        "K_small_um_per_V": {"value": local, "half_width_95": None},
        "hysteresis_left_percent": {"value": 100.0 * fit.held_out / fit.stroke},
        "noise_nm": {"value": found["noise"]["rms_nm"]},
        "creep_per_decade": {"value": found["creep"]["gamma_per_decade"]},
    }
    omega_n, zeta, delay = plant.omega_n, plant.zeta, plant.delay_samples
    spread = 0.1
    mode = dominant(found["response"], T_s)
    if isinstance(mode, str):
        sentences.append(mode)
    else:
        omega_n, zeta, delay = mode["omega_n"], mode["zeta"], round(mode["delay_s"] / T_s)
        spread = max(0.03, mode["omega_n_95"] / omega_n)
        parameters |= {
            "omega_n_rad_s": {"value": omega_n, "half_width_95": mode["omega_n_95"]},
            "zeta": {"value": zeta, "half_width_95": mode["zeta_95"]},
            "delay_us": {"value": mode["delay_s"] * 1e6, "half_width_95": mode["delay_95"] * 1e6},
        }
        if mode["count"] > 1:
            sentences.append(
                f"{mode['count']} modes were found; the model has the largest, at "
                f"{omega_n / (2.0 * math.pi):.4g} Hz"
            )

    sentences.append(
        "the fit of H is reported alone: the simulated plants keep the hysteresis of the experiment"
    )
    of_plant = [
        f"plant.K={K:.9g}",
        f"plant.omega_n={omega_n:.9g}",
        f"plant.zeta={zeta:.9g}",
        f"plant.delay_samples={delay}",
        f"plant.sensor.noise_nm={max(found['noise']['rms_nm'], 0.0):.6g}",
    ]
    of_loop = [
        f"{node}.{name}={value:.9g}"
        for node in ("observer", "controller")
        for name, value in (("K", K), ("omega_n", omega_n), ("zeta", zeta))
    ]
    plants = {
        "identified": [],
        "gain for small signals": [f"plant.K={local:.9g}", "plant.hysteresis.type=none"],
        f"resonance {-100.0 * spread:.2g} %": [f"plant.omega_n={omega_n * (1.0 - spread):.9g}"],
        f"resonance +{100.0 * spread:.2g} %": [f"plant.omega_n={omega_n * (1.0 + spread):.9g}"],
        "gain +10 %": [f"plant.K={1.1 * K:.9g}"],
    }
    return {
        "sets": [*of_plant, *of_loop],
        "plants": plants,
        "parameters": parameters,
        "sentences": sentences,
    }


def fitted_hysteresis(u: np.ndarray, y: np.ndarray) -> hysteresis.Fit:
    """H of a slow measurement: every second block of samples is fitted, the others judge."""
    every = max(len(u) // POINTS, 1)
    u, y = u[::every], y[::every]
    block = (np.arange(len(u)) // max(len(u) // 20, 1)) % 2 == 0
    return hysteresis.prandtl_ishlinskii(hysteresis.Data(u, y, block, ~block), PLAYS)


def dominant(response: dict[str, Any], T_s: float) -> dict[str, float] | str:
    """The mode of the largest share with its intervals, or a sentence why there is none."""
    table = response["curves"]["P_m_per_V"]

    def column(name: str) -> np.ndarray:
        return np.array([math.nan if x is None else x for x in table[name]])

    f = np.array(table["f_hz"])
    G = (np.array(table["real"]) + 1j * np.array(table["imag"]))[:, None, None]
    noise, more = (column(n)[:, None, None] for n in ("noise_variance", "nonlinear_variance"))
    coherence = column("coherence")[:, None]
    measured = FrequencyResponse(f, G, noise, noise + more, coherence, T_s)
    try:
        found = modes.fit(measured)
    except (ParameterError, np.linalg.LinAlgError, ValueError) as error:
        return f"the resonance is not determined ({error}); what the rig says of it stays"
    i = int(np.argmax(found.shares))
    omega_n, half = float(found.omega_n[i]), float(found.omega_n_95[i])
    highest = float(f[-1])
    if not half < UNSURE * omega_n or omega_n > 2.0 * math.pi * highest:
        return (
            f"the resonance is not determined by lines up to {highest:.4g} Hz; what the rig says "
            "of it stays"
        )
    return {
        "omega_n": omega_n,
        "omega_n_95": half,
        "zeta": float(found.zeta[i]),
        "zeta_95": float(found.zeta_95[i]),
        "delay_s": float(found.delay),
        "delay_95": float(found.delay_95),
        "count": len(found.omega_n),
    }


def on(base: Base, *more: list[str]) -> Experiment:
    """The experiment of a base with other settings over those of the user."""
    sets = [*base.sets, *(each for part in more for each in part)]
    return Base(base.name, (), base.rig).load(sets)


def proposed(
    base: Base, model: dict[str, Any], trials: int, there: Path, progress: Any
) -> dict[str, Any]:
    """Gains found by `pea_lab.tune` on the identified set of plants.

    Raises
    ------
    ParameterError
        The law has no gains, or none keeps the margin.
    """
    from pea_lab import tune

    experiment = on(base, model["sets"])
    goal = tune.Goal(
        MARGIN,
        {name: tuple(sets) for name, sets in model["plants"].items()},
        tune.gains_of(experiment),
    )
    if not goal.ranges:
        raise ParameterError("this law has no gains to propose; give the rig another controller")
    with tune.Processes(None) as hands:
        tried = tune.tune(experiment, goal, trials, 0, hands, progress)
    best = tune.best(tried)
    if not best.good:
        raise ParameterError(
            f"no gains keep a margin of {MARGIN:g} on every plant; the best has "
            f"{tune.margin_text(best.margin)}: give the rig another law, or a lower rate"
        )
    there.mkdir()
    tune.write(there, experiment, goal, tried, 0)
    return {
        "gains": best.values,
        "error_nm": best.error_nm,
        "worst_nm": best.worst_nm,
        "margin": best.margin,
        "by": "pea tune",
        "presets": str(there),
    }


def gain_sets(gains: dict[str, float]) -> list[str]:
    """Settings of proposed gains."""
    return [f"{name}={value:.12g}" for name, value in gains.items()]


def checked(base: Base, model: dict[str, Any], gains: dict[str, float]) -> dict[str, Any]:
    """Margins of the gains on each plant of the set.

    Raises
    ------
    ParameterError
        A plant on which the loop is unstable, or has too little margin.
    """
    rows = {}
    for name, sets in model["plants"].items():
        found = margins(on(base, model["sets"], gain_sets(gains), sets), 10.0)
        rows[name] = {"gain_margin": found.gain, "delay_margin_samples": found.delay}
        if found.gain < MARGIN:
            raise ParameterError(
                f"plant {name}: gain margin {found.gain:.3g} < {MARGIN:g}; propose other gains"
            )
    return rows
