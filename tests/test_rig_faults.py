"""Rows of the fault table, and runs on a rig, as a user starts them."""

import importlib.util
import itertools
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from pea_core import config
from pea_core.config import resolve
from pea_core.loop import CHUNK
from pea_experiment import rig as rigs
from pea_plant.plant import Params
from pea_record.messages import diagnostics
from pea_record.read import load
from pea_report.folder import COUNTS, GATE

spec = importlib.util.spec_from_file_location("pea_faults", Path(__file__).with_name("faults.py"))
assert spec is not None
assert spec.loader is not None
faults = importlib.util.module_from_spec(spec)
sys.modules["pea_faults"] = faults
spec.loader.exec_module(faults)


@pytest.mark.alone
@pytest.mark.parametrize(
    ("row", "kind", "rig"),
    [
        ("plant killed", faults.Loop, faults.RIG),
        ("limit tightened", faults.Loop, faults.RIG),
        ("watchdog killed", faults.Loop, faults.RIG),
        ("command nan", faults.Loop, "board_emulated"),
        ("plant stopped", faults.OneProcess, faults.RIG),
        ("slow device", faults.OneProcess, faults.RIG),
        ("plant killed", faults.OneProcess, "e727_xy_emulated"),
        ("sensor jump", faults.OneProcess, "e727_xy_emulated"),
    ],
)
def test_a_fault_has_its_reason_and_breaks_no_limit(row, kind, rig):
    said = []
    (found,) = faults.run([row], said.append, rig, kind)
    assert not found.broken, said
    assert found.safe < 2000.0
    if kind is faults.Loop:  # one process tells it at its end
        assert found.detected <= found.safe
    assert -20.0 <= found.peak <= 110.0


def test_a_broken_limit_would_be_seen():
    T_s = 5e-3
    assert faults.steepest([(0, 0.0), (5_000_000, 10.0), (15_000_000, 30.0)], T_s) == 2000.0
    assert faults.steepest([(0, 0.0), (1_000_000, 11.0)], T_s) == pytest.approx(2200.0)
    ramp = [(50_000 * k, 10.0 * k) for k in range(20)]
    assert faults.steepest(ramp, 5e-5, True) == pytest.approx(2e5 * 10 / 11)
    assert faults.steepest([(t, 2.0 * u) for t, u in ramp], 5e-5, True) > 3e5


def test_the_table_has_a_row_for_each_fault():
    row = faults.Found("x", "driver: tcp://127.0.0.1:5 a|b", 1.0, 2.0, 3.0, 4.0, "")
    assert "| x | driver: device a/b | 1.0 | 2.0 | 3 | 4 |" in faults.table([row])


def test_nobody_at_the_address_is_one_line_and_status_2(start_pea):
    run = start_pea(
        *("run", "fig9_hysteresis_10hz", "--rig", "e727_200hz_emulated", "--duration", "1"),
        *("--set", "plant.driver.address=tcp://127.0.0.1:9", "--out", "run"),
    )
    done = run.finish()
    assert done.status == 2
    (line,) = [line for line in done.err.splitlines() if line.startswith("pea: ")]
    assert "127.0.0.1:9" in line
    assert "Traceback" not in done.err


@pytest.mark.alone
def test_a_simulated_rig_runs_in_wall_time_with_its_transitions_recorded(start_pea):
    run = start_pea(
        *("run", "fig9_hysteresis_10hz", "--rig", "simulated_200hz", "--duration", "2"),
        *("--set", "reference.frequency_hz=1", "--out", "run", "--json"),
        *("--set", "plant.stage.specimen=x"),
    )
    figures = run.finish().metrics
    assert figures["samples"] == 400
    assert figures["lost_samples"] == 0
    recording = load(run.there / "run")
    assert recording.samples["y"].max() > 5e-6
    assert recording.signal == pytest.approx(1e6 * recording.samples["y"], abs=0.02)  # the noise
    log = (run.there / "run/log/plant.log").read_text()
    told = r"\[([\d.]+)\] \[pea.plant\]: {}"
    began = re.search(told.format("inactive -> active: autostart"), log)
    ended = re.search(told.format("active -> inactive: the end of the run"), log)
    assert began
    assert ended
    assert float(ended[1]) - float(began[1]) > 1.99
    counts = re.search(r"400 samples done; (\d+) late, (\d+) missing, (\d+) overruns", log)
    assert counts
    assert list(figures["commands"].items()) == [
        (name, int(n)) for name, n in zip(("late", "missing", "overruns"), counts.groups())
    ]
    gate = [status for _, status in diagnostics(run.there / "run") if status.name == GATE]
    values = [{pair.key: pair.value for pair in status.values} for status in gate]
    late = [[each[name] for name in COUNTS] for each in values]
    rose = [now != before for before, now in itertools.pairwise([["0"] * len(COUNTS), *late])]
    assert [bool(status.level) for status in gate] == rose
    with open(next((run.there / "run").glob("*.mcap")), "rb") as bag:
        told = [m.data for _, _, m in make_reader(bag).iter_messages(topics=["/diagnostics"])]
    assert any(b"inactive -> active: autostart" in data for data in told)
    assert any(b"active -> inactive: the end of the run" in data for data in told)


