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

from pea_controller.model import predictive
from pea_controller.model.modal import ModalParams
from pea_core.nominal import NominalModel
from pea_core.params import ParameterError
from pea_core.units import NM_PER_M
from pea_experiment.experiments import Experiment
from pea_identify import modes, results
from pea_identify.frequency_response import FrequencyResponse
from pea_identify.modes import Modes
from pea_lab import fitted, proposal
from pea_lab.fitted import inverse_of
from pea_lab.guard import margins
from pea_measure import identifying, plans
from pea_measure.analysis import finite
from pea_measure.identifying import RESONANT, divided
from pea_measure.plans import Base, PlannedMeasurement

MEASURED = ("response", "hysteresis", "creep", "noise")
"""Measurements that are identified from, in their order."""

SLOW = 2.0
"""Least period of a triangle of the hysteresis measurement, and half the hold of the creep (s)."""

SOFTLY = 0.03
"""Time of the creep's step (s): long for a mode, and short for creep."""

MARGIN = 1.3
"""Least gain margin on every plant of the set."""


LEAST_SPREAD = 0.03
"""Least spread of the resonance, as a share, for a law that knows no modes."""

KNOWN, DRIFT = 0.005, 0.01
"""Least spread of a mode's frequency that learning is told, and that gains are proposed for; what
drifts is not in an interval."""

KNOWN_GAIN = 0.05
"""Spread of the gain likewise."""

JUDGED, PERIODS = 0.005, 6.0
"""Frequency of the sine that gains are judged on, times T_s; periods of it."""

AT_REST = ["reference.type=constant", "reference.offset_um=0"]
"""Reference of a loop of which only margins are taken."""


def measurements(
    base: Base, at: float | None, amplitude: float | None
) -> dict[str, PlannedMeasurement]:
    """What is measured, by name.

    Raises
    ------
    ParameterError
        One of them would leave what the stage allows.
    """
    T_s = base.load(["reference.type=constant"]).T_s
    signal = {} if amplitude is None else {"amplitude_V": amplitude}
    slow = max(SLOW, 400.0 * T_s)
    try:
        loops = plans.hysteresis(base, None, None, slow, 1, "minimum_jerk")
    except ParameterError:  # steeper than a triangle of the same period
        loops = plans.hysteresis(base, None, None, slow, 1)
    made = (
        plans.injected(base, "response", at, signal),
        loops,
        plans.creep(base, at, None, 2.0 * slow, SOFTLY),
        plans.noise(base, at, max(1.0, 300.0 * T_s), True),
    )
    return dict(zip(MEASURED, made, strict=True))


NO_INVERSE = {
    "thresholds": (0.0,),
    "weights": (1.0,),
    "knots": (0.0,),
    "slopes": (1.0, 1.0),
    "alpha": 0.0,
}
"""Inverse of a stage without hysteresis; a preset may have another."""


def inverse(type: str, values: Mapping[str, Any], span: float) -> list[str]:
    """Settings of a law's inverse of the hysteresis that a plant has."""
    bent = type == "modified_prandtl_ishlinskii"  # of the law's own form
    found = {**NO_INVERSE, **(values if bent else inverse_of(type, values, span))}
    return settings("controller.inverse", found)


