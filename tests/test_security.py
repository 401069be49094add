"""SROS2's policy is what the table of topics says, of the form that SROS2 takes."""

import runpy
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import pytest

from pea_wire import topics

ROOT = Path(__file__).parents[1]
FORM: dict[str, tuple[set[str], set[str]]] = {
    "policy": ({"version"}, {"enclaves"}),
    "enclaves": (set(), {"enclave"}),
    "enclave": ({"path"}, {"profiles"}),
    "profiles": (set(), {"profile"}),
    "profile": ({"ns", "node"}, {"topics", "services"}),
    "topics": ({"publish", "subscribe"}, {"topic"}),
    "services": ({"reply", "request"}, {"service"}),
    "topic": (set(), set()),
    "service": (set(), set()),
}
"""Attributes and children of each element in SROS2's schema of version 0.2.0."""


@pytest.fixture(scope="module")
def made() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "docs/security.py"))


@pytest.fixture(scope="module")
def tree() -> ET.Element:
    return ET.fromstring((ROOT / "config/security/policy.xml").read_text())


def allowed(tree: ET.Element, kind: str, qualifier: str, word: str) -> set[str]:
    """Enclaves that may do something with a name that ends so."""
    return {
        enclave.attrib["path"]
        for enclave in tree.iter("enclave")
        for rules in enclave.iter(f"{kind}s")
        if rules.get(qualifier) == "ALLOW"
        for rule in rules
        if (rule.text or "").endswith(word)
    }


def test_the_file_is_what_the_script_writes(made):
    assert made["FILE"].read_text() == made["policy"](), "run .ci/env python docs/security.py"


def test_it_has_the_form_that_sros2_takes(tree):
    assert tree.attrib == {"version": "0.2.0"}
    for element in tree.iter():
        attributes, children = FORM[element.tag]
        assert set(element.attrib) <= attributes
        assert {child.tag for child in element} <= children
        assert bool(children) == bool(len(element))
        if element.tag in ("topics", "services"):
            assert list(element.attrib.values()) == ["ALLOW"]


def test_every_topic_of_the_table_is_in_it(made, tree):
    named = {rule.text for rule in tree.iter("topic")}
    assert set(topics.TABLE) == {t for t in vars(topics).values() if isinstance(t, topics.Topic)}
    assert {topic.name for topic in topics.TABLE} <= named


def test_a_new_topic_needs_no_other_line(monkeypatch):
    new = topics.Topic("/pea/new", topics.TIME, 1, "plant", ())
    monkeypatch.setattr(topics, "TABLE", (*topics.TABLE, new))
    tree = ET.fromstring(runpy.run_path(str(ROOT / "docs/security.py"))["policy"]())
    assert allowed(tree, "topic", "publish", new.name) == {"/pea/plant"}
    assert allowed(tree, "topic", "subscribe", new.name) == {"/pea/watcher", "/pea/dashboard"}


def test_each_topic_has_one_publisher_and_only_the_controller_publishes_volts(made, tree):
    for topic in made["TABLE"]:
        assert allowed(tree, "topic", "publish", topic.name) == {f"/pea/{topic.publisher}"}
    assert allowed(tree, "topic", "publish", "/voltage") == {"/pea/controller"}
    assert allowed(tree, "topic", "publish", "/voltage/blocks") == {"/pea/controller"}


@pytest.mark.parametrize("service", ["set_parameters", "set_parameters_atomically", "stop"])
def test_only_named_nodes_set_gains_and_stop(tree, service):
    assert allowed(tree, "service", "request", f"/{service}") == {"/pea/tuner", "/pea/dashboard"}


def test_nodes_open_nothing_that_the_policy_forbids(ros, tree, tmp_path):
    nodes = ("plant", "observer", "controller", "reference")
    for node in nodes:
        ros.start(node, "--ros-args", *(("-p", "clock:=wall") if node == "plant" else ()))
    ros.start("recorder", "--ros-args", "-p", f"out:={tmp_path / 'bag'}")
    ros.says("plant", "loop starts")
    opened = {
        ("topic", "publish"): ros.node.get_publisher_names_and_types_by_node,
        ("topic", "subscribe"): ros.node.get_subscriber_names_and_types_by_node,
        ("service", "reply"): ros.node.get_service_names_and_types_by_node,
        ("service", "request"): ros.node.get_client_names_and_types_by_node,
    }
    forbidden = [
        (node, verb, name)
        for node in (*nodes, "recorder")
        for (kind, verb), names_of in opened.items()
        for name, _ in names_of(node, "/pea")
        if f"/pea/{node}" not in allowed(tree, kind, verb, name)
    ]
    assert not forbidden
