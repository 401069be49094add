"""Load that comes at the sample nearest to `time` and stays."""

from dataclasses import dataclass
from typing import NamedTuple

from pea_core.params import param
from pea_plant.model.load.common import LoadParams, volts


@dataclass(frozen=True)
class Params(LoadParams):
    """One step."""

    amplitude: float = param(1.0, "V or N", -1e4, 1e4, help="load after the step")
    time: float = param(0.0, "s", 0.0, 1e6, help="when the step comes")


class Coefficients(NamedTuple):
    """Load after the step (V) and the sample at which it comes."""

    f_e: float
    k_step: int


def design(params: Params, T_s: float, K: float) -> Coefficients:
    """Convert to volts, with V's steady-state gain K (um/V), and to samples."""
    return Coefficients(params.amplitude * volts(params, K), round(params.time / T_s))


def output(c: Coefficients, k: int) -> float:
    """Volts-equivalent load (V) at sample k."""
    return 0.0 if k < c.k_step else c.f_e
