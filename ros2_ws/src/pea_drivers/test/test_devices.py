"""What every driver of a device does, whatever its protocol."""

import math
import os
import socket
import time

import numpy as np
import pytest

from pea_core.params import ParameterError
from pea_plant.drivers.driver import DriverError

PATIENCE = 20.0
STEP = 2e-5
"""Volts that a digit of the wire is worth, at most."""


def near(u):
    return pytest.approx(u, abs=STEP)


def settles(driver, y):
    """Wait until the stage has come to y (m)."""
    end = time.monotonic() + PATIENCE
    while driver.read().y != pytest.approx(y, rel=0.1):
        assert time.monotonic() < end


def cycles(driver):
    for _ in range(1000):
        driver.exchange(10.0)


def test_connecting_moves_nothing_and_tells_what_is_held(bench, device, driver):
    assert driver.read().u_applied == near(0.0)
    assert bench.untouched(device)
    low, high, _, _ = driver.limits
    assert low <= -20.0
    assert high >= 110.0


def test_a_cycle_commands_and_tells_what_was_held_until_then(device, driver):
    assert driver.exchange(40.0).u_applied == near(0.0)
    measured = driver.exchange(50.0)
    assert measured.u_applied == near(40.0)
    assert math.isnan(measured.y_dot)
    assert device.stage.u == near(50.0)
    driver.write(60.0)
    assert driver.read().u_applied == near(60.0)
    driver.check()


def test_a_slow_ramp_is_tracked(device, driver):
    u = np.linspace(0.0, 80.0, 41)
    y = np.array([driver.exchange(v).y for v in u])
    driver.check()
    told = device.told()
    assert told["max_voltage_V"]["value"] == near(80.0)
    assert told["max_step_V"]["value"] == near(2.0)
    assert told["counts"]["commands"] == len(u)
    assert np.all(np.diff(y) > -0.2e-6)
    settles(driver, 0.142e-6 * 80.0)


def test_nobody_there_is_bad_input(bench):
    with socket.socket() as unheard:
        unheard.bind(("127.0.0.1", 0))
        driver = bench.make(f"tcp://127.0.0.1:{unheard.getsockname()[1]}")
        with pytest.raises(ParameterError, match=r"^driver.address = .*refused; is the device on"):
            driver.connect()


def test_a_device_that_says_nothing_is_bad_input(bench, device):
    device.inject("mute")
    says = r"^driver.address = .*no .* answers .*no answer within 0.2 s"
    bench.refuses(device, says, driver__connect_s=0.2)


def test_something_else_there_is_bad_input(bench):
    other = type(bench)("nv200" if bench.kind == "modbus_daq" else "modbus_daq")
    with other.emulated() as device:
        bench.refuses(device, r"^driver.address = .* answers", driver__connect_s=0.3)


def test_a_calibration_that_turns_is_refused_before_anything_is_opened(bench):
    with pytest.raises(ParameterError, match=r"driver.calibration.amplifier = .*must rise or fall"):
        bench.make(driver__calibration__amplifier=(0.0, 1.0, -0.01))


@pytest.mark.parametrize("u", [math.nan, math.inf, -math.inf, 1e9, -20.001, 110.001])
def test_no_voltage_outside_the_range_is_ever_sent(device, driver, u):
    driver.exchange(10.0)
    for act in (driver.exchange, driver.write, driver.last_resort):
        with pytest.raises(DriverError, match="must be within -20 to 110 V"):
            act(u)
    driver.read()
    assert device.stage.u == near(10.0)


@pytest.mark.parametrize("name", ["garbage", "truncate"])
def test_after_a_bad_answer_the_driver_is_in_step_again(bench, device, name):
    driver = bench.driver(device, driver__timeout_s=1.0)
    driver.connect()
    device.inject(name)
    with pytest.raises(DriverError):
        driver.exchange(10.0)
    driver.check()
    for u in (20.0, 30.0):
        driver.exchange(u)
    device.inject("stuck")
    measured = driver.read()
    assert measured.y == pytest.approx(device.stage.reading(), abs=1e-9)
    assert measured.u_applied == near(30.0)
    driver.close()


def test_a_late_answer_is_not_taken_for_the_next(bench, device):
    driver = bench.driver(device, driver__timeout_s=0.3)
    driver.connect()
    device.inject("delay=0.5")
    with pytest.raises(DriverError, match=r"no answer within 0.3 s"):
        driver.exchange(10.0)
    device.clear()
    device.inject("jump=3")
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:  # until the device has caught up
        try:
            assert driver.exchange(10.0).y > 2.9e-6
            break
        except DriverError:
            continue
    else:
        pytest.fail("never in step again")
    driver.close()


@pytest.mark.parametrize("name", ["drop", "pull"])
def test_a_lost_connection_is_a_failure_with_a_reason(bench, device, name):
    driver = bench.driver(device, driver__timeout_s=0.1)
    driver.connect()
    device.inject(name)
    with pytest.raises(DriverError, match=r"^tcp://127.0.0.1:\d+: .*check"):
        cycles(driver)
    with pytest.raises(DriverError):
        driver.check()
    driver.close()


def test_a_stuck_and_a_saturated_device_tell_no_errors(device, driver):
    driver.exchange(10.0)
    device.inject("stuck")
    device.inject("saturate=30")
    assert len({driver.exchange(u).y for u in np.linspace(20.0, 60.0, 50)}) == 1
    driver.check()
    assert device.told()["max_voltage_V"]["value"] == 30.0


BEGUN = {"gcs": b"SVA 1 9", "nv200": b"set,9", "modbus_daq": b""}
"""A command that breaks off; Modbus has no way to begin anew within a frame."""


def test_the_last_resort_is_heard_after_half_a_command(bench, device, driver):
    driver.exchange(80.0)
    os.write(driver.fileno(), BEGUN[bench.kind] + driver.last_resort(0.0))
    driver.read()
    assert device.stage.u == near(0.0)


def test_the_last_resort_of_a_connection_that_is_closed_is_the_same(bench, device, driver):
    """Limits that change while a device is lost are renewed for who still holds it."""
    held = os.dup(driver.fileno())
    driver.exchange(80.0)
    driver.close()
    assert os.write(held, driver.last_resort(0.0))
    end = time.monotonic() + 10.0
    while device.stage.u != near(0.0):
        assert time.monotonic() < end
        time.sleep(1e-3)
    os.close(held)
