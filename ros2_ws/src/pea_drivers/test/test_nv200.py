import dataclasses
import math
import socket
import time

import pytest

from pea_core.params import ParameterError
from pea_plant.drivers.driver import DriverError

PATIENCE = 20.0


@pytest.fixture
def kind():
    return "nv200"


def test_it_reads_identity_and_limits(driver):
    assert driver.identity == "NV200/D_NET"
    assert driver.limits == pytest.approx((-20.0, 130.0, -10e-6, 30e-6))


@pytest.mark.parametrize("pipelined", [True, False])
def test_a_cycle_sets_and_tells_what_was_held_until_then(bench, device, pipelined):
    driver = bench.driver(device, driver__pipelined=pipelined)
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


def test_the_calibration_lies_between_volts_and_numbers(bench):
    rig = {"driver__calibration__amplifier": (1.0, 0.1), "driver__calibration__sensor": (2.0, 0.5)}
    with bench.emulated(bench.plant(**rig), voltage_min=-2.0, voltage_max=13.0) as device:
        driver = bench.driver(device, **rig)
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
def test_what_does_not_fit_is_refused_and_nothing_moves(bench, of_device, of_rig, says):
    made = dataclasses.replace(bench.quick, **of_device)
    travel = {"position_max": 30.0} if made.position_max <= made.position_min else {}
    with bench.emulated(**{**of_device, **travel}) as device:
        device.timing = made
        bench.refuses(device, says, **of_rig)


def test_flow_control_of_the_line_would_swallow_the_frames(bench):
    with pytest.raises(ParameterError, match=r"driver.address = .*leave xonxoff out"):
        bench.plant("serial:/dev/ttyUSB0?xonxoff=true")


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


def test_a_failure_of_the_device_is_found_by_check(bench, device, driver):
    driver.exchange(10.0)
    device.timing = dataclasses.replace(bench.quick, status=3 + (1 << 11) + (1 << 12))
    with pytest.raises(DriverError, match="actuator error, hardware error; see to the device"):
        driver.check()


def ask(device, text):
    """Answer to some text, by a socket of our own."""
    host, _, port = device.address.removeprefix("tcp://").partition(":")
    found = b""
    with socket.create_connection((host, int(port)), PATIENCE) as way:
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
        (b"set,nan", 4),
    ],
)
def test_the_emulator_has_the_errors_of_the_device(bench, device, command, code):
    assert ask(device, command + b"\r\n")[6:] == b"\x13error,%d\r\n\x11" % code
    assert bench.untouched(device)


@pytest.fixture
def say(device):
    """Frames with which the emulator answers a command, without the greeting."""
    session = device.session()
    session.feed(b"\r\n")

    def asked(text):
        with device.lock:
            return session.feed(text + b"\r\n").strip(b"\x11\x13\r\n")

    return asked


def until(said, wanted):
    end = time.monotonic() + PATIENCE
    while not wanted(found := said()):
        assert time.monotonic() < end, found


def value(answer):
    return float(answer.partition(b",")[2])


@pytest.mark.parametrize(
    ("command", "answer"),
    [
        (b"modsrc,0", b""),
        (b"modsrc,4", b"error,10"),
        (b"modsrc,-1", b"error,9"),
        (b"modsrc,0.5", b"error,4"),
        (b"cl,2", b"error,10"),
        (b"sr,0", b"error,9"),
        (b"sr,2000", b""),
        (b"setlpf,100,1", b"error,5"),
        (b"avmax,100", b"error,6"),
        (b"unitcl,mm", b"error,6"),
        (b"nosuch,1", b"error,2"),
        (b"unitcl", b"unitcl,um"),
        (b"unitol", b"unitol,V"),
        (b"desc", b"desc,EMULATED"),
        (b"acserno", b"acserno,000001"),
        (b"acmeasure", b"acmeasure,1"),
        (b"temp", b"temp,31.200"),
        (b"sr", b"sr,2000"),
        (b"ctrlmode", b"ctrlmode,0"),
        (b"pcf", b"pcf,0.000,0.000,0.000"),
        (b"stat", b"stat,3"),
    ],
)
def test_settings_are_taken_or_refused_as_the_device_does(say, command, answer):
    assert say(command) == answer


def test_what_is_set_is_read_back(say):
    for command in (b"ctrlmode,2", b"kp,1.5", b"setlpon,1", b"pcf,1,2", b"notchf,300"):
        assert say(command) == b""
    assert say(b"ctrlmode") == b"ctrlmode,2"
    assert say(b"kp") == b"kp,1.5"
    assert say(b"pcf") == b"pcf,1.000,2.000,0.000"
    assert int(value(say(b"stat"))) & 1 << 4


def test_in_closed_loop_set_is_a_position(device, say):
    say(b"set,30")
    until(lambda: value(say(b"meas")), lambda y: abs(y - 0.142 * 30.0) < 0.05)
    say(b"cl,1")
    assert value(say(b"set")) == pytest.approx(0.142 * 30.0, abs=0.1)  # it stays where it is
    assert say(b"set,10") == b""
    until(lambda: value(say(b"meas")), lambda y: abs(y - 10.0) < 0.05)
    assert device.stage.u == pytest.approx(10.0 / 0.142, abs=1.0)
    assert say(b"set,31") == b"error,10"
    assert say(b"set,-11") == b"error,9"
    assert say(b"set,29") == b""  # farther than its voltage goes
    until(lambda: int(value(say(b"stat"))), lambda status: status & 1 << 15)
    say(b"cl,0")
    assert value(say(b"set")) == pytest.approx(130.0, abs=0.01)


def test_a_driver_that_meets_a_closed_loop_says_so(device, driver):
    driver.exchange(10.0)
    device.command("cl", ("1",))
    with pytest.raises(DriverError, match="its loop is closed"):
        driver.check()


def test_another_source_of_the_setpoint_keeps_it_until_it_is_left(device, say):
    say(b"modsrc,1")
    assert say(b"set,50") == b""
    assert device.stage.u == 0.0
    say(b"modsrc,0")
    assert device.stage.u == 50.0


def test_the_slew_rate_is_kept(device, say):
    say(b"sr,0.01")  # 15 V/s
    say(b"set,130")
    assert value(say(b"meas")) < 0.142 * 60.0
    say(b"sr,2000")
    until(lambda: value(say(b"meas")), lambda y: y > 0.142 * 125.0)
