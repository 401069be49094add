r"""What stands between any controller and any driver: the gate.

Once a sample it is told the command, whether that is a new one, and what the sensor says; it
answers with the voltage that the driver may see. Whatever the command,

.. math:: |u_k - u_{k-1}| \le S\,T_s, \quad u_k \in [u_{min}, u_{max}],

from the first sample in that range on (a stage that is found outside ramps in).

States
    ``unconfigured``, ``inactive`` (ramps to the safe voltage and holds it), ``active``, and
    ``fault``: as inactive, until a deliberate reset.
Trips
    From active to fault, each with one of `REASONS`. A limit of zero is not looked at.

A loop in lock-step has the gate in its actuator's model, always active; there nothing ramps but
by S, and what is switched off changes no bit.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

from pea_core.loop import LoopFault
from pea_core.params import ParameterError, param

UNCONFIGURED, INACTIVE, ACTIVE, FAULT = range(4)

STATES = ("unconfigured", "inactive", "active", "fault")
"""Names of the gate's states."""

(
    NONE,
    COMMAND_NOT_FINITE,
    COMMAND_RANGE,
    COMMAND_SLEW,
    COMMAND_STALE,
    SENSOR_NOT_FINITE,
    SENSOR_STUCK,
    SENSOR_JUMP,
    DISPLACEMENT_RANGE,
    FOLLOWING_ERROR,
    DRIVER,
    CLOCK,
    CONTROLLERS,
    EMERGENCY_STOP,
) = range(14)

REASONS = (
    "none",
    "command_not_finite",
    "command_range",
    "command_slew",
    "command_stale",
    "sensor_not_finite",
    "sensor_stuck",
    "sensor_jump",
    "displacement_range",
    "following_error",
    "driver",
    "clock",
    "controllers",
    "emergency_stop",
)
"""Names of the reasons for a trip."""


class UnsafeCommand(LoopFault):
    """A command that no driver may see; the text names it."""


@dataclass(frozen=True)
class Params:
    """Limits of the gate besides voltage_min and voltage_max; 0: not looked at."""

    slew_rate: float = param(0.0, "V/s", 0.0, 1e9, help="fastest change of the voltage; 0: any")
    soft_start_rate: float = param(
        0.0, "V/s", 0.0, 1e9, help="the same until the first command is reached; 0: slew_rate"
    )
    safe_voltage: float = param(
        0.0, "V", -1e4, 1e4, help="voltage of a stage at rest, as near as the range allows"
    )
    beyond: float = param(
        0.0, "V", 0.0, 1e4, help="trip on a command so far outside the range; 0: hold it within"
    )
    slew_samples: int = param(
        0, "", 0, 10**6, help="trip when more commands in a row change faster; 0: hold them back"
    )
    stale_samples: int = param(
        0, "", 0, 10**6, help="trip after more samples without a new command; 0: never"
    )
    displacement_min_um: float = param(-1e6, "um", -1e6, 1e6, help="trip below")
    displacement_max_um: float = param(1e6, "um", -1e6, 1e6, help="trip above")
    following_error_um: float = param(
        0.0, "um", 0.0, 1e6, help="trip when the reference is farther away; 0: never"
    )
    following_samples: int = param(1, "", 1, 10**6, help="samples in a row that it takes")
    stuck_samples: int = param(
        0, "", 0, 10**6, help="trip on a sensor that says the same for more samples; 0: never"
    )
    stuck_voltage: float = param(
        1.0, "V", 1e-6, 1e4, help="while the voltage moves so far; less is no sign"
    )
    jump_um: float = param(
        0.0, "um", 0.0, 1e6, help="trip when the sensor moves farther in a sample; 0: never"
    )

    def __post_init__(self) -> None:
        if self.displacement_min_um >= self.displacement_max_um:
            raise ParameterError(
                f"displacement_min_um = {self.displacement_min_um:g}: must be below "
                f"displacement_max_um ({self.displacement_max_um:g} um)"
            )


