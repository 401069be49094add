"""Launch files, as far as they can be looked at without the launch packages."""

import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import pytest

from pea_core import config
from pea_core.params import ParameterError
from pea_ros import paths

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "ros2_ws/src/pea_bringup/launch"
FILES = sorted(FOLDER.glob("*.launch.py"))
NAMES = [f"launch{part}" for part in ("", ".actions", ".conditions", ".substitutions")]
NAMES += [
    f"launch_ros{part}" for part in ("", ".actions", ".parameter_descriptions", ".substitutions")
]


class Said:
    """Stands for anything of launch: remembers what it was made with."""

    made: ClassVar[list["Said"]] = []

    def __init__(self, *args: Any, **more: Any) -> None:
        self.args, self.more = args, more
        self.name = args[0] if args else ""
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

    def load(path: Path, argv: tuple[str, ...] = (), **given: str) -> dict[str, list[Said]]:
        space: dict[str, Any] = {"__file__": str(path)}
        exec(compile(path.read_text(), path, "exec"), space)
        found: dict[str, list[Said]] = {}
        actions = list(space["generate_launch_description"]().args[0])
        told = {a.args[0]: a.more.get("default_value", "") for a in space["ARGUMENTS"]}
        for name, value in told.items():
            if isinstance(value, list):
                told[name] = told[value[0].args[0]] + value[1]
        context = SimpleNamespace(launch_configurations={**told, **given}, argv=argv)
        for action in actions:
            if type(action).__name__ == "OpaqueFunction":
                actions += action.more["function"](context)
        for action in actions:
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
    asked = {"namespace"} if "checked(" in path.read_text() else set()  # in Python
    assert used | asked == {argument.args[0] for argument in declared}


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
    from pea_cli.cli import parser

    (process,) = loaded(FOLDER / "replay.launch.py")["ExecuteProcess"]
    words = ["1.0" if isinstance(word, Said) else word for word in process.more["cmd"][1:]]
    arguments = parser().parse_args(words)
    assert (arguments.command, arguments.publish, arguments.rate) == ("replay", True, "1.0")


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_the_packages_that_it_needs_are_in_the_manifest(path):
    manifest = (ROOT / "ros2_ws/src/pea_bringup/package.xml").read_text()
    needed = {"launch", "launch_ros"}
    if "block(" in path.read_text():
        needed |= {f"pea_{block}" for block in config.NODES}
    for package in needed:
        assert f"<exec_depend>{package}</exec_depend>" in manifest


@pytest.mark.parametrize("rig", sorted((ROOT / "config/rigs").glob("*.yaml")), ids=lambda p: p.stem)
def test_every_rig_starts(loaded, rig):
    assert len(loaded(FOLDER / "rig.launch.py", rig_params=rig.name)["Node"]) == 5


@pytest.mark.parametrize("name", ["raster_xy", "spiral_xy", "mirror"])
def test_an_experiment_of_several_axes_starts(loaded, name):
    nodes = loaded(FOLDER / "sim.launch.py", experiment=name, params=f"{name}.yaml")["Node"]
    assert sorted(node.more["executable"] for node in nodes) == sorted([*config.NODES, "recorder"])
    assert len({id(node.more["parameters"][0]) for node in nodes}) == 1  # one file for all


@pytest.mark.parametrize("name", ["sim", "rig", "replay"])
def test_an_argument_that_the_file_does_not_have_is_refused(loaded, name, monkeypatch):
    path = FOLDER / f"{name}.launch.py"
    loaded(path, argv=("experimnt:=x",))  # another launch file's, which includes this one
    monkeypatch.setattr(sys, "argv", ["ros2", "launch", "pea_bringup", path.name])
    loaded(path, argv=("bag:=",))
    with pytest.raises(ParameterError, match="unknown argument bga:= did you mean bag"):
        loaded(path, argv=("bag:=", "bga:=x"))


