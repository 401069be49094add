import pytest

from pea_core.params import ParameterError, build
from pea_plant import drivers
from pea_plant.plant import Params


def test_the_default_is_simulated():
    assert drivers.make(build(Params, {}), 50e-6).identity == "simulated actuator"


def test_ours_come_first():
    assert list(drivers.MODULES)[:3] == ["gcs", "modbus_daq", "nv200"]


def test_an_unknown_driver_is_refused_with_the_nearest():
    with pytest.raises(ParameterError, match=r"driver.type = 'gsc': did you mean gcs\?"):
        build(Params, {"driver.type": "gsc"})
