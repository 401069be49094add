import contextlib
import math
import os
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest

from pea_core.attempt import Attempt
from pea_core.loop import LoopFault
from pea_core.params import ParameterError
from pea_core.signals import Measurement
from pea_engine import pace
from pea_plant import gate as safety
from pea_plant import plant
from pea_plant import rig as rig_
from pea_plant.alarm import breaking
from pea_plant.driven import Driven
from pea_plant.drivers.driver import DriverError, Limits
from pea_plant.rig import Reached, Rig
from pea_watchdog import client
from pea_watchdog import watchdog as dog

T_s = 1e-3
LIMITS = safety.Params(
    slew_rate=1e4,
    soft_start_rate=1e3,
    beyond=50.0,
    stale_samples=20,
    jump_um=50.0,
    stuck_samples=900,
)
PARAMS = plant.Params(voltage_min=-20.0, voltage_max=100.0, safety=LIMITS)


class Scripted:
    """A driver that notes every voltage and answers with a gain."""

    limits = Limits(-30.0, 130.0, -5e-6, 20e-6)
    identity = "scripted"

    def __init__(self):
        self.u = 3.0
        self.given = []
        self.fails_at = math.inf
        self.closed = self.checked = 0

    def connect(self):
        pass

    def read(self):
        return Measurement(0.142e-6 * self.u, math.nan, self.u)

    def exchange(self, u):
        if len(self.given) >= self.fails_at:
            raise DriverError("no answer")
        measured = self.read()
        self.given.append(u)
        self.u = u
        return measured

    def check(self):
        self.checked += 1

    def last_resort(self, u):
        return b""

    def fileno(self):
        return -1

    def close(self):
        self.closed += 1


@pytest.fixture
def clock(monkeypatch):
    """Time that goes on by one period for each sample that is waited for."""
    t = SimpleNamespace(now=10**9)
    monkeypatch.setattr(pace, "now", lambda: t.now)

    def wait_until(due, spin):
        t.now = due
        return due

    monkeypatch.setattr(pace, "wait_until", wait_until)
    return t


@pytest.fixture
def device(clock):
    driver = Scripted()
    made = Driven(PARAMS, T_s, lambda k: 0.0, driver)
    made.connect()
    return made


def ticks(device, clock, commands):
    for u in commands:
        device.output(0.0)
        device.update(u)
        clock.now += 1_000_000


def test_a_command_acts_one_sample_later(device, clock):
    ticks(device, clock, [4.0] * 3)
    given = device.rig.driver.given
    assert given[0] == 3.0  # nothing is commanded yet: it stays
    assert given[1:] == [4.0, 4.0]  # the soft start may go 1 V a sample


def test_what_is_measured_is_the_driver_s(device, clock):
    ticks(device, clock, [4.0, 4.0])
    y, y_dot, u_applied = device.output(0.0)
    assert (y, u_applied) == (0.142e-6 * 4.0, 4.0)
    assert math.isnan(y_dot)


def test_no_step_is_larger_than_the_slew_rate_allows(device, clock):
    ticks(device, clock, [90.0] * 200)
    steps = [b - a for a, b in zip([3.0, *device.rig.driver.given], device.rig.driver.given)]
    assert max(steps) <= 1.0 + 1e-12  # softly, until the command is reached
    assert device.rig.driver.u == 90.0
    ticks(device, clock, [0.0] * 5)
    assert (
        min(b - a for a, b in zip(device.rig.driver.given, device.rig.driver.given[1:]))
        >= -10.0 - 1e-9
    )


@pytest.mark.parametrize("halted", ["before", "within"])
@pytest.mark.parametrize(("um", "trips"), [(400.0, False), (600.0, True)])
def test_a_jump_counts_from_the_last_measurement(device, clock, monkeypatch, halted, um, trips):
    """The machine stands still for 10 periods, before the device is asked or meanwhile."""
    ticks(device, clock, [3.0] * 3)
    driver, read = device.rig.driver, device.rig.driver.exchange

    def later(u):
        clock.now += 10_000_000 * (halted == "within")
        y, y_dot, held = read(u)
        return Measurement(y + um * 1e-6, y_dot, held)

    monkeypatch.setattr(driver, "exchange", later)
    clock.now += 10_000_000 * (halted == "before")
    ticks(device, clock, [3.0])
    monkeypatch.setattr(driver, "exchange", lambda u: Measurement(um * 1e-6, math.nan, u))
    with contextlib.suppress(LoopFault):  # a trip, and it rests
        ticks(device, clock, [3.0])
    assert (device.rig.gate.reason == "sensor_jump") == trips
    assert (device.rig.gate.state == "active") != trips


