"""From measurements of a stage to a model, a set of plants about it, and gains checked on them.

What the data determine replaces what the rig's file says; what they do not determine stays, and a
sentence says so.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pea_controller.model.modal import ModalParams
from pea_core.params import ParameterError
from pea_experiment.experiments import Experiment
from pea_identify import hysteresis, modes
from pea_identify.frequency_response import FrequencyResponse
from pea_identify.modes import Modes
from pea_lab.fitted import inverse_of
from pea_lab.guard import margins
from pea_measure import plans
from pea_measure.analysis import finite
from pea_measure.plans import Base, Measurement

MEASURED = ("response", "hysteresis", "creep", "noise")
"""Measurements that are identified from, in their order."""

SLOW = 2.0
"""Least period of a triangle of the hysteresis measurement, and half the hold of the creep (s)."""

UNSURE = 0.2
"""Share of a parameter by which its 95 % interval may be wide and still determine it."""

POINTS = 3000
"""Samples of a slow loop that H is fitted to at most."""

PLAYS = 10
"""Play operators of the fitted H."""

MARGIN = 1.3
"""Least gain margin on every plant of the set."""


LEAST_SHARE = 0.02
"""Share of the gain that a mode of the model has at least."""

KNOWN = 0.005
"""Least spread of a mode's frequency that learning is told; what drifts is not in an interval."""

WHOLE = 0.03
"""Share of a sample by which a delay may differ from a whole one and count as that."""

LATE_MAX = 20
"""Samples of delay of the command that a plant may have."""

RESONANT = 0.1
"""Damping ratio below which a stage needs a law on its modes."""

JUDGED, PERIODS = 0.005, 6.0
"""Frequency of the sine that gains are judged on, times T_s; periods of it."""

AT_REST = ["reference.type=constant", "reference.offset_um=0"]
"""Reference of a loop of which only margins are taken."""


