"""Writes ``config/security/policy.xml``, SROS2's policy, from the table of topics.

.ci/env python docs/security.py
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

from pea_core.config import NAMESPACE, NODES
from pea_wire import topics
from pea_wire.topics import (
    CONSUMED,
    DIAGNOSTICS,
    DISPLACEMENT,
    FOLLOWED,
    PARAMETER_EVENTS,
    RECORDED,
    RECORDED_TOPICS,
    RECORDER,
    REFERENCE,
    SAMPLED,
    STATE,
    VOLTAGE,
    Topic,
    blocks_of,
)

FILE = Path(__file__).parents[1] / "config/security/policy.xml"

TABLE = tuple(topic for topic in topics.TABLE if topic.publisher)
"""Topics that one node publishes."""

TUNERS = ("tuner", "dashboard")
"""Enclaves that may set parameters and call the services of the plant."""

WATCHER = "watcher"
"""Enclave of whoever only looks."""

HEARS: dict[str, tuple[Topic, ...]] = {
    "plant": (VOLTAGE, REFERENCE, FOLLOWED, RECORDED),
    "observer": (DISPLACEMENT, PARAMETER_EVENTS),
    "controller": (STATE, REFERENCE, PARAMETER_EVENTS),
    "reference": (CONSUMED, RECORDED, PARAMETER_EVENTS),
    RECORDER: (*RECORDED_TOPICS, FOLLOWED),
    WATCHER: topics.TABLE,
    "dashboard": topics.TABLE,
    "tuner": (),
}
"""Topics that each enclave subscribes to."""

LOOKS: dict[str, tuple[str, ...]] = {
    "observer": ("plant", "controller"),
    "controller": ("plant", "observer"),
    "reference": ("plant", "observer", "controller"),
    RECORDER: NODES,
    **dict.fromkeys(TUNERS, NODES),
}
"""Nodes whose parameters each enclave may read."""

READ = ("describe_parameters", "get_parameter_types", "get_parameters", "list_parameters")
SET = ("set_parameters", "set_parameters_atomically")
DESCRIBE = ("get_type_description",)
TRIGGERS = ("enable", "stop", "reset")
LIFECYCLE = (
    "change_state",
    "get_available_states",
    "get_available_transitions",
    "get_state",
    "get_transition_graph",
)


def _names(role: str, services: tuple[str, ...]) -> list[str]:
    return [f"{NAMESPACE}/{role}/{service}" for service in services]


def said(role: str) -> list[str]:
    """Topics that an enclave may publish."""
    own = [topic for topic in TABLE if topic.publisher == role]
    names = [topic.name for topic in own]
    names += [blocks_of(topic).name for topic in own if topic in (*SAMPLED, REFERENCE)]
    if role in (*NODES, RECORDER):
        names += [DIAGNOSTICS.name, f"{NAMESPACE}/_probe_{role}_*"]
    if role == "plant":
        names.append(f"{NAMESPACE}/plant/transition_event")
    return [*names, PARAMETER_EVENTS.name, "/rosout"]


def heard(role: str) -> list[str]:
    """Topics that an enclave may subscribe to."""
    names = [topic.name for topic in HEARS[role]]
    names += [blocks_of(topic).name for topic in HEARS[role] if topic in SAMPLED]
    if role in (*NODES, RECORDER):
        names.append(f"{NAMESPACE}/_probe_{role}_*")
    return names


def asked(role: str) -> list[str]:
    """Services that an enclave may call."""
    names = [name for node in LOOKS.get(role, ()) for name in _names(node, READ)]
    if role in TUNERS:
        names += [name for node in NODES for name in _names(node, SET)]
        names += _names("plant", (*TRIGGERS, *LIFECYCLE))
    return names


def answered(role: str) -> list[str]:
    """Services that an enclave offers."""
    if role not in (*NODES, RECORDER):
        return []
    return _names(
        role, (*READ, *SET, *DESCRIBE, *((*TRIGGERS, *LIFECYCLE) if role == "plant" else ()))
    )


def _rules(profile: ET.Element, kind: str, qualifier: str, names: list[str]) -> None:
    if names:
        rules = ET.SubElement(profile, f"{kind}s", {qualifier: "ALLOW"})
        for name in sorted(set(names)):
            ET.SubElement(rules, kind).text = name


def policy() -> str:
    """The policy's text."""
    root = ET.Element("policy", version="0.2.0")
    enclaves = ET.SubElement(root, "enclaves")
    for role in HEARS:
        enclave = ET.SubElement(enclaves, "enclave", path=f"{NAMESPACE}/{role}")
        profiles = ET.SubElement(enclave, "profiles")
        profile = ET.SubElement(profiles, "profile", ns=NAMESPACE, node=role)
        _rules(profile, "topic", "publish", said(role))
        _rules(profile, "topic", "subscribe", heard(role))
        _rules(profile, "service", "reply", answered(role))
        _rules(profile, "service", "request", asked(role))
    ET.indent(root)
    head = '<?xml version="1.0" encoding="UTF-8"?>\n<!-- Written by docs/security.py. -->\n'
    return head + ET.tostring(root, encoding="unicode") + "\n"


if __name__ == "__main__":
    FILE.write_text(policy(), encoding="utf-8")
