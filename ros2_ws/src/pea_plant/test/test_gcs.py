import dataclasses
import math
import random
import socket
import time

import pytest

from pea_core.params import ParameterError, build
from pea_plant import drivers
from pea_plant.drivers.driver import DriverError
from pea_plant.drivers.gcs import device as gcs_device
from pea_plant.drivers.gcs import emulator
from pea_plant.plant import Params

PATIENT = 20.0
"""Time-out (s) where none is to be tested: the machine may be busy."""


def plant(address="tcp://127.0.0.1:50000", **values):
    dotted = {name.replace("__", "."): value for name, value in values.items()}
    base = {"driver.type": "gcs", "driver.address": address, "driver.timeout_s": PATIENT}
    return build(Params, {**base, **dotted})


@pytest.fixture
def device():
    with emulator.make(plant(), emulator.Params(latency_s=0.0)) as emulated:
        yield emulated


def driver_of(device, **values):
    return drivers.make(plant(device.address, **values), 5e-4)


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
    assert "E-727" in driver.identity
    assert driver.limits == pytest.approx((-30.0, 130.0, -10e-6, 25e-6))
    assert untouched(device)


def test_a_cycle_commands_and_tells_what_was_held_until_then(device, driver):
    assert driver.exchange(40.0).u_applied == 0.0
    measured = driver.exchange(50.0)
    assert measured.u_applied == 40.0
    assert math.isnan(measured.y_dot)
    assert device.stage.u == 50.0
    driver.write(60.0)
    assert driver.read().u_applied == 60.0
    driver.check()


def test_the_displacement_follows(device, driver):
    for _ in range(100):
        measured = driver.exchange(100.0)
    assert measured.y == pytest.approx(device.stage.reading(), abs=1e-7)
    assert measured.y > 1e-6


def test_the_calibration_lies_between_volts_and_numbers():
    rig = {"driver__calibration__amplifier": (1.0, 0.1), "driver__calibration__sensor": (2.0, 0.5)}
    params = emulator.Params(latency_s=0.0, command_min=-2.0, command_max=13.0)
    with emulator.make(plant(**rig), params) as device:
        driver = driver_of(device, **rig)
        driver.connect()
        assert driver.limits == pytest.approx((-30.0, 120.0, -3e-6, 14.5e-6))
        assert driver.read().u_applied == pytest.approx(-10.0)  # the controller holds 0
        for _ in range(100):
            driver.exchange(100.0)
        assert device.axes["1"].command == pytest.approx(11.0)
        assert device.stage.u == pytest.approx(100.0)
        assert driver.read().y == pytest.approx(device.stage.reading(), abs=1e-7)
        driver.close()


def test_it_speaks_over_a_pty_too():
    with emulator.make(plant(), emulator.Params(latency_s=0.0), port=None) as device:
        driver = driver_of(device)
        driver.connect()
        driver.exchange(30.0)
        assert driver.read().u_applied == 30.0
        assert device.stage.u == 30.0
        driver.close()


@pytest.mark.parametrize(
    ("of_device", "of_rig", "says"),
    [
        ({}, {"driver__axis": "7"}, r"driver.axis = '7': .*E-727.* has 1"),
        ({"axes": "A B"}, {}, r"driver.axis = '1': .* has A, B"),
        ({"identity": "ACME 3000"}, {}, r"driver.device = '': .*ACME 3000"),
        ({}, {"driver__device": "E-709"}, r"driver.device = 'E-709': .*E-727"),
        ({"version": 1.0}, {}, r"speaks GCS 1; must be 2.0"),
        ({"servo": True}, {}, r"its servo is on"),
        ({"command_max": 100.0}, {}, r"^voltage_max = 110: must lie within -30 to 100 V"),
        ({"command_min": 0.0}, {}, r"^voltage_min = -20: must lie within 0 to 130 V"),
        ({"travel_min": 5.0, "travel_max": 4.0}, {}, r"is a stage connected"),
        ({"tells_voltage": False}, {}, r"driver.command_max = 0: .* does not tell"),
        (
            {},
            {"driver__calibration__sensor": (0.0, 1.0, -0.05)},
            r"driver.calibration.sensor = .*must rise or fall all over -10 to 25",
        ),
    ],
)
def test_what_does_not_fit_is_refused_and_nothing_moves(of_device, of_rig, says):
    params = dataclasses.replace(emulator.Params(latency_s=0.0), **of_device)
    with emulator.make(plant(), params) as device:
        driver = driver_of(device, **of_rig)
        with pytest.raises(ParameterError, match=says) as refusal:
            driver.connect()
        assert "\n" not in str(refusal.value)
        assert untouched(device)
        assert driver.fileno() == -1


