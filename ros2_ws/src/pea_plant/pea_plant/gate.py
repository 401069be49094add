r"""The safety gate: it limits every voltage between a controller and a driver.

Once a sample it gets the command, whether the command is a new one, and the sensor's reading. It
returns the voltage that the driver may apply. Whatever the command,

.. math:: |u_k - u_{k-1}| \le S\,T_s, \quad u_k \in [u_{min}, u_{max}],

from the first sample in that range on (a stage that starts outside ramps into it).

States
    ``unconfigured``, ``inactive`` (ramps to the safe voltage and holds it), ``active``, and
    ``fault``: as inactive, until a deliberate reset.
Trips
    From active to fault, each with one of `REASONS`. A limit of zero is not checked.
Staleness
    The number of periods that the commands are behind. Each period adds one, each new command
    subtracts two. So the gate trips without commands, and also if the loop or the controller runs
    at less than half its rate.
Soft start
    It ends when the first command is reached, or when the whole range could have been crossed at
    its rate. `soft_start` returns this longest time.

In lock-step the gate is part of the actuator's model and always active. There only the slew limit
S ramps the voltage, and a limit that is switched off changes no bit.
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
    WATCHDOG,
    OTHER_AXIS,
    PERMITTED_AREA,
) = range(17)

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
    "watchdog",
    "other_axis",
    "permitted_area",
)
"""Names of the reasons for a trip."""

JUMP = 1.0
"""Longest delay (s) of a sample, whatever the limits: the gate trips after a longer one."""


class UnsafeCommand(LoopFault):
    """A command that no driver may get; the text names it."""


@dataclass(frozen=True)
class Params:
    """Limits of the gate besides voltage_min and voltage_max; 0: not checked."""

    slew_rate: float = param(0.0, "V/s", 0.0, 1e9, help="fastest change of the voltage; 0: any")
    soft_start_rate: float = param(
        0.0,
        "V/s",
        0.0,
        1e9,
        help="slew rate to the first command, if below slew_rate; 0: slew_rate",
    )
    safe_voltage: float = param(
        0.0, "V", -1e4, 1e4, help="voltage of a stage at rest, as near as the range allows"
    )
    beyond: float = param(
        0.0, "V", 0.0, 1e4, help="trip on a command this far outside the range; 0: clip it"
    )
    slew_samples: int = param(
        0, "", 0, 10**6, help="trip when more consecutive commands exceed slew_rate; 0: limit them"
    )
    stale_samples: int = param(
        0, "", 0, 10**6, help="trip when commands are this many sample periods late; 0: never"
    )
    watchdog_s: float = param(
        0.5, "s", 0.02, 60.0, help="the watchdog acts after the plant has been silent for this time"
    )
    displacement_min_um: float = param(-1e6, "um", -1e6, 1e6, help="trip below")
    displacement_max_um: float = param(1e6, "um", -1e6, 1e6, help="trip above")
    following_error_um: float = param(
        0.0, "um", 0.0, 1e6, help="trip when the error |w - y| is larger; 0: never"
    )
    following_samples: int = param(1, "", 1, 10**6, help="consecutive samples before it trips")
    stuck_samples: int = param(
        0, "", 0, 10**6, help="trip when the reading does not change for more samples; 0: never"
    )
    stuck_voltage: float = param(
        1.0, "V", 1e-6, 1e4, help="while the voltage changes by at least this much"
    )
    jump_um: float = param(
        0.0, "um", 0.0, 1e6, help="trip when the reading changes by more in a period; 0: never"
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
    change, soft_change (V): largest change in a sample.  soft : longest soft start, in periods.
    pause : most periods between two samples; the gate trips after more.
    """

    on: bool
    voltage_min: float
    voltage_max: float
    change: float
    soft_change: float
    soft: float
    safe: float
    beyond: float
    slewing: int
    stale: int
    pause: float
    y_min: float
    y_max: float
    following: float
    following_samples: int
    stuck: int
    stuck_voltage: float
    jump: float


