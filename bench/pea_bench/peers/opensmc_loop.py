"""The nearest job of opensmc: its simulator, an actuator of second order, a PID sliding surface.

No observer, no hysteresis, no recording; the fixed-step RK4 that it takes by default. Runs in a
virtual environment of its own: ``python opensmc_loop.py STEPS`` prints the us of a step.
"""

from __future__ import annotations

import math
import sys
import time

import numpy as np
from opensmc.controllers.classical import ClassicalSMC
from opensmc.core import Plant
from opensmc.reaching.saturation import Saturation
from opensmc.simulator import Simulator
from opensmc.surfaces.pid import PIDSurface

T_S = 50e-6
OMEGA_N, ZETA, GAIN = 5450.0, 0.82, 0.142
AMPLITUDE, FREQUENCY = 5.0, 10.0


class Actuator(Plant):
    """Second order, in um and V; the reaching law works in its acceleration."""

    def __init__(self) -> None:
        super().__init__(n_states=2, n_inputs=1, n_outputs=1, name="actuator")

    def dynamics(
        self, t: float, x: np.ndarray, u: np.ndarray, d: np.ndarray | None = None
    ) -> np.ndarray:
        """Velocity and acceleration (um/s, um/s^2)."""
        x1, x2 = x
        pull = GAIN * float(u[0]) - x1
        return np.array([x2, OMEGA_N * OMEGA_N * pull - 2.0 * ZETA * OMEGA_N * x2])


def reference(t: float) -> np.ndarray:
    """Displacement (um) and velocity (um/s) wanted."""
    angle = 2.0 * math.pi * FREQUENCY * t
    w_dot = AMPLITUDE * 2.0 * math.pi * FREQUENCY * math.cos(angle)
    return np.array([AMPLITUDE * math.sin(angle) + AMPLITUDE, w_dot])


def main() -> None:
    """Time one run."""
    steps = int(sys.argv[1])
    surface = PIDSurface(alpha=1.0, beta=3000.0, gamma=4e6, dt=T_S)
    law = ClassicalSMC(surface=surface, reaching=Saturation(k=100.0, phi=2e4))
    simulator = Simulator(dt=T_S, T=steps * T_S)
    started = time.perf_counter()
    result = simulator.run(law, Actuator(), reference)
    took = time.perf_counter() - started
    if not np.isfinite(result["x"]).all():
        sys.exit("the loop of opensmc did not stay finite")
    print(took * 1e6 / (len(result["t"]) - 1))


if __name__ == "__main__":
    main()
