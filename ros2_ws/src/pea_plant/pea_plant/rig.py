"""A rig: driver, gate, watchdog and clock, with one `Rig.step` and one `Rig.stop`.

The plant's node and a loop in one process both call these methods. Every command passes the gate,
the watchdog gets the voltage before the device, and each wait has a deadline. The rules are in
docs/reliability.md.

One thread steps. It never waits for a device that does not answer: another thread connects to a
lost device again. All other threads may only request a stop, and read.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

from pea_core import claim
from pea_core.attempt import Attempt
from pea_core.axes import per_axis
from pea_core.params import ParameterError
from pea_core.signals import Measurement
from pea_core.units import SECOND
from pea_engine import pace
from pea_plant import drivers, gate
from pea_plant.drivers.driver import DriverError
from pea_plant.drivers.driver import Limits as DeviceLimits
from pea_plant.drivers.driver import within as within_device
from pea_plant.gate import DRIVER, EMERGENCY_STOP, WATCHDOG, Gate
from pea_plant.gates import Gates
from pea_watchdog import client
from pea_watchdog import watchdog as dog
from pea_watchdog.client import Watchdog, hold, line

CHECK_EVERY = 0.05
"""Seconds between two calls of the driver's `check` for errors of the device."""

DIAL_EVERY = 0.2
"""Seconds between two attempts to connect to a lost device."""

DIAL_FOR, DIALS = 1.5, 2
"""Seconds of such attempts at the end of a run, and their least number: data that the watchdog has
sent may be lost, and only the driver can ask the device."""

CONNECT = 8.0
"""Longest time (s) for connecting."""

HEED = 0.1
"""Seconds in which the safe voltage is sent again until the device holds it: data may be lost."""

AGAIN = 0.5
"""Least time (s) of the first attempt to connect again; if four times the time that connecting took
is longer, it gets that. Each failed attempt doubles it, up to the driver's own time."""

CLOSE = 1.0
"""Longest time (s) for closing a driver."""

SHARED = "the same connection (the device drops it for another)"
"""Connection of the watchdog to a device that serves only the last client."""

SOFT_START = "soft_start_s"
"""Key of the longest soft start in the gate's diagnostic."""

OURS = ("sensors_to_axes", "axes_to_actuators", "permitted_um")
"""Parameters of a stage of several axes that the rig applies, not the device."""

LATE = 2.0
"""Periods between two samples; after a longer time the watchdog ramps, not the driver."""

ANSWER = 0.6
"""Longest time (s) until a stop answers; the ramp may take longer."""

POLL = 0.002
"""Seconds between two checks by a thread that waits for the steps of another one."""


class Stopped(NamedTuple):
    """Result of a stop.

    Attributes
    ----------
    safe : bool
        Whether the stage is at its safe voltage, or on the way to it.
    text : str
        State of the gate and voltage, as a text for the user.
    """

    safe: bool
    text: str


class Reached(NamedTuple):
    """A connected device: driver, first measurement, watchdog, a text about it, its limits."""

    driver: Any
    measured: Measurement
    watchdog: Watchdog | None
    text: str
    params: Any