def test_limits_come_from_the_rig_where_the_controller_does_not_tell():
    params = emulator.Params(latency_s=0.0, tells_voltage=False)
    with emulator.make(plant(), params) as device:
        driver = driver_of(device, driver__command_min=-25.0, driver__command_max=115.0)
        driver.connect()
        assert driver.limits[:2] == (-25.0, 115.0)
        driver.check()  # the question that was not known has left no error
        driver.close()


def test_a_calibration_that_turns_is_refused_before_anything_is_opened():
    with pytest.raises(ParameterError, match=r"driver.calibration.amplifier = .*must rise or fall"):
        drivers.make(plant(driver__calibration__amplifier=(0.0, 1.0, -0.01)), 5e-4)


def test_nobody_there_is_bad_input():
    with socket.socket() as unheard:
        unheard.bind(("127.0.0.1", 0))
        driver = drivers.make(plant(f"tcp://127.0.0.1:{unheard.getsockname()[1]}"), 5e-4)
        with pytest.raises(ParameterError, match=r"driver.address = .*refused; is the device on"):
            driver.connect()


def test_a_device_that_says_nothing_is_bad_input(device, monkeypatch):
    monkeypatch.setattr(gcs_device, "PATIENCE", 0.2)
    device.inject("mute")
    driver = driver_of(device, driver__timeout_s=0.1)
    with pytest.raises(ParameterError, match=r"no answer within 0.2 s"):
        driver.connect()


@pytest.mark.parametrize(
    "address",
    [
        "",
        "127.0.0.1:50000",
        "udp://127.0.0.1:5",
        "tcp://127.0.0.1",
        "tcp://:5",
        "tcp://h:99999",
        "tcp://h:5/x",
        "serial:ttyUSB0",
        "serial:/dev/x?baud=fast",
        "serial:/dev/x?boud=9600",
    ],
)
def test_what_is_no_address_is_refused_in_one_line(address):
    with pytest.raises(ParameterError, match=r"^driver.address = "):
        plant(address)


def test_a_line_that_is_not_there_is_bad_input():
    driver = drivers.make(plant("serial:/dev/no_such_line"), 5e-4)
    with pytest.raises(ParameterError, match=r"driver.address = .*no such file.*plugged in"):
        driver.connect()


@pytest.mark.parametrize("u", [math.nan, math.inf, -math.inf, 1e9, -20.001, 110.001])
def test_no_voltage_outside_the_range_is_ever_sent(device, driver, u):
    driver.exchange(10.0)
    with pytest.raises(DriverError, match="must be within -20 to 110 V"):
        driver.exchange(u)
    with pytest.raises(DriverError):
        driver.write(u)
    with pytest.raises(DriverError):
        driver.last_resort(u)
    driver.read()
    assert device.stage.u == 10.0


@pytest.mark.parametrize(
    ("code", "name"), [(10, "stopped by command"), (17, "out of range"), (79, "servo is on")]
)
def test_an_error_of_the_controller_has_its_name(device, driver, code, name):
    device.inject(f"error={code}")
    driver.exchange(10.0)  # the answer to the question comes all the same
    with pytest.raises(DriverError, match=rf"error {code}, .*{name}"):
        driver.check()
    assert untouched(device)


