import os
import resource
import subprocess
from pathlib import Path

import numpy as np
import pytest

from pea_core.params import build
from pea_drivers.gcs import emulator
from pea_native import build as c
from pea_plant.plant import Params
from pea_run import doctor
from pea_run.deadlines import Deadlines

CPU = "sys/devices/system/cpu"


@pytest.fixture
def machine(tmp_path):
    """A machine that holds anything; files can be given other contents."""

    def put(name: str, text: str) -> Path:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n")
        return tmp_path

    put("sys/kernel/realtime", "1")
    put("proc/cpuinfo", "processor : 0\nflags : fpu tsc\n\nprocessor : 1\nflags : fpu tsc")
    put(f"{CPU}/isolated", "1,3-5")
    put(f"{CPU}/cpu0/cpufreq/scaling_governor", "performance")
    put(f"{CPU}/cpu1/cpufreq/scaling_governor", "performance")
    put("sys/devices/system/clocksource/clocksource0/current_clocksource", "tsc")
    put("proc/sys/kernel/sched_rt_runtime_us", "950000")
    put("proc/sys/kernel/sched_rt_period_us", "1000000")
    put(f"{CPU}/cpu0/cpuidle/state0/latency", "2")
    return put


def root_of(put) -> Path:
    return put("marker", "")


def test_a_list_of_cores_is_read_as_the_kernel_writes_it():
    assert doctor.cpus_of("1,3-5") == {1, 3, 4, 5}
    assert doctor.cpus_of("0") == {0}
    assert doctor.cpus_of("") == set()


def test_one_core_is_too_few():
    assert doctor.cores({0, 1}).fine
    assert not doctor.cores({0}).fine


def test_kernel_is_recognised_by_its_file_and_by_its_name(machine):
    assert doctor.preemption(root_of(machine), "#1 SMP").fine
    root = machine("sys/kernel/realtime", "0")
    assert not doctor.preemption(root, "#1 SMP PREEMPT_DYNAMIC").fine
    assert doctor.preemption(root, "#1 SMP PREEMPT_DYNAMIC").found == "PREEMPT_DYNAMIC"
    assert doctor.preemption(root, "#1 SMP PREEMPT_RT Debian").fine


def test_virtual_machine_is_told(machine):
    assert doctor.virtual(root_of(machine)).fine
    assert not doctor.virtual(machine("proc/cpuinfo", "flags : fpu hypervisor tsc")).fine


def test_core_must_be_an_isolated_one(machine):
    root = root_of(machine)
    assert doctor.isolated(root, {0, 1}, None).fine
    assert doctor.isolated(root, {0, 1}, 1).fine
    assert not doctor.isolated(root, {0, 1}, 0).fine
    none = doctor.isolated(machine(f"{CPU}/isolated", ""), {0, 1}, None)
    assert (none.fine, none.found) == (False, "none")
    assert "isolcpus=1" in none.advice


def test_every_core_needs_the_governor(machine):
    assert doctor.governor(root_of(machine), {0, 1}).fine
    root = machine(f"{CPU}/cpu1/cpufreq/scaling_governor", "powersave")
    assert not doctor.governor(root, {0, 1}).fine
    assert doctor.governor(root, {0}).fine


def test_slow_idle_states_count_where_they_cannot_be_held_off(machine):
    assert doctor.idle_states(root_of(machine), False).fine
    root = machine(f"{CPU}/cpu0/cpuidle/state3/latency", "133")
    assert not doctor.idle_states(root, False).fine
    assert "133 us" in doctor.idle_states(root, False).found
    assert doctor.idle_states(root, True).fine
    machine(f"{CPU}/cpu0/cpuidle/state3/disable", "1")
    assert doctor.idle_states(root, False).fine


def test_clock_source_must_be_fast(machine):
    assert doctor.clock_source(root_of(machine)).fine
    name = "sys/devices/system/clocksource/clocksource0/current_clocksource"
    assert not doctor.clock_source(machine(name, "hpet")).fine


@pytest.mark.parametrize(
    ("limit", "root_user", "fine"),
    [(0, False, False), (79, False, False), (80, False, True), (0, True, True), (-1, False, True)],
)
def test_priority_needs_its_limit_or_root(limit, root_user, fine):
    assert doctor.priority(limit, root_user).fine is fine


