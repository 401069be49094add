"""Several axes of a PI controller: one exchange, one watchdog, one stop."""

import json
import math
import signal
import subprocess
import sys
import time

import pytest

from pea_core.loop import LoopFault
from pea_core.params import ParameterError, build
from pea_drivers.gcs import emulator
from pea_plant import drivers, wall_node
from pea_plant.driven import Driven
from pea_plant.plant import Params

T_s = 5e-3
PATIENCE = 30.0
LIMITS = {
    "voltage_min": -20.0,
    "voltage_max": 100.0,
    "safety.slew_rate": 2000.0,
    "safety.beyond": 100.0,
    "safety.stale_samples": 10**6,
    "safety.jump_um": 100.0,
    "safety.stuck_samples": 10**6,
    "safety.watchdog_s": 20.0,
    "driver.type": "gcs",
    "driver.timeout_s": 5.0,
}

DRIVES = """
import json, math, sys
from pea_core.params import build
from pea_plant.plant import Params
from pea_plant.rig import Rig
rig = Rig(tuple(build(Params, each) for each in json.loads(sys.argv[1])), 5e-3, axes=("x", "y"))
print(rig.connect("test"), flush=True)
rig.gate.activate("test")
while rig.gate.s.u != (40.0, 25.0):
    rig.pace(0)
    assert rig.step((40.0, 25.0), True, rig.nothing), rig.failure
print("high", flush=True)
sys.stdin.readline()
"""


@pytest.fixture
def device():
    params = emulator.Params(latency_s=0.0, axes="1 2", stages=2, connections=2)
    with emulator.make(build(Params, LIMITS), params, 0) as made:
        yield made


def values(device, **more):
    """Parameters of x and y on channels 1 and 2."""
    own = {name.replace("__", "."): value for name, value in more.items()}
    return [
        {**LIMITS, "driver.address": device.address, **own, "driver.axis": axis} for axis in "12"
    ]


def plants(device, **more):
    return tuple(build(Params, own) for own in values(device, **more))


def held(device):
    return tuple(stage.u for stage in device.stages.values())


def until(true, act=lambda: time.sleep(0.01)):
    end = time.monotonic() + PATIENCE
    while not true():
        assert time.monotonic() < end
        act()


def test_all_channels_are_exchanged_in_one_line(device):
    driver = drivers.make(plants(device), T_s)
    driver.connect()
    try:
        device.inject("jump=1")  # of the first channel's sensor
        sent = []
        send = driver.way.send
        driver.way.send = lambda data: (sent.append(data), send(data))
        driver.exchange((3.0, 7.0))
        y, _, u = driver.read()
        assert sent[0] == b"SVA 1 3.000000 2 7.000000\nPOS? 1 2\n"
        assert u == (3.0, 7.0)
        assert held(device) == (3.0, 7.0)
        assert y[0] - y[1] == pytest.approx(1e-6, abs=1e-6)
        assert driver.last_resort((1.0, 2.0)).count(b"SVA") == 2
    finally:
        driver.close()


def test_emulated_stages_are_those_of_their_axes_and_see_each_other():
    """Each has its own gain; the sensor of y sees a share of x."""
    own = {**LIMITS, "hysteresis.type": "none", "sensor.noise_nm": 0.0}
    own["stage.cross_talk"] = (0.0, 0.0, 0.1, 0.0)
    each = [{**own, "driver.axis": "1", "K": 0.1}, {**own, "driver.axis": "2", "K": 0.2}]
    params = emulator.Params(latency_s=0.0, axes="1 2", stages=2, connections=2)
    with emulator.make(tuple(build(Params, one) for one in each), params, 0) as made:
        address = {"driver.address": made.address}
        driver = drivers.make(tuple(build(Params, {**one, **address}) for one in each), T_s)
        driver.connect()
        try:
            driver.exchange((10.0, 5.0))

            def near(*expected):
                driver.exchange((10.0, 5.0))
                return driver.read()[0] == pytest.approx(expected, abs=2e-9)

            until(lambda: near(1.0e-6, 1.0e-6 + 0.1e-6))
        finally:
            driver.close()


def test_cross_talk_to_a_channel_without_a_stage_is_refused():
    own = {**LIMITS, "stage.cross_talk": (0.0, 0.1, 0.1, 0.0)}
    each = tuple(build(Params, {**own, "driver.axis": axis}) for axis in "12")
    with pytest.raises(ParameterError, match="the channel '2' has no stage behind it"):
        emulator.make(each, emulator.Params(axes="1 2", stages=1), 0)