@pytest.mark.parametrize(("lost", "ends"), [(0, 0.0), (3, 0.0), (10**9, 10.0)])
def test_the_safe_voltage_is_sent_until_the_device_holds_it(device, clock, lost, ends):
    ticks(device, clock, [20.0] * 200)
    driver, exchange = device.rig.driver, device.rig.driver.exchange
    left = [lost]

    def loses(u):
        """The last commands of the ramp do not arrive; what is held is told all the same."""
        if u < 10.0 and left[0] > 0:
            left[0] -= 1
            return driver.read()
        return exchange(u)

    driver.exchange = loses
    device.close()  # ends, too, where the device never does
    assert driver.u == ends
    assert driver.closed == 1


def test_an_output_is_asked_for_once_a_sample(device):
    first = device.model.output(device.c, device.s, 0.0)
    assert device.model.output(device.c, device.s, 0.0) is first
    assert len(device.rig.driver.given) == 1


def test_a_trip_ramps_down_and_ends_the_loop(device, clock):
    ticks(device, clock, [50.0] * 100)
    device.update(500.0)  # 400 V beyond the range
    with pytest.raises(LoopFault, match="command_range"):
        ticks(device, clock, [50.0] * 100)
    assert device.rig.driver.u == 0.0
    downwards = device.rig.driver.given[-6:]
    assert downwards == sorted(downwards, reverse=True)


def test_an_emergency_stop_ramps_down_and_ends_the_loop(device, clock):
    ticks(device, clock, [20.0] * 60)
    device.rig.stop("asked", lambda: None)
    with pytest.raises(LoopFault, match="emergency_stop"):
        ticks(device, clock, [20.0] * 60)
    assert device.rig.driver.u == 0.0


def test_a_pause_of_the_loop_trips(device, clock):
    ticks(device, clock, [20.0] * 60)
    clock.now += 50 * 1_000_000
    with pytest.raises(LoopFault, match="clock"):
        ticks(device, clock, [20.0] * 60)


def test_a_driver_that_fails_ends_the_loop(device, clock):
    device.rig.driver.fails_at = 5
    with pytest.raises(LoopFault, match="driver: no answer"):
        ticks(device, clock, [4.0] * 10)
    assert device.rig.gate.state == "fault"
    assert device.rig.gate.reason == "driver"


def test_closing_ramps_to_the_safe_voltage_and_releases(device, clock):
    ticks(device, clock, [60.0] * 100)
    device.close()
    given = device.rig.driver.given[100:]
    # once more: the device then says that it holds it
    assert given == pytest.approx([50.0, 40.0, 30.0, 20.0, 10.0, 0.0, 0.0])
    assert device.rig.driver.closed == 1
    assert device.rig.gate.state == "unconfigured"
    device.close()
    assert device.rig.driver.given[100:] == given


@pytest.mark.parametrize("error", [DriverError("no answer"), KeyboardInterrupt()])
def test_the_watchdog_takes_over_a_ramp_that_does_not_end(device, clock, error):
    asked = []
    orders = ("fire", "done", "leave")
    answers = {name: lambda name=name: asked.append(name) for name in orders}
    device.rig.watchdog = SimpleNamespace(
        tell=lambda v: None,
        present=lambda: None,
        state=dog.WATCHING,
        wrong="",
        hung=False,
        alive=True,
        acts=False,
        **answers,
    )

    def fail(*u):
        raise error

    ticks(device, clock, [50.0] * 60)
    device.rig.driver.exchange = fail
    device.rig.driver.connect = lambda: fail() if isinstance(error, Exception) else None
    with contextlib.suppress(KeyboardInterrupt):
        device.close()
    broken_off = ("done",) if isinstance(error, KeyboardInterrupt) else ()
    assert tuple(asked) == ("fire", *broken_off, "leave")
    assert device.rig.driver.closed >= 1


def test_the_device_is_asked_for_errors_now_and_then(device, clock):
    ticks(device, clock, [4.0] * 101)
    assert device.rig.driver.checked == 3  # at 0, 50 and 100 ms


