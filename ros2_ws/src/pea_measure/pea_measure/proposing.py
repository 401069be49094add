"""Gains for an identified set of plants, and their check on each of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pea_controller.model import predictive
from pea_controller.model.modal import ModalParams
from pea_core.nominal import NominalModel
from pea_core.params import ParameterError
from pea_experiment.experiment import Experiment
from pea_lab import fitted, proposal
from pea_lab.guard import margins
from pea_measure import plans
from pea_measure.analysis import finite
from pea_measure.commissioning import settings
from pea_measure.plans import Base

MARGIN = 1.3
"""Least gain margin on every plant of the set."""

KNOWN_GAIN = 0.05
"""Least spread of the gain that gains are proposed for, as a share."""

JUDGED, PERIODS = 0.005, 6.0
"""Frequency of the sine that gains are judged on, times T_s; periods of it."""

AT_REST = ["reference.type=constant", "reference.offset_um=0"]
"""Reference of a loop of which only margins are taken."""


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
    from pea_lab import tune, tune_results

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
    tune_results.write(there, experiment, goal, tried, 0)
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
        known = proposal.ProposalGoal(frequency=share * model["spread"], gain=KNOWN_GAIN)
        try:
            found = from_model(experiment, known)
            checked(base, model, found["gains"])
        except ParameterError:
            continue
        return found
    return from_model(experiment, proposal.ProposalGoal())


def from_model(experiment: Experiment, goal: proposal.ProposalGoal) -> dict[str, Any]:
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