class State(NamedTuple):
    """state, reason : of `STATES` and `REASONS`.  since : samples in this state.

    u (V): last voltage given to the driver.  asked (V): last command, NaN before the first.
    soft : periods that the soft start may still take, 0 once it has ended.
    age : periods that the commands are behind.  slewing, astray : samples in a row with a too fast
    command, with too large an error.  y (m): last measurement, NaN before the first.
    still : samples since y last changed.  u_still (V): voltage at that sample.
    """

    state: int
    reason: int
    since: int
    u: float
    asked: float
    soft: float
    age: float
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


def soft_rate(params: Params) -> float:
    """Fastest change (V/s) in the soft start, at most the slew limit; 0 without a limit."""
    return min(filter(None, (params.soft_start_rate, params.slew_rate)), default=0.0)


def soft_start(params: Params, voltage_min: float, voltage_max: float) -> float:
    """Longest soft start (s): the whole range (V) at its rate; 0 without a limit."""
    rate = soft_rate(params)
    return (voltage_max - voltage_min) / rate if rate else 0.0


def design(params: Params, voltage_min: float, voltage_max: float, T_s: float) -> Coefficients:
    """Coefficients for a range (V) and a sample period (s)."""
    default = Params()
    unused = ("safe_voltage", "stuck_voltage", "soft_start_rate", "following_samples", "watchdog_s")
    neither = dataclasses.replace(params, **{name: getattr(default, name) for name in unused})
    pause = JUMP / T_s
    return Coefficients(
        on=neither != default,
        voltage_min=voltage_min,
        voltage_max=voltage_max,
        change=params.slew_rate * T_s,
        soft_change=soft_rate(params) * T_s,
        soft=soft_start(params, voltage_min, voltage_max) / T_s,
        safe=limit(params.safe_voltage, voltage_min, voltage_max),
        beyond=params.beyond,
        slewing=params.slew_samples,
        stale=params.stale_samples,
        pause=1.0 + min(params.stale_samples or pause, pause),
        y_min=params.displacement_min_um * 1e-6,
        y_max=params.displacement_max_um * 1e-6,
        following=params.following_error_um * 1e-6,
        following_samples=params.following_samples,
        stuck=params.stuck_samples,
        stuck_voltage=params.stuck_voltage,
        jump=params.jump_um * 1e-6,
    )


def start(state: int, u: float) -> State:
    """A gate in `state`, with a driver that holds u (V) now."""
    return State(
        state=state,
        reason=NONE,
        since=0,
        u=u,
        asked=math.nan,
        soft=0.0,
        age=0.0,
        slewing=0,
        astray=0,
        y=math.nan,
        still=0,
        u_still=u,
    )


