"""Composed mode in wall time with a driver written in Python: a scripted device."""

from __future__ import annotations

import math
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rclpy.parameter import Parameter
from rosbags.highlevel import AnyReader
from std_srvs.srv import Trigger

from pea_core import config
from pea_core.config import NODES
from pea_core.loop import LoopFault
from pea_core.params import ParameterError
from pea_core.signals import Measurement
from pea_experiment import experiments
from pea_experiment.experiment import Experiment
from pea_plant import drivers
from pea_plant.drivers.driver import DriverError, Limits
from pea_record.nowhere import Nowhere
from pea_record.read import load
from pea_run.modes import composed

pytestmark = pytest.mark.alone

RIG = (
    "T_s=1e-3",
    *("plant.driver.type=gcs", "plant.driver.address=tcp://127.0.0.1:1"),
    *("plant.safety.slew_rate=2e4", "plant.safety.beyond=200", "plant.safety.stale_samples=50"),
    *("plant.safety.jump_um=20", "plant.safety.stuck_samples=900"),
    *("plant.voltage_min=-20", "plant.voltage_max=110", "plant.delay_samples=1"),
    *("plant.sensor.ideal=true", "observer.type=alpha_beta", "observer.omega_o=150"),
    *("controller.K_p=0.5", "controller.K_i=300", "controller.K_d=0"),
)


class Scripted:
    """A device without dynamics, that notes what it is given."""

    limits = Limits(-30.0, 130.0, -5e-6, 20e-6)
    identity = "scripted"

    def __init__(self) -> None:
        self.u = 0.0
        self.given: list[float] = []
        self.told: list[float] = []
        self.marked: list[int] = []
        self.threads: set[str] = set()
        self.fails_at = math.inf
        self.closed = False

    def connect(self) -> None:
        pass

    def read(self) -> Measurement:
        return Measurement(0.142e-6 * self.u, math.nan, self.u)

    def exchange(self, u: float) -> Measurement:
        if len(self.given) >= self.fails_at:
            raise DriverError("scripted: no answer")
        self.threads.add(threading.current_thread().name)
        measured = self.read()
        self.given.append(u)
        self.told.append(measured.y)
        self.u = u
        return measured

    @property
    def signal(self) -> float:
        return 0.5 * len(self.given)

    def mark(self) -> None:
        self.marked.append(len(self.given))

    def check(self) -> None:
        pass

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch, free_domain: int) -> Scripted:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_domain))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    scripted = Scripted()
    monkeypatch.setattr(drivers, "make", lambda plant, T_s: scripted)
    return scripted


def experiment(duration: float) -> Experiment:
    return experiments.load("fig4_pid_step", RIG, duration)


def states(directory: Path) -> list[str]:
    with AnyReader([directory]) as reader:
        chosen = [c for c in reader.connections if c.topic == "/diagnostics"]
        found = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(chosen)]
    return [m.status[0].message for m in found if m.status[0].name == "pea: plant: safety"]


def test_the_trigger_output_is_set_at_the_events_of_a_scan(device, tmp_path):
    lines = (
        *("reference.type=raster", "reference.part=line", "reference.width_um=2"),
        *("reference.lines=4", "reference.line_rate_hz=10", "reference.pixels=8"),
        *("plant.driver.type=modbus_daq", "plant.driver.trigger=line"),
    )
    made = experiments.load("fig4_pid_step", (*RIG, *lines), 0.5)
    composed.run(made, tmp_path / "run", lambda k: None, wall=True)
    events = made.scan_events(0, 500)
    assert device.marked == events["k"][events["kind"] == 1].tolist() != []
    with AnyReader([tmp_path / "run"]) as reader:
        assert "/pea/events" in reader.topics


def test_a_trigger_output_without_a_scan_is_refused(device, tmp_path):
    sets = (*RIG, "plant.driver.type=modbus_daq", "plant.driver.trigger=pixel")
    made = experiments.load("fig4_pid_step", sets, 0.1)
    with pytest.raises(ParameterError, match=r"trigger = 'pixel': .* no scan and has no events"):
        composed.run(made, tmp_path / "run", lambda k: None, wall=True)
    assert device.given == []


def test_a_python_driver_is_called_once_a_sample_and_recorded(device, tmp_path):
    deadlines = composed.run(experiment(0.3), tmp_path / "run", lambda k: None, wall=True)
    recording = load(tmp_path / "run")
    samples = recording.samples
    assert len(samples) == 300
    assert recording.signal.tolist() == [0.5 * k for k in range(1, 301)]
    assert deadlines.samples == 300
    assert samples["y"].tolist() == device.told[:300]
    assert samples["u_applied"][1:].tolist() == device.given[:299]
    assert np.all(np.isnan(samples["y_dot"]))
    assert device.closed
    assert device.threads >= {"loop"}