class Coefficients(NamedTuple):
    """Limits in SI units and samples; zero: none.

    on : whether any limit but the voltage range is set.
    change, soft_change (V): largest change a sample.
    """

    on: bool
    voltage_min: float
    voltage_max: float
    change: float
    soft_change: float
    safe: float
    beyond: float
    slewing: int
    stale: int
    y_min: float
    y_max: float
    following: float
    following_samples: int
    stuck: int
    stuck_voltage: float
    jump: float


class State(NamedTuple):
    """state, reason : of `STATES` and `REASONS`.  since : samples in this state.

    u (V): what the driver was given last.  asked (V): last command, NaN before the first.
    soft : whether the first command is not reached yet.
    age, slewing, astray : samples since the last command, with too fast ones, with the
    reference too far away.  y (m): last measurement, NaN before the first.  still : samples
    since it last changed.  u_still (V): voltage then.
    """

    state: int
    reason: int
    since: int
    u: float
    asked: float
    soft: bool
    age: int
    slewing: int
    astray: int
    y: float
    still: int
    u_still: float


def limit(u: float, voltage_min: float, voltage_max: float) -> float:
    """Hold a finite command u (V) within the amplifier's range (V)."""
    return min(max(u, voltage_min), voltage_max)


def check(u: float, k: int) -> None:
    """Refuse a command that is no finite number.

    Raises
    ------
    UnsafeCommand
        u (V) at sample k is NaN or infinite.
    """
    if not math.isfinite(u):
        raise UnsafeCommand(f"voltage at sample {k} is {u}: a command must be a finite number")


def design(params: Params, voltage_min: float, voltage_max: float, T_s: float) -> Coefficients:
    """Coefficients for a range (V) and a sample period (s)."""
    neither = dataclasses.replace(
        params, safe_voltage=0.0, stuck_voltage=1.0, soft_start_rate=0.0, following_samples=1
    )
    return Coefficients(
        on=neither != Params(),
        voltage_min=voltage_min,
        voltage_max=voltage_max,
        change=params.slew_rate * T_s,
        soft_change=(params.soft_start_rate or params.slew_rate) * T_s,
        safe=limit(params.safe_voltage, voltage_min, voltage_max),
        beyond=params.beyond,
        slewing=params.slew_samples,
        stale=params.stale_samples,
        y_min=params.displacement_min_um * 1e-6,
        y_max=params.displacement_max_um * 1e-6,
        following=params.following_error_um * 1e-6,
        following_samples=params.following_samples,
        stuck=params.stuck_samples,
        stuck_voltage=params.stuck_voltage,
        jump=params.jump_um * 1e-6,
    )


def start(state: int, u: float) -> State:
    """A gate in `state` over a driver that has u (V) now."""
    return State(
        state=state,
        reason=NONE,
        since=0,
        u=u,
        asked=math.nan,
        soft=False,
        age=0,
        slewing=0,
        astray=0,
        y=math.nan,
        still=0,
        u_still=u,
    )


