"""The watchdog: the ramp arrives, whoever dies; at an orderly end nothing is sent."""

import contextlib
import importlib
import itertools
import json
import os
import select
import signal
import socket
import subprocess
import sys
import time

import pytest

from pea_core.params import build
from pea_plant import drivers
from pea_plant.plant import Params
from pea_watchdog import client
from pea_watchdog.client import RampLimits, Watchdog, levels
from pea_watchdog.watchdog import PERIOD, SAFE, STEPS_MAX, UNHEEDED, UNREACHED, Shared, ramp

LEVELS = [(float(u), b"%d " % u) for u in range(-20, 111, 10)]
PATIENCE = 20.0
LIMITS = RampLimits(-20.0, 110.0, 0.0, 2000.0)

DIES = """
import os, signal, socket, sys
from pea_watchdog.client import RampLimits, Watchdog
limits = RampLimits(-20.0, 110.0, 0.0, 2000.0)
watchdog = Watchdog(int(sys.argv[1]), lambda u: b"%.1f " % u, limits, 37.0, 60.0)
print("ready", flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""

DRIVES = """
import json, os, signal, sys
from pea_core.params import build
from pea_plant import drivers
from pea_watchdog.client import RampLimits, hold, line
from pea_plant.plant import Params
params = build(Params, json.loads(sys.argv[1]))
driver = drivers.make(params, 5e-3)
driver.connect()
print("connected", flush=True)
sys.stdin.readline()
limits = RampLimits(params.voltage_min, params.voltage_max, 0.0, 2000.0)
spare = line(lambda: drivers.make(params, 5e-3), driver)
process, held = hold(driver, spare, limits, 0.0, 60.0)
print(held, flush=True)
for u in (10.0, 20.0, 30.0, 40.0):
    process.tell(u)
    driver.exchange(u)
