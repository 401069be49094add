"""Values of a node by where they come from, as ROS arguments give them."""

import itertools

import pytest
from rclpy.node import Node
from rclpy.parameter import Parameter

from pea_controller.model import CHOICE as LAWS
from pea_core.config import Source, resolve
from pea_core.params import ParameterError
from pea_observer.model import CHOICE
from pea_ros import context
from pea_ros.params import BlockParameters, sources

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


# Several axes


@pytest.fixture(scope="module")
def graph(tmp_path_factory):
    patch = pytest.MonkeyPatch()
    patch.setenv("ROS_LOG_DIR", str(tmp_path_factory.mktemp("log")))
    patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    with context.context():
        yield
    patch.undo()


@pytest.fixture
def two(graph):
    """A node of two axes, its parameters, and what its block was given."""
    node = Node(
        f"controller_{next(NUMBER)}",
        allow_undeclared_parameters=True,
        use_global_arguments=False,
        automatically_declare_parameters_from_overrides=True,
        parameter_overrides=[Parameter("P", value=0.001)],  # as from a file: of all axes
    )
    given = [Source({"axes": ("x", "y"), "P": 0.001, "y.type": "pid"})]
    parameters = BlockParameters(node, "controller", LAWS, [*given])
    taken = []
    parameters.connect(lambda params: None, taken.append)
    yield node, parameters, taken
    node.destroy_node()


NUMBER = itertools.count()


def asked(node, **values):
    """Whether parameters can be set, each, and why not."""
    names = {name.replace("__", "."): value for name, value in values.items()}
    done = node.set_parameters([Parameter(name, value=value) for name, value in names.items()])
    return [result.reason for result in done if not result.successful]


def test_parameters_are_declared_of_each_axis(two):
    node, parameters, _ = two
    names = node.get_parameters_by_prefix("")
    assert {"axes", "T_s", "x.P", "x.type", "y.K_p", "y.type"} <= names.keys()
    assert not {"P", "type", "y.P"} & names.keys()
    assert parameters.axes == ("x", "y")
    assert [params.K for params in parameters.params] == [0.142, 0.142]
    assert parameters.params[0].P == 0.001


def test_what_is_set_of_all_axes_is_set_of_each(two):
    node, parameters, taken = two
    assert asked(node, K=0.2) == []
    assert [params.K for params in taken[-1]] == [0.2, 0.2]
    assert node.get_parameter("x.K").value == node.get_parameter("y.K").value == 0.2
    assert not node.has_parameter("K")
    assert asked(node, y__K=0.1) == []
    assert [params.K for params in parameters.params] == [0.2, 0.1]


def test_what_one_axis_lacks_or_a_value_that_cannot_be_is_refused_whole(two):
    node, parameters, taken = two
    before = parameters.params
    (reason,) = asked(node, y__P=0.1)
    assert "P" in reason
    (reason,) = asked(node, x__K=-1.0)
    assert "x.K out of range" in reason
    (reason,) = asked(node, z__K=0.1)
    assert "z.K" in reason
    assert parameters.params == before
    assert taken == []


def test_another_type_of_one_axis_brings_its_own_parameters(two):
    node, parameters, taken = two
    assert asked(node, y__type="pidsmc") == []
    assert [type(params).__module__.rpartition(".")[2] for params in taken[-1]] == ["pidsmc"] * 2
    assert node.has_parameter("y.P")
    assert not node.has_parameter("y.K_p")
    assert node.has_parameter("x.P")
    assert parameters.values["y.P"] == node.get_parameter("y.P").value


def test_what_follows_a_neighbour_is_told_as_a_change_and_is_nobody_s_wish(two, monkeypatch):
    node, parameters, taken = two
    told = []
    publish = type(node._parameter_event_publisher).publish
    monkeypatch.setattr(
        type(node._parameter_event_publisher),
        "publish",
        lambda self, event: (told.append(event), publish(self, event)),
    )
    parameters.follow({**parameters.values, "x.voltage_max": 50.0})
    assert [[p.name for p in event.changed_parameters] for event in told] == [["x.voltage_max"]]
    assert [params.voltage_max for params in taken[-1]] == [50.0, 110.0]
    assert parameters.live == set()
    assert asked(node, y__voltage_max=40.0) == []
    assert parameters.live == {"y.voltage_max"}
    with pytest.raises(ParameterError, match="out of range"):
        parameters.follow({"y.voltage_max": 1e9})