def step(
    c: Coefficients,
    s: State,
    u: float,
    fresh: bool,
    y: float,
    w: float,
    elapsed: float,
    apart: float,
) -> State:
    """One sample. It is compiled as one function; the order of the checks decides the reason.

    Parameters
    ----------
    c, s : Coefficients, State
    u : float
        Command (V); any value.
    fresh : bool
        Whether u is new since the last sample; if not, u is ignored.
    y, w : float
        Measured and desired displacement (m); w is NaN if it is unknown.
    elapsed : float
        Sample periods since the last step: in an early sample the voltage may change less.
    apart : float
        Sample periods between the measurement of the last step and y. It is more than one after
        lost samples, and then y may have changed by more.

    Returns
    -------
    State
        `State.u` is the voltage that the driver may apply.
    """
    found = NONE
    if not 0.0 < elapsed <= c.pause:
        found = CLOCK
    asked, age, slewing = s.asked, s.age, 0
    if math.isfinite(asked):
        age = max(age + max(elapsed, 0.0) - (2.0 if fresh else 0.0), 0.0)
        if found == NONE and 0 < c.stale < age - 0.5:  # half a period: samples have jitter
            found = COMMAND_STALE
    if fresh:
        if not math.isfinite(u):
            found = COMMAND_NOT_FINITE
        else:
            beyond = u > c.voltage_max + c.beyond or u < c.voltage_min - c.beyond
            if c.beyond > 0.0 and beyond and found == NONE:
                found = COMMAND_RANGE
            if c.change > 0.0 and abs(u - asked) > c.change:
                slewing = s.slewing + 1
                if 0 < c.slewing < slewing and found == NONE:
                    found = COMMAND_SLEW
            asked = u
    elif math.isfinite(asked):
        slewing = s.slewing
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
        begun = math.isfinite(s.asked) and s.soft <= 0.0
        if c.following > 0.0 and begun and abs(w - y) > c.following:
            astray = s.astray + 1
            if astray >= c.following_samples:
                sensed = FOLLOWING_ERROR
        if 0 < c.stuck < still and abs(s.u - u_still) > c.stuck_voltage:
            sensed = SENSOR_STUCK
        if c.jump > 0.0 and abs(y - s.y) > c.jump * max(apart, 1.0):
            sensed = SENSOR_JUMP
        if found == NONE:
            found = sensed
    state, reason, since = s.state, s.reason, s.since + 1
    if state == ACTIVE and found != NONE:
        state, reason, since = FAULT, found, 1
    given, change = c.safe, c.change
    if state == ACTIVE:
        given = limit(asked if math.isfinite(asked) else s.u, c.voltage_min, c.voltage_max)
        if s.soft > 0.0:
            change = c.soft_change
    soft = s.soft
    target = given
    if change > 0.0:
        reach = change * min(max(elapsed, 0.0), 1.0)
        given = min(max(target, s.u - reach), s.u + reach)
    if math.isfinite(asked):
        soft = max(soft - max(elapsed, 0.0), 0.0) if given != target else 0.0
    return State(state, reason, since, given, asked, soft, age, slewing, astray, y, still, u_still)


def tripped(s: State, reason: int) -> State:
    """The gate in fault, for a reason that `step` does not check."""
    return State(
        FAULT, reason, 0, s.u, s.asked, s.soft, s.age, s.slewing, s.astray, s.y, s.still, s.u_still
    )


class Transition(NamedTuple):
    """A change of state, as it is published.

    Attributes
    ----------
    stamp : int
        Time of the sample (ns).
    before, after : str
        Of `STATES`.
    cause : str
        Why: one of `REASONS` and the value, or who asked for it.
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
        Those that were not published yet; the reader removes them.
    cause : str
        Why it tripped last: the reason and the value.
    """

    def __init__(self, params: object, T_s: float) -> None:
        self.T_s = T_s
        self.transitions: list[Transition] = []
        self.cause = ""
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
        """Whether the driver has the safe voltage and keeps it."""
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

    def step(
        self, u: float, fresh: bool, y: float, w: float, elapsed: float, apart: float = 1.0
    ) -> float:
        """One sample, see `step`: the voltage that the driver may apply (V)."""
        self.follow(step(self.c, self.s, u, fresh, y, w, elapsed, apart), u, y, elapsed)
        return self.s.u

    def follow(self, s: State, u: float, y: float, elapsed: float) -> None:
        """Adopt the state that `step` returned for u, y and elapsed; report a trip."""
        before, self.s = self.s.state, s
        if self.s.state != before:
            reason = self.s.reason
            if reason == CLOCK:
                limit = self.c.pause * self.T_s
                about = f"{elapsed * self.T_s:.3g} s between two samples, at most {limit:.3g} s "
                about += "are a delay"
            elif reason == COMMAND_STALE:
                about = f"commands are {self.s.age * self.T_s:.3g} s behind"
            elif reason < COMMAND_STALE:
                about = f"{u:g} V"
            else:
                about = f"{y * 1e6:.4f} um"
            self._tell(before, f"{self.reason}: {about}")

    def configure(self, u: float, cause: str) -> bool:
        """From unconfigured to inactive, with a driver that holds u (V) now."""
        return self._go(UNCONFIGURED, start(INACTIVE, u), cause)

    def activate(self, cause: str) -> bool:
        """From inactive to active, with a soft start from the present voltage."""
        return self._go(INACTIVE, start(ACTIVE, self.s.u)._replace(soft=self.c.soft), cause)

    def deactivate(self, cause: str) -> bool:
        """From active to inactive."""
        return self._go(ACTIVE, start(INACTIVE, self.s.u), cause)

    def trip(self, reason: int, about: str = "") -> bool:
        """To fault, for a reason that `step` does not check; a fault keeps its first reason."""
        cause = f"{REASONS[reason]}: {about}" if about else REASONS[reason]
        after = tripped(self.s, reason)
        return self._go(ACTIVE, after, cause) or self._go(INACTIVE, after, cause)

    def reset(self, u: float, cause: str) -> bool:
        """From fault to inactive, with a driver that holds u (V) now."""
        return self._go(FAULT, start(INACTIVE, u), cause)

    def found(self, u: float) -> None:
        """Go on from u (V), which the driver holds after it was reached again."""
        self.s = self.s._replace(u=u)

    def cleanup(self, cause: str) -> bool:
        """From inactive or fault to unconfigured; the driver is released."""
        after = start(UNCONFIGURED, self.s.u)
        return self._go(INACTIVE, after, cause) or self._go(FAULT, after, cause)

    def _go(self, before: int, after: State, cause: str) -> bool:
        if self.s.state != before:
            return False
        self.s = after
        self._tell(before, cause)
        return True

    def _tell(self, before: int, cause: str) -> None:
        if self.s.state == FAULT:
            self.cause = cause
        self.transitions.append(Transition(self.stamp, STATES[before], self.state, cause))


