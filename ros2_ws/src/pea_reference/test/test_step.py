"""The step reference."""

from pea_core.block import Signal
from pea_core.signals import Reference
from pea_reference.model import step


def test_raw_step_jumps_at_its_sample():
    signal = Signal(step, step.Params(amplitude_um=5.0, offset_um=1.0, time=0.01), 50e-6)
    assert signal.at(199) == Reference(1e-6, 0.0, 0.0)
    assert signal.at(200) == Reference(1e-6 + 5.0 * 1e-6, 0.0, 0.0)
