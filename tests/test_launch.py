"""Launch files, as far as they can be looked at without the launch packages."""

import sys
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import pytest

from pea_core import config

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "ros2_ws/src/pea_bringup/launch"
FILES = sorted(FOLDER.glob("*.launch.py"))
NAMES = [f"launch{part}" for part in ("", ".actions", ".conditions", ".substitutions")]
NAMES += [f"launch_ros{part}" for part in ("", ".actions", ".substitutions")]


class Said:
    """Stands for anything of launch: remembers what it was made with."""

    made: ClassVar[list["Said"]] = []

    def __init__(self, *args: Any, **more: Any) -> None:
        self.args, self.more = args, more
        self.made.append(self)


@pytest.fixture
def loaded(monkeypatch):
    """A launch file's description, made of `Said`."""
    for name in NAMES:
        module = ModuleType(name)
        module.__getattr__ = lambda kind: type(kind, (Said,), {})  # type: ignore[method-assign]
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, "pea_bringup.parts", raising=False)
    monkeypatch.setattr(Said, "made", [])

    def load(path: Path) -> dict[str, list[Said]]:
        space: dict[str, Any] = {"__file__": str(path)}
        exec(compile(path.read_text(), path, "exec"), space)
        found: dict[str, list[Said]] = {}
        for action in space["generate_launch_description"]().args[0]:
            kind = type(action).__name__.replace("LifecycleNode", "Node")
            found.setdefault(kind, []).append(action)
        return found

    yield load
    sys.modules.pop("pea_bringup.parts", None)


def test_there_is_one_for_each_way_to_run():
    assert [path.name for path in FILES] == [
        "replay.launch.py",
        "rig.launch.py",
        "sim.launch.py",
    ]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_argument_is_documented_and_every_one_used_is_declared(loaded, path):
    declared = loaded(path)["DeclareLaunchArgument"]
    assert all(argument.more["description"] for argument in declared)
    used = {said.args[0] for said in Said.made if type(said).__name__ == "LaunchConfiguration"}
    assert used == {argument.args[0] for argument in declared}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_executable_is_one_of_its_package(loaded, path):
    for node in loaded(path).get("Node", ()):
        package, name = node.more["package"], node.more["executable"]
        assert f'"{name} = {package}.' in (ROOT / f"ros2_ws/src/{package}/setup.py").read_text()


@pytest.mark.parametrize("path", [p for p in FILES if "replay" not in p.name], ids=lambda p: p.stem)
def test_four_blocks_and_a_recorder_are_started(loaded, path):
    names = [node.more["executable"] for node in loaded(path)["Node"]]
    assert sorted(names) == sorted([*config.NODES, "recorder"])


@pytest.mark.parametrize("name", ["sim", "rig"])
def test_only_the_rig_is_in_wall_time_and_a_bag_is_waited_for(loaded, name):
    nodes = {n.more["executable"]: n for n in loaded(FOLDER / f"{name}.launch.py")["Node"]}
    for block in config.NODES:
        given = nodes[block].more["parameters"]
        assert ({"clock": "wall"} in given) is (name == "rig" and block == "plant")
        assert any("wait_for_recorder" in each for each in given if isinstance(each, dict))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_the_files_that_arguments_name_by_default_exist(loaded, path):
    defaults = {
        a.args[0]: a.more.get("default_value") for a in loaded(path)["DeclareLaunchArgument"]
    }
    for argument, folder in (("experiment", "experiments"), ("rig", "rigs")):
        if argument in defaults:
            assert (ROOT / f"config/{folder}/{defaults[argument]}.yaml").is_file()
    assert (ROOT / "config/fastdds.xml").is_file()


def test_replay_gives_options_that_the_command_has(loaded):
    from pea_runtime.cli import _parser

    (process,) = loaded(FOLDER / "replay.launch.py")["ExecuteProcess"]
    words = ["1.0" if isinstance(word, Said) else word for word in process.more["cmd"][1:]]
    arguments = _parser().parse_args(words)
    assert (arguments.command, arguments.publish, arguments.rate) == ("replay", True, "1.0")


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_the_packages_that_it_needs_are_in_the_manifest(path):
    manifest = (ROOT / "ros2_ws/src/pea_bringup/package.xml").read_text()
    needed = {"launch", "launch_ros"}
    if "block(" in path.read_text():
        needed |= {f"pea_{block}" for block in config.NODES}
    for package in needed:
        assert f"<exec_depend>{package}</exec_depend>" in manifest
