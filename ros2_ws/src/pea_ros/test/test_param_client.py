"""What `Client` says where a node does not answer in time, or is not there."""

from types import SimpleNamespace

import pytest

from pea_core.params import ParameterError
from pea_ros import param_client
from pea_ros.param_client import Client

ONE = {"P": 0.001, "type": "pidsmc", "axes": ("x",), "changed_by": ""}
TWO = {"x.P": 0.001, "y.P": 0.001, "axes": ("x", "y"), "changed_by": ""}


class Busy(Client):
    """Asks a node under load: a change is asked for, and nothing is said of it in time."""

    def __init__(self, values, done, deaf):
        named = SimpleNamespace(
            get_namespace=lambda: "/pea", get_fully_qualified_name=lambda: "/pea/param_me"
        )
        super().__init__(named)  # type: ignore[arg-type]
        self.values, self.done, self.deaf, self.late = {**values}, done, deaf, False

    def _values(self, role, names):
        return {name: self.values[name] for name in names}

    def names(self, role):
        if self.late and self.deaf:
            self._wait(role, None)
        return sorted(self.values)

    def _of(self, role):
        def asked(parameters):
            self.late = True
            if self.done:
                self.values |= {each.name: each.value for each in parameters}

        return SimpleNamespace(set_parameters_atomically=asked)

    def _wait(self, role, future):
        raise ParameterError(f"/pea/{role} does not answer within 10 s")


@pytest.mark.parametrize(
    ("values", "done", "deaf", "words"),
    [
        (ONE, True, False, "it has set them nevertheless: P = 0.002"),
        (ONE, False, False, "not set so far: P = 0.001"),
        (ONE, True, True, "it may have set them or not; look with pea param get controller P"),
        (TWO, True, False, "it has set them nevertheless: x.P = 0.002, y.P = 0.002"),
        (TWO, False, False, "not set so far: x.P = 0.001, y.P = 0.001"),
    ],
)
def test_a_change_that_nobody_confirms_is_looked_for(values, done, deaf, words):
    with pytest.raises(ParameterError, match="does not answer within 10 s") as error:
        Busy(values, done, deaf).set("controller", {"P": 0.002})
    assert words in str(error.value)


def test_a_long_wait_is_told_once_and_where_it_was_looked(monkeypatch):
    monkeypatch.setattr(param_client, "SILENT", 0.01)
    nobody = SimpleNamespace(
        context=SimpleNamespace(get_domain_id=lambda: 7),
        get_namespace=lambda: "/pea",
        get_node_names_and_namespaces=lambda: [("plant", "/pea"), ("observer", "/stage1")],
    )
    told = []
    asking = Client(nobody, 0.2, told.append)  # type: ignore[arg-type]
    assert asking.there(("plant", "observer")) == ["plant"]
    assert told == ["waits for /pea/observer, at most 0.2 s"]
    assert asking.nobody.startswith("no node of /pea is there in ROS domain 7: start the loop")
