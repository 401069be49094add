"""The displacement sensor: white noise on y."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pea_core.params import param


@dataclass(frozen=True)
class Params:
    """Displacement sensor."""

    noise_nm: float = param(0.0, "nm", 0.0, 1e6, help="white noise, rms")
    ideal: bool = param(
        False, help="also tell the true velocity, for the passthrough observer", fixed=True
    )


def noise(seed: int) -> Iterator[float]:
    """Standard normal numbers, the same for the same seed in every mode."""
    rng = np.random.default_rng(seed)
    while True:
        yield from rng.standard_normal(4096).tolist()
