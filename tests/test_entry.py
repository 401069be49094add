"""The first moments of every program: what is imported from where, and Ctrl-C meanwhile."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from ament_index_python.packages import get_package_prefix
from rclpy.impl.implementation_singleton import rclpy_implementation

from pea_core.entry import leave_working_directory, line_of

ROOT = Path(__file__).resolve().parents[1]
FIG9 = "fig9_hysteresis_10hz"
POISON = ("yaml", "numpy", "json", "rclpy", "rich", "scipy", "pea_core")


def executable(node: str) -> str:
    package = "pea_run" if node == "recorder" else f"pea_{node}"
    return f"{get_package_prefix(package)}/lib/{package}/{node}"


@pytest.fixture
def poisoned(tmp_path: Path) -> Path:
    """A directory of modules that leave a mark when they are imported."""
    there = tmp_path / "there"
    there.mkdir()
    for name in POISON:
        mark = tmp_path / f"{name}.imported"
        (there / f"{name}.py").write_text(f"open({str(mark)!r}, 'w').close()\nraise SystemExit(9)")
    return there


def done(command: list[str], there: Path, **env: str) -> subprocess.CompletedProcess[str]:
    """Run a command where the poison lies; see that none of it was imported."""
    ended = subprocess.run(
        command, cwd=there, env={**os.environ, **env}, capture_output=True, text=True, timeout=100
    )
    assert not [*there.parent.glob("*.imported")], ended.stderr
    return ended


COMMANDS = {
    "list": ("list",),
    "batch": ("run", FIG9, "--duration", "0.005"),
    "nodes": ("run", FIG9, "--mode", "distributed", "--duration", "0.005", "--no-record"),
    "workers": ("compare", FIG9, "--controllers", "pid", "--duration", "0.005"),
}


@pytest.mark.parametrize("words", COMMANDS.values(), ids=COMMANDS)
def test_no_command_imports_from_the_working_directory(poisoned, words):
    path = f":{os.environ['PYTHONPATH']}:."
    ended = done([str(ROOT / "pea"), *words], poisoned, PYTHONPATH=path, PYTHONSAFEPATH="")
    assert ended.returncode == 0, ended.stderr


@pytest.mark.parametrize("node", ["plant", "recorder"])
def test_no_node_does(poisoned, node):
    path = f"{os.environ['PYTHONPATH']}:"
    command = [executable(node), "--ros-args", "--no-such-option"]
    ended = done(command, poisoned, PYTHONPATH=path, PYTHONSAFEPATH="")
    assert (ended.returncode, ended.stderr.count("\n")) == (2, 1), ended.stderr


def test_a_module_run_by_python_does_not_either(poisoned):
    (poisoned / "pea_core.py").unlink()  # who asks Python for this module finds it there
    ended = done([sys.executable, "-m", "pea_cli.cli", "list"], poisoned, PYTHONSAFEPATH="")
    assert ended.returncode == 0, ended.stderr


def test_what_was_named_as_a_whole_path_stays(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    here = str(tmp_path)
    path = ["/lib", here, f"{here}/mine", "/opt"]
    env = {"PYTHONPATH": f"{here}::mine:/opt"}
    leave_working_directory(path, env)
    assert path == ["/lib", here, "/opt"]
    assert env == {"PYTHONPATH": f"{here}:/opt", "PYTHONSAFEPATH": "1"}


@pytest.mark.parametrize(("command", "status"), [(["pea", "list"], 130), (["plant"], 0)])
def test_ctrl_c_before_anything_has_begun_is_silent(tmp_path, command, status):
    if command[0] == "pea":
        words, hold = [str(ROOT / "pea"), *command[1:]], lambda: None
    else:  # as `pea run` starts its nodes
        words = [executable(command[0])]
        hold = lambda: signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])  # noqa: E731
    process = subprocess.Popen(
        words, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, preexec_fn=hold
    )
    if command[0] == "pea":  # a shell script until it has become Python
        while b"python" not in Path(f"/proc/{process.pid}/cmdline").read_bytes().split(b"\0")[0]:
            assert process.poll() is None
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err) == (status, b"", b"")


@pytest.mark.parametrize(
    ("said", "line"),
    [
        ("error creating node: no\n room", "error creating node: no room"),
        ("Failed to create std::thread: Resource temporarily unavailable", "there is not enough"),
    ],
)
def test_what_the_middleware_refuses_is_one_line(said, line):
    assert (line_of(rclpy_implementation.RCLError(said)) or "").startswith(line)


@pytest.mark.parametrize("name", ["a b", "a:b", "a\tb"])
def test_a_checkout_that_ros_cannot_run_in_is_refused_in_one_line(tmp_path, name):
    """Also one that has been moved there after its setup."""
    there = tmp_path / name
    for part in ("pea", ".ci/env", ".ci/setup", "install/.ready"):
        (there / part).parent.mkdir(parents=True, exist_ok=True)
        (there / part).touch()
        if part != "install/.ready":
            shutil.copy(ROOT / part, there / part)
    for command in ("pea", ".ci/env", ".ci/setup"):
        ended = subprocess.run(
            [str(there / command), "list"], capture_output=True, text=True, timeout=100, check=False
        )
        assert ended.returncode == 2
        (line,) = ended.stderr.splitlines()
        assert line.startswith(f"{there}: ROS cannot run programs below a path with a space")


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("pea_mine.model", "the package pea_mine of pea is not built here: make setup"),
        ("rclpy", "python3 -m pip install '.[ros]'"),
        ("serial", "python3 -m pip install pyserial"),
    ],
)
def test_what_is_missing_is_named_with_what_brings_it(name, line):
    assert line in (line_of(ModuleNotFoundError(name=name)) or "")