os.kill(os.getpid(), signal.SIGKILL)
"""


def command(u):
    return b"%.1f " % u


def watching(near, limits=LIMITS, u=0.0, silence=60.0):
    return Watchdog(near.fileno(), command, limits, u, silence)


def heard(connection, until=b"0.0 "):
    """Voltages that came, up to the last one expected."""
    data = b""
    while not (b" " + data).endswith(b" " + until):
        assert select.select([connection], [], [], PATIENCE)[0], data
        data += connection.recv(4096)
    return [float(word) for word in data.split()]


@pytest.fixture
def ends():
    near, far = socket.socketpair()
    with near, far:
        yield near, far


def test_the_ramp_goes_from_where_it_is_to_the_safe_voltage():
    way = lambda u: [data for _, data in ramp(LEVELS, u, 0.0)]  # noqa: E731
    assert way(37.0) == [b"30 ", b"20 ", b"10 ", b"0 "]
    assert way(-15.0) == [b"-10 ", b"0 "]
    assert way(0.0) == [b"0 "]
    assert way(1e9)[0] == b"110 "


@pytest.mark.parametrize("slew_rate", [1.0, 2e3, 1e4, 2e5, 1e9])
def test_a_ramp_is_no_single_step_and_no_faster_than_the_limit(slew_rate):
    period, taken = levels(RampLimits(-20.0, 110.0, 0.0, slew_rate))
    steps = [b - a for a, b in itertools.pairwise(taken)]
    assert max(steps) <= 26.0
    assert max(steps) <= slew_rate * period * (1 + 1e-9)
    assert period <= max(PERIOD, 130.0 / slew_rate / STEPS_MAX)
    assert len(taken) <= STEPS_MAX + 1


def test_it_fires_when_it_is_told(ends):
    near, far = ends
    watchdog = watching(near)
    try:
        watchdog.tell(50.0)
        watchdog.fire()
        assert watchdog.done()
        voltages = heard(far)
        assert voltages == [float(u) for u in range(48, -1, -4)]
        assert watchdog.alive
    finally:
        watchdog.stand_down()


def test_standing_down_sends_nothing(ends):
    near, far = ends
    watchdog = watching(near)
    watchdog.tell(50.0)
    watchdog.stand_down()
    assert not watchdog.alive
    near.close()
    assert far.recv(100) == b""


def test_it_says_when_the_device_is_gone(ends):
    near, far = ends
    watchdog = watching(near)
    try:
        watchdog.tell(50.0)
        far.close()
        watchdog.fire()
        assert not watchdog.done()
    finally:
        watchdog.stand_down()


def test_it_outlives_a_plant_that_is_killed(ends):
    near, far = ends
    plant = subprocess.Popen(
        [sys.executable, "-c", DIES, str(near.fileno())],
        pass_fds=(near.fileno(),),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    near.close()
    voltages = heard(far)
    assert plant.wait(PATIENCE) == -signal.SIGKILL
    assert voltages[0] == 36.0
    assert voltages == sorted(voltages, reverse=True)
    assert far.recv(100) == b""  # the watchdog has ended, too
    _, said = plant.communicate()
    assert b"watchdog: the plant has died: from 37.000 V to the safe 0 V" in said


def test_it_does_not_wait_for_the_files_of_a_plant_that_is_killed(ends):
    """They close once its memory is given back; here another process holds them for longer."""
    near, far = ends
    holds = "os.fork() or (os.close(1), os.close(2), time.sleep(60))\n"
    plant = subprocess.Popen(
        [sys.executable, "-c", "import time" + DIES.replace("os.kill(", holds + "os.kill("),
         str(near.fileno())],
        pass_fds=(near.fileno(),),
        stdout=subprocess.PIPE,
        start_new_session=True,
    )  # fmt: skip
    near.close()
    try:
        assert heard(far)[0] == 36.0
        assert plant.wait(PATIENCE) == -signal.SIGKILL
    finally:
        os.killpg(plant.pid, signal.SIGKILL)  # the one that holds them
        plant.communicate()


def test_a_device_that_hung_up_is_dialled_anew():
    listener = socket.create_server(("127.0.0.1", 0))
    with listener, socket.create_connection(listener.getsockname()) as near:
        listener.accept()[0].close()
        watchdog = watching(near)
        try:
            watchdog.tell(8.0)
            watchdog.leave()  # else the plant dials
            with listener.accept()[0] as far:
                assert heard(far) == [4.0, 0.0]
            assert watchdog.process.wait(PATIENCE) == 0
        finally:
            watchdog.kill()


def test_the_safe_voltage_need_not_be_zero(ends):
    near, far = ends
    watchdog = watching(near, RampLimits(10.0, 110.0, 30.0, 2000.0))
    try:
        watchdog.tell(10.0)
        watchdog.fire()
        assert watchdog.done()
        voltages = heard(far, b"30.0 ")
        assert voltages == [14.0, 18.0, 22.0, 26.0, 30.0]
    finally:
        watchdog.stand_down()


@pytest.mark.parametrize("kind", ["gcs", "modbus_daq", "nv200"])
@pytest.mark.parametrize("clients", ["many", "one"])
def test_a_killed_plant_is_brought_to_rest_though_the_device_takes_one_client(kind, clients):
    emulator = importlib.import_module(f"pea_drivers.{kind}.emulator")
    values = {"driver.type": kind, "driver.address": "tcp://127.0.0.1:1", "driver.timeout_s": 2.0}
    if kind == "modbus_daq":
        values["driver.calibration.amplifier"] = (0.75, 0.0375)
    with emulator.make(build(Params, values), emulator.Params(), 0) as device:
        plant = subprocess.Popen(
            [
                sys.executable,
                "-c",
                DRIVES,
                json.dumps({**values, "driver.address": device.address}),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert plant.stdout is not None
        assert plant.stdout.readline() == "connected\n"
        if clients == "one":
            device.inject("refuse")
        _, said = plant.communicate("go\n", PATIENCE)  # until the watchdog has ended, too
        assert plant.returncode == -signal.SIGKILL
        end = time.monotonic() + PATIENCE  # the device takes its time for each command
        while abs((told := device.told())["last_voltage_V"]["value"]) > 0.02:
            assert time.monotonic() < end, told
    assert "watchdog: the plant has died: from 40.000 V to the safe 0 V" in said
    assert told["max_voltage_V"]["value"] == pytest.approx(40.0, abs=0.02)
    assert told["counts"].get("refused", 0) == (clients == "one")


def test_a_device_that_refuses_is_tried_again_and_takes_no_step():
    """A connection that is closed at once takes no command: the ramp begins where it was.

    It may have been switched off: as long as the plant is there, the plant asks what it holds.
    """
    listener = socket.create_server(("127.0.0.1", 0))
    with listener, socket.create_connection(listener.getsockname()) as near:
        listener.accept()[0].close()
        watchdog = watching(near, u=37.0, silence=2.0)
        try:
            watchdog.fire()
            end = time.monotonic() + PATIENCE
            while watchdog.state != UNREACHED:
                watchdog.present()
                assert time.monotonic() < end
            for _ in range(30):  # several times its pause between two attempts
                watchdog.present()
                assert not select.select([listener], [], [], 0.01)[0]
            for _ in range(3):  # the plant hangs now
                listener.accept()[0].close()
            with listener.accept()[0] as far:
                assert heard(far)[0] == 36.0
                assert watchdog.done() or watchdog.state == UNREACHED
                end = time.monotonic() + PATIENCE
                while watchdog.state != SAFE:
                    assert time.monotonic() < end
        finally:
            watchdog.stand_down()


def test_it_acts_when_the_plant_is_silent(ends):
    near, far = ends
    watchdog = watching(near, u=20.0, silence=0.1)
    try:
        assert heard(far)[0] == 16.0
        assert watchdog.done()
        assert watchdog.state == SAFE
    finally:
        watchdog.stand_down()


def test_a_new_limit_counts_from_then_on(ends):
    near, far = ends
    watchdog = watching(near, u=20.0)
    try:
        watchdog.renew(command, RampLimits(-20.0, 110.0, 5.0, 500.0))
        watchdog.fire()
        assert heard(far, b"5.0 ") == [float(u) for u in range(19, 4, -1)]
    finally:
        watchdog.stand_down()


def test_one_that_is_stopped_is_seen_and_ended_in_time(ends):
    near, _ = ends
    watchdog = watching(near, u=20.0)
    os.kill(watchdog.pid, signal.SIGSTOP)
    began = time.monotonic()
    watchdog.fire()
    assert not watchdog.done()
    assert "has not looked" in watchdog.wrong
    watchdog.stand_down()
    assert time.monotonic() - began < 10.0
    assert not watchdog.alive


@pytest.mark.parametrize("number", UNHEEDED)
def test_one_that_is_starting_heeds_no_signal_either(ends, capfd, monkeypatch, number):
    near, _ = ends
    start = subprocess.Popen

    def signalled(*arguments, **options):
        process = start(*arguments, **options)
        process.send_signal(number)  # Python has not begun to import
        return process

    monkeypatch.setattr(client.subprocess, "Popen", signalled)
    watchdog = watching(near, u=20.0)
    assert not watchdog.wrong
    watchdog.stand_down()
    assert capfd.readouterr().err == ""


def test_one_that_died_is_seen_at_once(ends):
    near, _ = ends
    watchdog = watching(near)
    assert not watchdog.wrong
    os.kill(watchdog.pid, signal.SIGKILL)
    end = time.monotonic() + PATIENCE
    while not watchdog.wrong:
        assert time.monotonic() < end
    assert "SIGKILL" in watchdog.wrong
    watchdog.kill()


def test_left_alone_it_tries_until_it_is_told():
    listener = socket.create_server(("127.0.0.1", 0))
    address = listener.getsockname()
    with socket.create_connection(address) as near:
        watchdog = watching(near, u=10.0)
    listener.close()
    watchdog.leave()
    end = time.monotonic() + PATIENCE
    while watchdog.state != UNREACHED:
        assert time.monotonic() < end
    os.kill(watchdog.pid, signal.SIGTERM)
    assert watchdog.process.wait(PATIENCE) == 0


def test_nobody_reads_a_value_that_is_half_written():
    memory = os.memfd_create("half_written")
    os.truncate(memory, 1 << 16)
    shared, other = Shared(memory), Shared(memory)
    shared.voltage = 1.0
    child = os.fork()
    if not child:
        while True:
            shared.voltage = 1.0
    try:
        assert all(other.voltage == 1.0 for _ in range(300_000))
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        os.close(memory)


@contextlib.contextmanager
def emulated(kind):
    """An emulated device, and a driver that is connected to it."""
    emulator = importlib.import_module(f"pea_drivers.{kind}.emulator")
    values = {"driver.type": kind, "driver.address": "tcp://127.0.0.1:1", "driver.timeout_s": 2.0}
    if kind == "modbus_daq":
        values["driver.calibration.amplifier"] = (0.75, 0.0375)
    with emulator.make(build(Params, values), emulator.Params(), 0) as device:
        driver = drivers.make(build(Params, {**values, "driver.address": device.address}), 5e-3)
        driver.connect()
        yield device, driver


def beside(device, driver, u):
    """A watchdog with a connection of its own, which was told u (V) last."""
    host, _, port = device.address.removeprefix("tcp://").rpartition(":")
    with socket.create_connection((host, int(port))) as own:
        return Watchdog(
            own.fileno(), driver.last_resort, LIMITS, u, 60.0, question=driver.question()
        )


@pytest.mark.parametrize("kind", ["gcs", "modbus_daq", "nv200"])
def test_a_device_that_was_switched_off_takes_no_step_though_the_plant_is_dead(kind):
    """It holds another voltage than it was told last: the watchdog asks before it ramps."""
    with emulated(kind) as (device, driver):
        driver.exchange(10.0)
        watchdog = beside(device, driver, 60.0)
        try:
            device.inject("drop")
            while select.select([driver.fileno()], [], [], PATIENCE)[0]:
                if not os.read(driver.fileno(), 4096):  # it has hung up
                    break
            watchdog.leave()
            assert watchdog.process.wait(PATIENCE) == 0
        finally:
            watchdog.kill()
            driver.close()
        told = device.told()
        assert told["max_voltage_V"]["value"] == pytest.approx(10.0, abs=0.1)
        assert abs(told["last_voltage_V"]["value"]) < 0.02


@pytest.mark.parametrize("kind", ["gcs", "modbus_daq", "nv200"])
def test_a_cable_that_was_out_leaves_no_stage_where_it_was(kind):
    """What is sent into a silent line is lost: it ends when the device says it holds 0 V."""
    with emulated(kind) as (device, driver):
        for u in range(0, 45, 4):
            driver.exchange(float(u))
        watchdog = beside(device, driver, 44.0)
        try:
            driver.close()
            device.inject("mute")
            watchdog.leave()
            end = time.monotonic() + PATIENCE
            while watchdog.state != UNREACHED:
                assert time.monotonic() < end
                time.sleep(0.005)
            assert device.told()["last_voltage_V"]["value"] == pytest.approx(44.0, abs=0.1)
            device.faults.clear()
            assert watchdog.process.wait(PATIENCE) == 0
        finally:
            watchdog.kill()
        told = device.told()
        assert abs(told["last_voltage_V"]["value"]) < 0.02
        assert told["max_step_V"]["value"] < 4.1  # as it was driven, and no more