@pytest.mark.parametrize(
    ("limit", "root_user", "fine"),
    [(8 << 20, False, False), (8 << 20, True, True), (resource.RLIM_INFINITY, False, True)],
)
def test_memory_needs_no_limit_or_root(limit, root_user, fine):
    assert doctor.memory(limit, root_user).fine is fine


@pytest.mark.parametrize(
    ("runtime", "fine"), [("950000", True), ("-1", True), ("500000", False), ("0", False)]
)
def test_real_time_share_must_be_most_of_a_core(machine, runtime, fine):
    root = machine("proc/sys/kernel/sched_rt_runtime_us", runtime)
    assert doctor.throttling(root).fine is fine


def test_every_finding_that_is_not_fine_says_what_to_do(tmp_path):
    findings = doctor.findings(root=tmp_path)
    assert len({finding.what for finding in findings}) == len(findings) == 11
    for finding in findings:
        assert finding.found
        assert bool(finding.advice) is not finding.fine


def test_this_machine_can_be_looked_at():
    assert doctor.findings(min(os.sched_getaffinity(0)))


@pytest.mark.parametrize(
    ("missed", "words"), [(0, ": held, 0"), (50, ": held with gaps"), (1000, ": not held")]
)
def test_verdict_goes_by_the_missed_deadlines(missed, words):
    times = np.zeros((10_000, 2), np.int64)
    times[:missed, 1] = 60_000
    deadlines = Deadlines(50_000)
    deadlines.add(times)
    assert words in doctor.verdict(deadlines)


@pytest.mark.parametrize("switch", "01")
def test_measured_loop_counts_every_sample_but_the_warm_up(monkeypatch, switch):
    monkeypatch.setenv("PEA_COMPILE", switch)
    monkeypatch.setattr(doctor, "WARM_UP", 20)
    usual = os.sched_getaffinity(0)
    deadlines = doctor.measure(0.005, min(usual))
    assert deadlines.samples == 100
    assert deadlines.latest >= 0
    assert deadlines.conditions["cpu"] == min(usual)
    assert os.sched_getaffinity(0) == usual
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


@pytest.fixture
def board():
    """Address of a board over UDP, a process, that samples each millisecond."""
    if not c.compiler():
        pytest.skip("no C compiler")
    program = c.made(sorted(c.BOARD.glob("*.c")), "board", shared=False)
    command = [str(program), "udp://127.0.0.1:0", "1000000"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        yield f"udp://127.0.0.1:{int(process.stdout.readline().split()[1])}"
    finally:
        process.terminate()
        process.communicate()


@pytest.fixture
def controller():
    """Address of a controller over TCP."""
    with emulator.make(build(Params, {"driver.type": "gcs"}), emulator.Params(), 0) as device:
        yield device.address


@pytest.mark.parametrize(
    ("kind", "device", "identity", "says"),
    [
        ("udp", "board", "board", "1000 Hz, the device's pace: "),
        ("gcs", "controller", "Physik Instrumente", "1000 Hz: "),
    ],
)
def test_the_exchange_of_a_rig_is_measured_and_commands_nothing(
    request, monkeypatch, kind, device, identity, says
):
    monkeypatch.setenv("PEA_COMPILE", "0")
    values = {"driver.type": kind, "driver.address": request.getfixturevalue(device)}
    plant = build(Params, {**values, "driver.timeout_s": 20.0})
    found = doctor.line(plant, 1e-3, 0.1)
    assert identity in found.identity
    assert found.paced == (kind == "udp")
    assert found.deadlines.samples == found.exchanges.samples == 100
    figures = found.figures()
    assert 0.0 < figures["exchange_us_p50"] <= figures["exchange_us_max"]
    assert figures["lost_by_device"] >= 0
    assert doctor.holds(found).startswith(says)


def test_the_exchange_of_two_axes_is_one(monkeypatch):
    monkeypatch.setenv("PEA_COMPILE", "0")
    values = {"driver.type": "gcs", "driver.timeout_s": 20.0}
    several = tuple(build(Params, {**values, "driver.axis": name}) for name in "12")
    timing = emulator.Params(axes="1 2", stages=2)
    with emulator.make(several, timing, 0) as device:
        there = {**values, "driver.address": device.address}
        plants = tuple(build(Params, {**there, "driver.axis": name}) for name in "12")
        found = doctor.line(plants, 1e-3, 0.05)
        felt = device.told()
    assert "Physik Instrumente" in found.identity
    assert found.exchanges.samples == 50
    assert felt["counts"].get("commands", 0) == 0
    assert felt["counts"]["connections"] == 1
