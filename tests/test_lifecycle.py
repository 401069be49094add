"""Lifecycle and gate agree after every order of transitions and services."""

import threading

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from std_srvs.srv import Trigger

from pea_core import config
from pea_core.params import ParameterError
from pea_plant import drivers
from pea_plant.wall_node import WallNode
from pea_ros.context import context
from pea_wire import convert

TRANSITIONS = {
    name: getattr(Transition, f"TRANSITION_{name.upper()}")
    for name in ("configure", "activate", "deactivate", "cleanup")
}
SERVICES = ("enable", "stop", "reset")
AGREE = {
    ("unconfigured", "unconfigured"),
    ("inactive", "inactive"),
    ("inactive", "fault"),
    ("active", "active"),
}
STEPS = st.lists(
    st.tuples(st.sampled_from([*TRANSITIONS, *SERVICES, "neighbours"]), st.integers(0, 30)),
    max_size=14,
)


@pytest.fixture
def plant(free_domain, monkeypatch):
    monkeypatch.setenv("PEA_COMPILE", "0")
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_domain))
    rig = str(config.find("rigs", "simulated_200hz", "rig"))
    patient = ["-p", "safety.stale_samples:=5000"]  # the machine may halt for a while
    given = ["-p", "clock:=wall", "-p", "T_s:=0.002", *patient]
    with context(["--ros-args", "--params-file", rig, *given]):
        node = WallNode()
        try:
            yield node
        finally:
            node.rig.close("the end of the test")
            node.close()


def asked(node, name):
    """Answer to a transition that the service is asked for: the executor goes on with it."""
    (service,) = [s for s in node.node.services if s.srv_name.endswith("/change_state")]
    request = ChangeState.Request(transition=Transition(id=TRANSITIONS[name]))
    return service.callback(request, ChangeState.Response())


def answered(answering):
    """What comes of it."""
    while True:
        try:
            answering.send(None)  # the executor serves others meanwhile
        except StopIteration as answer:
            return answer.value.success


def change(node, name):
    """Ask for a transition as the service does."""
    return answered(asked(node, name))


@given(steps=STEPS)
@settings(
    max_examples=25,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
def test_gate_and_lifecycle_agree_after_every_order(plant, steps):
    node = plant
    for name, ticks in steps:
        before = node.lifecycle.state, node.gate.state
        if name in TRANSITIONS:
            done = change(node, name)
            if name == "cleanup" and done:
                assert not node.rig.connected
        elif name == "neighbours":
            node.gathered = True
        else:
            answer = getattr(node, name)(Trigger.Request(), Trigger.Response())
            assert answer.success or answer.message  # a reason is given
            if name == "stop":
                assert node.gate.state != "active"
        assert (node.lifecycle.state, node.gate.state) in AGREE, (before, name)
        for _ in range(ticks):
            node.tick()
            assert (node.lifecycle.state, node.gate.state) in AGREE, (before, name)
        if node.gate.state == "unconfigured":
            assert not node.rig.connected  # nothing reconnects by itself
    # a way out of everything
    node.stop(Trigger.Request(), Trigger.Response())
    if node.gate.state == "unconfigured":
        assert change(node, "configure")
    else:
        assert node.reset(Trigger.Request(), Trigger.Response()).success
    assert node.enable(Trigger.Request(), Trigger.Response()).success
    assert (node.lifecycle.state, node.gate.state) == ("active", "active")
    node.stop(Trigger.Request(), Trigger.Response())
    assert change(node, "cleanup")
    assert not change(node, "cleanup")  # refused, and nothing ends
    node.gathered = False


@pytest.mark.parametrize("meanwhile", [*TRANSITIONS, *SERVICES])
def test_they_agree_whatever_is_asked_while_the_device_is_connected(plant, monkeypatch, meanwhile):
    node, may = plant, threading.Event()
    kind = type(node.rig.driver)
    connect = kind.connect
    monkeypatch.setattr(kind, "connect", lambda self: may.wait(10.0) and connect(self))
    first = asked(node, "configure")
    first.send(None)
    assert node.rig.reaching
    second = None
    if meanwhile == "configure":
        second = asked(node, "configure")
        second.send(None)
    elif meanwhile in TRANSITIONS:
        assert not change(node, meanwhile)
    else:
        answer = getattr(node, meanwhile)(Trigger.Request(), Trigger.Response())
        assert answer.message
    node.tick()
    assert (node.lifecycle.state, node.gate.state) == ("unconfigured", "unconfigured")
    may.set()
    assert answered(first)
    if second is not None:
        assert not answered(second)  # it is configured already
    node.tick()
    assert (node.lifecycle.state, node.gate.state) == ("inactive", "inactive")
    assert change(node, "activate")
    assert (node.lifecycle.state, node.gate.state) == ("active", "active")


def test_a_driver_that_cannot_be_made_refuses_the_transition(plant, monkeypatch):
    """A library that is gone since, for example."""
    node = plant

    def fails(*params):
        raise ParameterError("library = 'x.so': there is no such file")

    with monkeypatch.context() as patch:
        patch.setattr(node.rig, "simulated", False)  # of a device, a driver is made each time
        patch.setattr(drivers, "make", fails)
        assert not change(node, "configure")
        assert (node.lifecycle.state, node.gate.state) == ("unconfigured", "unconfigured")
    assert change(node, "configure")


@pytest.mark.parametrize("stamp", [(2**31 - 1) * 10**9, 10**18, 2_000_000 * 10**6, 1_000_000])
def test_a_command_that_no_sample_asked_for_trips_and_blocks_nothing(plant, stamp):
    """Far ahead, a little ahead, between two samples."""
    node = plant
    messages = []
    node.voltage.messages = lambda: [messages.pop(0)] if messages else []
    assert change(node, "configure")
    node.gathered = True

    def begin():
        assert node.enable(Trigger.Request(), Trigger.Response()).success
        for _ in range(5):
            node.tick()
            if node.k:
                messages.append(convert.forms().voltage.encode((node.k - 1) * node.T_ns, 1.0))
        assert node.gate.state == "active", node.gate.cause
        assert node.answered > 0

    begin()
    for _ in range(2):  # once more after a reset: nothing of it is kept
        messages[:] = [convert.forms().voltage.encode(stamp, 100.0)]
        k = node.k
        node.tick()
        assert node.gate.cause == (
            f"controllers: a command is stamped {stamp} ns, samples are 0 to {k - 1} times "
            f"{node.T_ns} ns: another loop's"
        )
        messages.clear()
        assert node.reset(Trigger.Request(), Trigger.Response()).success
        begin()