def identified(
    base: Base, made: Mapping[str, PlannedMeasurement], samples: Mapping[str, np.ndarray]
) -> dict[str, Any]:
    """A model of the stage from its measurements.

    Parameters
    ----------
    base : Base
    made, samples : mapping
        What was measured, by name, and the recorded samples.

    Returns
    -------
    dict
        sets : settings of plant, observer and law.  plants : settings of each plant about it.
        slopes : settings of plants that only margins are taken of.  spread : of the frequencies,
        as a share, by their intervals.
        parameters : value and 95 % half width of each.  sentences : what was not determined.
    """
    experiment = base.load(["reference.type=constant"])
    T_s, plant = experiment.T_s, experiment.nodes["plant"].params
    params = experiment.nodes["controller"].params
    of, V = identifying.identified(made, samples)
    fit = of.hysteresis
    assert fit is not None
    K, H = results.of_hysteresis(fit, of.gain)
    K, shape = 1e6 * K, str(H.pop("type"))
    noise = max(of.noise.rms * NM_PER_M if of.noise is not None else 0.0, 1e-3)
    local = of.small * 1e6 if math.isfinite(of.small) else K * fit.slope
    parameters: dict[str, Any] = {
        "K_um_per_V": {"value": K, "half_width_95": 1e6 * fit.intervals["K"]},
        "K_small_um_per_V": {"value": local},
        "hysteresis_left_percent": {"value": fit.percent},
        "noise_nm": {"value": noise},
    }
    of_plant = [
        f"plant.K={K:.9g}",
        f"plant.sensor.noise_nm={noise:.6g}",
        f"plant.hysteresis.type={shape}",
        *settings("plant.hysteresis", H),
    ]
    if of.creep is not None:
        parameters["creep_percent"] = {
            "value": 100.0 * of.creep.total,
            "half_width_95": 100.0 * of.creep.total_95,
        }
        creep = {
            "type": "linear",
            "enabled": True,
            "tau": of.creep.tau,
            "weights": of.creep.weights,
        }
        of_plant += settings("plant.creep", creep)
    nominal: dict[str, float] = {"K": K}
    of_law: list[str] = []
    sentences = list(of.sentences)
    inverted = inverse(shape, H, float(np.ptp(samples["hysteresis"]["u_applied"])))
    if isinstance(V, str):
        sentences.append(V)
        omega_n, spread, shapes, known = plant.omega_n, 0.1, None, 0.1
    else:
        main = int(np.argmax(V.shares))
        omega_n, zeta = float(V.omega_n[main]), float(V.zeta[main])
        spread = max(LEAST_SPREAD, float(V.omega_n_95[main]) / omega_n)
        nominal |= {"omega_n": omega_n, "zeta": zeta}
        parameters |= of_modes(V)
        known = of_intervals(V)
        of_plant += settings("plant", {"omega_n": omega_n, "zeta": zeta})
        shapes = V if len(V.omega_n) > 1 or zeta < RESONANT else None
        command, rest = divided(V, plant, shapes is not None, T_s)
        of_plant.append(f"plant.delay_samples={command}")
        if shapes is not None:
            of_plant += ["plant.vibration.type=modal", *modal("plant.vibration", V, K)]
            of_plant += settings("plant.vibration", {"delay": rest})
        resonant = float(V.zeta.min()) < RESONANT
        if resonant and not isinstance(params, ModalParams) and base.chooses_law:
            sentences.append(
                "the stage is resonant: state_feedback or pidsmc_modal suits it better than the "
                "law that was given"
            )
        elif resonant or isinstance(params, ModalParams):
            if not isinstance(params, ModalParams):
                of_law += ["controller.preset=resonant", "observer.preset=measured"]
                sentences.append(
                    "the stage is resonant: the law is state_feedback on the identified modes"
                )
            of_law += modal_law(V, K, rest, inverted, noise)
            spread = max(known, DRIFT)
    nodes = ("controller",) if of_law else ("observer", "controller")
    if isinstance(params, predictive.Params):
        of_law += ["controller.hysteresis_max=0", *inverted]

    def plant_with(gain: float = K, frequency: float = 1.0) -> list[str]:
        """Settings of a plant with another gain (um/V), or its frequencies multiplied."""
        if shapes is not None:
            return modal("plant.vibration", shapes, gain, frequency)
        if frequency != 1.0:
            return settings("plant", {"omega_n": frequency * omega_n})
        return settings("plant", {"K": gain})

    plants: dict[str, list[str]] = {"identified": []}
    for share in (-spread, spread):
        plants[f"resonance {100.0 * share:+.2g} %"] = plant_with(frequency=1.0 + share)
    plants["gain +10 %"] = plant_with(1.1 * K)
    # a margin is of the linear loop: this plant is checked, but could not follow over the stroke
    small = f"gain {100.0 * (local / K - 1.0):+.2g} %, as for small signals"
    return {
        "slopes": {small: plant_with(local)},
        "sets": [
            *of_plant,
            *of_law,
            *(each for node in nodes for each in settings(node, nominal)),
        ],
        "plants": plants,
        "spread": max(known, DRIFT),
        "parameters": parameters,
        "sentences": sentences,
    }


def of_modes(V: Modes) -> dict[str, Any]:
    """Parameters of the modes and of the delay, with their half widths."""
    found: dict[str, Any] = {}
    for i in range(len(V.omega_n)):
        for name, value, half in (
            (f"omega_n_{i + 1}_rad_s", V.omega_n[i], V.omega_n_95[i]),
            (f"zeta_{i + 1}", V.zeta[i], V.zeta_95[i]),
        ):
            found[name] = {"value": float(value), "half_width_95": float(half)}
    found["delay_us"] = {"value": V.delay * 1e6, "half_width_95": V.delay_95 * 1e6}
    return found


def of_intervals(V: Modes) -> float:
    """Spread of the frequencies, as a share: twice the largest of their intervals."""
    return 2.0 * float((V.omega_n_95 / V.omega_n).max())


def modal_law(V: Modes, K: float, delay: float, inverted: list[str], noise: float) -> list[str]:
    """Settings of a modal law: its model, its inverse, what its estimator and learning know."""
    known = max(of_intervals(V), KNOWN)
    return [
        *modal("controller.model", V, K),
        *settings("controller.model", {"delay": delay}),
        *inverted,
        f"controller.estimator.noise_nm={noise:.6g}",
        f"controller.learning.spread_frequency={min(known, 0.5):.6g}",
    ]


