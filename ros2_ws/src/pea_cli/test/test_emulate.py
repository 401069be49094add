import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from pea_cli.cli import main
from pea_core.config import NODES, resolve_axes
from pea_drivers.emulator import Control
from pea_experiment import experiments, rig
from pea_plant.plant import Params

RIGS = Path(__file__).parents[4] / "config" / "rigs"


@pytest.fixture
def emulate():
    """Starts an emulator; ends it as Ctrl-C does and gives what it has said then."""
    processes = []

    def start(*words):
        process = subprocess.Popen(
            [sys.executable, "-m", "pea_cli.cli", "emulate", *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env={**os.environ, "PEA_COMPILE": "0"},
            text=True,
        )
        processes.append(process)
        return process

    yield start
    for process in processes:
        process.kill()
        process.communicate()


def test_it_tells_its_addresses_and_at_the_end_what_it_has_felt(emulate, tmp_path):
    log = tmp_path / "felt.json"
    process = emulate("gcs", "--rig", "e727_emulated", "--port", "0", "--log", str(log))
    address, control = (process.stdout.readline().strip() for _ in range(2))
    host, _, port = address.removeprefix("tcp://").partition(":")
    assert host == "127.0.0.1"
    with socket.create_connection((host, int(port)), 20.0) as way:
        way.sendall(b"SVA 1 33.5\nPOS? 1\n")
        assert way.recv(100).startswith(b"1=")
    channel = Control(control)
    assert channel.log()["last_voltage_V"]["value"] == 33.5
    channel.close()
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=20)
    assert (process.returncode, err) == (0, "")
    told = json.loads(out)
    assert told["max_voltage_V"]["value"] == told["last_voltage_V"]["value"] == 33.5
    assert json.loads(log.read_text()) == told


def test_faults_of_the_command_line_are_there_from_the_start(emulate):
    process = emulate("gcs", "--port", "0", "--fault", "refuse")
    port = int(process.stdout.readline().strip().rpartition(":")[2])
    with socket.create_connection(("127.0.0.1", port), 20.0) as way:
        assert way.recv(10) == b""


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["gsc"], "unknown device 'gsc': did you mean gcs?"),
        (["simulated"], "unknown device 'simulated'"),
        (["gcs", "--rig", "nonsense"], "unknown rig 'nonsense'"),
        (["gcs", "--fault", "dripp"], "fault 'dripp': unknown name 'dripp'"),
        (["gcs", "--port", "99999"], "--port = '99999': must be 0 to 65535"),
        (["gcs", "--port", "0", "--pty"], "not allowed with"),
        (["gcs", "--set", "latency_s"], "--set 'latency_s': write NAME=VALUE"),
        (["gcs", "--set", "latency=1"], "did you mean emulator.latency_s?"),
        (["gcs", "--set", "latency_s=-1"], "emulator.latency_s = -1: must be 0 to 10 s"),
        (["gcs", "--set", "axes=''"], "emulator.axes = '': give one axis at least"),
        (["gcs", "--log", "/"], "--log /: is a directory"),
    ],
)
def test_bad_input_is_one_line_and_status_2(words, says, capsys):
    assert main(["emulate", *words]) == 2
    err = capsys.readouterr().err
    assert says in " ".join(err.split())


@pytest.mark.parametrize("name", sorted(path.stem for path in RIGS.glob("*.yaml")))
def test_every_rig_is_described_whole_and_stable_at_its_rate(name):
    from pea_lab.check import check
    from pea_lab.coupled import check_axes

    values = rig.read(name)
    assert values[rig.SECTION]["description"]
    plant = resolve_axes("plant", Params, [values["plant"]])[0]
    assert {values[node].get("T_s") for node in NODES} == {plant.T_s}
    made = experiments.load_axes("fig9_hysteresis_10hz", rig=name)
    assert (check if len(made.axes) == 1 else check_axes)(made)["stable"]


def test_a_rig_of_another_driver_is_refused(tmp_path, capsys):
    path = tmp_path / "mine.yaml"
    path.write_text("/pea/plant:\n  ros__parameters:\n    driver: {type: simulated}\n")
    assert main(["emulate", "gcs", "--rig", str(path)]) == 2
    assert "its driver is simulated, not gcs" in " ".join(capsys.readouterr().err.split())


def test_an_emulator_that_lacks_a_package_names_it(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pea_drivers.modbus_daq.emulator", None)
    monkeypatch.delitem(sys.modules, "pea_drivers.modbus_daq.emulator")
    monkeypatch.setitem(sys.modules, "pymodbus.pdu", None)
    assert main(["emulate", "modbus_daq", "--port", "0"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "device 'modbus_daq': its emulator needs the Python package pymodbus" in said
