"""Whatever ends a loop on a compiled driver, the stage ends at its safe voltage, within its limits.

The library dies or hangs within an exchange, in a process of its own; its log has what loop and
watchdog have given it.
"""

import itertools
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

T_s = 50e-6

PATIENCE = 30.0

LOOP = """
import os, sys, time
sys.path.insert(0, sys.argv[1])
from conftest import _plant
from test_cycle import loop_of
device, loop = loop_of(_plant(sys.argv[2]), 10**6, compiled=False)
device.connect()
loop.start()
while loop.alive and not device.hangs():
    loop.take()
    loop.feed()
    device.look()
    time.sleep(0.001)
if loop.alive:
    device.rig.abandon()
else:
    device.close()
print(device.rig.gate.cause, flush=True)
os._exit(3)
"""


@pytest.mark.parametrize(
    ("way", "status", "says"),
    [
        ("crash later", -11, ""),
        ("killed later", -9, ""),
        ("hang later", 3, "driver: "),
        ("silent later", 3, "driver: silent later: no answer within timeout_s"),
    ],
)
def test_the_stage_ends_safe(tmp_path, monkeypatch, plant, way, status, says):
    log = tmp_path / "log"
    log.touch()
    monkeypatch.setenv("TOY_LOG", str(log))
    ended = subprocess.run(
        [sys.executable, "-c", LOOP, str(Path(__file__).parent), way],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert ended.returncode == status, ended.stderr
    assert ended.stdout.startswith(says)
    assert "Traceback" not in ended.stderr

    def given():
        return np.fromfile(log).reshape(-1, 2)

    end = time.monotonic() + PATIENCE
    while given()[-1, 1] != 0.0 and time.monotonic() < end:
        time.sleep(0.01)
    params = plant(way)
    times, volts = given().T
    assert volts[-1] == 0.0
    assert volts.max() > 5.0  # there was something to come down from
    assert params.voltage_min <= volts.min()
    assert volts.max() <= params.voltage_max
    for (s, u), (t, v) in itertools.pairwise(zip(times, volts, strict=True)):
        assert abs(v - u) <= params.safety.slew_rate * max(t - s, T_s) * 1.01
