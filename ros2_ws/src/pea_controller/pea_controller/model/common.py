"""What all control laws share: nominal model, actuator limits, feedforward of Eq 7."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from pea_controller.model import slew
from pea_controller.model.inverse import Params as Inverse
from pea_core.injection import InjectParams
from pea_core.nominal import NominalModel
from pea_core.params import ParameterError, group, param
from pea_core.signals import Reference

DELAY_MAX = 20
"""Largest delay of a command (samples)."""

PATIENCE = 0.1
"""Time (s) that a command may stay limited before the integral starts to lead it back."""


@dataclass(frozen=True)
class TuningParams:
    """Margins that gains must keep, and what happens if they do not."""

    guard: str = param(
        "refuse",
        choices=("off", "warn", "refuse"),
        help="action on gains that theory finds unstable or of too little margin",
        common=True,
    )
    gain_margin: float = param(
        1.3,
        "",
        1.0,
        10.0,
        help="least factor, up and down, to instability on the nominal plant",
        common=True,
    )
    delay_margin: float = param(
        0.5, "samples", 0.0, 10.0, help="least delay more that makes it unstable there", common=True
    )
    modulus_margin: float = param(
        0.0, "", 0.0, 1.0, help="least 1 / max |S| there; 0: any", common=True
    )
    phase_margin: float = param(
        0.0,
        "deg",
        0.0,
        180.0,
        help="least phase to instability where |L| is 1; 0: any",
        common=True,
    )


@dataclass(frozen=True)
class CommonParams(NominalModel):
    """Nominal model, limits of the actuator as the controller knows them, and options."""

    voltage_min: float = param(
        -20.0, "V", -1e4, 1e4, help="lowest voltage of the actuator", common=True
    )
    voltage_max: float = param(
        110.0, "V", -1e4, 1e4, help="highest voltage of the actuator", common=True
    )
    slew_rate: float = param(
        0.0,
        "V/s",
        0.0,
        1e9,
        help="fastest change of the actuator's voltage; 0: no limit",
        common=True,
    )
    feedforward: bool = param(True, help="add the feedforward of Eq 7")
    eps_compensation: bool = param(False, help="subtract the observer's eps")
    preview_samples: float = param(
        0.0, "samples", 0.0, 4.0, help="how far ahead the feedforward looks, besides the delay"
    )
    delay_samples: int = param(
        0,
        "",
        0,
        DELAY_MAX,
        help="the plant's delay; a preview looks as much further ahead",
        fixed=True,
        common=True,
    )
    sensor_delay_samples: int = param(
        0,
        "",
        0,
        1000,
        help="delay of the plant's sensor, for laws that predict over it",
        fixed=True,
        common=True,
    )
    tuning: TuningParams = group(TuningParams)
    inject: InjectParams = group(InjectParams)

    def __post_init__(self) -> None:
        if self.voltage_min >= self.voltage_max:
            raise ParameterError(
                f"voltage_min = {self.voltage_min:g}: must be below voltage_max "
                f"({self.voltage_max:g} V)"
            )

    def actuator(self, T_s: float) -> slew.Coefficients:
        """Coefficients of `slew` for the actuator's limits."""
        low, high = self.voltage_min, self.voltage_max
        return slew.design(self, low, high, self.slew_rate, self.delay_samples, T_s)

    @property
    def preview(self) -> float:
        """How far ahead the feedforward looks (samples)."""
        if self.preview_samples == 0.0:
            return 0.0
        return self.preview_samples + self.delay_samples


class ActuatorLimits(NamedTuple):
    """What an actuator can apply: range (V) and fastest change (V/s, 0: any)."""

    voltage_min: float
    voltage_max: float
    slew_rate: float


BOUNDLESS = ActuatorLimits(-math.inf, math.inf, 0.0)
"""Limits of an actuator about which nothing is known."""

OF_THE_PLANT = (
    "voltage_min",
    "voltage_max",
    "delay_samples",
    "sensor.delay_samples",
    "amplifier.slew_rate",
    "safety.slew_rate",
)
"""Parameters of the plant that a law must know."""


