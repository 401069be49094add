"""The shell round a block, as far as it needs no graph."""

import os
import threading
from types import SimpleNamespace

import pytest

from pea_core.loop import LoopFault
from pea_core.params import ParameterError
from pea_ros.block_node import BlockNode
from pea_ros.transport import Inbox
from pea_wire.topics import DISPLACEMENT


@pytest.fixture
def node():
    made = object.__new__(BlockNode)
    made.between = None
    made.tell_time = lambda: None
    made.node = SimpleNamespace(resolve_topic_name=lambda name: f"/pea/{name}")
    return made


def test_the_loop_goes_on_while_something_is_judged(node):
    sample = threading.Event()
    node.between = sample.set

    def judge():
        assert sample.wait(10.0), "no sample was handled meanwhile"
        raise ParameterError("too much")

    with pytest.raises(ParameterError, match="too much"):
        node.beside(judge)


def test_within_a_sample_nothing_else_is_handled(node):
    done = []
    node.beside(lambda: done.append(threading.current_thread()))
    assert done == [threading.main_thread()]


def test_samples_missed_while_a_neighbour_was_gone_count_as_lost(node, monkeypatch):
    monkeypatch.setattr(BlockNode, "stamp", property(lambda self: self.k * self.T_ns))
    node.T_ns, node.k, node.lost_samples, node.found = 1000, 0, 0, []
    node.log = SimpleNamespace(info=lambda text: None)
    node.joins = lambda topic, stamp: True

    assert node.expect(DISPLACEMENT, 5000)  # started late: the loop was there before
    node.k += 1
    assert node.expect(DISPLACEMENT, 9000)
    assert (node.k, node.lost_samples) == (9, 3)


def test_a_sample_that_was_lost_is_taken_from_the_block(node, monkeypatch):
    """The next one has come already: in wall time nobody waits."""
    monkeypatch.setattr(BlockNode, "stamp", property(lambda self: self.k * self.T_ns))
    node.T_ns, node.k, node.lost_samples, node.found = 1000, 5, 0, []
    node.joins = lambda topic, stamp: False
    handled = []

    def handle(data):
        handled.append(data)
        node.k += 1

    inbox = object.__new__(Inbox)
    inbox.keep = lambda: None
    sent = {5000: b"fifth", 6000: b"sixth"}
    inbox.missed = sent.get
    node.serving = inbox, handle

    assert node.expect(DISPLACEMENT, 7000)
    assert (node.k, node.lost_samples, handled) == (7, 2, [b"fifth", b"sixth"])
    monkeypatch.setattr("pea_ros.block_node.RESENT", 0.0)
    with pytest.raises(LoopFault, match=r"expected sample 7 .*, got 9 .*: lost"):
        node.expect(DISPLACEMENT, 9000)  # none of the blocks has it


def test_another_type_is_compiled_beside_the_loop(node):
    made = threading.Event()
    node.cpus = os.sched_getaffinity(0)
    node._make = lambda: made.set() or "another hop"
    coming = SimpleNamespace(coming="another type")
    node.hop = SimpleNamespace(serves=lambda: False, block=coming)

    assert not node.leap(1, lambda data: None)  # until it has taken over, the old one is kept
    assert node.hop.block is coming
    coming.coming = None
    assert not node.leap(1, lambda data: None)

    assert made.wait(10.0)
