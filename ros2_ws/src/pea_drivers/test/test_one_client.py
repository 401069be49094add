"""A device that serves one client: it refuses a second one, or drops the first one for it.

Either way the rig drives it, a watchdog holds it, and whoever has to reach it again does.
"""

import json
import math
import os
import signal
import subprocess
import sys
import time

import pytest

from pea_plant.drivers.driver import DriverError
from pea_plant.rig import Rig
from pea_watchdog import watchdog as dog

T_s = 5e-3
PATIENCE = 30.0
LIMITS = {
    "safety__slew_rate": 2000.0,
    "safety__beyond": 100.0,
    "safety__stale_samples": 10**6,
    "safety__jump_um": 100.0,
    "safety__stuck_samples": 10**6,
    "safety__watchdog_s": 20.0,
}

DRIVES = """
import json, math, os, sys
from pea_core.params import build
from pea_plant.plant import Params
from pea_plant.drivers.driver import DriverError
from pea_plant.rig import Rig
rig = Rig(build(Params, json.loads(sys.argv[1])), 5e-3)
print(rig.connect("test"), flush=True)
rig.gate.activate("test")
while rig.gate.s.u < 40.0:
    rig.pace(0)
    assert rig.step(40.0, True, math.nan), rig.failure
print("high", flush=True)
sys.stdin.readline()
"""


@pytest.fixture(params=["refuses", "drops"])
def device(request, bench):
    with bench.emulated(connections=1, drops=request.param == "drops") as emulated:
        yield emulated


def until(true, act):
    end = time.monotonic() + PATIENCE
    while not true():
        assert time.monotonic() < end
        act()


def test_it_is_driven_and_reached_again(bench, device):
    rig = Rig(bench.plant(device.address, **LIMITS, driver__timeout_s=2.0), T_s)

    def step(u=40.0):
        rig.pace(0)
        return rig.step(u, True, math.nan)

    said = rig.connect("test")
    assert "watchdog holds the same connection" in said
    try:
        rig.gate.activate("test")
        until(lambda: rig.gate.s.u == 40.0, lambda: step() or pytest.fail(str(rig.failure)))
        device.inject("drop")
        until(lambda: not rig.connected, step)
        assert rig.gate.reason == "driver"
        until(lambda: rig.connected and rig.gate.at_rest, step)
        for _ in range(20):  # nobody drops it again
            assert step(), rig.failure
        assert rig.watchdog is not None
        assert rig.watchdog.state == dog.WATCHING
        told = device.told()
        assert told["max_voltage_V"]["value"] == pytest.approx(40.0, abs=0.1)
        assert abs(told["last_voltage_V"]["value"]) < 0.1
        assert told["counts"].get("dropped", 0) <= 1  # it was noticed, and not tried again
    finally:
        rig.close("test")


def test_a_watchdog_that_hangs_does_not_keep_the_device(bench, device):
    """It holds the connection that the plant has left, and the device takes no other one."""
    rig = Rig(bench.plant(device.address, **LIMITS, driver__timeout_s=2.0), T_s)

    def step(u=40.0):
        rig.pace(0)
        return rig.step(u, True, math.nan)

    rig.connect("test")
    try:
        rig.gate.activate("test")
        until(lambda: rig.gate.s.u == 40.0, lambda: step() or pytest.fail(str(rig.failure)))
        hung = rig.watchdog
        os.kill(hung.pid, signal.SIGSTOP)
        rig.lost(DriverError("lost"))
        until(lambda: rig.connected and rig.gate.at_rest, step)
        assert not hung.alive
        assert rig.watchdog is not hung
        assert abs(device.told()["last_voltage_V"]["value"]) < 0.1
    finally:
        rig.close("test")


@pytest.mark.parametrize("then", ["left to its watchdog", "watchdog killed"])
def test_a_device_that_is_unplugged_is_at_rest_once_it_is_plugged_in(bench, device, then):
    """What was sent is lost: whoever is left tries until the device answers."""
    rig = Rig(bench.plant(device.address, **LIMITS, driver__timeout_s=0.5), T_s)

    def step(u=40.0):
        rig.pace(0)
        return rig.step(u, True, math.nan)

    def at_rest():
        return abs(device.told()["last_voltage_V"]["value"]) < 0.1

    rig.connect("test")
    try:
        rig.gate.activate("test")
        until(lambda: rig.gate.s.u == 40.0, lambda: step() or pytest.fail(str(rig.failure)))
        old = rig.watchdog
        device.inject("pull")
        until(lambda: not rig.connected and old.state == dog.SAFE, step)
        until(lambda: rig.reaching, step)
        until(lambda: not rig.reaching, step)
        assert old.alive  # it may have finished too early
        assert not at_rest()
        if then == "watchdog killed":
            os.kill(old.pid, signal.SIGKILL)
            until(lambda: not old.alive, step)
            assert not rig.release("test")
        else:
            assert rig.release("test")
        device.clear()
        until(at_rest, (lambda: time.sleep(0.01)) if rig.gate.state == "unconfigured" else step)
    finally:
        rig.close("test")


@pytest.mark.parametrize("then", ["killed", "killed, hung up"])
def test_a_dead_plant_leaves_it_safe(bench, device, then):
    given = {name.replace("__", "."): value for name, value in LIMITS.items()}
    of_driver = vars(bench.plant(device.address).driver)
    values = {
        "driver.type": bench.kind,
        "driver.address": device.address,
        "driver.timeout_s": 2.0,
        "driver.calibration.amplifier": of_driver["calibration"].amplifier,
        "driver.calibration.sensor": of_driver["calibration"].sensor,
        **given,
    }
    plant = subprocess.Popen(
        [sys.executable, "-c", DRIVES, json.dumps(values)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert plant.stdout is not None
    assert "watchdog holds the same connection" in plant.stdout.readline()
    assert plant.stdout.readline() == "high\n"
    os.kill(plant.pid, signal.SIGSTOP)  # it shall not see the end of the connection
    if then == "killed, hung up":
        device.inject("drop")
        until(lambda: not device.ways, lambda: time.sleep(0.01))
    os.kill(plant.pid, signal.SIGKILL)
    _, said = plant.communicate(timeout=PATIENCE)  # until the watchdog has ended, too
    assert "to the safe 0 V" in said
    until(lambda: abs(device.told()["last_voltage_V"]["value"]) < 0.1, lambda: time.sleep(0.01))
    assert device.told()["max_voltage_V"]["value"] == pytest.approx(40.0, abs=0.1)