class Rig:
    """A device, or the simulated actuator, in wall time.

    Parameters
    ----------
    params : pea_plant.plant.Params
        With several axes, a tuple of them; then commands, voltages and measurements are tuples,
        too.
    T_s : float
        Sample period (s).
    driver : Driver, optional
        Used instead of the driver that the parameters choose.
    tell : callable
        Called after a trip, before anything that may take long.
    axes : sequence of str
        Names of the axes, if there are several.

    Attributes
    ----------
    gate : Gate
        Every command passes it.
    driver : Driver
    connected : bool
        Whether the driver is connected to the device.
    measured : Measurement
        The last measurement.
    failure : Exception or None
        Why the device was lost last, or could not be connected.
    notes : list of str
        Texts for the user that were not published yet; the reader removes them.
    until : float
        Deadline of the present call of the driver (s, monotonic).

    Raises
    ------
    ParameterError
        A limit that every rig needs is missing, or the driver cannot be designed.
    """

    def __init__(
        self,
        params: Any,
        T_s: float,
        driver: Any = None,
        tell: Callable[[], None] = lambda: None,
        axes: Sequence[str] = (),
    ) -> None:
        several = type(params) is tuple
        first = per_axis(params)[0]
        self.simulated = driver is None and isinstance(first.driver, drivers.Simulated)
        if several:
            drivers.together(axes, params)
        if not self.simulated:
            self._unlimited(params)
        self.params = params
        self.T_s, self.T_ns = T_s, round(T_s * SECOND)
        self.gate: Any = Gates(params, T_s, axes) if several else Gate(params, T_s)
        self._given = driver
        self.driver: Any = self._make() if driver is None else driver
        self.watchdog: Watchdog | None = None
        self.connected = False
        nothing: Any = (math.nan, math.nan, 0.0)
        if several:
            nothing = tuple((one,) * len(params) for one in nothing)
        self.measured = Measurement(*nothing)
        self.failure: Exception | None = None
        self.notes: list[str] = []
        self.until = math.inf
        self.allowed = 0.0
        self._tell = tell
        self._made_for = params
        self._took = 0.0
        self._attempt: Attempt[Reached] | None = None
        self._line: Attempt[client.HeldLine] | None = None
        self._unwatched = self._left = self._silent = self._single = self._refused = False
        self._claims: list[Any] = []
        self.halt_cause = ""
        self._due = self._stepped = self._check_at = 0
        self._measured_at = self._seen_at = 0
        self.dial_at = 0.0
        self._heed_until = math.inf
        self._dials = self._losses = 0

    @property
    def signal(self) -> float:
        """The sample signal that the driver read last; NaN if it has none."""
        return float(getattr(self.driver, "signal", math.nan))

    @property
    def nothing(self) -> Any:
        """NaN, one for each axis: stands for no command, or for an unknown reference."""
        several = type(self.params) is tuple
        return (math.nan,) * len(self.params) if several else math.nan

    def _make(self) -> Any:
        return drivers.make(self._driven(self.params), self.T_s)

    def _driven(self, params: Any) -> Any:
        """Parameters of the driver; a simulated one gets no second gate and no matrices."""
        if not self.simulated:
            return params
        if type(params) is tuple:
            return tuple(map(self._driven, params))
        stage = dataclasses.replace(params.stage, **dict.fromkeys(OURS, ()))
        return dataclasses.replace(params, safety=gate.Params(), stage=stage)

    # Parameters

    def check(self, params: object) -> None:
        """Refuse new parameters that cannot be adopted now.

        Raises
        ------
        ParameterError
            The gate is active and must not adopt them, or they exceed the limits of the device.
        """
        if self.gate.s.state == gate.ACTIVE:
            for old, new in zip(per_axis(self.params), per_axis(params), strict=True):
                gate.refuse_looser(old, new)
        if self.simulated:
            self.driver.designed(self._driven(params))
            return
        self._unlimited(params)
        if self.gate.s.state != gate.UNCONFIGURED:
            self._fit(self.driver, params)

    @staticmethod
    def _unlimited(params: Any) -> None:
        """Refuse a rig without the limits that every rig needs."""
        for own in per_axis(params):
            gate.refuse_unlimited(own)

    def _fit(self, driver: Any, params: Any) -> None:
        """Refuse limits beyond those of the device, or of the driver as it was made.

        This also holds while the device is lost: otherwise it would be refused when it is connected
        again.
        """
        who = "the connection as it was made; clean up and configure again for more"
        channels = getattr(driver, "channels", (driver,))
        made = per_axis(self._made_for)
        for one, before, new in zip(channels, made, per_axis(params), strict=True):
            own = DeviceLimits(before.voltage_min, before.voltage_max, 0.0, 0.0)
            within_device(own, new.voltage_min, new.voltage_max, who)
            within_device(one.limits, new.voltage_min, new.voltage_max, driver.identity)

    def adopt(self, params: object) -> None:
        """Adopt new parameters between two samples; the watchdog gets them before the gate."""
        if self.watchdog is not None:
            self.watchdog.renew(client.command_of(self.driver), self._limits(params))
        self.gate.adopt(params)
        self.params = params
        if self.simulated:
            self.driver.retune(self._driven(params))

    def _limits(self, params: Any) -> Any:
        """Limits of a ramp of the watchdog; with several axes, a tuple of them."""
        if type(params) is tuple:
            return tuple(map(self._limits, params))
        c = gate.design(params.safety, params.voltage_min, params.voltage_max, self.T_s)
        return client.RampLimits(c.voltage_min, c.voltage_max, c.safe, params.safety.slew_rate)

    # Connection

    def connect(self, cause: str) -> str:
        """Connect the driver and start the watchdog; the gate becomes inactive at that voltage.

        Returns
        -------
        str
            Text for the user: identity of the device, first measurement, watchdog.

        Raises
        ------
        ParameterError, DriverError, OSError
            The device does not answer, or does not match the parameters; it is closed again.
        """
        try:
            if self._attempt is None:
                self._made_for = self.params
                with self.bounded(CONNECT):
                    made = self._reach(self._another(), self.params, None, lambda: None)
            else:
                attempt, self._attempt = self._attempt, None
                made = attempt.result()
            self._take(made)
        except Exception as error:
            self.failure = _named(error)
            raise self.failure from None
        u = self.measured.u_applied
        if not self.gate.configure(u, cause):
            self.gate.reset(u, cause)
        y = ", ".join(f"{one * 1e6:.4f}" for one in per_axis(self.measured.y))
        return f"{self.driver.identity}: {y} um, {_volts(u, 3)}; {made.text}"

    def begin(self) -> None:
        """Begin to connect in another thread; `connect` then uses the result."""
        if self._attempt is None:
            self._made_for = self.params
            driver, params = self._another(), self.params
            self._attempt = Attempt(
                lambda attempt: self._reach(driver, params, None, attempt.commit), leave
            )

    @property
    def reaching(self) -> bool:
        """Whether an attempt to reach the device is under way."""
        return self._attempt is not None and not self._attempt.over

    def _another(self, seconds: float = math.inf) -> Any:
        """A new driver with this time (s) to connect; a given or simulated one is used again."""
        if self._given is not None or self.simulated:
            return self.driver
        own = per_axis(self._made_for)
        connect_s = getattr(own[0].driver, "connect_s", 0.0)
        if seconds < connect_s:
            quick = [dataclasses.replace(one.driver, connect_s=seconds) for one in own]
            own = tuple(dataclasses.replace(a, driver=b) for a, b in zip(own, quick, strict=True))
        return drivers.make(own if type(self._made_for) is tuple else own[0], self.T_s)

    def _reach(
        self,
        driver: Any,
        params: object,
        old: Watchdog | None,
        commit: Callable[[], None],
        seconds: float = math.inf,
    ) -> Reached:
        """Connect a driver, read the device, and start a watchdog in place of `old`.

        A device that refuses sooner than in half of the `seconds` that it has is there, and may
        accept one client only. One that is silent may be unplugged: what `old` has sent is lost.
        """
        began = time.monotonic()
        if old is not None and old.hung:
            old.stand_down()  # it never will act; this frees a device that accepts one client only
        try:
            try:
                driver.connect()
            except Exception:
                answered = time.monotonic() - began < 0.5 * seconds
                if old is None or old.state != dog.SAFE or not answered:
                    raise
                old.stand_down()  # it has finished, and keeps the only connection
                driver.connect()
            self._took = time.monotonic() - began
            if not self.simulated:
                self._fit(driver, params)
            self._claims = claim.held()
            commit()  # raises if the attempt was given up; the old watchdog then goes on
            if old is not None:
                old.stand_down()
            measured = Measurement(*driver.read())
            held = self._line_beside(driver, params)
            watchdog, text = self._watch(driver, held, params, measured.u_applied)
        except BaseException:
            with contextlib.suppress(Exception):
                driver.close()
            raise
        return Reached(driver, measured, watchdog, text, params)

    def _line_beside(self, driver: Any, params: Any) -> client.HeldLine:
        """A second connection for the watchdog, if the device still answers the first one."""
        if self._single:
            return client.HeldLine(None, SHARED)
        held = line(lambda: drivers.make(params, self.T_s), driver)
        if held.spare is None:
            return held
        try:
            driver.read()
        except Exception:  # it has dropped the first one
            self._single = True
            held.spare.close()
            driver.close()
            driver.connect()
            return client.HeldLine(None, SHARED)
        return held

    def _watch(
        self, driver: Any, held: client.HeldLine, params: Any, u: Any
    ) -> tuple[Watchdog | None, str]:
        """Start a watchdog before the first command; the device holds u (V) now."""
        watchdog, text = hold(driver, held, self._limits(params), u, self.silence, self._claims)
        return watchdog, text if watchdog is None else f"watchdog holds {text}"

    def _take(self, made: Reached) -> None:
        """Use a connected device, with the present limits.

        Raises
        ------
        ParameterError
            The plant's range has changed since then, and now exceeds that of the device.
        """
        try:
            if made.params is not self.params and not self.simulated:
                self._fit(made.driver, self.params)
                if made.watchdog is not None:
                    made.watchdog.renew(client.command_of(made.driver), self._limits(self.params))
        except Exception:
            leave(made)
            raise
        self.driver, self.watchdog = made.driver, made.watchdog
        self.note(made.measured)
        self.connected, self._unwatched, self._left, self.failure = True, False, False, None

    def _unwatch(self) -> None:
        if self.watchdog is not None:
            self.watchdog.stand_down()
            self.watchdog = None

    def _close(self) -> None:
        if self._line is not None and not self._line.give_up():
            with contextlib.suppress(Exception):
                _hang_up(self._line.result())
        self._line = None
        with contextlib.suppress(Exception), self.bounded(CLOSE):
            self.driver.close()
        self.connected = False

    def lost(self, error: Exception, reason: int = DRIVER) -> None:
        """Leave a device that the driver does not reach to the watchdog; later, connect again."""
        if self._taken_over:  # the driver then reads answers to the watchdog
            limit = self.silence
            about = f"it has taken over: the plant was silent for more than {limit:g} s"
            error, reason = DriverError(about), WATCHDOG
        self.connected = False
        self.failure = _named(error)
        if self.watchdog is not None:
            self.watchdog.present()
            self.watchdog.fire()
        self.gate.trip(reason, str(self.failure))
        self._tell()
        self._left, self._silent = True, False
        self._losses += 1
        self.dial_at, self._dials = time.monotonic() + DIAL_EVERY, 0
        self._close()

    @property
    def _taken_over(self) -> bool:
        """Whether the watchdog acts, or has acted, on a device that the plant drives."""
        watchdog = self.watchdog
        return (
            self.connected
            and watchdog is not None
            and watchdog.state != dog.WATCHING
            and watchdog.alive
        )

    def _look_out(self) -> None:
        """Read the result of the watchdog with a lost device; connect again to bring it to rest.

        The thread that steps waits for neither.
        """
        if self.gate.s.state != gate.FAULT:
            return
        watchdog = self.watchdog
        if watchdog is not None and watchdog.acts:
            return
        if self._left:
            self._left = False
            if watchdog is None:
                about = "no watchdog; the device holds its last voltage"
                self.notes.append(f"{self.failure}: {about}")
            elif watchdog.state == dog.SAFE:
                self.gate.found(self.gate.c.safe)
            else:
                wrong = watchdog.wrong or "the watchdog does not reach the device either"
                self.notes.append(f"{self.failure}: {wrong}; trying again")
        if self._attempt is None:
            if time.monotonic() >= self.dial_at:
                self._redial()
        elif self._attempt.over:
            attempt, self._attempt = self._attempt, None
            try:
                self._take(attempt.result())
            except Exception as error:
                self.failure, self._silent = _named(error), True
                self.dial_at = time.monotonic() + DIAL_EVERY
                return
            self.gate.found(self.measured.u_applied)
            self.notes.append("the device is reached again")

    def _redial(self) -> None:
        """Begin to connect to the device again."""
        seconds = max(AGAIN, 4.0 * self._took) * 2.0 ** min(self._dials, 20)
        self._dials += 1
        try:
            driver, params, old = self._another(seconds), self.params, self.watchdog
            own = per_axis(self._made_for)[0].driver
            seconds = min(seconds, getattr(own, "connect_s", seconds))
        except ParameterError as error:
            self.failure = error
            self.dial_at = time.monotonic() + DIAL_EVERY
            return
        self._attempt = Attempt(
            lambda attempt: self._reach(driver, params, old, attempt.commit, seconds), leave
        )

    @contextlib.contextmanager
    def bounded(self, seconds: float) -> Iterator[None]:
        """Set the deadline of the block to `seconds` from now; a reader of `until` may end it."""
        self.allowed, self.until = seconds, time.monotonic() + seconds
        try:
            yield
        finally:
            self.until = math.inf

    # One sample

    def pace(self, spin: int) -> bool:
        """Wait for the next deadline, spinning for the last `spin` ns; whether it was kept.

        After a missed deadline, the next one is a period after the present time.
        """
        now = pace.now()
        if not self._due:
            self._due = now
        self._due += self.T_ns
        now = pace.wait_until(self._due, spin)
        kept = 0 <= now - self._due <= self.T_ns
        if not kept:
            self._due = now
        return kept

    @property
    def elapsed(self) -> int:
        """Time (ns) since the deadline of this sample."""
        return pace.now() - self._due

    def restart(self) -> None:
        """Start the clock again at the next sample: the time before it is no delay."""
        self._due = self._stepped = 0

    @property
    def silence(self) -> float:
        """Silence of the plant (s) after which the watchdog acts: the shortest of all axes."""
        return min(float(own.safety.watchdog_s) for own in per_axis(self.params))

    def step(self, u: Any, fresh: bool, w: Any) -> bool:
        """One sample: clock, watchdog, gate, driver.

        Parameters
        ----------
        u : float or tuple of float
            Command (V); any value.
        fresh : bool
            Whether u is new since the last sample; if not, u is ignored.
        w : float or tuple of float
            Desired displacement (m); NaN if it is unknown.

        Returns
        -------
        bool
            Whether the device has answered: `measured` is new then.
        """
        now = pace.now()
        elapsed = (now - self._stepped) / self.T_ns if self._stepped else 1.0
        self._stepped = now
        if self.halt_cause:
            self.gate.trip(EMERGENCY_STOP, self.halt_cause)
            self.halt_cause = ""
        self.look_after_watchdog()
        before = self.gate.s.state
        apart = (self._measured_at - self._seen_at) / self.T_ns
        self._seen_at = self._measured_at
        v = self.gate.step(u, fresh, self.measured.y, w, elapsed, apart)
        tripped = before == gate.ACTIVE and self.gate.s.state == gate.FAULT
        if tripped and elapsed > LATE and self.connected and self.watchdog is not None:
            # with such slow samples the ramp would take too long; the watchdog waits for no answer
            self.lost(DriverError(self.gate.cause), self.gate.s.reason)
            return False
        if not self.connected:
            if self.watchdog is not None:
                self.watchdog.present()
            self._look_out()
            return False
        if self.watchdog is not None:
            self.watchdog.tell(v)
        try:
            with self.bounded(self.silence):
                self._push(v)
                measured = self.driver.exchange(v)
            self.note(Measurement(*measured))
        except Exception as error:
            self.lost(error)
            return False
        if now >= self._check_at:
            self._check_at = now + int(CHECK_EVERY * SECOND)
            self._ask()
        return True

    def note(self, measured: Measurement) -> None:
        """Keep a new measurement and its time."""
        self.measured, self._measured_at = measured, pace.now()

    def _push(self, v: Any) -> None:
        """After an error, send v (V) in the driver's `last_resort` form, which the device accepts.

        Raises
        ------
        OSError
            It cannot be sent.
        """
        self._refused = self._refused and self.gate.s.state == gate.FAULT
        refused = self._refused or self.gate.s.reason == DRIVER
        if refused and (data := self.driver.last_resort(v)):
            os.write(self.driver.fileno(), data)

    def _ask(self) -> None:
        """Ask the device for errors."""
        try:
            with self.bounded(self.silence):
                self.driver.check()
        except DriverError as error:
            self.failure, self._refused = error, True  # the gate may have tripped before
            self.gate.trip(DRIVER, str(error))
            self._tell()
            self._look_again()
        except Exception as error:
            self.lost(error)

    def _look_again(self) -> None:
        """Go on from the voltage that the device holds: it may have refused the last commands."""
        try:
            with self.bounded(self.silence):
                self.note(Measurement(*self.driver.read()))
        except Exception as error:
            self.lost(error)
        else:
            self.gate.found(self.measured.u_applied)

    def look_after_watchdog(self) -> None:
        """Trip if the watchdog has ended or acted; start a new one when the stage is at rest."""
        if not self.connected:
            return
        if self.watchdog is not None:
            if self._taken_over:
                self.lost(DriverError("it has taken over"), WATCHDOG)
                return
            if wrong := self.watchdog.wrong:
                if self.gate.s.state == gate.ACTIVE:
                    self.gate.trip(WATCHDOG, wrong)
                self.notes.append(wrong)
                self.watchdog.kill()
                self.watchdog, self._unwatched = None, True
                self.dial_at = 0.0
        if not (self._unwatched and self.gate.at_rest):
            return
        if self._line is None:
            if time.monotonic() >= self.dial_at:
                driver, params = self.driver, self.params
                single = self._single
                self._line = Attempt(
                    lambda attempt: (
                        client.HeldLine(None, SHARED)
                        if single
                        else line(lambda: drivers.make(params, self.T_s), driver)
                    ),
                    _hang_up,
                )
        elif self._line.over:
            attempt, self._line = self._line, None
            try:
                made, text = self._watch(self.driver, attempt.result(), self.params, self.gate.s.u)
            except Exception as error:
                self.notes.append(f"{error}; trying again")
                self.dial_at = time.monotonic() + DIAL_EVERY
            else:
                self.watchdog, self._unwatched = made, False
                self.notes.append(f"a new {text}")

    @property
    def soft_start(self) -> float:
        """Longest soft start (s) from the first sample; the first command comes a sample later."""
        longest = max(
            gate.soft_start(p.safety, p.voltage_min, p.voltage_max) for p in per_axis(self.params)
        )
        return longest + 2.0 * self.T_s if longest else 0.0

    def refusal(self) -> str:
        """Why the gate must not be activated now; empty if it may."""
        if self.gate.s.state != gate.INACTIVE:
            return f"{self.gate.state}: must be inactive"
        if not self.connected:
            return self.unreached
        if self._unwatched or (self.watchdog is not None and self.watchdog.wrong):
            return "there is no watchdog yet"
        return ""

    @property
    def unreached(self) -> str:
        """Why the device is not driven now, and what happens next."""
        why = f" ({self.failure})" if self.failure else ""
        return f"the device is not reached{why}; it is tried again every {DIAL_EVERY:g} s"

    # The end

    def stop(self, cause: str, advance: Callable[[], None] = lambda: time.sleep(POLL)) -> Stopped:
        """Emergency stop: trip, bring the stage to rest, and return the result.

        If no thread steps any more because the device hangs, the watchdog brings it to rest.

        Parameters
        ----------
        cause : str
            Who asks.
        advance : callable
            Steps once, or waits while another thread steps.
        """
        if self.gate.s.state == gate.UNCONFIGURED:
            return Stopped(True, "unconfigured: no device is driven")
        self.halt_cause = cause
        end = time.monotonic() + ANSWER
        while (self.halt_cause or not self.settled) and time.monotonic() < end:
            if self.hangs:
                break
            advance()
        return self.reached()

    def abandon(self) -> None:
        """Leave the device to the watchdog; another thread calls it if the one that steps hangs."""
        text = self.reached().text
        self.gate.trip(DRIVER, text)
        if self.watchdog is not None:
            self.watchdog.leave()

    @property
    def hangs(self) -> bool:
        """Whether the device has not answered for longer than the watchdog waits."""
        return time.monotonic() > self.until

    def reached(self) -> Stopped:
        """Present state of the rig: gate, voltage, and what holds it."""
        watchdog = self.watchdog
        told = f"{self.gate.state}: {self.gate.cause}" if self.gate.cause else self.gate.state
        if self.hangs or self.halt_cause:  # the call of the driver does not return
            if watchdog is not None:
                watchdog.fire()
                if watchdog.done():
                    return Stopped(
                        True, f"the device does not answer; the watchdog has it at {self._safe}"
                    )
            return Stopped(False, "the device does not answer, and holds its last voltage")
        if self.settled and not self.connected and self._silent:  # what was sent may be lost
            why = f"the watchdog has sent {self._safe}, and the device does not answer since"
            return Stopped(False, f"{told}; {why}")
        if self.settled:
            return Stopped(True, f"{told}; {self._safe}")
        if self.connected:
            return Stopped(True, f"{told}; {_volts(self.gate.s.u, 1)}, on the way to {self._safe}")
        return Stopped(False, f"{told}; the device is not reached, and holds its last voltage")

    @property
    def _safe(self) -> str:
        return ", ".join(f"{safe:g}" for safe in per_axis(self.gate.c.safe)) + " V"

    @property
    def _alone(self) -> bool:
        """Whether nobody but this rig would bring a lost device to rest: its watchdog has ended."""
        watchdog = self.watchdog
        lost = self.gate.s.state == gate.FAULT and not self.connected
        return lost and watchdog is not None and not watchdog.alive

    @property
    def settled(self) -> bool:
        """Whether the device has its safe voltage, as far as plant and watchdog know."""
        watched = self.watchdog is not None and self.watchdog.state == dog.SAFE
        return self.gate.s.state == gate.UNCONFIGURED or (
            self.gate.at_rest and (self.connected or watched)
        )

    def rest(self, advance: Callable[[], None] | None = None) -> None:
        """Ramp to the safe voltage; try for a while to connect to a lost device.

        Parameters
        ----------
        advance : callable, optional
            Steps once, for a caller that does more with a sample than `step`.
        """
        rates = [
            (own.voltage_max - own.voltage_min) / own.safety.slew_rate
            for own in per_axis(self.params)
            if own.safety.slew_rate
        ]
        way = max(rates, default=0.0)
        until = time.monotonic() + DIAL_FOR
        end, losses = until + 2.0 * way + CONNECT, self._losses

        def goes_on() -> bool:
            if time.monotonic() > end or self.gate.s.state == gate.UNCONFIGURED:
                return False
            if self._losses - losses > DIALS:  # it connects, and then fails
                return False
            if self.connected:
                return not self.gate.at_rest or not self._heeded()
            tried = self._dials >= DIALS and self._attempt is None
            return time.monotonic() < until or not tried

        self._heed_until = math.inf
        while goes_on():
            if advance is not None:
                advance()
            else:
                self.pace(0)
                self.step(self.nothing, False, self.nothing)

    def _heeded(self) -> bool:
        """Whether a device holds the safe voltage that it was sent, or was sent it long enough."""
        now = time.monotonic()
        self._heed_until = min(self._heed_until, now + HEED)
        told = zip(
            per_axis(self.params),
            per_axis(self.measured.u_applied),
            per_axis(self.gate.c.safe),
            strict=True,
        )
        near = all(
            abs(u - safe) <= dog.NEAR * (p.voltage_max - p.voltage_min) for p, u, safe in told
        )
        return near or now > self._heed_until

    def release(self, cause: str, last: bool = False) -> bool:
        """Close the driver and end the watchdog if the stage is at rest; whether it is.

        A watchdog that still tries to reach the device goes on alone. Where there is none any more,
        a lost device is kept until it is reached again, unless this is the `last` time.
        """
        if self.connected and not self.gate.at_rest:
            return False
        if self._alone and not last:
            return False
        if self._attempt is not None and not self._attempt.give_up():
            return False  # it has just been reached
        self._attempt = None
        # without a connection it is unknown whether the last data have arrived
        if self.watchdog is not None and not (self.connected and self.settled):
            self.watchdog.leave()
            self.watchdog = None
        self._unwatch()
        self._unwatched = False
        self._close()
        self._claims = []
        self.gate.cleanup(cause)
        return True

    def close(self, cause: str) -> None:
        """Ramp down and release; a second call does nothing.

        The watchdog ramps down if the device does not answer, or if a Ctrl-C ends the ramp.
        """
        self.gate.deactivate(cause)
        self.restart()
        try:
            self.rest()
        finally:
            if self.connected and not self.settled and self.watchdog is not None:
                self.watchdog.fire()  # a Ctrl-C has ended the ramp
                self.watchdog.done()
            if not self.settled:
                self.connected = False
            if not self.release(cause):
                self._attempt = None  # its watchdog acts when this process ends
                self.release(cause, last=True)


def _volts(u: Any, digits: int) -> str:
    """Voltages as a text."""
    return ", ".join(f"{one:.{digits}f}" for one in per_axis(u)) + " V"


def leave(made: Reached) -> None:
    """Leave a device that no driver uses to its watchdog."""
    if made.watchdog is not None:
        made.watchdog.leave()
    with contextlib.suppress(Exception):
        made.driver.close()


def _hang_up(made: client.HeldLine) -> None:
    """Close a connection that no watchdog holds."""
    if made.spare is not None:
        made.spare.close()


def _named(error: Exception) -> Exception:
    """Any exception of a driver as an error in one line."""
    if isinstance(error, DriverError | ParameterError):
        return error
    text = " ".join(str(error).split())
    if isinstance(error, OSError):
        return DriverError(text)
    return DriverError(f"{type(error).__name__}: {text}" if text else type(error).__name__)