def step(
    c: Coefficients, s: State, u: float, fresh: bool, y: float, w: float, elapsed: float
) -> State:
    """One sample.

    Parameters
    ----------
    c, s : Coefficients, State
    u : float
        Command (V), whatever the controller says.
    fresh : bool
        Whether it has come since the last sample; else u is not looked at.
    y, w : float
        Measured and desired displacement (m); w is NaN where the gate is told none.
    elapsed : float
        Sample periods since the last step: a sample that comes early may change less.

    Returns
    -------
    State
        `State.u` is what the driver may see.
    """
    found = NONE
    asked, age, slewing = s.asked, s.age, 0
    if fresh:
        age = 0
        if not math.isfinite(u):
            found = COMMAND_NOT_FINITE
        else:
            if c.beyond > 0.0 and (u > c.voltage_max + c.beyond or u < c.voltage_min - c.beyond):
                found = COMMAND_RANGE
            if c.change > 0.0 and abs(u - asked) > c.change:
                slewing = s.slewing + 1
                if 0 < c.slewing < slewing and found == NONE:
                    found = COMMAND_SLEW
            asked = u
    elif math.isfinite(asked):
        age += 1
        slewing = s.slewing
        if 0 < c.stale < age:
            found = COMMAND_STALE
    still, u_still, astray = s.still + 1, s.u_still, 0
    if not math.isfinite(y):
        if found == NONE:
            found = SENSOR_NOT_FINITE
    else:
        if y != s.y:
            still, u_still = 0, s.u
        sensed = NONE
        if not c.y_min <= y <= c.y_max:
            sensed = DISPLACEMENT_RANGE
        if c.following > 0.0 and not s.soft and abs(w - y) > c.following:
            astray = s.astray + 1
            if astray >= c.following_samples:
                sensed = FOLLOWING_ERROR
        if 0 < c.stuck < still and abs(s.u - u_still) > c.stuck_voltage:
            sensed = SENSOR_STUCK
        if c.jump > 0.0 and abs(y - s.y) > c.jump * max(elapsed, 1.0):
            sensed = SENSOR_JUMP
        if found == NONE:
            found = sensed
    state, reason, since = s.state, s.reason, s.since + 1
    if state == ACTIVE and found != NONE:
        state, reason, since = FAULT, found, 1
    given, change = c.safe, c.change
    if state == ACTIVE:
        given = limit(asked if math.isfinite(asked) else s.u, c.voltage_min, c.voltage_max)
        if s.soft:
            change = c.soft_change
    soft = s.soft and not math.isfinite(asked)
    if change > 0.0:
        reach = change * min(max(elapsed, 0.0), 1.0)
        target = given
        given = min(max(target, s.u - reach), s.u + reach)
        soft = soft or (s.soft and given != target)
    return State(state, reason, since, given, asked, soft, age, slewing, astray, y, still, u_still)


class Transition(NamedTuple):
    """A change of state, told to people.

    Attributes
    ----------
    stamp : int
        Time of the sample (ns).
    before, after : str
        Of `STATES`.
    cause : str
        Why: one of `REASONS`, behind it what is known, or who asked.
    """

    stamp: int
    before: str
    after: str
    cause: str