@pytest.mark.alone
@pytest.mark.parametrize(
    "name", ["e727_200hz_emulated", "nv200_serial_emulated", "labjack_t7_emulated"]
)
def test_the_same_experiment_runs_on_every_device(start_pea, name):
    T_s = resolve("plant", Params, [rigs.read(name)["plant"]]).T_s
    with faults.emulator(name) as device:
        run = start_pea(
            *("run", "fig9_hysteresis_10hz", "--rig", name, "--duration", "1", "--json"),
            *(
                "--set",
                f"plant.driver.address={device.address}",
                "--set",
                "reference.frequency_hz=2",
            ),
            *("--set", "plant.driver.timeout_s=5", "--set", "plant.safety.stale_samples=1000"),
        )
        figures = run.finish().metrics
        told = device.control.log()
    assert figures["lost_samples"] == 0
    assert figures["samples"] == round(1.0 / T_s)
    assert figures["rms_error_percent"] < 10.0
    assert told["last_voltage_V"]["value"] == pytest.approx(0.0, abs=faults.REST)
    assert not [what for what in told["counts"] if "error" in what or "refused" in what]


@pytest.mark.alone
@pytest.mark.parametrize("node", ["controller", "observer", "plant", "reference"])
def test_a_node_started_again_is_joined_again(ros, node):
    rig = ("--ros-args", "--params-file", str(config.find("rigs", "simulated_200hz", "rig")))
    fig9 = ("--params-file", str(config.find("experiments", "fig9_hysteresis_10hz", "experiment")))
    fault = node in ("controller", "observer")
    late = (f"safety.stale_samples:={200 if fault else 2000}", "safety.following_samples:=2000")
    patient = [word for rule in late for word in ("-p", rule)]
    more = {
        "plant": ("-p", "clock:=wall", *patient),
        "controller": ("-p", "K_i:=30.0"),  # stable though a busy machine is late by a third of 1 s
        "reference": (*fig9, "-p", "frequency_hz:=1.0"),
    }
    y, ends = [], [0]

    def ask(name):
        client = ros.node.create_client(Trigger, f"/pea/plant/{name}")
        assert ros.until(client.service_is_ready)
        asked = client.call_async(Trigger.Request())
        assert ros.until(asked.done)
        return asked.result()

    def moves():
        """Whether half of the sine's stroke has been seen lately."""
        return len(y) > 200 and max(y[-200:]) - min(y[-200:]) > 5e-6

    def supplied(message):
        stamp = message.header.stamp
        ends.append(round((stamp.sec + stamp.nanosec * 1e-9) / 5e-3) + len(message.points))

    heard = lambda message: y.append(message.position[0])  # noqa: E731
    ros.node.create_subscription(JointState, "/pea/displacement", heard, 1000)
    ros.node.create_subscription(JointTrajectory, "/pea/reference", supplied, 100)
    for each in ("plant", "observer", "controller", "reference"):
        ros.start(each, *rig, *more.get(each, ()))
    assert ros.until(moves), ros.log("plant")
    ros.end(node, signal.SIGKILL)  # the graph remembers it for 20 s
    if fault:
        ros.says("plant", "active -> fault: ")  # stale commands, or what follows from them
    known = max(ends)
    another = ("-p", "frequency_hz:=2.0") if node == "reference" else ()
    ros.start(node, *rig, *more.get(node, ()), *another)
    if fault:
        ros.says(node, "all neighbours are there")
        assert ask("reset").success
        assert ask("enable").success
    elif node == "plant":
        ros.says("plant", "inactive -> active")
        ros.says("controller", "begins with sample 0")
    else:
        assert ros.until(lambda: ends[-1] > known), "\n".join(map(ros.log, ros.processes))
    y.clear()
    looked = CHUNK // 2 if node == "reference" else 0  # samples until the controller looks at it
    assert ros.until(lambda: len(y) > looked and moves()), "\n".join(map(ros.log, ros.processes))
    assert ros.log("plant").count("-> fault") == fault
    paced = ("plant", "observer", "controller")
    urgent = {os.sched_getparam(ros.processes[each].pid).sched_priority > 0 for each in paced}
    assert len(urgent) == 1  # real time, where the plant has that
    assert all(process.poll() is None for process in ros.processes.values())


