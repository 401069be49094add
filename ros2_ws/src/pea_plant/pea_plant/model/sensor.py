r"""The displacement sensor: bandwidth, delay, white noise, quantisation, in this order.

.. math:: \tau \dot y_s = y - y_s, \quad \tau = \frac{1}{2 \pi f_b}, \quad
          y_k = Q(y_s(t_{k-d}) + n_k)

Accuracy: exact. The lag is stepped together with the actuator, so it sees y between the
samples too; delays are whole samples. At start the sensor has settled on the initial
displacement.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from pea_core.params import param
from pea_core.units import NM
from pea_plant.model.amplifier import bandwidth
from pea_plant.model.quantiser import quantise


@dataclass(frozen=True)
class Params:
    """Displacement sensor."""

    noise_nm: float = param(0.0, "nm", 0.0, 1e6, help="white noise, rms")
    quantisation_nm: float = param(0.0, "nm", 0.0, 1e6, help="resolution; 0: none")
    bandwidth_hz: float = param(
        0.0, "Hz", 0.0, 1e6, help="first-order bandwidth; 0: none", fixed=True
    )
    delay_samples: int = param(0, "", 0, 1000, help="delay of the reading", fixed=True)
    ideal: bool = param(
        False, help="also publish the true velocity, for the passthrough observer", fixed=True
    )

    def __post_init__(self) -> None:
        bandwidth(self.bandwidth_hz)


class Coefficients(NamedTuple):
    """Noise rms (m), resolution (m, 0: none), delay (samples), whether the velocity is told."""

    noise: float
    step: float
    delay: int
    ideal: bool


def design(params: Params) -> Coefficients:
    """Convert to SI."""
    return Coefficients(
        params.noise_nm * NM,
        params.quantisation_nm * NM,
        params.delay_samples,
        params.ideal,
    )


def behind(
    params: Params, A: np.ndarray, B: np.ndarray, C: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The system A, B, C with the sensor's lag, if it has one, as the last state."""
    if params.bandwidth_hz == 0.0:
        return A, B, C
    n = len(A)
    pole = 2.0 * math.pi * params.bandwidth_hz
    A_s = np.block([[A, np.zeros((n, 1))], [pole * C, np.full((1, 1), -pole)]])
    return A_s, np.vstack([B, [[0.0]]]), np.eye(n + 1)[n:]


def reading(c: Coefficients, y: float, noise: float) -> float:
    """What is told (m) of y (m) with white noise of unit variance."""
    y = y + c.noise * noise
    if c.step > 0.0:
        y = quantise(y, c.step)
    return y


class Noise:
    """Standard normal numbers, the same for the same seed in every mode.

    Parameters
    ----------
    seed : int
        Seed of the generator.
    """

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._ready: list[float] = []

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> float:
        if not self._ready:
            self._ready = self._rng.standard_normal(4096).tolist()[::-1]
        return self._ready.pop()

    def ahead(self, count: int) -> np.ndarray:
        """The next `count` numbers, which stay the next."""
        if count > len(self._ready):
            more = self._rng.standard_normal(count - len(self._ready))
            self._ready = more.tolist()[::-1] + self._ready
        return np.array(self._ready[: -count - 1 : -1])

    def take(self, count: int) -> np.ndarray:
        """The next `count` numbers, as `next` would give them one by one."""
        first = self._ready[: -count - 1 : -1]
        self._ready = self._ready[: len(self._ready) - len(first)]
        return np.concatenate([first, self._rng.standard_normal(count - len(first))])