def measurements(base: Base, at: float | None, amplitude: float | None) -> dict[str, Measurement]:
    """What is measured, by name.

    Raises
    ------
    ParameterError
        One of them would leave what the stage allows.
    """
    T_s = base.load(["reference.type=constant"]).T_s
    signal = {} if amplitude is None else {"amplitude_V": amplitude}
    slow = max(SLOW, 400.0 * T_s)
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
        slopes : settings of plants that only margins are taken of.
        parameters : value and 95 % half width of each.  sentences : what was not determined.
    """
    experiment = base.load(["reference.type=constant"])
    T_s, plant = experiment.T_s, experiment.nodes["plant"].params
    fit = fitted_hysteresis(*slow)
    K, noise = 1e6 * fit.K, max(found["noise"]["rms_nm"], 1e-3)
    local = float(found["response"]["gain_um_per_V"])
    parameters: dict[str, Any] = {
        "K_um_per_V": {"value": K},
        "K_small_um_per_V": {"value": local},
        "hysteresis_left_percent": {"value": fit.percent},
        "noise_nm": {"value": noise},
        "creep_per_decade": {"value": found["creep"]["gamma_per_decade"]},
    }
    of_plant = [
        f"plant.K={K:.9g}",
        f"plant.sensor.noise_nm={noise:.6g}",
        f"plant.hysteresis.type={fit.type}",
        *settings("plant.hysteresis", fit.values),
    ]
    law = {"K": K}
    more: list[str] = []
    sentences: list[str] = []
    V = determined(found["response"], T_s)
    if isinstance(V, str):
        sentences.append(V)
        omega_n, spread, shapes = plant.omega_n, 0.1, None
    else:
        main = int(np.argmax(V.shares))
        omega_n, zeta = float(V.omega_n[main]), float(V.zeta[main])
        spread = max(0.03, float(V.omega_n_95[main]) / omega_n)
        law |= {"omega_n": omega_n, "zeta": zeta}
        for i in range(len(V.omega_n)):
            for name, value, half in (
                (f"omega_n_{i + 1}_rad_s", V.omega_n[i], V.omega_n_95[i]),
                (f"zeta_{i + 1}", V.zeta[i], V.zeta_95[i]),
            ):
                parameters[name] = {"value": float(value), "half_width_95": float(half)}
        parameters["delay_us"] = {"value": V.delay * 1e6, "half_width_95": V.delay_95 * 1e6}
        of_plant += settings("plant", {"omega_n": omega_n, "zeta": zeta})
        shapes = V if len(V.omega_n) > 1 or zeta < RESONANT else None
        command, rest = divided(V, plant, shapes is not None, T_s)
        of_plant.append(f"plant.delay_samples={command}")
        if shapes is not None:
            of_plant += ["plant.vibration.type=modal", *modal("plant.vibration", V, K)]
            of_plant += settings("plant.vibration", {"delay": rest})
        is_modal = isinstance(experiment.nodes["controller"].params, ModalParams)
        if float(V.zeta.min()) < RESONANT and not is_modal and base.chooses_law:
            sentences.append(
                "the stage is resonant: state_feedback or pidsmc_modal suits it better than the "
                "law that was given"
            )
        elif float(V.zeta.min()) < RESONANT:
            if not is_modal:
                more.append("controller.preset=resonant")
                sentences.append(
                    "the stage is resonant: the law is state_feedback on the identified modes"
                )
                more.append("observer.preset=measured")
            more += modal("controller.model", V, K)
            more += settings("controller.model", {"delay": rest})
            inverted = inverse_of(fit.type, fit.values, float(np.ptp(slow[0])))
            more += settings("controller.inverse", inverted)
            more.append(f"controller.estimator.noise_nm={noise:.6g}")
            known = max(2.0 * float((V.omega_n_95 / V.omega_n).max()), KNOWN)
            more.append(f"controller.learning.spread_frequency={min(known, 0.5):.6g}")
    nodes = ("controller",) if more else ("observer", "controller")
    plants: dict[str, list[str]] = {"identified": []}
    for share in (-spread, spread):
        plants[f"resonance {100.0 * share:+.2g} %"] = (
            modal("plant.vibration", shapes, K, 1.0 + share)
            if shapes is not None
            else settings("plant", {"omega_n": (1.0 + share) * omega_n})
        )
    plants["gain +10 %"] = (
        modal("plant.vibration", shapes, 1.1 * K)
        if shapes is not None
        else settings("plant", {"K": 1.1 * K})
    )
    # a margin is of the linear loop: this plant is checked, but could not follow over the stroke
    slopes = {
        f"gain {100.0 * (local / K - 1.0):+.2g} %, as for small signals": (
            modal("plant.vibration", shapes, local)
            if shapes is not None
            else settings("plant", {"K": local})
        )
    }
    return {
        "slopes": slopes,
        "sets": [*of_plant, *more, *(each for node in nodes for each in settings(node, law))],
        "plants": plants,
        "parameters": parameters,
        "sentences": sentences,
    }


def divided(found: Modes, plant: Any, modal_model: bool, T_s: float) -> tuple[int, float]:
    """Samples of the command, and delay of V (s), for the delay from command to y that was found.

    What the rig says of sensor and command stays. A model of modes takes the rest, in V; another
    one counts whole samples of the command.
    """
    samples, sensor = max(found.delay / T_s, 0.0), plant.sensor.delay_samples
    if abs(samples - round(samples)) <= max(found.delay_95 / T_s, WHOLE):
        samples = float(round(samples))
    rest = samples - sensor - plant.delay_samples
    if modal_model and rest >= 0.0:
        return plant.delay_samples, rest * T_s
    return min(max(round(samples) - sensor, 0), LATE_MAX), 0.0


def settings(node: str, values: Mapping[str, Any]) -> list[str]:
    """Values of a node, or of a group of its parameters, as ``--set`` takes them."""

    def told(value: object) -> str:
        if isinstance(value, float):
            return f"{value:.9g}"
        if isinstance(value, tuple):
            return "[" + ", ".join(f"{float(each):.9g}" for each in value) + "]"
        return str(value)

    return [f"{node}.{name}={told(value)}" for name, value in values.items()]


def modal(group: str, V: Modes, K: float, frequency: float = 1.0) -> list[str]:
    """Settings of modes whose gains have the sum K (um/V), every frequency multiplied."""
    shares = V.K[:, 0, 0] / V.K[:, 0, 0].sum()
    values = {"omega_n": frequency * V.omega_n, "zeta": V.zeta, "K": K * shares}
    return settings(group, {name: tuple(each.tolist()) for name, each in values.items()})


def fitted_hysteresis(u: np.ndarray, y: np.ndarray) -> hysteresis.Fit:
    """H of a slow measurement: every second block of samples is fitted, the others judge."""
    every = max(len(u) // POINTS, 1)
    u, y = u[::every], y[::every]
    block = (np.arange(len(u)) // max(len(u) // 20, 1)) % 2 == 0
    return hysteresis.prandtl_ishlinskii(hysteresis.Data(u, y, block, ~block), PLAYS)


def determined(response: dict[str, Any], T_s: float) -> Modes | str:
    """The modes that a response determines, or a sentence why there is none."""
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
        return f"the resonance is not determined ({error}); the rig's values are kept"
    highest = float(f[-1])
    kept = (
        (found.shares >= LEAST_SHARE)
        & (found.omega_n_95 < UNSURE * found.omega_n)
        & (found.zeta_95 < UNSURE * np.maximum(found.zeta, RESONANT))
        & (found.omega_n <= 2.0 * math.pi * highest)
    )
    if not kept[int(np.argmax(found.shares))]:
        return (
            f"the resonance is not determined by lines up to {highest:.4g} Hz; what the rig says "
            "of it stays"
        )
    arrays = ("omega_n", "zeta", "K", "omega_n_95", "zeta_95", "K_95")
    return replace(found, **{name: getattr(found, name)[kept] for name in arrays})


def on(base: Base, *more: list[str]) -> Experiment:
    """The experiment on a simulated plant, with other settings over those of the user."""
    sets = [
        *base.sets,
        *(["plant.driver.type=simulated"] if base.rig else []),
        *(each for part in more for each in part),
    ]
    return Base(base.name, (), base.rig).load(sets)


def judged_on(base: Base) -> list[str]:
    """Settings of the reference that gains are judged on: a sine within the stage's reach."""
    experiment = base.load(["reference.type=constant"])
    allowed = plans.reach(experiment)
    frequency = JUDGED / experiment.T_s
    values = {
        "type": "sine",
        "amplitude_um": 0.25 * allowed.stroke,
        "offset_um": 0.5 * (allowed.low + allowed.high),
        "frequency_hz": frequency,
        "phase_deg": -90.0,
    }
    return [*settings("reference", values), f"experiment.duration={PERIODS / frequency:.9g}"]