def test_limits_are_not_loosened_while_active(device, clock):
    looser = replace(PARAMS, safety=replace(LIMITS, slew_rate=1e6))
    with pytest.raises(ParameterError, match="looser"):
        device.model.design(looser, T_s)
    tighter = replace(PARAMS, safety=replace(LIMITS, slew_rate=2e3))
    device.adopt(tighter, device.model.design(tighter, T_s))
    ticks(device, clock, [80.0] * 200)
    ticks(device, clock, [0.0] * 3)
    assert device.rig.driver.given[-2] - device.rig.driver.given[-1] == pytest.approx(2.0)


def test_a_rig_without_limits_is_refused():
    with pytest.raises(ParameterError, match=r"safety\.slew_rate"):
        Driven(plant.Params(), T_s, lambda k: 0.0, Scripted())


def test_voltages_that_the_device_has_not_are_refused():
    device = Driven(replace(PARAMS, voltage_max=140.0), T_s, lambda k: 0.0, Scripted())
    with pytest.raises(ParameterError, match="voltage_max = 140"):
        device.connect()
    assert device.rig.driver.closed == 1


def until(true, act, patience=10.0):
    """Act until a condition holds: another thread works for it."""
    end = time.monotonic() + patience
    while not true():
        assert time.monotonic() < end
        act()
        time.sleep(1e-3)


def quick(driver, **limits):
    """A connected rig whose watchdog would wait for 50 ms."""
    safety_ = replace(LIMITS, watchdog_s=0.05, **limits)
    rig = Rig(replace(PARAMS, safety=safety_), T_s, driver)
    rig.connect("test")
    rig.gate.activate("test")
    return rig


def test_a_driver_that_does_not_come_back_is_broken_off():
    near, far = os.pipe()
    driver = Scripted()
    rig = quick(driver)
    driver.exchange = lambda u: os.read(near, 1)
    with breaking(rig):
        assert not rig.step(math.nan, False, math.nan)
    assert rig.gate.cause == "driver: no answer within 0.05 s"
    assert not rig.connected
    os.close(near)
    os.close(far)


@pytest.mark.parametrize(
    "error", [ValueError("no"), KeyError("x"), RuntimeError(), OSError(5, "io")]
)
def test_whatever_a_driver_raises_is_a_lost_device(clock, error):
    driver = Scripted()
    rig = quick(driver)

    def exchange(u):
        raise error

    driver.exchange = exchange
    assert not rig.step(math.nan, False, math.nan)
    assert rig.gate.cause.startswith("driver: ")
    assert rig.gate.state == "fault"


def test_what_is_lost_is_reached_again_and_brought_to_rest(clock, monkeypatch):
    driver = Scripted()
    rig = quick(driver)
    exchange, driver.u = driver.exchange, 40.0

    def fails(u):
        raise DriverError("out")

    driver.exchange = fails
    rig.step(math.nan, False, math.nan)
    driver.exchange = exchange
    rig.dial_at = 0.0
    until(lambda: rig.connected, lambda: rig.step(50.0, True, math.nan))
    for _ in range(20):
        rig.pace(0)
        rig.step(50.0, True, math.nan)
    assert driver.given[0] == 30.0  # from what the device had, at the slew limit
    assert driver.u == 0.0
    assert rig.gate.state == "fault"


def silent(driver, near):
    """Have a driver wait for a device that does not answer, until the other end closes."""

    def wait(*u):
        os.read(near, 1)
        raise DriverError("no answer within 5 s")

    driver.connect = driver.exchange = wait


@pytest.fixture
def unreached(clock):
    """A rig that has lost a device, and is dialling it in vain."""
    near, far = os.pipe()
    driver = Scripted()
    rig = quick(driver)
    rig.lost(DriverError("out"))
    silent(driver, near)
    rig.dial_at = 0.0
    until(lambda: rig.reaching, lambda: rig.step(math.nan, False, math.nan))
    yield rig
    os.close(far)
    until(lambda: not rig.reaching, lambda: None)
    os.close(near)


def test_no_sample_waits_for_a_device_that_is_dialled(unreached):
    for _ in range(100):
        assert not unreached.step(math.nan, False, math.nan)
    assert unreached.reaching
    assert "not reached (out); it is tried again" in unreached.unreached


