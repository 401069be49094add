"""The recorder's node, as far as it needs no graph."""

from types import SimpleNamespace

import pytest

from pea_core.config import NODES
from pea_experiment import experiments
from pea_run.recorder.node import RecorderNode

SHELL = {"use_sim_time": False, "samples": 5, "wait_for_recorder": True, "clock": "wall"}
"""What a running node has besides the parameters of its block."""


@pytest.fixture
def node(tmp_path):
    made = object.__new__(RecorderNode)
    made.bag = SimpleNamespace(directory=tmp_path)
    return made


def test_nodes_are_asked_for_what_an_experiment_can_have(node):
    experiment = experiments.load("fig9_hysteresis_10hz")
    values = {name: experiment.nodes[name].values for name in NODES}
    node.ask = lambda name: {**values[name], **SHELL}
    assert node.sections() == values


def test_what_a_foreign_node_says_is_left_out(node):
    node.ask = lambda name: {"type": "neural"} if name == "controller" else {}
    assert node.sections() == {}


@pytest.mark.parametrize(("samples", "said"), [(0, ""), (10, "5\n")])
def test_how_far_it_is_is_told_to_who_has_given_a_number_of_samples(node, samples, said, capsys):
    node.params = SimpleNamespace(samples=samples)
    node.tell(5)
    assert capsys.readouterr().out == said