FIXED = ("safe_voltage", "soft_start_rate")
"""Parameters that are fixed while the gate is active: neither direction is the tighter one, and the
end of the soft start has been announced."""

HIGHER = ("voltage_min", "displacement_min_um")
"""Limits that are tighter when higher. All others are tighter when lower; 0 is no limit."""

_NEEDED = ("slew_rate", "beyond", "stale_samples", "jump_um", "stuck_samples")
"""Limits that every rig must set."""


def limits(params: Any) -> dict[str, float]:
    """Every parameter of the gate by its name, with the voltage range."""
    own = {name: getattr(params, name) for name in ("voltage_min", "voltage_max")}
    safety = dataclasses.asdict(params.safety).items()
    return own | {f"safety.{name}": value for name, value in safety}


def refuse_looser(old: Any, new: Any) -> None:
    """Refuse new parameters of a plant that an active gate must not adopt.

    Raises
    ------
    ParameterError
        A limit is looser than the old one, a fixed parameter changes, or the new range does not
        contain the safe voltage; the parameter is named.
    """
    before, after = limits(old), limits(new)
    for name, value in after.items():
        short = name.rpartition(".")[2]
        was = before[name]
        if short in FIXED:
            if value != was:
                raise ParameterError(
                    f"{name} = {value:g}: stays {was:g} while the gate is active; stop first"
                )
            continue
        if short in HIGHER:
            looser = value < was
        elif short in ("voltage_max", "displacement_max_um"):
            looser = value > was
        else:
            looser = (value or math.inf) > (was or math.inf)
        if looser:
            raise ParameterError(
                f"{name} = {value:g}: looser than {was:g}, and the gate is active; stop first"
            )
    safe = limit(old.safety.safe_voltage, old.voltage_min, old.voltage_max)
    if not new.voltage_min <= safe <= new.voltage_max:
        name = "voltage_min" if safe < new.voltage_min else "voltage_max"
        raise ParameterError(
            f"{name} = {after[name]:g}: the range must hold the safe voltage, {safe:g} V, while "
            "the gate is active; stop first"
        )


def refuse_unlimited(params: Any) -> None:
    """Refuse a rig without the limits that every rig needs.

    Raises
    ------
    ParameterError
        A limit is not set; it is named.
    """
    for name in _NEEDED:
        if not getattr(params.safety, name):
            raise ParameterError(f"safety.{name} = 0: a rig needs this limit; give it a value")
