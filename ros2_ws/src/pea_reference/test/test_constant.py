"""The constant reference."""

import pytest

from pea_core.block import Signal
from pea_core.params import build
from pea_core.signals import Reference
from pea_reference.model import constant


def test_level_holds_for_ever():
    signal = Signal(constant, constant.Params(offset_um=3.0), 50e-6)
    assert signal.at(0) == signal.at(10**10) == Reference(3.0 * 1e-6, 0.0, 0.0)


def test_its_level_holds_from_the_start():
    assert constant.move(build(constant.Params, {"offset_um": 4.0})) == (0.0, pytest.approx(4e-6))