def test_every_command_passes_the_gate(device, tmp_path):
    composed.run(experiment(0.3), tmp_path / "run", lambda k: None, wall=True)
    steps = np.abs(np.diff([0.0, *device.given]))
    assert steps.max() <= 20.0 + 1e-9
    assert device.given[-1] == 0.0  # at rest in the end
    told = states(tmp_path / "run")
    assert [text.partition(":")[0] for text in told] == [
        "unconfigured -> inactive",
        "inactive -> active",
        "active -> inactive",
        "inactive -> unconfigured",
    ]


def test_a_driver_that_fails_ends_the_run_with_its_words(device, tmp_path):
    device.fails_at = 100
    with pytest.raises(LoopFault, match="no answer"):
        composed.run(experiment(0.5), tmp_path / "run", lambda k: None, wall=True)
    assert len(load(tmp_path / "run").samples) == 100
    assert device.closed
    assert "active -> fault: driver: scripted: no answer" in states(tmp_path / "run")


def test_an_emergency_stop_by_service_ramps_down(device, tmp_path, ros):
    client = ros.node.create_client(Trigger, "/pea/plant/stop")
    failed: list[str] = []

    def run() -> None:
        try:
            composed.run(experiment(60.0), tmp_path / "run", lambda k: None, wall=True)
        except LoopFault as fault:
            failed.append(str(fault))

    thread = threading.Thread(target=run)
    thread.start()
    try:
        assert ros.until(client.service_is_ready)
        asked = client.call_async(Trigger.Request())
        assert ros.until(asked.done)
    finally:
        thread.join(60.0)
    assert failed == ["the safety gate has tripped: emergency_stop: asked by ~/stop"]
    assert device.given[-1] == 0.0


def test_a_stop_while_the_driver_hangs_says_so_and_the_run_ends(device, tmp_path, ros):
    hung = threading.Event()
    exchange = device.exchange

    def hangs(u: float) -> Measurement:
        if len(device.given) >= 50:
            hung.set()
            threading.Event().wait()
        return exchange(u)

    device.exchange = hangs
    client = ros.node.create_client(Trigger, "/pea/plant/stop")
    failed: list[str] = []

    def run() -> None:
        try:
            composed.run(experiment(60.0), tmp_path / "run", lambda k: None, wall=True)
        except LoopFault as fault:
            failed.append(str(fault))

    thread = threading.Thread(target=run)
    thread.start()
    try:
        assert ros.until(client.service_is_ready)
        assert hung.wait(30.0)
        asked = client.call_async(Trigger.Request())
        assert ros.until(asked.done)
    finally:
        thread.join(60.0)
    assert not asked.result().success  # a driver without a connection has no watchdog
    assert "does not answer, and holds its last voltage" in asked.result().message
    assert "the device does not answer" in failed[0]
    assert len(load(tmp_path / "run").samples) == 50


@pytest.mark.parametrize("given", [(), ("controller.voltage_max=100",)])
def test_the_controller_follows_the_plant_s_limits(free_domain, monkeypatch, given):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_domain))
    loaded = experiments.load("fig4_pid_step", given, 0.05)
    loop = loaded.loop()
    blocks = dict(zip(NODES, (loop.plant, loop.observer, loop.controller, loop.reference)))

    def swap(name: str, params: Any) -> None:
        blocks[name].retune(params)

    with composed.nodes_beside(loaded, blocks, Nowhere(), swap, config.NAMESPACE) as beside:
        node = beside.nodes["plant"]
        for value in (50.0, 40.0):
            (result,) = node.set_parameters([Parameter("voltage_max", value=value)])
            assert result.successful, result.reason
            assert blocks["controller"].params.voltage_max == value
            assert beside.nodes["controller"].get_parameter("voltage_max").value == value
        (result,) = beside.nodes["controller"].set_parameters(
            [Parameter("voltage_max", value=90.0)]
        )
        assert not result.successful
        assert "voltage_max = 90" in result.reason
        for who, value in (("controller", 30.0), ("plant", 35.0)):  # what somebody sets stays
            (result,) = beside.nodes[who].set_parameters([Parameter("voltage_max", value=value)])
            assert result.successful, result.reason
        assert blocks["controller"].params.voltage_max == 30.0
