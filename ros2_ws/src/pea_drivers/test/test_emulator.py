import math
import socket
import time
from pathlib import Path

import numpy as np
import pytest

from pea_core.params import ParameterError, build
from pea_drivers.emulator import Control, Emulator, Timing
from pea_drivers.faults import FAULTS, Faults, fault
from pea_drivers.nv200.emulator import SETTINGS
from pea_drivers.stage import EmulatedStage, Felt
from pea_plant.drivers.simulated import Simulated
from pea_plant.plant import Params


class Clock:
    """Wall time by hand."""

    def __init__(self):
        self.t = 1_000_000_007

    def __call__(self):
        return self.t


class Echo(Emulator):
    """A device that says what it hears."""

    def session(self):
        return self

    def feed(self, data):
        return data


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def echo():
    with Echo(EmulatedStage(build(Params, {}), -30.0, 130.0), Timing()) as emulator:
        yield emulator


def stage(clock, compiled=False, **values):
    return EmulatedStage(build(Params, values), -30.0, 130.0, clock=clock, compiled=compiled)


def connected(emulator):
    host, _, port = emulator.address.removeprefix("tcp://").partition(":")
    return socket.create_connection((host, int(port)), 10.0)


@pytest.mark.parametrize("compiled", [False, True])
def test_the_stage_is_the_simulated_actuator_in_wall_time(clock, compiled):
    values = {"hysteresis.type": "bouc_wen"}
    emulated = stage(clock, compiled, **values)
    model = Simulated(build(Params, values), 50e-6)
    rng = np.random.default_rng(1)
    for _ in range(50):
        u, steps = rng.uniform(0.0, 100.0), int(rng.integers(1, 9))
        emulated.command(u)
        clock.t += 50_000 * steps
        for _ in range(steps):
            model.exchange(u)
        assert emulated.reading() == model.read().y


def test_the_sensor_is_read_in_its_period(clock):
    emulated = EmulatedStage(build(Params, {}), -30.0, 130.0, update_s=1e-3, clock=clock)
    emulated.command(100.0)
    clock.t += 999_999
    assert emulated.reading() == 0.0
    clock.t += 1
    assert emulated.reading() > 0.0


@pytest.mark.parametrize("compiled", [False, True])
def test_a_stage_that_was_left_alone_is_at_rest(clock, compiled):
    emulated = stage(clock, compiled)
    emulated.command(100.0)
    clock.t += 3600 * 10**9
    assert emulated.reading() == pytest.approx(14.2e-6, rel=1e-6)


def test_the_amplifier_goes_no_farther_than_it_can(clock):
    emulated = stage(clock)
    emulated.command(1e9)
    assert emulated.u == 130.0
    emulated.saturation = 60.0
    emulated.command(100.0)
    assert emulated.u == 60.0
    emulated.command(-1e9)
    assert emulated.u == -30.0


def test_a_stuck_and_a_jumping_sensor(clock):
    emulated = stage(clock)
    emulated.command(100.0)
    clock.t += 50_000
    y = emulated.reading()
    emulated.stuck = True
    clock.t += 10**8
    assert emulated.reading() == y
    emulated.stuck, emulated.jump = False, 1e-6
    assert emulated.reading() == pytest.approx(15.2e-6)


def test_what_was_felt_has_its_extremes_and_their_times():
    felt = Felt(0)
    for t, u in ((10**6, 5.0), (2 * 10**6, -10.0), (20 * 10**6, -9.0), (40 * 10**6, 2.0)):
        felt.command(t, u)
    told = felt.told()
    assert told["max_voltage_V"] == {"value": 5.0, "at_s": 1e-3}
    assert told["min_voltage_V"] == {"value": -10.0, "at_s": 2e-3}
    assert told["max_step_V"] == {"value": 15.0, "at_s": 2e-3}
    assert told["max_slew_V_s"]["value"] == pytest.approx(1500.0)  # 15 V within 10 ms
    assert told["last_voltage_V"] == {"value": 2.0, "at_s": 0.04}
    assert felt.since(20 * 10**6) == [(20 * 10**6, -9.0), (40 * 10**6, 2.0)]


