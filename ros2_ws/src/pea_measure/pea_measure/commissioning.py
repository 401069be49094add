"""From measurements of a stage to a model, and a set of plants about it.

What the data determine replaces what the rig's file says; what they do not determine stays, and a
sentence says so.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from pea_controller.model import predictive
from pea_controller.model.modal import ModalParams
from pea_core.params import ParameterError
from pea_core.units import NM_PER_M
from pea_experiment.experiment import Experiment
from pea_identify import mode_fit, results
from pea_identify.frequency_response import FrequencyResponse
from pea_identify.identified_stage import IdentifiedStage
from pea_identify.modes import Modes
from pea_lab.fitted import inverse_of
from pea_measure import identifying, plans
from pea_measure.identifying import RESONANT, divided
from pea_measure.plans import Base, PlannedMeasurement

MEASURED = ("response", "hysteresis", "creep", "noise")
"""Measurements that are identified from, in their order."""

SLOW = 2.0
"""Least period of a triangle of the hysteresis measurement, and half the hold of the creep (s)."""

SOFTLY = 0.03
"""Time of the creep's step (s): long for a mode, and short for creep."""

LEAST_SPREAD = 0.03
"""Least spread of the resonance, as a share, for a law that knows no modes."""

KNOWN, DRIFT = 0.005, 0.01
"""Least spread of a mode's frequency that learning is told, and that gains are proposed for; what
drifts is not in an interval."""


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


class Slow(NamedTuple):
    """What slow motion determines of a stage, as settings and parameters.

    K, local (um/V): gain over the stroke, and for small signals.  noise (nm): of the sensor.
    inverse : settings of a law's inverse of the hysteresis.  plant : settings of the plant.
    """

    K: float
    local: float
    noise: float
    inverse: list[str]
    plant: list[str]
    parameters: dict[str, Any]


class Fast(NamedTuple):
    """What the response determines of a stage, as settings and parameters.

    omega_n (rad/s): of the main mode, or what the rig says.  shapes : the modes of the plant, None
    where it is one oscillator.  spread, known : of the frequencies, as shares: of the plants to
    propose gains for, and by their intervals.  nominal : values of observer and law.
    """

    omega_n: float
    shapes: Modes | None
    spread: float
    known: float
    nominal: dict[str, float]
    plant: list[str]
    law: list[str]
    parameters: dict[str, Any]
    sentences: list[str]


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
    stage, V = identifying.identified(made, samples)
    slow = slow_part(stage, float(np.ptp(samples["hysteresis"]["u_applied"])))
    if isinstance(V, str):
        omega_n = experiment.nodes["plant"].params.omega_n
        fast = Fast(omega_n, None, 0.1, 0.1, {}, [], [], {}, [V])
    else:
        fast = fast_part(V, slow, experiment, base.chooses_law)
    law = fast.law
    nodes = ("controller",) if law else ("observer", "controller")
    if isinstance(experiment.nodes["controller"].params, predictive.Params):
        law = [*law, "controller.hysteresis_max=0", *slow.inverse]
    plants, slopes = plants_about(slow, fast)
    nominal = {"K": slow.K, **fast.nominal}
    of_nodes = [each for node in nodes for each in settings(node, nominal)]
    return {
        "slopes": slopes,
        "sets": [*slow.plant, *fast.plant, *law, *of_nodes],
        "plants": plants,
        "spread": max(fast.known, DRIFT),
        "parameters": {**slow.parameters, **fast.parameters},
        "sentences": [*stage.sentences, *fast.sentences],
    }


