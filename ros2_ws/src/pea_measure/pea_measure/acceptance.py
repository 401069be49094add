r"""Acceptance figures of a stage from its measurements, as far as one sensor allows.

They follow ASME B5.64 (precision linear stages) and ISO 230-2 (repeatability), adapted: no
independent reference measures the position, so the sensor of the stage is the reference. Every
figure tells how well the stage repeats by its own sensor, not how accurate that sensor is.

Positions are approached R times from each side. x_ij is the displacement reached at position i,
and e_ij = x_ij - w_i. With the standard deviation s_i at a position from one side,

.. math:: R_{uni} = \max_i 4 s_i, \quad
          R_{bi} = \max_i \bigl(2 s_i^\uparrow + 2 s_i^\downarrow + |B_i|,
          4 s_i^\uparrow, 4 s_i^\downarrow\bigr), \quad
          B_i = \bar e_i^\uparrow - \bar e_i^\downarrow

(ISO 230-2:2014, 3.15 to 3.18). The smallest incremental motion is the step of the finest staircase
whose steps are all in the right direction and larger than twice their standard deviation, as are
those of all coarser staircases.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from pea_core.units import NM_PER_M
from pea_measure import plans
from pea_measure.analysis import finite, times
from pea_measure.plans import Base, PlannedMeasurement, Way, middle

SENSOR = (
    "The reference is the displacement sensor of the stage itself; one sensor cannot check itself. "
    "Its calibration, its Abbe offset and its drift are in none of these figures."
)

RULES = {
    "stroke_um": "stroke over which hysteresis was measured",
    "linearity_percent": "open loop: largest distance from the best line over the stroke",
    "hysteresis_percent": "open loop: largest width of a loop over the stroke",
    "linearity_closed_nm": "closed loop: largest distance of mean positions from their best line",
    "repeatability_uni_nm": "closed loop: 4 s, one side, largest (ISO 230-2)",
    "repeatability_bi_nm": "closed loop: both sides with the reversal value, largest (ISO 230-2)",
    "reversal_nm": "closed loop: largest difference of mean positions between the sides",
    "smallest_increment_nm": "closed loop: smallest step that all steps of a staircase resolve",
    "bandwidth_hz": "of T, the running loop, by a test signal",
    "settling_ms": "mean, to within 2 % of a step",
    "noise_nm": "rms, closed loop, standing still",
    "noise_open_nm": "rms, constant voltage: sensor and amplifier",
    "drift_nm_per_s": "slope of the mean at constant voltage",
    "creep_percent_per_decade": "open loop, after a step",
}
"""Definition of each figure."""

SHARES = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Positions of the repeatability test, as shares of the stroke."""

INCREMENTS_NM = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
"""Steps of the staircases (nm)."""

RISERS = 4
"""Number of steps up of a staircase; it has as many down."""


def repeatability(base: Base, repeats: int, hold: float) -> PlannedMeasurement:
    """Positions approached from both sides, several times."""
    allowed, _ = middle(base, None)
    positions = [allowed.low + share * allowed.stroke for share in SHARES]
    beyond = 0.03 * allowed.stroke
    way, made = Way(allowed), []
    for _ in range(repeats):
        for side, order in ((1, positions), (-1, positions[::-1])):
            way.to(order[0] - side * beyond, 0.0)
            made += [(way.to(p, hold), positions.index(p), side) for p in order]
    way.to(0.0, 0.05)
    return plans.looked_ahead(
        "repeatability", base, way.sets(), open=False, approaches=made, positions_um=positions
    )


def staircases(base: Base, hold: float) -> PlannedMeasurement:
    """Staircases of several step sizes, up and down."""
    allowed, level = middle(base, None)
    way, made = Way(allowed), []
    way.to(level, plans.SETTLE)
    for increment in INCREMENTS_NM:
        size = increment * 1e-3
        stairs = [*range(1, RISERS + 1), *range(RISERS - 1, -1, -1)]
        first = way.to(level, hold, 0.0)
        made.append((increment, [first, *(way.to(level + n * size, hold, 0.0) for n in stairs)]))
    way.to(0.0, 0.05)
    return plans.looked_ahead("increments", base, way.sets(), open=False, stairs=made)