def test_a_device_that_is_lost_keeps_its_limits(unreached):
    """Else it would be refused for them once it is reached again."""
    with pytest.raises(ParameterError, match=r"voltage_min = -2000: .* clean up and configure"):
        unreached.check(replace(unreached.params, voltage_min=-2000.0))
    unreached.check(replace(unreached.params, voltage_min=-10.0))


def test_a_stop_does_not_wait_for_it_nor_say_that_the_stage_is_safe(unreached):
    stopped = unreached.stop("test", lambda: unreached.step(math.nan, False, math.nan))
    assert not stopped.safe
    assert "not reached" in stopped.text
    assert unreached.reaching


def test_a_stop_does_not_believe_what_a_silent_device_was_sent(clock):
    """The watchdog has sent it; the plant has asked since, in vain."""
    driver = Scripted()
    rig = quick(driver)
    rig.watchdog = SimpleNamespace(
        state=dog.SAFE,
        alive=True,
        wrong="",
        hung=False,
        fire=lambda: None,
        present=lambda: None,
        acts=False,
        stand_down=lambda: None,
    )

    def fails(*u):
        raise DriverError("no answer")

    driver.connect = driver.exchange = fails
    rig.lost(DriverError("out"))
    rig.dial_at = math.inf
    rig.step(math.nan, False, math.nan)
    assert rig.stop("test", lambda: rig.step(math.nan, False, math.nan)).safe
    rig.dial_at = 0.0
    until(lambda: str(rig.failure) == "no answer", lambda: rig.step(math.nan, False, math.nan))
    stopped = rig.stop("test", lambda: rig.step(math.nan, False, math.nan))
    assert not stopped.safe
    assert stopped.text.endswith("the watchdog has sent 0 V, and the device does not answer since")


def test_a_clean_up_does_not_wait_for_it(unreached):
    driver = unreached.driver
    assert unreached.release("test")
    assert unreached.gate.state == "unconfigured"
    for _ in range(5):
        unreached.step(math.nan, False, math.nan)
    assert driver.closed
    assert not unreached.connected


def test_an_end_gives_up_a_device_that_is_silent(unreached, monkeypatch):
    """Not before `DIAL_FOR`, not after an attempt that may take for ever."""
    monkeypatch.setattr("pea_plant.rig.DIAL_FOR", 0.05)
    monkeypatch.setattr("pea_plant.rig.CONNECT", 0.05)
    unreached.close("test")
    assert unreached.gate.state == "unconfigured"


def test_connecting_waits_for_nobody_either(clock):
    driver = Scripted()
    rig = Rig(PARAMS, T_s, driver)
    near, far = os.pipe()
    connect = driver.connect
    driver.connect = lambda: os.read(near, 1)
    rig.begin()
    for _ in range(10):
        assert not rig.step(math.nan, False, math.nan)
    assert rig.reaching
    os.write(far, b"x")
    until(lambda: not rig.reaching, lambda: None)
    assert rig.connect("test").startswith("scripted")
    assert rig.gate.state == "inactive"
    driver.connect = connect
    os.close(near)
    os.close(far)


def test_what_is_reached_when_nobody_wants_it_is_left_to_its_watchdog():
    left, go = [], threading.Event()
    made = Reached(Scripted(), None, SimpleNamespace(leave=lambda: left.append(1)), "", None)
    attempt = Attempt(lambda attempt: go.wait() and made, rig_.leave)
    assert attempt.give_up()
    go.set()
    until(lambda: left, lambda: None)
    assert made.driver.closed


def test_an_attempt_that_has_reached_the_device_is_not_given_up():
    reached, go = threading.Event(), threading.Event()

    def work(attempt):
        attempt.commit()
        reached.set()
        go.wait()
        return "made"

    attempt = Attempt(work, lambda made: pytest.fail("undone"))
    reached.wait()
    assert not attempt.give_up()
    go.set()
    until(lambda: attempt.over, lambda: None)
    assert attempt.result() == "made"


def test_nothing_reconnects_after_a_clean_up(clock):
    driver = Scripted()
    rig = quick(driver)
    rig.gate.deactivate("test")
    rig.rest()
    assert rig.release("cleanup")
    driver.connect = None  # would raise
    for _ in range(5):
        rig.pace(0)
        assert not rig.step(5.0, True, math.nan)
    assert rig.gate.state == "unconfigured"
    assert rig.stop("test").safe


