"""A rig of several axes: one device with a channel each, or one line that says why not."""

import pytest

from pea_core.params import ParameterError
from pea_experiment import experiments


@pytest.mark.parametrize(
    ("rig", "sets", "says"),
    [
        ("registers_emulated", (), "driver.type = 'registers': drives one channel, not the axes"),
        ("labjack_t7_emulated", (), "driver.type = 'modbus_daq': drives one channel"),
        ("e727_emulated", ("plant.y.driver.type=simulated",), "axes of one loop have one device"),
    ],
)
def test_what_cannot_be_driven_is_refused_in_one_line(rig, sets, says):
    with pytest.raises(ParameterError, match=says) as refused:
        experiments.load_axes("fig9_hysteresis_10hz", ["axes=[x, y]", *sets], rig=rig)
    assert "\n" not in str(refused.value)