def levels_of(
    measurement: PlannedMeasurement, samples: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of y (m) over the second half of each hold."""
    first, there, end = times(measurement.experiment)
    stops = np.append(first[1:], end)
    means, deviations = np.full(len(first), np.nan), np.full(len(first), np.nan)
    for i, (a, b) in enumerate(zip(there.tolist(), stops.tolist(), strict=True)):
        part = samples["y"][(a + b) // 2 : b]
        if len(part) > 1:
            means[i], deviations[i] = part.mean(), part.std(ddof=1)
    return means, deviations


def of_repeatability(measurement: PlannedMeasurement, samples: np.ndarray) -> dict[str, Any]:
    """Repeatability from both sides, reversal, linearity of mean positions."""
    means, _ = levels_of(measurement, samples)
    positions = np.array(measurement.settings["positions_um"]) * 1e-6
    errors: dict[tuple[int, int], list[float]] = {}
    for index, i, side in measurement.settings["approaches"]:
        errors.setdefault((i, side), []).append(float(means[index] - positions[i]))
    return iso_230_2(positions, errors)


def iso_230_2(positions: np.ndarray, errors: dict[tuple[int, int], list[float]]) -> dict[str, Any]:
    """Figures of ISO 230-2 from the errors (m) at each position and side (1 up, -1 down)."""
    uni, bi, reversal, rows, mean = 0.0, 0.0, 0.0, [], []
    for i, position in enumerate(positions.tolist()):
        up, down = (np.array(errors[i, side]) for side in (1, -1))
        s_up, s_down = (float(e.std(ddof=1)) if len(e) > 1 else math.nan for e in (up, down))
        B = float(up.mean() - down.mean())
        uni = max(uni, 4.0 * s_up, 4.0 * s_down)
        bi = max(bi, 2.0 * s_up + 2.0 * s_down + abs(B), 4.0 * s_up, 4.0 * s_down)
        reversal = max(reversal, abs(B))
        mean.append(0.5 * float(up.mean() + down.mean()))
        rows.append(
            {
                "position_um": position * 1e6,
                "error_up_nm": float(up.mean()) * NM_PER_M,
                "error_down_nm": float(down.mean()) * NM_PER_M,
                "s_up_nm": s_up * NM_PER_M,
                "s_down_nm": s_down * NM_PER_M,
            }
        )
    reached = positions + np.array(mean)
    left = reached - np.polyval(np.polyfit(positions, reached, 1), positions)
    return {
        "repeatability_uni_nm": uni * NM_PER_M,
        "repeatability_bi_nm": bi * NM_PER_M,
        "reversal_nm": reversal * NM_PER_M,
        "linearity_closed_nm": float(np.abs(left).max()) * NM_PER_M,
        "positions": rows,
    }


def of_staircases(measurement: PlannedMeasurement, samples: np.ndarray) -> dict[str, Any]:
    """The smallest increment that is resolved, as all larger ones are, by every step."""
    means, deviations = levels_of(measurement, samples)
    rows = []
    for increment, indices in measurement.settings["stairs"]:
        steps = np.diff(means[indices]) * NM_PER_M
        asked = increment * np.array([1.0] * RISERS + [-1.0] * RISERS)
        noise = float(np.mean(deviations[indices])) * NM_PER_M
        of_mean = 2.0 * float(np.std(steps * np.sign(asked), ddof=1))
        clear = bool((steps * np.sign(asked) > of_mean).all())
        rows.append(
            {
                "increment_nm": increment,
                "mean_step_nm": float(np.mean(steps * np.sign(asked))),
                "twice_deviation_nm": of_mean,
                "noise_nm": noise,
                "resolved": clear,
            }
        )
    smallest = math.nan
    for row in reversed(rows):
        if not row["resolved"]:
            break
        smallest = row["increment_nm"]
    return {"smallest_increment_nm": smallest, "increments": rows}


def summary(found: dict[str, dict[str, object]]) -> dict[str, Any]:
    """The figures of a report from those of its measurements, by name; None if not measured."""

    def of(name: str, *keys: object) -> Any:
        value: Any = found.get(name, {})
        for key in keys:
            try:
                value = value[key]
            except (KeyError, IndexError, TypeError):
                return None
        return value

    gamma = of("creep", "gamma_per_decade")
    figures = {
        "stroke_um": of("hysteresis", "stroke_um"),
        "linearity_percent": of("hysteresis", "linearity_percent"),
        "hysteresis_percent": of("hysteresis", "hysteresis_percent"),
        "linearity_closed_nm": of("repeatability", "linearity_closed_nm"),
        "repeatability_uni_nm": of("repeatability", "repeatability_uni_nm"),
        "repeatability_bi_nm": of("repeatability", "repeatability_bi_nm"),
        "reversal_nm": of("repeatability", "reversal_nm"),
        "smallest_increment_nm": of("increments", "smallest_increment_nm"),
        "bandwidth_hz": of("loop", "margins", "bandwidth_hz", "measured"),
        "settling_ms": of("steps", "steps", 0, "settling_ms", "mean"),
        "noise_nm": of("noise", "rms_nm"),
        "noise_open_nm": of("noise_open", "rms_nm"),
        "drift_nm_per_s": of("noise_open", "drift_nm_per_s"),
        "creep_percent_per_decade": None if gamma is None else 100.0 * gamma,
    }
    return dict(finite(figures))


def measurements(
    base: Base, quick: bool, only: Sequence[str] = ()
) -> dict[str, PlannedMeasurement]:
    """The measurements of an acceptance, by name, each checked against the stage's limits.

    Raises
    ------
    ParameterError
        A measurement would exceed the limits of the stage.
    """
    T_s = base.load(["reference.type=constant"]).T_s
    hold = max(0.05 if quick else 0.2, 40.0 * T_s)
    stroke = middle(base, None)[0].stroke
    slow = 1.0 if quick else 4.0
    made: dict[str, Callable[[], PlannedMeasurement]] = {
        "noise_open": lambda: plans.noise(base, None, 300.0 * T_s + slow, True),
        "noise": lambda: plans.noise(base, None, 300.0 * T_s + slow, False),
        "hysteresis": lambda: plans.hysteresis(base, None, None, 2.0 * slow, 1 if quick else 3),
        "creep": lambda: plans.creep(base, None, None, 2.0 * slow),
        "steps": lambda: plans.steps(
            base, None, [0.01 * stroke], 2 if quick else 10, 5.0 * hold, False
        ),
        "loop": lambda: plans.injected(base, "loop", None, {}),
        "repeatability": lambda: repeatability(base, 2 if quick else 5, hold),
        "increments": lambda: staircases(base, hold),
    }
    return {n: make() for n, make in made.items() if not only or n in only}
