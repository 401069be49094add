import dataclasses
import math
import os
import socket

import numpy as np
import pytest

from pea_core.params import ParameterError, build
from pea_plant import drivers
from pea_plant.drivers.driver import DriverError
from pea_plant.drivers.nv200 import emulator
from pea_plant.plant import Params

PATIENT = 20.0
"""Time-out (s) where none is to be tested: the machine may be busy."""

QUICK = emulator.Params(latency_s=0.0, baud=0.0)


def plant(address="tcp://127.0.0.1:23", **values):
    dotted = {name.replace("__", "."): value for name, value in values.items()}
    base = {"driver.type": "nv200", "driver.address": address, "driver.timeout_s": PATIENT}
    return build(Params, {**base, **dotted})


def driver_of(device, **values):
    return drivers.make(plant(device.address, **values), 4e-3)


@pytest.fixture
def device():
    with emulator.make(plant(), QUICK) as emulated:
        yield emulated


@pytest.fixture
def driver(device):
    connected = driver_of(device)
    connected.connect()
    yield connected
    connected.close()


def cycles(driver):
    for _ in range(1000):
        driver.exchange(10.0)


def untouched(device):
    return device.told()["last_voltage_V"] is None


def test_connecting_moves_nothing_and_reads_the_limits(device, driver):
    assert driver.identity == "NV200/D_NET"
    assert driver.limits == pytest.approx((-20.0, 130.0, -10e-6, 30e-6))
    assert untouched(device)


@pytest.mark.parametrize("pipelined", [True, False])
def test_a_cycle_sets_and_tells_what_was_held_until_then(device, pipelined):
    driver = driver_of(device, driver__pipelined=pipelined)
    driver.connect()
    assert driver.exchange(40.0).u_applied == 0.0
    measured = driver.exchange(50.00049)
    assert measured.u_applied == 40.0
    assert math.isnan(measured.y_dot)
    assert device.stage.u == 50.0  # three decimals are sent
    driver.write(60.0)
    assert driver.read().u_applied == 60.0
    driver.check()
    driver.close()


@pytest.mark.parametrize("port", [0, None], ids=["telnet", "pty"])
def test_a_slow_ramp_is_tracked(port):
    with emulator.make(plant(), QUICK, port=port) as device:
        driver = driver_of(device)
        driver.connect()
        u = np.linspace(0.0, 80.0, 41)
        y = np.array([driver.exchange(v).y for v in u])
        driver.check()
        told = device.told()
        come_to_rest = pytest.approx(0.142e-6 * 80.0, rel=0.1)
        assert any(driver.exchange(80.0).y == come_to_rest for _ in range(1000))
        driver.close()
    assert told["max_voltage_V"]["value"] == 80.0
    assert told["max_step_V"]["value"] == pytest.approx(2.0)
    assert told["counts"]["commands"] == len(u)
    assert np.all(np.diff(y) > -0.2e-6)


def test_the_calibration_lies_between_volts_and_numbers():
    rig = {"driver__calibration__amplifier": (1.0, 0.1), "driver__calibration__sensor": (2.0, 0.5)}
    params = dataclasses.replace(QUICK, voltage_min=-2.0, voltage_max=13.0)
    with emulator.make(plant(**rig), params) as device:
        driver = driver_of(device, **rig)
        driver.connect()
        assert driver.limits == pytest.approx((-30.0, 120.0, -3e-6, 17e-6))
        driver.exchange(100.0)
        assert device.held == pytest.approx(11.0)
        assert device.stage.u == pytest.approx(100.0)
        device.inject("stuck")
        assert driver.read().y == pytest.approx(device.stage.reading(), abs=1e-9)
        driver.close()


@pytest.mark.parametrize(
    ("of_device", "of_rig", "says"),
    [
        ({"identity": "SPIBOX"}, {}, r"driver.address = .*'SPIBOX' answers, not an NV200"),
        ({"status": 2}, {}, r"no actuator connected"),
        ({"status": 3 + 1024}, {}, r"temperature too high"),
        ({"status": 1}, {}, r"driver.address = .*no sensor"),
        ({"closed_loop": True}, {}, r"its loop is closed"),
        ({"modsrc": 1}, {}, r"driver.address = .*modsrc is 1"),
        ({"voltage_max": 100.0}, {}, r"^voltage_max = 110: must lie within -20 to 100 V"),
        ({"voltage_min": 0.0}, {}, r"^voltage_min = -20: must lie within 0 to 130 V"),
        ({"position_max": -10.0}, {}, r"a travel of -10 to -10"),
        (
            {},
            {"driver__calibration__sensor": (0.0, 1.0, -0.05)},
            r"driver.calibration.sensor = .*must rise or fall all over -10 to 30",
        ),
    ],
)
def test_what_does_not_fit_is_refused_and_nothing_moves(of_device, of_rig, says):
    made = dataclasses.replace(QUICK, **of_device)
    travel = {"position_max": 30.0} if made.position_max <= made.position_min else {}
    with emulator.make(plant(), dataclasses.replace(made, **travel)) as device:
        device.timing = made
        driver = driver_of(device, **of_rig)
        with pytest.raises(ParameterError, match=says) as refusal:
            driver.connect()
        assert "\n" not in str(refusal.value)
        assert untouched(device)
        assert driver.fileno() == -1


