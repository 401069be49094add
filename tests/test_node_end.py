"""The end of a node: Ctrl-C in the midst of an answer, and nothing left behind."""

import os
import signal

import pytest
from std_srvs.srv import Trigger

from pea_controller.node import ControllerNode
from pea_core.interrupt import INTERRUPT
from pea_observer.node import ObserverNode
from pea_plant.node import PlantNode
from pea_plant.wall_node import WallNode
from pea_reference.node import ReferenceNode
from pea_ros.context import context
from pea_ros.shell import Shell


class Interrupted(Trigger.Response):
    """An answer during whose conversion Ctrl-C comes."""

    @property
    def message(self):
        os.kill(os.getpid(), signal.SIGINT)
        return "whole"

    @message.setter
    def message(self, value):
        pass


@pytest.fixture
def shell(free_domain, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_domain))
    before = signal.signal(signal.SIGINT, INTERRUPT)
    with context():
        shell = Shell("told")
        yield shell
        shell.close()
    signal.signal(signal.SIGINT, before)


def test_an_answer_goes_out_whole_before_ctrl_c_acts(shell):
    shell.node.create_service(Trigger, "~/ask", lambda request, response: Interrupted())
    client = shell.node.create_client(Trigger, "/pea/told/ask")
    asked = client.call_async(Trigger.Request())

    def serve():
        for _ in range(100):
            if not asked.done():
                shell.serve(0.1)

    with pytest.raises(KeyboardInterrupt):
        serve()
    serve()
    assert asked.result().message == "whole"


def threads():
    return set(os.listdir("/proc/self/task"))


NODES = (PlantNode, WallNode, ObserverNode, ControllerNode, ReferenceNode)


@pytest.mark.parametrize("make", NODES)
def test_the_middleware_ends_with_the_node(make, free_domain, monkeypatch):
    """Threads that are left run into a process that is being taken apart."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_domain))
    monkeypatch.setenv("PEA_COMPILE", "0")  # no thread of ours
    with context():
        Shell("first").close()  # what the middleware starts once, and keeps
        before = threads()
        node = make()
        assert threads() - before
        node.close()
        assert not threads() - before