def following(plant: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters of the law that follow those of the plant, unless the user sets them.

    Parameters
    ----------
    plant : mapping
        Values of a plant by dotted name, with `OF_THE_PLANT` among them. A plant from elsewhere
        has at least range and delay; a missing value means no limit, or no delay.
    """
    slew_rates = [plant.get(f"{part}.slew_rate", 0.0) for part in ("amplifier", "safety")]
    return {
        **{name: plant[name] for name in OF_THE_PLANT[:3]},
        "sensor_delay_samples": plant.get("sensor.delay_samples", 0),
        "slew_rate": min((rate for rate in slew_rates if rate > 0.0), default=0.0),
    }


def followed(
    own: Mapping[str, Any], plant: Mapping[str, object], given: Collection[str]
) -> dict[str, Any]:
    """New limits of a law, after its plant has changed limits in a running loop.

    Parameters
    ----------
    own : mapping
        Values of the law.
    plant : mapping
        New values of the plant, see `following`.
    given : collection of str
        Parameters of the law that the user has set: these can only become tighter.
    """
    new = following(plant)
    del new["delay_samples"], new["sensor_delay_samples"]  # fixed while the loop runs
    tighter = {
        "voltage_min": max(own["voltage_min"], new["voltage_min"]),
        "voltage_max": min(own["voltage_max"], new["voltage_max"]),
        "slew_rate": min((r for r in (own["slew_rate"], new["slew_rate"]) if r), default=0.0),
    }
    return {name: tighter[name] if name in given else new[name] for name in new}


def limits(plant: Mapping[str, object]) -> ActuatorLimits:
    """Limits of the actuator of a plant with these values (see `following`)."""
    known = following(plant)
    return ActuatorLimits(*(float(known[name]) for name in ActuatorLimits._fields))


def within(params: CommonParams, actuator: ActuatorLimits) -> None:
    """Refuse limits looser than those of the actuator.

    Raises
    ------
    ParameterError
        A limit of the controller is wider or looser than that of the actuator.
    """
    low, high, rate = actuator
    for name, wider in (
        ("voltage_min", params.voltage_min < low),
        ("voltage_max", params.voltage_max > high),
    ):
        if wider:
            raise ParameterError(
                f"{name} = {getattr(params, name):g}: wider than the plant's "
                f"{low:g} to {high:g} V; give limits within them"
            )
    if rate > 0.0 and not 0.0 < params.slew_rate <= rate:
        none = "0 (no limit)" if params.slew_rate == 0.0 else f"{params.slew_rate:g}"
        raise ParameterError(
            f"slew_rate = {none}: looser than the plant's {rate:g} V/s; give that or less"
        )


def counted_once(inverse: Inverse, eps_compensation: bool) -> None:
    """Refuse to compensate the hysteresis twice: by the feedforward, and as a part of eps.

    Raises
    ------
    ParameterError
        Both compensations are on.
    """
    if inverse.given and eps_compensation:
        raise ParameterError(
            "eps_compensation = True: the observer's eps holds the hysteresis that inverse feeds "
            "forward, it would be counted twice; set it false, or take type predictive"
        )


def feedforward(A21: float, A22: float, B2: float, W: Reference) -> float:
    r"""Eq 7: (B^T B)^{-1} B^T (\dot W - A W) in volts."""
    return (W.w_ddot - A21 * W.w - A22 * W.w_dot) / B2


def limited(u: float, voltage_min: float, voltage_max: float) -> bool:
    """Whether the actuator cannot apply u (V)."""
    return u < voltage_min or u > voltage_max


def patient(u: float, voltage_min: float, voltage_max: float, spare: int, patience: int) -> int:
    """Samples of patience left after a sample of u (V): all of them if u was applied."""
    return max(spare - 1, 0) if limited(u, voltage_min, voltage_max) else patience


def waits(u: float, push: float, voltage_min: float, voltage_max: float, spare: int) -> bool:
    """Conditional anti-windup: whether the integral keeps its value.

    The integral waits while u is limited, in whichever direction it would move. This rule alone
    can lock the loop: an integral with a wrong value may hold u beyond the limit for ever. So,
    when the patience is over, the integral moves again if this leads u back.

    Parameters
    ----------
    u : float
        Command (V).
    push : float
        Any number with the sign of the change of u that the integral's next step would make.
    voltage_min, voltage_max : float
        Limits of the actuator (V).
    spare : int
        Samples of patience left.
    """
    if u > voltage_max:
        return spare > 0 or push >= 0.0
    if u < voltage_min:
        return spare > 0 or push <= 0.0
    return False