def test_nobody_there_is_bad_input():
    with socket.socket() as unheard:
        unheard.bind(("127.0.0.1", 0))
        driver = drivers.make(plant(f"tcp://127.0.0.1:{unheard.getsockname()[1]}"), 4e-3)
        with pytest.raises(ParameterError, match=r"driver.address = .*is the device on"):
            driver.connect()


def test_a_device_that_says_nothing_is_bad_input(device):
    device.inject("mute")
    driver = driver_of(device, driver__timeout_s=0.1)
    with pytest.raises(ParameterError, match=r"no NV200 answers .*no answer within 0.1 s"):
        driver.connect()


def test_flow_control_of_the_line_would_swallow_the_frames():
    with pytest.raises(ParameterError, match=r"driver.address = .*leave xonxoff out"):
        plant("serial:/dev/ttyUSB0?xonxoff=true")


def test_a_calibration_that_turns_is_refused_before_anything_is_opened():
    with pytest.raises(ParameterError, match=r"driver.calibration.amplifier = .*must rise or fall"):
        drivers.make(plant(driver__calibration__amplifier=(0.0, 1.0, -0.01)), 4e-3)


@pytest.mark.parametrize("u", [math.nan, math.inf, -math.inf, 1e9, -20.001, 110.001])
def test_no_voltage_outside_the_range_is_ever_sent(device, driver, u):
    driver.exchange(10.0)
    for act in (driver.exchange, driver.write, driver.last_resort):
        with pytest.raises(DriverError, match="must be within -20 to 110 V"):
            act(u)
    driver.read()
    assert device.stage.u == 10.0


@pytest.mark.parametrize(
    ("code", "name"), [(2, "unknown command"), (8, "overload"), (10, "parameter too high")]
)
def test_an_error_of_the_device_has_its_name(device, driver, code, name):
    driver.exchange(10.0)
    device.inject(f"error={code}")
    with pytest.raises(DriverError, match=rf"error {code} \({name}\) to 'meas set,20.000'"):
        driver.exchange(20.0)
    assert device.stage.u == 10.0
    assert driver.read().u_applied == 10.0  # read back: the command was not taken
    driver.check()


def test_a_failure_of_the_device_is_found_by_check(device, driver):
    driver.exchange(10.0)
    device.timing = dataclasses.replace(QUICK, status=3 + (1 << 11) + (1 << 12))
    with pytest.raises(DriverError, match="actuator error, hardware error; see to the device"):
        driver.check()


@pytest.mark.parametrize("name", ["garbage", "truncate"])
def test_after_a_bad_answer_the_driver_is_in_step_again(device, name):
    driver = driver_of(device, driver__timeout_s=0.5)
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
    assert measured.u_applied == 30.0
    driver.close()


def test_a_late_answer_is_not_taken_for_the_next(device):
    driver = driver_of(device, driver__timeout_s=0.3)
    driver.connect()
    device.inject("delay=0.5")
    with pytest.raises(DriverError, match=r"no answer within 0.3 s"):
        driver.exchange(10.0)
    device.clear()
    device.inject("jump=3")
    for _ in range(100):  # until the device has caught up
        try:
            assert driver.exchange(10.0).y > 2.9e-6
            break
        except DriverError:
            continue
    else:
        pytest.fail("never in step again")
    driver.close()


@pytest.mark.parametrize("name", ["drop", "pull"])
def test_a_lost_connection_is_a_failure_with_a_reason(device, name):
    driver = driver_of(device, driver__timeout_s=0.3)
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


def test_the_last_resort_is_heard_after_half_a_command(device, driver):
    driver.exchange(80.0)
    data = driver.last_resort(0.0)
    os.write(driver.fileno(), b"set,9" + data)
    driver.read()
    assert device.stage.u == 0.0


def ask(device, text):
    """Answer to some text, by a socket of our own."""
    host, _, port = device.address.removeprefix("tcp://").partition(":")
    found = b""
    with socket.create_connection((host, int(port)), PATIENT) as way:
        way.sendall(text)
        while found.count(b"\x11") < text.count(b"\r\n"):
            found += way.recv(100)
    return found


def test_the_emulator_frames_its_answers(device):
    found = ask(device, b"\r\nset,5\r\nset\r\ncl\r\n")
    assert found.startswith(b"\xff\xfb\x01\xff\xfd\x03")  # options of Telnet come first
    assert found[6:] == (b"\x13NV200/D_NET>\r\n\x11\x13\x11\x13set,5.000\r\n\x11\x13cl,0\r\n\x11")


@pytest.mark.parametrize(
    ("command", "code"),
    [
        (b"foo", 2),
        (b"set,x", 4),
        (b"set,1,2", 5),
        (b"meas,1", 6),
        (b"set,-21", 9),
        (b"set,131", 10),
        (b"set,nan", 9),
    ],
)
def test_the_emulator_has_the_errors_of_the_device(device, command, code):
    assert ask(device, command + b"\r\n")[6:] == b"\x13error,%d\r\n\x11" % code
    assert untouched(device)
