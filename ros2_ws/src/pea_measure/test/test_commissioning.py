"""Delays that a response shows, divided among what can be late."""

from types import SimpleNamespace

import pytest

from pea_measure.commissioning import divided

T_S = 50e-6


def late(samples, command, sensor, modal_model=True, half=0.0):
    found = SimpleNamespace(delay=samples * T_S, delay_95=half * T_S)
    plant = SimpleNamespace(delay_samples=command, sensor=SimpleNamespace(delay_samples=sensor))
    return divided(found, plant, modal_model, T_S)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ((4.0, 1, 3), (1, 0.0)),  # all that the rig says of: nothing counts twice
        ((4.3, 1, 3), (1, 0.3)),
        ((6.4, 1, 3), (1, 2.4)),
        ((4.01, 1, 3), (1, 0.0)),
        ((4.2, 1, 3, True, 0.25), (1, 0.0)),  # not to be told from a whole sample
        ((3.0, 1, 3), (0, 0.0)),  # less than the rig says: the command is not late
        ((4.0, 1, 3, False), (1, 0.0)),
        ((2.4, 0, 0, False), (2, 0.0)),
        ((1.0, 0, 0, False), (1, 0.0)),
    ],
)
def test_a_delay_is_divided(given, told):
    command, rest = late(*given)
    assert command == told[0]
    assert rest / T_S == pytest.approx(told[1], abs=1e-9)
