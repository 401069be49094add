"""Values of a node by where they come from, as ROS arguments give them."""

import pytest

from pea_core.config import resolve
from pea_observer.model import CHOICE
from pea_ros import context
from pea_ros.params import sources

FILE = """/pea/observer:
  ros__parameters: {type: levant, eps_rate: 40000.0, omega_min: 9000.0, K: 0.15}
"""


@pytest.fixture
def file(tmp_path):
    def of(text, name="one.yaml"):
        (tmp_path / name).write_text(text)
        return str(tmp_path / name)

    return of


def found(given, *arguments):
    """What an observer runs where ROS lays `given` over each other from such arguments."""
    context.given.read(["observer", "--ros-args", *arguments])
    return resolve("observer", CHOICE, sources("/pea/observer", given)).values


IN_FILE = {"type": "levant", "eps_rate": 40000.0, "omega_min": 9000.0, "K": 0.15}


def test_a_preset_of_the_command_line_replaces_what_a_file_names(file):
    given = {**IN_FILE, "preset": "kalman"}
    values = found(given, "--params-file", file(FILE), "-p", "preset:=kalman")
    assert (values["type"], values["preset"], values["K"]) == ("kalman", "kalman", 0.15)
    assert "eps_rate" not in values


@pytest.mark.parametrize("name", ["type", "/pea/observer:type"])
def test_a_type_of_the_command_line_replaces_the_files(file, name):
    given = {**IN_FILE, "type": "extended_state"}
    values = found(given, "--params-file", file(FILE), "-p", f"{name}:=extended_state")
    assert (values["type"], values["omega_o"], values["K"]) == ("extended_state", 20000.0, 0.15)


def test_a_later_file_is_stronger(file):
    later = file("/pea/observer:\n  ros__parameters: {preset: kalman}\n", "two.yaml")
    given = {**IN_FILE, "preset": "kalman"}
    values = found(given, "--params-file", file(FILE), "--params-file", later)
    assert values["type"] == "kalman"


def test_what_no_source_is_known_of_is_the_weakest():
    assert found({"type": "levant"}, "-p", "K:=0.2")["type"] == "levant"
    assert found({"type": "levant", "preset": "kalman"}, "-p", "preset:=kalman")["type"] == "kalman"
