"""Identification of a stage: from measured voltages and displacements to a model with intervals.

No ROS and no plotting. Every array is SI: volts, metres, seconds, hertz. An error of the data is a
`pea_core.params.ParameterError` of one line.

Frequency responses
    `frequency_response.from_periods(u, y, T_s)` from whole periods, u (N, n_u, R, P): samples a
    period, inputs, realisations, periods. `frequency_response.from_record(u, y, T_s)` from any
    record. Both return a `FrequencyResponse` with the variance of noise, the variance of noise and
    nonlinearity, and coherence at each line.
Modes
    `modes.fit(response, held_out)` returns `Modes`: omega_n, zeta, K, fractional delay, creep
    rate, and the half width of the 95 % interval of each.
Rational models
    `rational.fit` fits a stable model of common poles to n x n responses (vector fitting).
Hysteresis
    `hysteresis.prandtl_ishlinskii(data, count, bends)` and others fit H.
Oscillators
    `oscillator.fit(u, y, T_s)` fits a mass on a spring and a Bouc-Wen element, driven by a force.
Excitation
    `excitation.multisine`, `orthogonal`, `chirp`, `triangles`, `soft`, `move`, `check`: voltages
    that show what a stage is, refused where they would leave range or slew limit.

May import: pea_experiment and below; no rclpy, no plotting but in pages.
"""

from pea_identify.frequency_response import FrequencyResponse, from_periods, from_record
from pea_identify.modes import Modes

__all__ = ["FrequencyResponse", "Modes", "from_periods", "from_record"]
