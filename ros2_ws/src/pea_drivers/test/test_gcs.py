import random
import socket
import time

import pytest

from pea_core.params import ParameterError
from pea_plant.drivers.driver import DriverError

PATIENCE = 20.0


@pytest.fixture
def kind():
    return "gcs"


def test_it_reads_identity_and_limits(driver):
    assert "E-727" in driver.identity
    assert driver.limits == pytest.approx((-30.0, 130.0, -10e-6, 25e-6))


def test_the_calibration_lies_between_volts_and_numbers(bench):
    rig = {"driver__calibration__amplifier": (1.0, 0.1), "driver__calibration__sensor": (2.0, 0.5)}
    with bench.emulated(bench.plant(**rig), command_min=-2.0, command_max=13.0) as device:
        driver = bench.driver(device, **rig)
        driver.connect()
        assert driver.limits == pytest.approx((-30.0, 120.0, -3e-6, 14.5e-6))
        assert driver.read().u_applied == pytest.approx(-10.0)  # the controller holds 0
        for _ in range(100):
            driver.exchange(100.0)
        assert device.axes["1"].command == pytest.approx(11.0)
        assert device.stage.u == pytest.approx(100.0)
        assert driver.read().y == pytest.approx(device.stage.reading(), abs=1e-7)
        driver.close()


def test_it_speaks_over_a_pty_too(bench):
    with bench.emulated(port=None) as device:
        driver = bench.driver(device)
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
def test_what_does_not_fit_is_refused_and_nothing_moves(bench, of_device, of_rig, says):
    with bench.emulated(**of_device) as device:
        bench.refuses(device, says, **of_rig)


def test_limits_come_from_the_rig_where_the_controller_does_not_tell(bench):
    with bench.emulated(tells_voltage=False) as device:
        driver = bench.driver(device, driver__command_min=-25.0, driver__command_max=115.0)
        driver.connect()
        assert driver.limits[:2] == (-25.0, 115.0)
        driver.check()  # the question that was not known has left no error
        driver.close()


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
def test_what_is_no_address_is_refused_in_one_line(bench, address):
    with pytest.raises(ParameterError, match=r"^driver.address = "):
        bench.plant(address)


def test_a_line_that_is_not_there_is_bad_input(bench):
    driver = bench.make("serial:/dev/no_such_line")
    with pytest.raises(ParameterError, match=r"driver.address = .*no such file.*plugged in"):
        driver.connect()


@pytest.mark.parametrize(
    ("code", "name"), [(10, "stopped by command"), (17, "out of range"), (79, "servo is on")]
)
def test_an_error_of_the_controller_has_its_name(bench, device, driver, code, name):
    device.inject(f"error={code}")
    driver.exchange(10.0)  # the answer to the question comes all the same
    with pytest.raises(DriverError, match=rf"error {code}, .*{name}"):
        driver.check()
    assert bench.untouched(device)


def test_a_servo_that_comes_on_refuses_all_commands(bench, device, driver):
    device.inject("error=79")
    for _ in range(3):
        driver.exchange(10.0)
    with pytest.raises(DriverError, match="error 79"):
        driver.check()
    assert bench.untouched(device)


def ask(device, text, ends):
    """Answer to some text, by a socket of our own."""
    host, _, port = device.address.removeprefix("tcp://").partition(":")
    found = b""
    with socket.create_connection((host, int(port)), PATIENCE) as way:
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


def test_the_emulator_answers_as_the_manual_says(bench):
    with bench.emulated(axes="1 2 X") as device:
        assert ask(device, b"SAI?\n", 3) == b"1 \n2 \nX\n"
        assert ask(device, b"svo? 1 X\n", 2) == b"1=0 \nX=0\n"
        assert ask(device, b"CSV?\nERR?\n", 2) == b"2.0\n0\n"


def test_an_error_of_whoever_was_here_before_does_no_harm(bench, device):
    ask(device, b"FOO 1\nCSV?\n", 1)
    driver = bench.driver(device)
    driver.connect()
    assert driver.limits[:2] == (-30.0, 130.0)
    driver.close()


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
def test_the_emulator_has_the_errors_of_the_manual(bench, device, command, code):
    assert ask(device, command + b"\nERR?\nERR?\n", 2) == b"%d\n0\n" % code
    assert bench.untouched(device)


@pytest.fixture
def say(bench):
    """What the emulator of two axes answers, on one connection."""
    with bench.emulated(axes="1 2") as device:
        session = device.session()
        yield lambda data: session.feed(data)