@pytest.mark.alone
def test_loop_time_waits_for_the_first_command(ros):
    y = []

    def heard(message):
        if not message.header.frame_id:  # else no sample
            y.append(message)

    ros.node.create_subscription(JointState, "/pea/displacement", heard, 1000)
    ros.node.create_publisher(JointState, "/pea/state", 10)
    ros.node.create_publisher(JointTrajectory, "/pea/reference", 10)
    voltage = ros.node.create_publisher(JointState, "/pea/voltage", 10)
    rig = str(config.find("rigs", "simulated_200hz", "rig"))
    ros.start("plant", "--ros-args", "--params-file", rig, "-p", "clock:=wall")
    assert ros.until(lambda: y)
    assert ros.until(voltage.get_subscription_count)
    assert not ros.until(lambda: len(y) > 1, 0.5)  # a controller gets ready
    voltage.publish(JointState(name=["x"], effort=[0.0]))  # for sample 0
    assert ros.until(lambda: len(y) > 10)


@pytest.mark.alone
def test_the_stage_can_be_watched_while_nothing_is_commanded(ros):
    """Marked by its frame_id, once loop time stands still; an observer answers none of it."""
    seen, answers = [], []
    heard = lambda message: seen.append(message.header.frame_id)  # noqa: E731
    ros.node.create_subscription(JointState, "/pea/displacement", heard, 1000)
    ros.node.create_subscription(JointState, "/pea/state", answers.append, 10)
    rig = ("--ros-args", "--params-file", str(config.find("rigs", "simulated_200hz", "rig")))
    ros.start("plant", *rig, "-p", "clock:=wall")
    ros.start("observer", *rig)
    assert ros.until(lambda: seen.count("inactive") > 2)
    client = ros.node.create_client(Trigger, "/pea/plant/stop")
    assert ros.until(client.service_is_ready)
    asked = client.call_async(Trigger.Request())
    assert ros.until(asked.done)
    assert asked.result().success
    assert "emergency_stop: asked by ~/stop; 0 V" in asked.result().message
    assert ros.until(lambda: seen.count("fault") > 2)
    assert not answers
    assert all(process.poll() is None for process in ros.processes.values())


@pytest.fixture(scope="module")
def tracking(tmp_path_factory):
    """A loop that tracks, on an emulator."""
    with faults.emulator() as device:
        patient = faults.loaded(  # the machine may halt for a while
            device.address, "plant.safety.stale_samples=1000", "plant.safety.following_samples=1000"
        )
        loop = faults.Loop(tmp_path_factory.mktemp("loop"), patient, device, None)
        try:
            loop.run_in()
            yield loop
        finally:
            loop.close()


def test_limits_are_tightened_while_it_runs_and_never_loosened(tracking):
    def param(*words):
        command = [sys.executable, "-m", "pea_cli.cli", "param", *words]
        env = tracking.env
        return subprocess.run(command, env=env, capture_output=True, text=True, timeout=60.0)

    looser = param("set", "plant", "safety.slew_rate=5000.0")
    assert looser.returncode != 0
    assert "safety.slew_rate = 5000: looser than 2000" in looser.stderr
    tighter = param("set", "plant", "safety.slew_rate=1000.0")
    assert tighter.returncode == 0, tighter.stderr
    assert "fault" not in tracking.log()


@pytest.mark.parametrize(
    ("rig", "says"),
    [
        (faults.RIG, "another process of this machine drives it"),
        # beside other tests the name of the second one comes later than the gate waits for it
        pytest.param(
            *("simulated_200hz", "2 plants publish /pea/displacement"), marks=pytest.mark.alone
        ),
    ],
)
def test_a_second_plant_is_refused_and_the_first_one_tracks_on(tracking, free_domain, rig, says):
    command, env = [*tracking.command("plant"), *tracking.arguments], tracking.env
    if rig == faults.RIG:
        env = {**env, "ROS_DOMAIN_ID": str(free_domain)}
    else:
        command = [*command[:-1], str(config.find("rigs", rig, "rig"))]
    command += ["-p", "clock:=wall"]
    second = subprocess.run(command, env=env, capture_output=True, text=True, timeout=60.0)
    assert second.returncode == 2, second.stderr
    assert says in second.stderr.splitlines()[-1]
    assert "fault" not in tracking.log()
    assert tracking.crew.processes["observer"].poll() is None
