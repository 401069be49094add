"""The stage of a commissioning: its measurements as records, and what of it they determine."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from pea_core.injection import plan
from pea_core.params import ParameterError
from pea_identify import stage
from pea_identify.identified_stage import IdentifiedStage
from pea_identify.modes import Modes
from pea_identify.records import Record, record
from pea_measure.analysis import lag_of, standing, times
from pea_measure.plans import PlannedMeasurement

KINDS = {"response": "periodic", "hysteresis": "slow", "creep": "step", "noise": "rest"}
"""What each measurement is to identification."""

UNSURE = 0.2
"""Share of a parameter by which its 95 % interval may be wide and still determine it."""

RESONANT = 0.1
"""Damping ratio below which a stage needs a law on its modes."""

LEAST_SHARE = 0.02
"""Share of the gain that a mode of the model has at least."""

UNEXPLAINED = 0.3
"""Relative error on data not fitted above which modes are not those of the stage."""

WHOLE = 0.002
"""Share of a sample by which a delay may differ from a whole one and count as that: at 100 Hz and
20 kHz what it makes of a sine of 5 um is below the noise of a sensor."""

LATE_MAX = 20
"""Samples of delay of the command that a plant may have."""


def record_of(measurement: PlannedMeasurement, samples: np.ndarray) -> Record:
    """A measurement as identification takes it: voltage that acted, displacement, what it is."""
    experiment, settings = measurement.experiment, measurement.settings
    T_s, name = experiment.T_s, measurement.kind
    kind = KINDS[name]
    # u_applied belongs to the interval that ended at the stamp
    u, y = samples["u_applied"][1:].copy(), samples["y"][:-1].copy()
    if kind == "step":
        first, _, end = times(experiment)
        index = settings["step"]
        stop = int(first[index + 1]) if index + 1 < len(first) else end
        u, y = u[: stop - 1], y[: stop - 1]
    elif kind == "rest":
        still = standing(measurement, samples)
        u, y = u[still], y[still]
    if kind != "periodic":
        return record(u, y, T_s, name, kind)
    made = plan(experiment.nodes["controller"].params.inject, T_s)
    length, begin = (1 + made.periods) * made.N, settings["start"] + made.wait
    end = begin + made.blocks * length
    # checked without the way to the operating point
    record(u[begin:end], y[begin:end], T_s, name, "general")
    return replace(
        record(u, y, T_s, name, "general"),
        kind=kind,
        period=made.N,
        blocks=tuple((begin + i * length + made.N, made.periods) for i in range(made.blocks)),
        lines=tuple(made.lines[0].tolist()),
    )


def identified(
    made: Mapping[str, PlannedMeasurement], samples: Mapping[str, np.ndarray]
) -> tuple[IdentifiedStage, Modes | str]:
    """The stage, and its modes from command to displacement, or why they are not determined.

    Raises
    ------
    ParameterError
        The slow motion determines no gain.
    """
    records = {name: record_of(made[name], samples[name]) for name in KINDS}
    told = ""
    for left_out in ((), ("creep",), ("response",), ("creep", "response")):
        kept = [each for name, each in records.items() if name not in left_out]
        try:
            of = stage.identify(kept)
            break
        except (ParameterError, np.linalg.LinAlgError, ValueError) as error:
            told = str(error)
            if len(left_out) == 2:
                raise
    if "creep" in left_out:
        of = replace(of, sentences=(*of.sentences, f"creep is not determined ({told})"))
    if "response" in left_out:
        return of, f"the resonance is not determined ({told}); the rig's values are kept"
    V = determined(of)
    if isinstance(V, str):
        return of, V
    # what lies between a command and the voltage that acted for it is no part of the record
    late = (lag_of(samples["response"]) - 1) * of.T_s
    return of, replace(V, delay=V.delay + V.lag + late, lag=0.0)


def determined(of: IdentifiedStage) -> Modes | str:
    """The modes that a stage's records determine, or a sentence why there is none."""
    found, response = of.modes, of.response
    assert found is not None
    assert response is not None
    highest = float(response.f[-1])
    if found.error > UNEXPLAINED:
        return (
            f"the resonance is not determined: modes leave {100.0 * found.error:.3g} % of the "
            "response unexplained; what the rig says of it stays"
        )
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


def divided(found: Modes, plant: Any, modal_model: bool, T_s: float) -> tuple[int, float]:
    """Samples of the command, and delay of V (s), for the delay from command to y that was found.

    What the rig says of sensor and command stays. A model of modes takes the rest, in V; another
    one counts whole samples of the command.
    """
    samples, sensor = max(found.delay / T_s, 0.0), plant.sensor.delay_samples
    if abs(samples - round(samples)) <= WHOLE:
        samples = float(round(samples))
    rest = samples - sensor - plant.delay_samples
    if modal_model and rest >= 0.0:
        return plant.delay_samples, rest * T_s
    return min(max(round(samples) - sensor, 0), LATE_MAX), 0.0