def test_a_ramp_in_bursts_has_the_slew_of_the_ramp():
    felt = Felt(0)
    for k in range(1000):
        felt.command(k // 4 * 4 * 500_000, k * 0.5)  # 1000 V/s, four at once
    assert felt.told()["max_slew_V_s"]["value"] == pytest.approx(1000.0, rel=0.25)


def test_steps_of_a_ramp_have_its_slew_and_a_sudden_step_its_own():
    felt = Felt(0)
    for k in range(1, 100):
        felt.command(int(k * 4.99e6), k * 10.0)
    assert felt.told()["max_slew_V_s"]["value"] == pytest.approx(10.0 / 4.99e-3)
    felt.command(10**12, 1020.0)  # 30 V, after a long rest
    assert felt.told()["max_slew_V_s"]["value"] == pytest.approx(3000.0)


@pytest.mark.parametrize("text", ["drop", "delay=0.1", "error=79@2", "stuck@0.5"])
def test_faults_are_read(text):
    found = fault(text)
    name, _, after = text.partition("@")
    name, _, value = name.partition("=")
    assert found.name == name
    assert found.after == (float(after) if after else None)
    assert found.value == float(value) if value else math.isnan(found.value)


@pytest.mark.parametrize("text", ["", "drip", "drop=1", "delay", "delay=x", "stuck@x", "jump=@1"])
def test_what_is_no_fault_is_refused_in_one_line(text):
    with pytest.raises(ParameterError, match=r"^fault .*$"):
        fault(text)


def test_it_listens_on_the_loopback_interface_alone(echo):
    assert echo.address.startswith("tcp://127.0.0.1:")


def test_a_port_that_is_taken_is_bad_input(echo):
    port = int(echo.address.rpartition(":")[2])
    with pytest.raises(ParameterError, match="give another one, or 0"):
        Echo(echo.stage, Timing(), port)


def test_answers_are_late_by_the_latency():
    with Echo(EmulatedStage(build(Params, {}), -30.0, 130.0), Timing(latency_s=0.05)) as emulator:
        way = connected(emulator)
        before = time.monotonic()
        way.sendall(b"x")
        assert way.recv(10) == b"x"
        assert time.monotonic() - before >= 0.05


def test_drop_closes_once(echo):
    way = connected(echo)
    echo.inject("drop")
    assert way.recv(10) == b""
    way = connected(echo)
    way.sendall(b"again")
    assert way.recv(10) == b"again"


def test_refuse_closes_new_connections(echo):
    old = connected(echo)
    old.sendall(b"a")
    assert old.recv(10) == b"a"
    echo.inject("refuse")
    assert connected(echo).recv(10) == b""
    old.sendall(b"b")
    assert old.recv(10) == b"b"


def test_a_pulled_cable_breaks_an_answer_and_stays_silent(echo):
    way = connected(echo)
    echo.inject("pull")
    way.sendall(b"12345678")
    assert way.recv(10) == b"1234"
    way.sendall(b"hello")
    way.settimeout(0.2)
    with pytest.raises(TimeoutError):
        way.recv(10)


def test_garbage_and_truncation_pass(echo):
    way = connected(echo)
    for name in ("garbage", "truncate"):
        echo.inject(name)
        way.sendall(b"12345678")
        assert way.recv(100) != b"12345678"
        way.sendall(b"12345678")
        assert way.recv(100) == b"12345678"


def test_the_control_channel_sets_faults_and_tells(echo):
    control = Control(echo.control())
    before = time.monotonic_ns()
    assert before <= control.fault("mute") <= time.monotonic_ns()
    assert echo.faults.get("mute") is not None
    control.clear("mute")
    assert echo.faults.get("mute") is None
    echo.stage.command(7.0)
    assert control.log()["last_voltage_V"]["value"] == 7.0
    assert [u for _, u in control.since(before)] == [7.0]
    with pytest.raises(ParameterError, match="unknown name"):
        control.fault("nonsense")
    control.close()


def test_a_fault_counts_its_seconds_from_the_next_command():
    clock = Clock()
    faults = Faults(clock)
    faults.set(fault("error=10@4"))
    clock.t += 3600 * 10**9
    assert faults.get("error") is None
    faults.commanded()
    clock.t += 3_999_999_999
    assert faults.get("error") is None
    faults.commanded()  # only the first one counts
    clock.t += 1
    assert faults.take("error") == 10.0
    assert faults.get("error") is None


def test_a_command_of_a_client_starts_what_waits(bench_gcs):
    device, session = bench_gcs
    device.inject("stuck@0")
    for line in (b"*IDN?\n", b"SVO 1 0\n"):
        device.hear(session, line)
        assert device.faults.get("stuck") is None
    device.hear(session, b"SVA 1 0\n")
    assert device.faults.get("stuck") is not None


@pytest.fixture
def bench_gcs():
    from pea_drivers.gcs import emulator

    with emulator.make(build(Params, {"driver.type": "gcs"}), emulator.Params()) as device:
        yield device, device.session()


@pytest.mark.parametrize("text", ["stuck@-1", "stuck@nan", "delay=inf", "jump=nan"])
def test_a_fault_has_times_and_values_that_can_be(text):
    with pytest.raises(ParameterError, match=r"^fault .*$"):
        fault(text)


@pytest.mark.parametrize("compiled", [False, True])
def test_an_amplifier_with_a_slew_rate_takes_its_time(clock, compiled):
    emulated = stage(clock, compiled)
    emulated.slew(1e4)  # 0.5 V a step
    emulated.command(100.0)
    for n in range(1, 9):
        clock.t += 50_000 * 20
        emulated.reading()
        assert emulated.motion.u == pytest.approx(10.0 * n)
    clock.t += 10**10
    assert emulated.reading() == pytest.approx(14.2e-6, rel=1e-6)


def test_drip_and_babble(echo):
    way = connected(echo)
    echo.inject("drip=0.001")
    way.sendall(b"12345678")
    found = b""
    while len(found) < 8:
        found += way.recv(100)
    assert found == b"12345678"
    echo.clear()
    echo.inject("babble")
    way = connected(echo)
    way.sendall(b"ab")
    found = b""
    while len(found) < 1000:
        found += way.recv(1000)
    assert found.startswith(b"ababab")


def test_no_more_connections_than_the_device_takes():
    params = Timing(connections=2)
    with Echo(EmulatedStage(build(Params, {}), -30.0, 130.0), params) as emulator:
        first, second = connected(emulator), connected(emulator)
        for way in (first, second):
            way.sendall(b"x")
            assert way.recv(10) == b"x"
        assert connected(emulator).recv(10) == b""
        first.close()
        end = time.monotonic() + 20.0
        while True:
            third = connected(emulator)
            third.sendall(b"y")
            try:
                if third.recv(10) == b"y":
                    break
            except ConnectionResetError:
                pass
            assert time.monotonic() < end


PAGE = Path(__file__).parents[4] / "docs" / "rigs.md"


@pytest.mark.skipif(not PAGE.exists(), reason="needs the whole checkout")
def test_the_page_names_every_command_that_an_emulator_knows(bench_gcs):
    _, session = bench_gcs
    known = [line.split()[0] for line in session.feed(b"HLP?\n").decode().splitlines()[4:-1]]
    page = PAGE.read_text(encoding="utf-8")
    assert [name for name in (*known, *SETTINGS, *FAULTS) if f"`{name}" not in page] == []