def slow_part(stage: IdentifiedStage, span: float) -> Slow:
    """Gain, hysteresis, creep and noise; `span` is the range of the slow voltage (V)."""
    fit, creep = stage.hysteresis, stage.creep
    assert fit is not None
    K, H = results.of_hysteresis(fit, stage.gain)
    K, shape = 1e6 * K, str(H.pop("type"))
    noise = max(stage.noise.rms * NM_PER_M if stage.noise is not None else 0.0, 1e-3)
    local = stage.small * 1e6 if math.isfinite(stage.small) else K * fit.slope
    parameters: dict[str, Any] = {
        "K_um_per_V": {"value": K, "half_width_95": 1e6 * fit.intervals["K"]},
        "K_small_um_per_V": {"value": local},
        "hysteresis_left_percent": {"value": fit.percent},
        "noise_nm": {"value": noise},
    }
    plant = [
        f"plant.K={K:.9g}",
        f"plant.sensor.noise_nm={noise:.6g}",
        f"plant.hysteresis.type={shape}",
        *settings("plant.hysteresis", H),
    ]
    if creep is not None:
        parameters["creep_percent"] = {
            "value": 100.0 * creep.total,
            "half_width_95": 100.0 * creep.total_95,
        }
        values = {"type": "linear", "enabled": True, "tau": creep.tau, "weights": creep.weights}
        plant += settings("plant.creep", values)
    return Slow(K, local, noise, inverse(shape, H, span), plant, parameters)


def fast_part(V: Modes, slow: Slow, experiment: Experiment, law_given: bool) -> Fast:
    """Modes, delay and what a law makes of them; a resonant stage gets a modal law if it may."""
    plant = experiment.nodes["plant"].params
    modal_law_given = isinstance(experiment.nodes["controller"].params, ModalParams)
    main = int(np.argmax(V.shares))
    omega_n, zeta = float(V.omega_n[main]), float(V.zeta[main])
    nominal = {"omega_n": omega_n, "zeta": zeta}
    shapes = V if len(V.omega_n) > 1 or zeta < RESONANT else None
    command, rest = divided(V, plant, shapes is not None, experiment.T_s)
    of_plant = [*settings("plant", nominal), f"plant.delay_samples={command}"]
    if shapes is not None:
        of_plant += ["plant.vibration.type=modal", *modal("plant.vibration", V, slow.K)]
        of_plant += settings("plant.vibration", {"delay": rest})
    known = of_intervals(V)
    spread = max(LEAST_SPREAD, float(V.omega_n_95[main]) / omega_n)
    law: list[str] = []
    sentences: list[str] = []
    resonant = float(V.zeta.min()) < RESONANT
    if resonant and not modal_law_given and law_given:
        sentences.append(
            "the stage is resonant: state_feedback or pidsmc_modal suits it better than the law "
            "that was given"
        )
    elif resonant or modal_law_given:
        if not modal_law_given:
            law = ["controller.preset=resonant", "observer.preset=measured"]
            sentences.append(
                "the stage is resonant: the law is state_feedback on the identified modes"
            )
        law += modal_law(V, slow.K, rest, slow.inverse, slow.noise)
        spread = max(known, DRIFT)
    return Fast(omega_n, shapes, spread, known, nominal, of_plant, law, of_modes(V), sentences)


def plants_about(slow: Slow, fast: Fast) -> tuple[dict[str, list[str]], dict[str, list[str]]]:
    """Settings of each plant about the identified one, and of plants that only have margins."""

    def gain(K: float) -> list[str]:
        """Settings of the plant with another gain (um/V)."""
        if fast.shapes is not None:
            return modal("plant.vibration", fast.shapes, K)
        return settings("plant", {"K": K})

    def resonance(factor: float) -> list[str]:
        """Settings of the plant with its frequencies multiplied."""
        if fast.shapes is not None:
            return modal("plant.vibration", fast.shapes, slow.K, factor)
        return settings("plant", {"omega_n": factor * fast.omega_n})

    plants = {
        "identified": [],
        **{
            f"resonance {100.0 * share:+.2g} %": resonance(1.0 + share)
            for share in (-fast.spread, fast.spread)
        },
        "gain +10 %": gain(1.1 * slow.K),
    }
    # a margin is of the linear loop: this plant is checked, but could not follow over the stroke
    small = f"gain {100.0 * (slow.local / slow.K - 1.0):+.2g} %, as for small signals"
    return plants, {small: gain(slow.local)}


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
        V = mode_fit.fit(response)
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