@pytest.mark.parametrize("namespace", ["1stage", "a-b", "stage 1", "/"])
def test_what_is_no_namespace_is_refused(loaded, namespace):
    with pytest.raises(ParameterError, match="write names with / between, as /stage1"):
        loaded(FOLDER / "sim.launch.py", namespace=namespace)


def test_a_bag_that_cannot_be_written_is_refused(loaded, tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "old").mkdir()
    (tmp_path / "old/metadata.yaml").touch()
    loaded(FOLDER / "sim.launch.py", bag=str(tmp_path / "new/place"))
    for bag, words in (("old", "has a recording"), ("file", "exists"), ("file/x", "directory")):
        with pytest.raises(ParameterError, match=words):
            loaded(FOLDER / "sim.launch.py", bag=str(tmp_path / bag))


def test_the_transports_are_those_that_there_are(loaded):
    declared = loaded(FOLDER / "sim.launch.py")["DeclareLaunchArgument"]
    (transport,) = (a for a in declared if a.name == "transport")
    assert transport.more["choices"] == ["", *paths.PATHS]


REFUSED = {
    "a rig": ("rig", {"rig_params": "e727_typo.yaml"}, "unknown rig 'e727_typo': did you mean e7"),
    "an experiment": (
        "sim",
        {"params": "fig9.yaml"},
        "unknown experiment 'fig9': did you",
    ),
    "its experiment": ("rig", {"params": "sine_serie.yaml"}, "did you mean sine_series"),
    "a path": ("sim", {"params": "/no/where.yaml"}, "experiment '/no/where.yaml': no such file"),
}


@pytest.mark.parametrize(("name", "given", "words"), REFUSED.values(), ids=REFUSED)
def test_a_file_that_there_is_not_is_refused_before_a_node_starts(loaded, name, given, words):
    with pytest.raises(ParameterError, match=re.escape(words)):
        loaded(FOLDER / f"{name}.launch.py", **given)


def test_a_rig_whose_driver_lacks_a_package_is_refused_before_a_node_starts(loaded, monkeypatch):
    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(ParameterError, match="the Python package pyserial is missing"):
        loaded(FOLDER / "rig.launch.py", rig_params="nv200_serial_emulated.yaml")


def test_a_file_of_another_namespace_is_refused(loaded, tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("/pea/plant:\n  ros__parameters:\n    K: 0.1\n")
    loaded(FOLDER / "sim.launch.py", params=str(file))
    with pytest.raises(ParameterError, match="is /pea/plant to ROS, not /stage1/plant"):
        loaded(FOLDER / "sim.launch.py", params=str(file), namespace="stage1")


SPACES = {
    "none": ({}, "/pea"),
    "an argument": ({"namespace": "stage1"}, "/stage1"),
    "pushed": ({"ros_namespace": "/stage1"}, "/stage1"),
    "both": ({"ros_namespace": "/lab", "namespace": "stage1"}, "/lab/stage1"),
    "an absolute argument": ({"ros_namespace": "/lab", "namespace": "/stage1"}, "/stage1"),
}


@pytest.mark.parametrize(("given", "space"), SPACES.values(), ids=SPACES)
@pytest.mark.parametrize("name", ["sim", "rig"])
def test_every_node_is_in_the_namespace(loaded, name, given, space):
    nodes = loaded(FOLDER / f"{name}.launch.py", **given)["Node"]
    assert {node.more["namespace"] for node in nodes} == {space}


def test_a_copy_of_the_packages_alone_is_whole():
    source = ROOT / "ros2_ws/src"
    assert [path for path in source.rglob("*") if path.is_symlink()] == []
    assert (ROOT / "config").resolve() == source / "pea_bringup/config"
    setup = (source / "pea_bringup/setup.py").read_text()
    for folder in (source / "pea_bringup/config").iterdir():
        assert folder.is_file() or f'files("{folder.name}"' in setup
