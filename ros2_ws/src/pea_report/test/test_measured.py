"""Test signals of a recording, from its start or switched on while it ran."""

import numpy as np
import pytest

from pea_core.block import changed
from pea_experiment import experiments
from pea_experiment.experiment import SCHEMAS
from pea_record.bag import BagWriter
from pea_record.origin import ORIGIN, origin
from pea_record.rows import ahead, record
from pea_report.measured import read
from pea_wire import events
from pea_wire.topics import PARAMETER_EVENTS

T_S = 5e-5
SETS = (
    "reference.type=constant",
    "controller.inject.period=0.01",
    "controller.inject.from_hz=100",
    "controller.inject.realisations=2",
    "controller.inject.periods=2",
)
PERIOD = 200


def written(there, changes, samples, *sets):
    """A recording of a run in which the controller's parameters change at some samples."""
    made = experiments.load("sine_series", [*SETS, *sets], duration=samples * T_S)
    loop, T_ns = made.loop(), round(T_S * 1e9)
    with BagWriter(there, T_ns) as bag:
        bag.metadata(ORIGIN, origin(made.name, made.sections(), "batch", T_ns))
        for k in range(0, samples, 100):
            if k in changes:
                block = loop.controller
                block.retune(changed(SCHEMAS["controller"], block.planned, changes[k]))
                event = events.encode(k * T_ns, "/pea/controller", changes[k])
                bag.write(PARAMETER_EVENTS, k * T_ns, event)
            rows = loop.run(100)
            record(bag, k, T_ns, rows, *([ahead(loop)] if loop.k == samples else []))
    return there


ON, OFF = {"inject.where": "voltage"}, {"inject.where": "off"}

CASES = {
    "from its start": ({}, ("controller.inject.where=voltage",), [(0, 2)]),
    "switched on": ({500: ON}, (), [(500, 2)]),
    "another value first": ({300: {"P": 0.0011}, 500: ON}, (), [(500, 2)]),
    "twice": ({300: ON, 1600: {"inject.amplitude_V": 0.6}}, (), [(300, 2), (1600, 2)]),
    "cut short": ({300: ON, 1200: OFF}, (), [(300, 1)]),
}


@pytest.mark.parametrize("case", CASES)
def test_whole_blocks_are_found(case, tmp_path):
    changes, sets, spans = CASES[case]
    found = read(written(tmp_path / "bag", changes, 3000, *sets))
    assert [r.kind for r in found.records] == ["periodic"] * len(spans)
    for r, (start, count) in zip(found.records, spans, strict=True):
        assert r.period == PERIOD
        assert r.blocks == tuple((start + PERIOD * (1 + 3 * i), 2) for i in range(count))
        for first, whole in r.blocks:
            periods = r.u[first : first + whole * PERIOD, 0].reshape(whole, PERIOD)
            # noise, and the way from rest; a block that is not in steady state differs by all of it
            assert np.ptp(periods[0] - periods[1]) < 0.5 * np.ptp(periods[0])


def test_switched_off_before_a_block_ends_nothing_is_injected(tmp_path):
    found = read(written(tmp_path / "bag", {300: ON, 500: OFF}, 1500))
    assert [r.blocks for r in found.records] == [()]