def test_the_watchdog_s_copies_are_renewed_before_the_limits_act(clock):
    rig = quick(Scripted())
    renewed = []

    def renew(command, limits):
        renewed.append((limits, rig.gate.params.safety.slew_rate))

    rig.watchdog = SimpleNamespace(renew=renew)
    tighter = replace(
        rig.params, voltage_max=60.0, safety=replace(rig.params.safety, slew_rate=300.0)
    )
    rig.check(tighter)
    rig.adopt(tighter)
    assert renewed == [(client.RampLimits(-20.0, 60.0, 0.0, 300.0), 1e4)]


def test_without_a_watchdog_nothing_is_activated(clock):
    rig = quick(Scripted())
    wrong = SimpleNamespace(
        state=dog.WATCHING, alive=False, wrong="the watchdog has ended", kill=lambda: None
    )
    rig.watchdog = wrong
    rig.gate.found(20.0)
    rig.step(20.0, True, math.nan)
    assert rig.gate.cause == "watchdog: the watchdog has ended"
    rig.gate.reset(rig.gate.s.u, "test")
    assert rig.refusal() == "there is no watchdog yet"
    until(lambda: not rig.refusal(), lambda: (rig.pace(0), rig.step(math.nan, False, math.nan)))
    assert rig.gate.at_rest  # a new one, or none where there is no connection


def test_what_the_watchdog_has_done_is_not_undone(clock):
    """A plant that was stopped meanwhile connects anew, and goes on from what the device has."""
    driver = Scripted()
    rig = quick(driver)
    rig.gate.found(50.0)
    driver.u = 50.0
    driver.given.clear()
    rig.watchdog = SimpleNamespace(
        state=dog.SAFE, alive=True, wrong="", fire=lambda: None, present=lambda: None, acts=False
    )
    assert not rig.step(50.0, True, math.nan)
    assert not driver.given
    assert rig.gate.reason == "watchdog"
    rig.pace(0)
    assert not rig.step(50.0, True, math.nan)
    assert not driver.given
    assert rig.gate.s.u == 0.0


def test_what_a_plant_hears_of_its_watchdog_is_no_fault_of_the_device(clock):
    """It was stopped in the middle of an exchange: what comes are answers to the watchdog."""
    driver = Scripted()
    rig = quick(driver)
    rig.watchdog = SimpleNamespace(
        state=dog.WATCHING,
        alive=True,
        wrong="",
        hung=False,
        fire=lambda: None,
        present=lambda: None,
        tell=lambda u: None,
        acts=False,
    )

    def stopped_meanwhile(u):
        rig.watchdog.state = dog.SAFE
        raise DriverError("'>' answers nothing that was asked; who else is connected?")

    driver.exchange = stopped_meanwhile
    assert not rig.step(0.0, True, math.nan)
    assert rig.gate.reason == "watchdog"
    assert "taken over" in rig.gate.cause


@pytest.fixture
def kind():
    return "gcs"


@pytest.mark.parametrize("before", [None, safety.CONTROLLERS])
def test_a_device_that_refuses_is_brought_to_rest_whatever_has_tripped(bench, before):
    """Its servo comes on while the stage ramps: plain commands are refused from then on."""
    with bench.emulated() as device:
        limits = {"safety__slew_rate": 1e3, "safety__soft_start_rate": 1e3, "safety__beyond": 50.0}
        others = {
            "safety__stale_samples": 10**5,
            "safety__stuck_samples": 10**5,
            "safety__watchdog_s": 5.0,
        }
        rig = Rig(bench.plant(device.address, **limits, **others, safety__jump_um=50.0), 2e-3)
        rig.connect("test")
        assert rig.gate.activate("test")
        end = time.monotonic() + 20.0

        def steps(until):
            while not until() and time.monotonic() < end:
                rig.pace(0)
                rig.step(40.0, True, math.nan)

        steps(lambda: rig.gate.s.u > 30.0)
        if before is not None:
            rig.gate.trip(before)
        device.inject("error=79")
        steps(lambda: device.axes["1"].servo)
        steps(lambda: not device.axes["1"].servo and abs(device.stage.u) < 0.01)
        held = device.stage.u
        state = rig.gate.state
        rig.close("test")
    assert state == "fault"
    assert abs(held) < 0.01
