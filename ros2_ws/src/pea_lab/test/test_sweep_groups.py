"""Which runs of a sweep go side by side in one kernel."""

import pytest

from pea_experiment import experiments
from pea_lab.sweep_groups import Runs

PLANTS = {
    "no hysteresis": ("plant.hysteresis.type=none",),
    "paper": (),
    "another hysteresis": ("plant.hysteresis.type=preisach",),
    "a load": ("plant.load.type=sine",),
    "a lag of the amplifier": ("plant.amplifier.bandwidth_hz=5000",),
    "a late command": ("plant.delay_samples=2",),
    "a late sensor": ("plant.sensor.delay_samples=3",),
    "a fraction of a sample": ("plant.vibration.type=modal", "plant.vibration.delay=25e-6"),
}
OTHERS = {
    "K": 0.15,
    "zeta": 0.7,
    "seed": 4,
    "voltage_max": 90.0,
    "sensor.noise_nm": 2.0,
    "safety.slew_rate": 1e5,
}


def models(sets):
    runs = Runs(experiments.load("fig9_hysteresis_10hz", sets, 0.01))
    each = [{}, *({name: value} for name, value in OTHERS.items())]
    return [id(runs.made("plant", runs.params("plant", changes))[0]) for changes in each]


@pytest.mark.parametrize("sets", PLANTS.values(), ids=PLANTS)
def test_plants_that_differ_in_numbers_alone_share_a_kernel(sets):
    """Otherwise each has one of its own, and 15 of its 16 lanes do nothing of use."""
    assert len(set(models(sets))) == 1


def test_plants_of_different_blocks_do_not():
    first = [models(sets)[0] for sets in PLANTS.values()]
    assert len(set(first)) == len(first)
