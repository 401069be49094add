"""The command line: bad input is refused in one line, good input says what was asked for."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import pytest
import yaml

from pea_cli import cli
from pea_cli import compare as compare_cli
from pea_cli import list as list_cli
from pea_cli import run as run_cli
from pea_core.console import Console
from pea_lab import compare
from pea_run.modes import distributed

ROOT = Path(__file__).resolve().parents[1]
FIG9 = "fig9_hysteresis_10hz"

NOTHING: dict = {}


@pytest.fixture
def pea(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Iterator[Callable[..., tuple[int, str, str]]]:
    """Run the command line in this process, in an empty directory."""
    monkeypatch.chdir(tmp_path)
    before = signal.getsignal(signal.SIGTERM)

    def run(*arguments: str) -> tuple[int, str, str]:
        capfd.readouterr()
        try:
            status = cli.main(list(arguments))
        except SystemExit as end:  # --help
            status = int(end.code or 0)
        return (status, *capfd.readouterr())

    yield run
    signal.signal(signal.SIGTERM, before)


def refused(result: tuple[int, str, str], *words: str) -> None:
    """Bad input: exit 2, one line that holds the words, nothing else, nothing made."""
    status, out, err = result
    assert (status, out) == (2, "")
    assert err.startswith("pea: ")
    assert err.endswith("\n")
    assert err.count("\n") == 1
    for word in words:
        assert word in err
    assert not Path("runs").exists()


DRIVING = {
    "run": ["run", FIG9],
    "run in one process": ["run", FIG9, "--mode", "composed"],
    "measure": ["measure", "noise"],
    "accept": ["accept", "--only", "noise", "--yes"],
    "commission": ["commission", "--yes"],
    "doctor": ["doctor", "--seconds", "0.1"],
}
LACKED = {"pymodbus": "labjack_t7_emulated", "serial": "nv200_serial_emulated"}


@pytest.mark.parametrize("package", LACKED)
@pytest.mark.parametrize("words", DRIVING.values(), ids=DRIVING)
def test_a_rig_whose_driver_lacks_a_package_is_refused(pea, monkeypatch, words, package):
    for name in [name for name in sys.modules if name.partition(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    name = "pea_drivers.modbus_daq.protocol"
    monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.delattr(sys.modules["pea_drivers.modbus_daq"], "protocol", raising=False)
    told = {"serial": "pyserial"}.get(package, package)
    monkeypatch.setattr(distributed.Crew, "start", None)
    refused(
        pea(*words, "--rig", LACKED[package]),
        "driver.type = ",
        f"the Python package {told} is missing: python3 -m pip install {told}",
    )


COMMANDS = {
    "unknown command": (["runn", FIG9], ["runn", "run"]),
    "no experiment": (["run"], ["EXPERIMENT"]),
    "two experiments": (["run", FIG9, "fig8_initial_condition"], ["fig8_initial_condition"]),
    "unknown option": (["run", FIG9, "--fast"], ["--fast"]),
    "unknown experiment": (["run", "fig9_hysteresis_10Hz"], [FIG9]),
    "unlike any experiment": (["run", "zzz"], [FIG9, "fig8_initial_condition"]),
    "empty experiment": (["run", ""], [FIG9]),
    "no such file": (["run", "mine.yaml"], ["mine.yaml", "no such file"]),
    "unknown mode": (["run", FIG9, "--mode", "distribute"], ["'distribute'", "distributed"]),
    "mode without value": (["run", FIG9, "--mode"], ["--mode"]),
    "rig in batch": (["run", FIG9, "--rig", "x", "--mode", "batch"], ["--mode batch", "clock"]),
    "rig unpaced": (["run", FIG9, "--rig", "x", "--clock", "unpaced"], ["unpaced", "clock"]),
    "no duration": (["run", FIG9, "--duration", "0"], ["0", "1e+06 s"]),
    "negative duration": (["run", FIG9, "--duration", "-1"], ["-1", "1e+06 s"]),
    "duration nan": (["run", FIG9, "--duration", "nan"], ["nan", "finite"]),
    "duration inf": (["run", FIG9, "--duration", "inf"], ["inf", "finite"]),
    "duration text": (["run", FIG9, "--duration", "long"], ["long", "number"]),
    "duration below a sample": (["run", FIG9, "--duration", "1e-6"], ["1e-06", "5e-05 s"]),
    "duration too long": (["run", FIG9, "--duration", "1e7"], ["1e+06 s"]),
    "seed not whole": (["run", FIG9, "--seed", "1.5"], ["1.5", "whole"]),
    "negative seed": (["run", FIG9, "--seed", "-1"], ["-1", "0 to"]),
    "seed text": (["run", FIG9, "--seed", "x"], ["--seed", "'x'", "number"]),
    "unknown node to run": (["node", "plnt"], ["'plnt'", "plant"]),
    "no address of a cluster": (["tune", FIG9, "--scheduler", "x"], ["'x'", "tcp://HOST:PORT"]),
    "a scheduler unasked": (
        ["tune", FIG9, "--scheduler", "tcp://127.0.0.1:1"],
        ["run code as you", "--trust-scheduler"],
    ),
    "a scheduler without certificates": (
        ["tune", FIG9, "--scheduler", "tls://127.0.0.1:1"],
        ["--tls-ca-file"],
    ),
    "certificates for plain TCP": (
        ["tune", FIG9, "--scheduler", "tcp://127.0.0.1:1", "--tls-cert", "x"],
        ["tls://HOST:PORT"],
    ),
    "a node with an option of nobody": (["node", "plant", "--fast"], ["--fast", "--ros-args"]),
    "list of something": (["list", "plants"], ["plants"]),
}

SETS = {
    "no equals sign": ("controller.P", ["'controller.P'", "NODE.PARAM=VALUE"]),
    "no node": ("P=1", ["'P=1'", "NODE.PARAM=VALUE", "controller"]),
    "empty": ("=1", ["NODE.PARAM=VALUE"]),
    "no parameter": ("plant.=1", ["plant."]),
    "unknown node": ("controler.P=1", ["'controler'", "controller"]),
    "unknown parameter": ("controller.p=1", ["controller.p", "controller.P"]),
    "unlike any parameter": ("reference.zzz=1", ["reference.zzz", "amplitude_um"]),
    "a group": ("plant.hysteresis=none", ["plant.hysteresis", "plant.hysteresis.type"]),
    "parameter of another type": ("controller.eta=1", ["controller.eta", "type"]),
    "unknown type": ("observer.type=extended", ["'extended'", "extended_state"]),
    "unknown inner type": ("plant.hysteresis.type=bouc", ["'bouc'", "bouc_wen"]),
    "unknown preset": ("controller.preset=paper_set3", ["'paper_set3'", "paper_set2"]),
    "no such preset file": ("controller.preset=my.yaml", ["my.yaml", "no such file"]),
    "below the range": ("plant.K=-1", ["plant.K = -1", "um/V"]),
    "above the range": ("plant.zeta=1e9", ["plant.zeta", "to"]),
    "nan": ("plant.K=.nan", ["nan", "finite"]),
    "nan as text": ("plant.K=nan", ["nan", "finite"]),
    "inf": ("controller.P=.inf", ["inf", "finite"]),
    "text for a number": ("plant.K=abc", ["'abc'", "number"]),
    "nothing for a number": ("plant.K=", ["plant.K", "number"]),
    "truth for a number": ("plant.K=true", ["True", "number"]),
    "list for a number": ("plant.K=[1]", ["[1]", "number"]),
    "number for a truth": ("plant.creep.enabled=1", ["1", "true or false"]),
    "number for a text": ("observer.type=3", ["3", "extended_state"]),
    "fraction for a whole number": ("plant.delay_samples=0.5", ["0.5", "whole"]),
    "two lines": ("plant.K=a\nb", ["plant.K"]),
    "limits the wrong way round": ("plant.voltage_min=2000", ["2000", "voltage_max"]),
    "limits wider than the plant's": ("controller.voltage_max=2000", ["2000", "-1000 to 1000 V"]),
    "no true velocity": ("plant.sensor.ideal=false", ["passthrough", "plant.sensor.ideal=true"]),
    "no whole number of ns": ("T_s=5.00005e-5", ["5.00005e-05", "nanoseconds", "5e-05"]),
    "T_s of one node": ("observer.T_s=1e-4", ["observer.T_s", "0.0001", "plant.T_s"]),
    "T_s of zero": ("T_s=0", ["T_s = 0"]),
    "unknown of the experiment": ("experiment.length=1", ["experiment.length", "duration"]),
    "T_s too long": ("T_s=20", ["T_s = 20", "10 s"]),
}


@pytest.mark.parametrize(("arguments", "words"), COMMANDS.values(), ids=COMMANDS)
def test_bad_command_is_refused(pea, arguments, words):
    refused(pea(*arguments), *words)


@pytest.mark.parametrize(("text", "words"), SETS.values(), ids=SETS)
def test_bad_set_is_refused(pea, text, words):
    refused(pea("run", FIG9, "--set", text), *words)


FILES = {
    "unknown node": ({"/pea/plnt": {"ros__parameters": {}}}, ["/pea/plnt", "plant"]),
    "unknown parameter": ({"/pea/plant": {"ros__parameters": {"KK": 1}}}, ["plant.KK", "plant.K"]),
    "unknown inner parameter": (
        {"/pea/plant": {"ros__parameters": {"sensor": {"noise": 1}}}},
        ["plant.sensor.noise", "plant.sensor.noise_nm"],
    ),
    "out of range": ({"/pea/plant": {"ros__parameters": {"K": -1.0}}}, ["plant.K = -1.0"]),
    "wrong type": ({"/pea/plant": {"ros__parameters": {"K": "x"}}}, ["plant.K = 'x'"]),
    "another key": ({"/pea/plant": {"parameters": {"K": 1}}}, ["/pea/plant", "ros__parameters"]),
    "values without a section": ({"K": 1}, ["K", "ros__parameters"]),
    "duration 0": ({"/pea/experiment": {"ros__parameters": {"duration": 0.0}}}, ["duration"]),
    "no mapping of values": ({"/pea/plant": {"ros__parameters": [1]}}, ["/pea/plant", "names"]),
}


@pytest.mark.parametrize(("tree", "words"), FILES.values(), ids=FILES)
def test_bad_experiment_file_is_refused(pea, tree, words):
    Path("mine.yaml").write_text(yaml.safe_dump(tree))
    refused(pea("run", "mine.yaml"), *words)


@pytest.mark.parametrize(
    "text",
    ["/pea/plant: [", "just words", "[1, 2]", "", "\x00", "a: 1\n b: 2\n", "!!python/object:x {}"],
)
def test_file_that_is_no_parameter_file_is_refused(pea, text):
    Path("mine.yaml").write_text(text)
    refused(pea("run", "mine.yaml"), "mine.yaml")


def test_file_that_is_no_text_is_refused(pea):
    Path("mine.yaml").write_bytes(b"\xff\xfe\x00\x01")
    refused(pea("run", "mine.yaml"), "mine.yaml", "no utf-8 text")


def test_same_key_twice_is_refused(pea):
    section = "/pea/plant:\n  ros__parameters:\n    K: 0.1\n    K: 0.2\n"
    Path("mine.yaml").write_text(section)
    refused(pea("run", "mine.yaml"), "mine.yaml", "K")


def test_existing_directory_is_refused_and_untouched(pea):
    Path("mine").mkdir()
    (Path("mine") / "kept.txt").write_text("kept")
    refused(pea("run", FIG9, "--out", "mine"), "mine", "exists")
    assert [p.name for p in Path("mine").iterdir()] == ["kept.txt"]


@pytest.mark.parametrize("make", [Path.mkdir, Path.touch], ids=["directory", "file"])
def test_existing_out_is_refused(pea, make):
    make(Path("mine"))
    refused(pea("run", FIG9, "--out", "mine"), "mine", "exists")


def test_out_below_a_file_is_refused(pea):
    Path("mine").touch()
    refused(pea("run", FIG9, "--out", "mine/run"), "mine/run")


def test_alone_prints_its_help(pea):
    status, out, err = pea()
    assert status == 0
    assert all(word in out for word in ("list", "run", "node"))
    assert err == ""


@pytest.mark.parametrize("arguments", [["--help"], ["run", "--help"], ["list", "--help"]])
def test_help(pea, arguments):
    status, out, err = pea(*arguments)
    assert (status, err) == (0, "")
    assert "usage: pea" in out


def test_help_of_run_names_every_option(pea):
    _, out, _ = pea("run", "--help")
    assert all(
        option in out for option in ("--mode", "--duration", "--set", "--seed", "--out", "--json")
    )


def test_version_is_one_line(pea):
    status, out, err = pea("--version")
    assert (status, err, out.count("\n")) == (0, "", 1)
    assert re.fullmatch(r"pea \d+\.\d+\.\d+\n", out)


@pytest.mark.parametrize("option", ["--help", "-h"])
def test_help_of_a_node_starts_none(pea, option):
    status, out, err = pea("node", "plant", option)
    assert (status, err) == (0, "")
    assert "usage: pea node plant" in out


def test_a_package_that_is_missing_is_one_line(pea, monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    status, out, err = pea("tune", FIG9, "--trials", "1", "--workers", "1")
    assert (status, out.count("Traceback"), err.count("\n")) == (2, 0, 1), err
    assert "optuna is missing" in err


def test_runs_that_leads_nowhere_is_refused(pea, tmp_path):
    Path("runs").symlink_to(tmp_path / "gone")
    status, _, err = pea("run", FIG9, "--duration", "0.001")
    assert (status, err.count("\n")) == (2, 1)
    assert "gone" in err


def test_a_directory_called_latest_stays(pea):
    (Path("runs") / "latest").mkdir(parents=True)
    status, _, err = pea("run", FIG9, "--duration", "0.001")
    assert (status, err.count("warning: runs/latest")) == (0, 1)
    names = {path.name for path in Path("runs").iterdir()}
    assert len(names) == 2
    assert not any(name.startswith(".") for name in names)


def test_a_worker_that_was_killed_is_one_line(pea, monkeypatch):
    def die(*_: object) -> None:
        raise BrokenProcessPool

    monkeypatch.setattr(compare, "run", die)
    status, out, err = pea("compare", FIG9, "--controllers", "pid", "--duration", "0.01")
    assert (status, "Traceback" in out + err) == (3, False)
    assert "pea: a worker process was killed" in err


def test_a_switch_that_is_neither_0_nor_1_is_refused(pea, monkeypatch):
    monkeypatch.setenv("PEA_COMPILE", "yes")
    refused(pea("run", FIG9), "PEA_COMPILE = 'yes'", "give 0 (never) or 1 (always)")


@pytest.mark.parametrize(
    ("variable", "value"), [("ROS_DOMAIN_ID", "abc"), ("ROS_DOMAIN_ID", "999")]
)
def test_a_graph_that_there_is_not_is_refused(pea, monkeypatch, variable, value):
    monkeypatch.setenv(variable, value)
    refused(pea("param", "list"), value)


def test_list_names_what_there_is(pea):
    status, out, err = pea("list")
    assert (status, err) == (0, "")
    for name in (FIG9, "fig8_initial_condition", "pidsmc", "extended_state", "sine", "paper_set1"):
        assert name in out
    for title in ("experiments", "plants", "observers", "controllers", "references", "drivers"):
        assert title in out


def test_list_as_json(pea):
    status, out, err = pea("list", "--json")
    assert (status, err) == (0, "")
    assert {FIG9, "fig8_initial_condition"} <= set(json.loads(out)["experiments"])
    assert "cannot be used" not in out


def test_json_is_the_metrics_and_nothing_else(pea):
    status, out, err = pea("run", FIG9, "--duration", "0.01", "--json")
    assert status == 0
    assert "Traceback" not in err
    assert json.loads(out) == json.loads(Path("runs/latest/metrics.json").read_text())


def test_run_prints_its_metrics_and_where_they_are(pea):
    status, out, err = pea("run", FIG9, "--duration", "0.2")
    assert (status, err) == (0, "")
    assert "rms_error" in out
    told = json.loads(Path("runs/latest/metrics.json").read_text())
    assert told["trace_sha256"] in re.sub(r"[^0-9a-f]", "", out)
    there = Path("runs/latest").resolve()
    assert there.name in out
    assert {"metrics.json", "report.png", "metadata.yaml", "params.yaml"} <= {
        p.name for p in there.iterdir()
    }
    assert (there / "report.png").read_bytes().startswith(b"\x89PNG")


def test_latest_points_at_the_last_run(pea):
    for seed in ("1", "2"):
        assert pea("run", FIG9, "--duration", "0.001", "--seed", seed)[0] == 0
        kept = yaml.safe_load(Path("runs/latest/params.yaml").read_text())
        assert kept["/pea/plant"]["ros__parameters"]["seed"] == int(seed)
    assert len(list(Path("runs").iterdir())) == 3


def test_out_is_made_and_latest_left_alone(pea):
    assert pea("run", FIG9, "--duration", "0.001", "--out", "some/where new")[0] == 0
    assert (Path("some/where new") / "metrics.json").exists()
    assert not Path("runs").exists()


def test_written_parameters_run_again(pea):
    sets = ("--set", "plant.sensor.noise_nm=0.7", "--set", "plant.creep.enabled=true")
    first = pea("run", FIG9, "--duration", "0.02", "--seed", "7", "--json", *sets)
    again = pea("run", "runs/latest/params.yaml", "--json")
    assert first[0] == again[0] == 0
    one, two = json.loads(first[1]), json.loads(again[1])
    assert one["trace_sha256"] == two["trace_sha256"]
    assert one["samples"] == two["samples"] == 400


def test_later_set_wins(pea):
    assert pea("run", FIG9, "--duration", "0.001", "--set", "plant.K=0.1", "--set", "plant.K=0.2")[
        0
    ] == (0)
    kept = yaml.safe_load(Path("runs/latest/params.yaml").read_text())
    assert kept["/pea/plant"]["ros__parameters"]["K"] == 0.2


def test_preset_lies_under_what_is_set(pea):
    sets = ("--set", "controller.preset=recommended", "--set", "controller.I=3")
    assert pea("run", FIG9, "--duration", "0.001", *sets)[0] == 0
    kept = yaml.safe_load(Path("runs/latest/params.yaml").read_text())
    found = kept["/pea/controller"]["ros__parameters"]
    assert (found["m"], found["I"], found["eps_compensation"]) == (5000.0, 3.0, True)


def test_script_at_the_root_needs_no_sourcing(tmp_path):
    there = tmp_path / "a place"
    there.mkdir()
    done = subprocess.run(
        [str(ROOT / "pea"), "run", FIG9, "--duration", "0.001", "--json"],
        cwd=there,
        env={"PATH": "/usr/bin:/bin", "HOME": str(tmp_path)},
        capture_output=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["samples"] == 20


def test_presets_are_listed_with_whole_sentences():
    for title, entries in list_cli.lists().items():
        if title.endswith("presets"):
            assert [text for text in entries.values() if not text.endswith(".")] == []


@pytest.mark.parametrize(
    ("counts", "warns"),
    [
        ({"late": 17, "missing": 17, "overruns": 4}, False),
        ({"late": 0, "missing": 2600, "overruns": 0}, True),
        ({"late": 4000, "missing": 0, "overruns": 0}, True),
        ({}, False),
    ],
)
def test_a_run_whose_commands_came_too_late_is_warned_of(counts, warns):
    from pea_run.run import held_up

    told = held_up({"samples": 5000, "commands": counts})
    assert bool(told) is warns
    assert all(f"{count} {name}" in told for name, count in counts.items() if warns and count)


def test_the_table_shows_what_a_rig_run_has_counted(capsys):

    figures = {"soft_start_s": 0.25, "commands": {"late": 3, "missing": 2, "overruns": 1}}
    run_cli.out.print(run_cli.table(figures))
    rows = [
        [cell.strip() for cell in line.split("│")[1:-1]]
        for line in capsys.readouterr().out.splitlines()
    ]
    assert ["soft_start_s", "0.25", "s"] in rows
    assert ["commands late", "3", ""] in rows
    assert ["commands missing", "2", ""] in rows
    assert ["periods overrun", "1", ""] in rows


@pytest.mark.parametrize("frequencies", [1, 5, 12])
@pytest.mark.parametrize(
    "failure", ["", "the loop is unstable on the nominal plant: a pole at 1.25"]
)
def test_a_comparison_fits_80_columns_with_every_number_whole(capsys, frequencies, failure):
    names = ("smc_boundary_layer", "pid", "config/controllers/a_long_name_of_a_preset.yaml")
    rows = [
        {
            "controller": name,
            "rms_error_nm": 1.23456e-13,
            "max_error_nm": 1234567.0,
            "rms_error_percent": 0.351,
            "rms_voltage_step_V": 0.447,
            "overshoot_percent": 20.6,
            "settling_time_ms": 1.35,
            "segments": [
                {"frequency_hz": 10.0 * i + 150.0, "rms_error_nm": 0.111 * i + 1e-9}
                for i in range(frequencies)
            ],
            "failure": failure if name == "pid" else "",
        }
        for name in names
    ]
    heads, cells = compare.table(rows)
    for table in compare_cli.side_by_side(heads, cells, 80):
        Console(width=80).print(table)
    said = capsys.readouterr().out
    assert max(map(len, said.splitlines())) <= 80
    numbers = [row[i] for row in cells for i, head in enumerate(heads) if i and head]
    assert set(numbers) <= set(said.split())
    assert failure.split()[:1] == [] or failure.split()[0] in said