def test_a_channel_that_is_not_there_is_refused(device):
    first, second = values(device)
    second["driver.axis"] = "7"
    driver = drivers.make((build(Params, first), build(Params, second)), T_s)
    with pytest.raises(ParameterError, match="axis = '7'"):
        driver.connect()
    assert driver.fileno() == -1


@pytest.mark.parametrize(
    ("given", "wall"),
    [
        ({}, False),
        ({"driver.type": "simulated", "x.driver.type": "simulated"}, False),
        ({"driver.type": "gcs"}, True),
        ({"axes": ["x", "y"], "x.driver.type": "gcs", "y.driver.type": "gcs"}, True),
        ({"clock": "wall"}, True),
    ],
)
def test_a_node_on_a_device_is_paced_by_the_wall_whichever_axis_names_it(given, wall):
    assert wall_node.asked(given) == wall


def test_axes_of_one_channel_are_refused(device):
    same = plants(device)[0]
    with pytest.raises(ParameterError, match="is the channel of x and of y"):
        Driven((same, same), T_s, lambda k: (math.nan, math.nan), axes=("x", "y"))


def ticks(loop, commands):
    for u in commands:
        loop.rig.pace(0)
        loop.output(None)
        loop.update(u)


def test_matrices_lie_between_axes_and_channels(device):
    A, S = (1.0, 1.0, 1.0, -1.0), (0.5, 0.5, 0.5, -0.5)
    params = plants(device, stage__axes_to_actuators=A, stage__sensors_to_axes=S)
    loop = Driven(params, T_s, lambda k: (0.0, 0.0), axes=("x", "y"))
    loop.connect()
    try:
        ticks(loop, [(20.0, 5.0)] * 20)
        until(lambda: held(device) == (25.0, 15.0))
        x, y = loop.output(None)
        assert (x.u_applied, y.u_applied) == pytest.approx((20.0, 5.0))
        assert x.y > 4.0 * abs(y.y) > 0.0
        ticks(loop, [(90.0, 20.0)] * 40)  # the actuators' own limits hold
        assert max(held(device)) == 100.0
    finally:
        loop.close()
    assert held(device) == (0.0, 0.0)


def test_a_trip_of_one_axis_brings_both_to_rest(device):
    limited = plants(device, safety__displacement_max_um=15.0)
    loop = Driven(limited, T_s, lambda k: (0.0, 0.0), axes=("x", "y"))
    loop.connect()
    try:
        ticks(loop, [(40.0, 25.0)] * 20)
        device.inject("jump=30")
        with pytest.raises(LoopFault, match="x: displacement_range"):
            ticks(loop, [(40.0, 25.0)] * 60)
        until(lambda: held(device) == (0.0, 0.0))  # a busy machine leaves it to the watchdog
    finally:
        loop.close()


def test_a_stop_is_one_of_both(device):
    loop = Driven(plants(device), T_s, lambda k: (0.0, 0.0), axes=("x", "y"))
    loop.connect()
    try:
        ticks(loop, [(40.0, 25.0)] * 20)

        def step():
            loop.rig.pace(0)
            loop.rig.step((40.0, 25.0), True, (0.0, 0.0))

        told = loop.rig.stop("asked", step)
        assert told.safe
        assert told.text.startswith("fault: emergency_stop: asked; ")
        until(lambda: held(device) == (0.0, 0.0), step)
        assert loop.rig.reached().text == "fault: emergency_stop: asked; 0, 0 V"
    finally:
        loop.close()


@pytest.mark.parametrize("then", ["killed", "killed, hung up"])
def test_a_dead_plant_leaves_both_safe(device, then):
    plant = subprocess.Popen(
        [sys.executable, "-c", DRIVES, json.dumps(values(device))],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert plant.stdout is not None
    assert "watchdog holds a connection of its own" in plant.stdout.readline()
    assert plant.stdout.readline() == "high\n"
    plant.send_signal(signal.SIGSTOP)
    if then == "killed, hung up":  # whoever connects anew asks what each channel holds
        device.inject("drop")
        until(lambda: not device.ways)
        device.drive("2", 10.0)
    plant.kill()
    _, said = plant.communicate(timeout=PATIENCE)
    second = "10" if then == "killed, hung up" else "25"
    assert f"from 40.000 V to the safe 0 V and from {second}.000 V to the safe 0 V" in said
    until(lambda: held(device) == (0.0, 0.0))
    for told in device.told()["axes"].values():  # a starved device reads steps of a ramp at once
        assert told["max_slew_V_s"]["value"] <= 2000.0 * 3.0 or then == "killed, hung up"