def test_a_servo_that_comes_on_refuses_all_commands(device, driver):
    device.inject("error=79")
    for _ in range(3):
        driver.exchange(10.0)
    with pytest.raises(DriverError, match="error 79"):
        driver.check()
    assert untouched(device)


@pytest.mark.parametrize("name", ["garbage", "truncate"])
def test_after_a_bad_answer_the_driver_is_in_step_again(device, name):
    driver = driver_of(device, driver__timeout_s=0.3)
    driver.connect()
    device.inject(name)
    with pytest.raises(DriverError):
        driver.exchange(10.0)
    driver._transport.timeout = 2.0  # the machine may be busy
    driver.check()
    for u in (20.0, 30.0):
        driver.exchange(u)
    end = time.monotonic() + 20.0  # the stage is still on its way
    while abs(driver.read().y - device.stage.reading()) > 1e-8:
        assert time.monotonic() < end
    driver.close()


def test_a_late_answer_is_not_taken_for_the_next(device):
    driver = driver_of(device, driver__timeout_s=0.3)
    driver.connect()
    device.inject("delay=0.5")
    with pytest.raises(DriverError, match=r"no answer within 0.3 s"):
        driver.exchange(10.0)
    device.clear()
    device.inject("jump=3")
    driver._transport.timeout = PATIENT
    assert driver.exchange(10.0).y > 2.9e-6
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


def test_the_last_resort_is_heard_after_half_a_command(device, driver):
    driver.exchange(80.0)
    data = driver.last_resort(0.0)
    with socket.socket(fileno=socket.dup(driver.fileno())) as way:
        way.sendall(b"SVA 1 9" + data)
    driver.read()
    assert device.stage.u == 0.0


def ask(device, text, ends):
    """Answer to some text, by a socket of our own."""
    host, _, port = device.address.removeprefix("tcp://").partition(":")
    found = b""
    with socket.create_connection((host, int(port)), PATIENT) as way:
        way.sendall(text)
        while found.count(b"\n") < ends:
            found += way.recv(100)
    return found


def test_no_bytes_break_the_emulator(device):
    rng = random.Random(1)
    words = [b"SVA", b"POS?", b"SVO", b"ERR?", b"1", b"-9.5", b"1e999", b"nan", b"\n", b"\x81", b""]
    session = device.session()
    for _ in range(2000):
        joined = b" ".join(rng.choices(words, k=6)) + b"\n"
        answer = session.feed(joined if rng.random() < 0.7 else rng.randbytes(50))
        assert len(answer) < 1000
    assert -30.0 <= device.stage.u <= 130.0


def test_the_emulator_answers_as_the_manual_says():
    with emulator.make(plant(), emulator.Params(axes="1 2 X")) as device:
        assert ask(device, b"SAI?\n", 3) == b"1 \n2 \nX\n"
        assert ask(device, b"svo? 1 X\n", 2) == b"1=0 \nX=0\n"
        assert ask(device, b"CSV?\nERR?\n", 2) == b"2.0\n0\n"


@pytest.mark.parametrize(
    ("command", "code"),
    [
        (b"SVA 1", 1),
        (b"SVA 1 x", 1),
        (b"FOO 1", 2),
        (b"MOV 1 3", 5),
        (b"SVO 1 1\nMOV 1 9999", 7),
        (b"STP", 10),
        (b"SVA 1 1000", 17),
        (b"SVA 9 1", 23),
        (b"SVO 1 1\nSVA 1 5", 79),
    ],
)
def test_the_emulator_has_the_errors_of_the_manual(device, command, code):
    assert ask(device, command + b"\nERR?\nERR?\n", 2) == b"%d\n0\n" % code
    assert untouched(device)