@pytest.mark.parametrize("end", [b"", b"\n"])
@pytest.mark.parametrize(
    ("byte", "answer"), [(b"\x05", b"0\n"), (b"\x07", b"\xb1\n"), (b"\x18", b"")]
)
def test_a_single_byte_eats_no_line(say, byte, answer, end):
    assert say(byte + end + b"SVA 1 20\nSVA? 1\n") == answer + b"1=20.000000\n"
    assert say(b"SVA 1 3" + byte + b"5\nSVA? 1\n") == answer + b"1=35.000000\n"


def test_a_stop_is_an_error_and_is_told_once(say):
    for stop in (b"\x18", b"STP\n", b"HLT\n", b"HLT 1 2\n"):
        assert say(stop + b"ERR?\nERR?\n") == b"10\n0\n"
    assert say(b"HLT 9\nERR?\n") == b"23\n"


@pytest.mark.parametrize(
    ("lines", "code"),
    [
        (b"SVA 1 10 2 2000", 17),  # all of a line or nothing
        (b"SVA 1 10 2", 1),
        (b"SVA 1 1_0", 1),
        (b"SVA 1 nan", 1),
        (b"SVA 1 10 9 20", 23),
        (b"SVR 1 131", 17),
        (b"SVO 1 2", 1),
        (b"MOV 1 5", 5),
        (b"MVR 1 5", 5),
        (b"SVO 2 1\nSVA 1 10 2 20", 79),
        (b"SVO 1 1\nMOV 1 25.1", 7),
        (b"SVA 1 " + b"1" * 300, 3),
        (b"SVA 1 10" + b" " * 300, 3),
        (b"SPA 1 0x7000000 3", 64),
        (b"SPA? 1 0x123", 54),
        (b"*IDN? 1", 1),
        (b"DRR? 1 10 1", 77),
        (b"QQQ?", 2),
    ],
)
def test_what_the_device_refuses_is_refused_and_moves_nothing(say, lines, code):
    assert say(lines + b"\nERR?\nERR?\n") == b"%d\n0\n" % code
    assert say(b"SVO 1 0 2 0\nSVA?\n") == b"1=0.000000 \n2=0.000000\n"


def test_several_axes_stand_on_one_line(say):
    assert say(b"SVA 1 10 2 20\nSVR 2 -5\nSVA?\nERR?\n") == b"1=10.000000 \n2=15.000000\n0\n"


def until(said, wanted):
    end = time.monotonic() + PATIENCE
    while (found := said()) != wanted:
        assert time.monotonic() < end, found


def test_a_servo_moves_to_its_target_and_stops_there(bench):
    with bench.emulated() as device:
        session = device.session()

        def say(data):
            with device.lock:
                return session.feed(data)

        say(b"SVA 1 30\nSVO 1 1\n")
        assert say(b"SVO?\n") == b"1=1\n"
        say(b"MOV 1 10\n")
        assert say(b"MOV?\n") == b"1=10.000000\n"
        until(lambda: say(b"ONT?\n\x05"), b"1=1\n0\n")
        assert float(say(b"POS?\n")[2:]) == pytest.approx(10.0, abs=0.05)
        assert float(say(b"VOL?\n")[2:]) == pytest.approx(10.0 / 0.142, abs=1.0)
        assert say(b"OVF?\n") == b"1=0\n"
        say(b"MOV 1 24\n")  # farther than its voltage goes
        until(lambda: say(b"OVF?\n"), b"1=1\n")
        assert say(b"ONT?\n\x05") == b"1=0\n1\n"
        held = float(say(b"VOL?\n")[2:])
        say(b"SVO 1 0\n")
        assert float(say(b"SVA?\n")[2:]) == held
        assert say(b"ERR?\n") == b"0\n"


def test_help_versions_and_parameters_are_of_several_lines(say):
    for question in (b"HLP?\n", b"HPA?\n", b"SPA?\n"):
        lines = say(question).split(b"\n")
        assert all(line.endswith(b" ") for line in lines[:-2])
        assert not lines[-2].endswith(b" ")
    for name in (b"#5 ", b"#7 ", b"#24 ", b"ONT?", b"SVR", b"HLT"):
        assert b"\n" + name in say(b"HLP?\n")
    assert say(b"SPA? 1 0x7000000\n") == b"1 0x07000000=-10.000000\n"
    assert say(b"VER?\n").startswith(b"FW_")
    assert say(b"PUN?\n") == b"1=um \n2=um\n"


def test_one_client_at_a_time(bench, device, driver):
    other = bench.driver(device)
    with pytest.raises(ParameterError, match=r"closed the connection|reset by peer|broken pipe"):
        other.connect()
    driver.exchange(10.0)
    driver.close()
    other.connect()
    other.close()
