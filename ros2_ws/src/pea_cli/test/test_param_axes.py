"""Parameters of nodes with several axes, as ``pea param`` names and compares them."""

from types import SimpleNamespace

import pytest

from pea_cli import param
from pea_core import config
from pea_core.params import ParameterError
from pea_experiment import experiments
from pea_ros.param_client import Client

TWO = ["axes=[x, y]", "controller.y.P=0.002"]
SECTIONS = experiments.load_axes("fig9_hysteresis_10hz", TWO).sections()


class Running(Client):
    """Nodes that have the parameters of an experiment, without a graph."""

    def __init__(self):
        self.sent = {}
        self.node = SimpleNamespace(get_fully_qualified_name=lambda: "/pea/test")
        self.space = "/pea"

    def names(self, role):
        return sorted(SECTIONS[role])

    def _values(self, role, names):
        return {name: SECTIONS[role][name] for name in names}

    def _of(self, role):
        def take(parameters):
            self.sent = {p.name: p.value for p in parameters if p.name != "changed_by"}

        return SimpleNamespace(set_parameters_atomically=take)

    def _wait(self, role, future):
        return SimpleNamespace(result=SimpleNamespace(successful=True))


def test_a_name_without_an_axis_stands_for_all():
    assert Running().get("controller", ["y.P"]) == {"y.P": 0.002}
    assert list(Running().get("controller", ["P"])) == ["x.P", "y.P"]


@pytest.mark.parametrize(
    ("values", "sent"),
    [
        ({"y.P": 1}, {"y.P": 1.0}),
        ({"P": 1}, {"x.P": 1.0, "y.P": 1.0}),
        ({"P": 1, "y.P": 2}, {"x.P": 1.0, "y.P": 2.0}),
        ({"y.type": "pid", "y.K_p": 2.0}, {"y.type": "pid", "y.K_p": 2.0}),
    ],
)
def test_a_value_is_set_on_one_axis_or_all(values, sent):
    nodes = Running()
    nodes.set("controller", values)
    assert nodes.sent == sent


@pytest.mark.parametrize("name", ["z.P", "Q", "y.Q"])
def test_a_name_that_no_axis_has_is_refused(name):
    with pytest.raises(ParameterError, match=rf"unknown parameter controller\.{name}: "):
        Running().set("controller", {name: 1.0})
    with pytest.raises(ParameterError, match=rf"unknown parameter controller\.{name}: "):
        Running().get("controller", [name])


def test_what_is_saved_is_the_same_as_what_runs(tmp_path):
    path = tmp_path / "saved.yaml"
    config.write(path, SECTIONS)
    asked = param.wanted(str(path))
    for node in config.NODES:
        assert param.differences(SECTIONS[node], asked[node]) == {}


def test_a_file_is_compared_axis_by_axis(tmp_path):
    path = tmp_path / "one.yaml"
    path.write_text("/pea/controller:\n  ros__parameters:\n    P: 0.003\n    y:\n      I: 4.0\n")
    found = param.differences(SECTIONS["controller"], param.wanted(str(path))["controller"])
    assert {name: new for name, (_, new) in found.items()} == {
        "x.P": 0.003, "y.P": 0.003, "y.I": 4.0,
    }  # fmt: skip


def test_a_preset_of_one_axis_is_of_that_axis(tmp_path):
    path = tmp_path / "one.yaml"
    path.write_text(
        "/pea/controller:\n  ros__parameters:\n    axes: ['x', 'y']\n"
        "    y:\n      preset: precise\n"
    )
    asked = param.wanted(str(path))["controller"]
    assert asked["y.type"]
    assert not any(name.startswith("x.") for name in asked)