def settings(node: str, values: Mapping[str, Any]) -> list[str]:
    """Values of a node, or of a group of its parameters, as ``--set`` takes them."""

    def told(value: object) -> str:
        if isinstance(value, float):
            return f"{value:.9g}"
        if isinstance(value, tuple | list | np.ndarray):
            return "[" + ", ".join(f"{float(each):.9g}" for each in value) + "]"
        return str(value)

    return [f"{node}.{name}={told(value)}" for name, value in values.items()]


def modal(group: str, V: Modes, K: float, frequency: float = 1.0) -> list[str]:
    """Settings of modes whose gains have the sum K (um/V), every frequency multiplied."""
    shares = V.K[:, 0, 0] / V.K[:, 0, 0].sum()
    values = {"omega_n": frequency * V.omega_n, "zeta": V.zeta, "K": K * shares}
    return settings(group, {name: tuple(each.tolist()) for name, each in values.items()})


def of_response(response: FrequencyResponse, experiment: Experiment) -> list[str]:
    """Settings of a modal law from the frequency response from command to displacement alone.

    Raises
    ------
    ParameterError
        The response does not determine a mode.
    """
    plant = experiment.nodes["plant"].params
    try:
        V = modes.fit(response)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ParameterError(f"the response determines no mode ({error})") from None
    strong = V.shares >= identifying.LEAST_SHARE
    kept = {name: getattr(V, name)[strong] for name in ("omega_n", "zeta", "K")}
    V = replace(V, **kept)
    K = 1e6 * float(V.K[:, 0, 0].sum())
    main = int(np.argmax(np.abs(V.K[:, 0, 0])))
    late = (plant.delay_samples + plant.sensor.delay_samples) * experiment.T_s
    delay = V.delay + V.lag - late
    if delay < identifying.WHOLE * experiment.T_s:
        delay = 0.0
    nominal = {"K": K, "omega_n": float(V.omega_n[main]), "zeta": float(V.zeta[main])}
    return [
        *modal("controller.model", V, K),
        *settings("controller.model", {"delay": delay}),
        *settings("controller", nominal),
        *inverse("none", {}, 0.0),
    ]


def on(base: Base, *more: list[str]) -> Experiment:
    """The experiment on a simulated plant, with other settings over those of the user."""
    sets = [
        *(each for each in base.sets if not (base.rig and _of_driver(each))),
        *(["plant.driver.type=simulated"] if base.rig else []),
        *(each for part in more for each in part),
    ]
    return Base(base.name, (), base.rig).load(sets)


def _of_driver(text: str) -> bool:
    """Whether a setting is of the driver, which a simulated plant does not have."""
    parts = text.partition("=")[0].strip().split(".")
    return parts[0] == "plant" and "driver" in parts[1:3]  # the name of an axis may be before it


def judged_on(base: Base, model: dict[str, Any]) -> list[str]:
    """Settings of the reference that gains are judged on: a sine within reach of what was found."""
    experiment = on(base, model["sets"], AT_REST)
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
    experiment = on(base, model["sets"], judged_on(base, model))
    params = experiment.nodes["controller"].params
    if isinstance(params, ModalParams):
        return within_intervals(base, model, experiment)
    if isinstance(params, predictive.Params):
        values = fitted.precise(NominalModel(params.zeta, params.omega_n, params.K)).controller
        gains = {f"controller.{name}": float(values[name]) for name in ("m", "P", "omega_o")}
        try:
            rows = checked(base, model, gains)
        except ParameterError:
            pass  # on this set of plants they are too fast
        else:
            least = min(row["gain_margin"] for row in rows.values())
            return {"gains": gains, "margin": finite(least), "by": "pea_lab.fitted.precise"}
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


def within_intervals(base: Base, model: dict[str, Any], experiment: Experiment) -> dict[str, Any]:
    """Gains of a modal law for the spread of identification's intervals.

    Where these keep no margin on every plant of the set, which is wider: for twice that, and then
    for the spread that a proposal has by itself.

    Raises
    ------
    ParameterError
        No gains keep the goal.
    """
    for share in (1.0, 2.0):
        known = proposal.Goal(frequency=share * model["spread"], gain=KNOWN_GAIN)
        try:
            found = from_model(experiment, known)
            checked(base, model, found["gains"])
        except ParameterError:
            continue
        return found
    return from_model(experiment, proposal.Goal())


def from_model(experiment: Experiment, goal: proposal.Goal) -> dict[str, Any]:
    """Gains of a modal law from its model.

    Raises
    ------
    ParameterError
        No gains keep the goal.
    """
    params = experiment.nodes["controller"].params
    try:
        found = proposal.propose(params, goal, experiment.T_s)
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
        "spread_percent": 100.0 * goal.frequency,
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