class Gate:
    """The gate of a loop in wall time, with its transitions.

    Parameters
    ----------
    params : object
        With ``safety``, ``voltage_min`` and ``voltage_max``.
    T_s : float
        Sample period (s).

    Attributes
    ----------
    transitions : list of Transition
        What nobody has taken yet.
    """

    def __init__(self, params: Any, T_s: float) -> None:
        self.T_s = T_s
        self.transitions: list[Transition] = []
        self.stamp = 0
        self.s = start(UNCONFIGURED, 0.0)
        self.params = params
        self.adopt(params)

    @property
    def state(self) -> str:
        """One of `STATES`."""
        return STATES[self.s.state]

    @property
    def reason(self) -> str:
        """One of `REASONS`."""
        return REASONS[self.s.reason]

    @property
    def at_rest(self) -> bool:
        """Whether the driver has the safe voltage, for good."""
        return self.s.state != ACTIVE and self.s.u == self.c.safe

    def adopt(self, params: Any) -> None:
        """Take new limits; while active, tighter ones only.

        Raises
        ------
        ParameterError
            A limit would be loosened while active.
        """
        if self.s.state == ACTIVE:
            refuse_looser(self.params, params)
        self.params = params
        self.c = design(params.safety, params.voltage_min, params.voltage_max, self.T_s)

    def step(self, u: float, fresh: bool, y: float, w: float, elapsed: float) -> float:
        """One sample, see `step`: the voltage that the driver may see (V)."""
        before = self.s.state
        self.s = step(self.c, self.s, u, fresh, y, w, elapsed)
        if self.s.state != before:
            told = {COMMAND_STALE: "", SENSOR_STUCK: f"{y * 1e6:.4f} um"}
            about = told.get(self.s.reason)
            if about is None:
                of_command = self.s.reason <= COMMAND_STALE
                about = f"{u:g} V" if of_command else f"{y * 1e6:.4f} um"
            self._tell(before, f"{self.reason}: {about}" if about else self.reason)
        return self.s.u

    def configure(self, u: float, cause: str) -> bool:
        """From unconfigured to inactive, over a driver that has u (V) now."""
        return self._go(UNCONFIGURED, start(INACTIVE, u), cause)

    def activate(self, cause: str) -> bool:
        """From inactive to active, starting softly from the voltage there is."""
        return self._go(INACTIVE, start(ACTIVE, self.s.u)._replace(soft=True), cause)

    def deactivate(self, cause: str) -> bool:
        """From active to inactive."""
        return self._go(ACTIVE, start(INACTIVE, self.s.u), cause)

    def trip(self, reason: int, about: str = "") -> bool:
        """To fault, for a reason that the gate cannot see itself; a fault keeps its first."""
        cause = f"{REASONS[reason]}: {about}" if about else REASONS[reason]
        tripped = self.s._replace(state=FAULT, reason=reason, since=0)
        return self._go(ACTIVE, tripped, cause) or self._go(INACTIVE, tripped, cause)

    def reset(self, u: float, cause: str) -> bool:
        """From fault to inactive, over a driver that has u (V) now."""
        return self._go(FAULT, start(INACTIVE, u), cause)

    def found(self, u: float) -> None:
        """Take note that the driver, reached again, has u (V): go on from there."""
        self.s = self.s._replace(u=u)

    def cleanup(self, cause: str) -> bool:
        """From inactive, or fault, to unconfigured: the driver is released."""
        after = start(UNCONFIGURED, self.s.u)
        return self._go(INACTIVE, after, cause) or self._go(FAULT, after, cause)

    def _go(self, before: int, after: State, cause: str) -> bool:
        if self.s.state != before:
            return False
        self.s = after
        self._tell(before, cause)
        return True

    def _tell(self, before: int, cause: str) -> None:
        self.transitions.append(Transition(self.stamp, STATES[before], self.state, cause))


_HIGHER = ("voltage_min", "displacement_min_um")
"""Limits that are tighter when higher."""

_NEEDED = ("slew_rate", "beyond", "stale_samples", "jump_um", "stuck_samples")
"""Limits that no rig goes without."""


def _limits(params: Any) -> dict[str, float]:
    own = {name: getattr(params, name) for name in ("voltage_min", "voltage_max")}
    return own | {
        f"safety.{name}": value
        for name, value in dataclasses.asdict(params.safety).items()
        if name != "safe_voltage"
    }


def refuse_looser(old: Any, new: Any) -> None:
    """Refuse parameters of a plant whose limits are looser than the old ones.

    Raises
    ------
    ParameterError
        One is; it is named.
    """
    before, after = _limits(old), _limits(new)
    for name, value in after.items():
        short = name.rpartition(".")[2]
        was = before[name]
        if short in _HIGHER:
            looser = value < was
        elif short in ("voltage_max", "displacement_max_um"):
            looser = value > was
        else:
            looser = (value or math.inf) > (was or math.inf)
        if looser:
            raise ParameterError(
                f"{name} = {value:g}: looser than {was:g}, and the gate is active; stop first"
            )


def refuse_unlimited(params: Any) -> None:
    """Refuse a rig without the limits that every rig needs.

    Raises
    ------
    ParameterError
        One is not set; it is named.
    """
    for name in _NEEDED:
        if not getattr(params.safety, name):
            raise ParameterError(f"safety.{name} = 0: a rig needs this limit; give it a value")
