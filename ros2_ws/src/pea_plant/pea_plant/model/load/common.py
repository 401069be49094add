"""What every load shares: the unit it is stated in."""

from dataclasses import dataclass

from pea_core.params import ParameterError, param


@dataclass(frozen=True)
class LoadParams:
    """Unit of a load."""

    unit: str = param(
        "V", choices=("V", "N"), help="volts-equivalent, or newtons", fixed=True, common=True
    )
    stiffness: float = param(
        0.0, "N/um", 0.0, 1e6, help="the actuator's stiffness, for newtons", fixed=True, common=True
    )

    def __post_init__(self) -> None:
        if self.unit == "N" and self.stiffness < 1e-6:
            raise ParameterError(
                f"stiffness = {self.stiffness:g}: a load in newtons needs the actuator's "
                "stiffness, at least 1e-06 N/um"
            )


def volts(params: LoadParams, K: float) -> float:
    r"""Volts-equivalent of one unit of the load, K (um/V) being V's steady-state gain.

    .. math:: K f_e = F / stiffness
    """
    return 1.0 if params.unit == "V" else 1.0 / (params.stiffness * K)
