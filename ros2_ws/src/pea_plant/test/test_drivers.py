import importlib.metadata
import sys
from importlib.metadata import EntryPoint
from types import ModuleType

import pytest

from pea_core.params import ParameterError, build
from pea_drivers import gcs
from pea_plant import drivers
from pea_plant.plant import Params


@pytest.fixture
def installed(monkeypatch):
    """Entry points that a lab's packages have."""
    points = []
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: points)
    monkeypatch.setattr(drivers, "BROKEN", {})
    return lambda name, value: points.append(EntryPoint(name, value, drivers.GROUP))


def test_the_default_is_simulated():
    assert drivers.make(build(Params, {}), 50e-6).identity == "simulated actuator"


def test_a_driver_of_a_lab_is_found(installed, monkeypatch):
    module = ModuleType("lab_amplifier")
    module.Params = type("Params", (), {})
    monkeypatch.setitem(sys.modules, "lab_amplifier", module)
    installed("lab", "lab_amplifier")
    assert drivers._found()["lab"] is module


def test_a_broken_driver_is_named_and_the_others_work(installed):
    installed("broken", "no_such_module_at_all")
    assert "broken" not in drivers._found()
    assert "no_such_module_at_all" in drivers.BROKEN["broken"]


def test_our_own_cannot_be_replaced(installed):
    installed("gcs", "no_such_module_at_all")
    assert drivers._found()["gcs"] is gcs


def test_an_unknown_driver_is_refused_with_the_nearest():
    with pytest.raises(ParameterError, match=r"driver.type = 'gsc': did you mean gcs\?"):
        build(Params, {"driver.type": "gsc"})
