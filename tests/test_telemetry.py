"""What a loop in one process shows of itself on its topics."""

import numpy as np
import pytest
from rclpy.node import Node

from pea_core.config import NODES
from pea_core.signals import SAMPLE
from pea_ros.transport import message_type, qos
from pea_run.modes.telemetry import Telemetry
from pea_wire import convert
from pea_wire.topics import (
    DISPLACEMENT,
    REFERENCE,
    SAMPLED,
    SIGNAL,
    STATE,
    VOLTAGE,
    blocks_of,
)

FORMS = convert.forms()

T_NS = 50_000
SPIKE = 431


def rows(n=800):
    found = np.zeros(n, SAMPLE)
    found["w"] = 5e-6 * np.sin(2 * np.pi * 10.0 * np.arange(n) * T_NS * 1e-9)
    found["y"] = found["w"]
    found["y_dot"] = np.nan
    return found


@pytest.fixture
def heard(ros):
    """Telemetry of a loop, and what comes of it, by topic."""
    nodes = {name: Node(name, namespace="/pea", context=ros.context) for name in NODES}
    telemetry = Telemetry(nodes, T_NS)
    found = {}

    def listen(*topics):
        for topic in topics:
            come = found.setdefault(topic.name, [])
            kind = message_type(topic.type)
            ros.node.create_subscription(kind, topic.name, come.append, qos(topic), raw=True)
        for topic in topics:
            name = topic.name
            assert ros.until(lambda name=name: _matched(nodes, name))
        return found

    yield telemetry, listen, ros
    for node in nodes.values():
        node.destroy_node()


def _matched(nodes, name):
    boxes = [box for node in nodes.values() for box in node.publishers]
    return next(box for box in boxes if box.topic_name == name).get_subscription_count()


@pytest.mark.parametrize("signal", ["y", "u", "eps_hat", "w"])
def test_a_spike_of_one_sample_is_shown_on_all_topics_with_its_stamp(heard, signal):
    telemetry, listen, ros = heard
    found = listen(DISPLACEMENT, STATE, VOLTAGE, REFERENCE)
    spiky = rows()
    spiky[signal][SPIKE] += 1e-3
    telemetry.add(100, spiky, last=True)
    spiked = (100 + SPIKE) * T_NS
    assert ros.until(lambda: all(spiked in map(convert.stamp, come) for come in found.values()))
    telemetry.add(100 + len(spiky), spiky[:1], last=True)
    end = (100 + len(spiky)) * T_NS
    assert ros.until(lambda: all(convert.stamp(come[-1]) == end for come in found.values()))
    stamps = [[convert.stamp(data) for data in come] for come in found.values()]
    assert stamps.count(stamps[0]) == 4  # so that they can be paired
    assert len(stamps[0]) <= 8 + 1
    shown = dict(zip(stamps[0], map(FORMS.decode_displacement, found[DISPLACEMENT.name])))
    assert shown[spiked].position == spiky["y"][SPIKE]


def test_the_sample_signal_is_shown_at_the_same_samples(heard):
    telemetry, listen, ros = heard
    detected = np.arange(800.0)
    detected[:10] = np.nan  # not known yet
    telemetry.add(0, rows(), last=True, signal=detected)  # from now on there is the topic
    found = listen(DISPLACEMENT, SIGNAL)
    telemetry.add(800, rows(), last=True, signal=detected)
    at = lambda topic: [convert.stamp(data) // T_NS for data in found[topic.name]]  # noqa: E731
    known = lambda: [k for k in at(DISPLACEMENT) if k >= 810]  # noqa: E731
    assert ros.until(lambda: known() and at(SIGNAL) == known())
    for data in found[SIGNAL.name]:
        k = convert.stamp(data) // T_NS
        assert convert.DETECTED.decode(data).position == detected[k - 800]


def test_every_sample_is_shown_in_blocks(heard):
    telemetry, listen, ros = heard
    topics = [blocks_of(topic) for topic in (*SAMPLED, REFERENCE)]
    found = listen(*topics)
    told = rows(5000)
    told["u"] = np.arange(5000)
    telemetry.add(0, told, last=True)
    assert ros.until(lambda: all(len(come) == 3 for come in found.values()))
    for come in found.values():
        parts = [convert.decode_block(data) for data in come]
        stamps = np.concatenate([convert.stamps(payload, size) for size, payload in parts])
        np.testing.assert_array_equal(stamps, np.arange(5000) * T_NS)
    payloads = [convert.decode_block(data)[1] for data in found[topics[2].name]]
    u = np.frombuffer(b"".join(payloads), FORMS.voltage.dtype)["effort"]
    np.testing.assert_array_equal(u, told["u"])
    payloads = [convert.decode_block(data)[1] for data in found[topics[3].name]]
    w = FORMS.reference.decode_each(b"".join(payloads))
    np.testing.assert_array_equal(w, told["w"])
