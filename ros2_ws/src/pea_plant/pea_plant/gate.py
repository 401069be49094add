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
Staleness
    A time. The gate adds up how far the commands are behind: each period adds one, each new
    command takes two off. So silence trips, and so does a loop, or a controller, that runs at less
    than half its rate.
Soft start
    Until the first command is reached, or the whole range could have been crossed at its rate:
    `soft_start` gives that time beforehand.

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
"""Seconds beyond the period between two samples that are no delay any more, whatever the limits."""


class UnsafeCommand(LoopFault):
    """A command that no driver may see; the text names it."""


@dataclass(frozen=True)
class Params:
    """Limits of the gate besides voltage_min and voltage_max; 0: not looked at."""

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
    change, soft_change (V): largest change a sample.  soft : longest soft start, in periods.
    pause : periods between two samples that are a delay; more trip.
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

    u (V): what the driver was given last.  asked (V): last command, NaN before the first.
    soft : periods that the soft start may still take, 0 once it has ended.
    age : periods that the commands are behind.  slewing, astray : samples in a row with too fast
    commands, with the reference too far away.  y (m): last measurement, NaN before the first.
    still : samples since it last changed.  u_still (V): voltage then.
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
    """Fastest change (V/s) in the soft start: the slew limit holds, too; 0 without a limit."""
    return min(filter(None, (params.soft_start_rate, params.slew_rate)), default=0.0)


def soft_start(params: Params, voltage_min: float, voltage_max: float) -> float:
    """Longest soft start (s): what the whole range (V) takes at its rate; 0 without a limit."""
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
    """A gate in `state` over a driver that has u (V) now."""
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
    """One sample: compiled whole, and its order decides which reason is told.

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
    apart : float
        Sample periods from the measurement of the last step to y: more than one where samples
        were lost, and then y may have changed by more.

    Returns
    -------
    State
        `State.u` is what the driver may see.
    """
    found = NONE
    if not 0.0 < elapsed <= c.pause:
        found = CLOCK
    asked, age, slewing = s.asked, s.age, 0
    if math.isfinite(asked):
        age = max(age + max(elapsed, 0.0) - (2.0 if fresh else 0.0), 0.0)
        if found == NONE and 0 < c.stale < age - 0.5:  # half a period: samples are not on the dot
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
    """The gate in fault, for a reason that `step` cannot see."""
    return State(
        FAULT, reason, 0, s.u, s.asked, s.soft, s.age, s.slewing, s.astray, s.y, s.still, s.u_still
    )


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
    cause : str
        Why it has tripped last: the reason, and what is known.
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

    def step(
        self, u: float, fresh: bool, y: float, w: float, elapsed: float, apart: float = 1.0
    ) -> float:
        """One sample, see `step`: the voltage that the driver may see (V)."""
        self.follow(step(self.c, self.s, u, fresh, y, w, elapsed, apart), u, y, elapsed)
        return self.s.u

    def follow(self, s: State, u: float, y: float, elapsed: float) -> None:
        """Take over what `step` has made of u, y and elapsed; a trip is told."""
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
        """From unconfigured to inactive, over a driver that has u (V) now."""
        return self._go(UNCONFIGURED, start(INACTIVE, u), cause)

    def activate(self, cause: str) -> bool:
        """From inactive to active, starting softly from the voltage there is."""
        return self._go(INACTIVE, start(ACTIVE, self.s.u)._replace(soft=self.c.soft), cause)

    def deactivate(self, cause: str) -> bool:
        """From active to inactive."""
        return self._go(ACTIVE, start(INACTIVE, self.s.u), cause)

    def trip(self, reason: int, about: str = "") -> bool:
        """To fault, for a reason that the gate cannot see itself; a fault keeps its first."""
        cause = f"{REASONS[reason]}: {about}" if about else REASONS[reason]
        after = tripped(self.s, reason)
        return self._go(ACTIVE, after, cause) or self._go(INACTIVE, after, cause)

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
        if self.s.state == FAULT:
            self.cause = cause
        self.transitions.append(Transition(self.stamp, STATES[before], self.state, cause))


FIXED = ("safe_voltage", "soft_start_rate")
"""Parameters that stay as they are while the gate is active: neither way is the tighter one, and
when the soft start ends was said beforehand."""

HIGHER = ("voltage_min", "displacement_min_um")
"""Limits that are tighter when higher; all others are tighter when lower, and 0 is none."""

_NEEDED = ("slew_rate", "beyond", "stale_samples", "jump_um", "stuck_samples")
"""Limits that no rig goes without."""


def limits(params: Any) -> dict[str, float]:
    """Every parameter of the gate by its name, the voltage range too."""
    own = {name: getattr(params, name) for name in ("voltage_min", "voltage_max")}
    safety = dataclasses.asdict(params.safety).items()
    return own | {f"safety.{name}": value for name, value in safety}


def refuse_looser(old: Any, new: Any) -> None:
    """Refuse parameters of a plant that an active gate must not take.

    Raises
    ------
    ParameterError
        A limit is looser than the old one, one that is fixed changes, or the range would move the
        safe voltage; it is named.
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
        One is not set; it is named.
    """
    for name in _NEEDED:
        if not getattr(params.safety, name):
            raise ParameterError(f"safety.{name} = 0: a rig needs this limit; give it a value")