def proposed(
    base: Base, model: dict[str, Any], trials: int, there: Path, progress: Any
) -> dict[str, Any]:
    """Gains for the identified set of plants: from the model where the law is modal, else tuned.

    Raises
    ------
    ParameterError
        The law has no gains, or none keeps the margin.
    """
    experiment = on(base, model["sets"], judged_on(base))
    if isinstance(experiment.nodes["controller"].params, ModalParams):
        return from_model(experiment)
    from pea_lab import tune

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
            f"no gains of {len(tried)} trials keep a margin of {MARGIN:g} on every plant and come "
            f"to rest; the best has {tune.margin_text(best.margin)}: give more --trials, the rig "
            "another law, or a lower rate"
        )
    there.mkdir()
    tune.write(there, experiment, goal, tried, 0)
    return {
        "gains": best.values,
        "error_nm": best.error_nm,
        "worst_nm": best.worst_nm,
        "margin": finite(best.margin),
        "by": "pea tune",
        "presets": str(there),
    }


def from_model(experiment: Experiment) -> dict[str, Any]:
    """Gains of a modal law from its model.

    Raises
    ------
    ParameterError
        No gains keep the goal.
    """
    from pea_lab import proposal

    params = experiment.nodes["controller"].params
    try:
        found = proposal.propose(params, proposal.Goal(), experiment.T_s)
    except proposal.NoProposal as error:
        raise ParameterError(
            f"{error}: no gains are proposed; give the rig another law, or a higher rate"
        ) from None
    return {
        "gains": {f"controller.{name}": value for name, value in found.values.items()},
        "modulus_margin": found.figures.modulus,
        "modulus_margin_of_set": found.figures.modulus_set,
        "bandwidth_hz": found.figures.bandwidth,
        "limited_by": found.limit,
        "by": "pea tune --from-model",
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
    for name, sets in {**model["plants"], **model["slopes"]}.items():
        loop = on(base, model["sets"], gain_sets(gains), sets, AT_REST)
        found = margins(loop, 10.0)
        rows[name] = {"gain_margin": found.gain, "delay_margin_samples": found.delay}
        if found.gain < MARGIN:
            raise ParameterError(
                f"plant {name}: gain margin {found.gain:.3g} < {MARGIN:g}; propose other gains"
            )
    return rows
