"""Loops of several axes in plain Python: a change of one leaves the others' bits, in any mode."""

import math
import time

import numpy as np
import pytest

from pea_core.axes import one_axis
from pea_core.loop import blocks_of
from pea_core.params import ParameterError
from pea_engine.wall import WallLoop
from pea_experiment import experiments
from pea_experiment.metrics import truth

SETS = (
    "axes=[x,y]",
    "plant.y.K=0.12",
    "reference.y.frequency_hz=20",
    "observer.preset=extended_state",
    "controller.y.preset=pid",
)


def two(*sets, duration=0.1):
    return experiments.load_axes("fig9_hysteresis_10hz", [*SETS, *sets], duration)


def ran(loop, samples):
    return np.concatenate([loop.run(part) for part in blocks_of(samples, 500)])


def test_without_coupling_each_axis_has_the_bits_that_it_has_alone():
    rows = ran(two().loop(), 1000)
    for i, axis in enumerate("xy"):
        alone = experiments.load(f"fig9_hysteresis_10hz@{axis}", SETS, 0.1).loop()
        assert one_axis(rows, i).tobytes() == ran(alone, 1000).tobytes()


@pytest.mark.parametrize("sets", [("controller.y.K_p=5",), ("controller.y.preset=recommended",)])
def test_a_change_of_one_axis_leaves_the_bits_of_the_other(sets):
    steady, changed = two().loop(), two().loop()
    before = ran(changed, 1000)
    assert ran(steady, 1000).tobytes() == before.tobytes()
    new = two(*sets).loop().controller.params
    changed.controller.retune(new)
    rows, as_it_was = ran(changed, 3000), ran(steady, 3000)
    x, y = (one_axis(rows, i) for i in range(2))
    assert x.tobytes() == one_axis(as_it_was, 0).tobytes()
    assert not np.array_equal(y["u"], one_axis(as_it_was, 1)["u"])
    usual = np.abs(np.diff(one_axis(as_it_was, 1)["u"])).max()
    assert np.abs(np.diff(y["u"])).max() < 1.5 * usual  # no bump
    assert changed.controller.params == new


def test_a_loop_in_wall_time_has_the_same_bits_with_a_change_under_way():
    made = two(duration=0.02)
    parts = made.loop()
    loop = WallLoop(
        *(parts.plant, parts.observer, parts.controller, parts.reference),
        made.T_ns * 40,  # plain Python keeps up with 500 Hz
        made.samples,
        compiled=False,
        capacity=1 << 12,
    )
    loop.start()
    rows = []
    end = time.monotonic() + 60.0
    while loop.alive and time.monotonic() < end:
        rows.append(loop.take(leave=1).rows)
        loop.feed()
        time.sleep(0.01)
    rows.append(loop.take().rows)
    assert loop.fault is None
    assert np.concatenate(rows).tobytes() == ran(two().loop(), made.samples).tobytes()


def test_the_truth_of_a_coupled_stage_is_that_of_its_axes():
    made = two("plant.stage.cross_talk=[0, 0.05, 0.02, 0]", "plant.sensor.noise_nm=1")
    loop = made.loop()
    rows = ran(loop, 800)
    found = truth(made.plant(), rows, tuple(one.nominal for one in made.each))
    assert found.shape == (800, 2)
    last = loop.plant.truth
    again = made.plant()
    for u in rows["u"]:
        again.read()
        again.write(tuple(u.tolist()))
    assert [one.x1 for one in again.truth] == [one.x1 for one in last]
    error = (rows["y"] - found["x1"]).std(axis=0)
    np.testing.assert_allclose(error, 1e-9, rtol=0.15)
    spoilt = rows.copy()
    spoilt["y"][400, 1] += 1e-15
    assert truth(made.plant(), spoilt, tuple(one.nominal for one in made.each)) is None


def test_a_command_that_is_no_number_ends_the_loop_of_all_axes():
    made = two()
    loop = made.loop()
    block = loop.controller.blocks[1]
    model = block.model
    loop.run(10)
    block.model = type(model)(**{**vars(model), "output": lambda *signals: math.nan})
    rows = loop.run(10)
    assert len(rows) == 0
    assert "sample 10" in str(loop.fault)


def test_one_axis_is_an_experiment_of_its_own_and_an_unknown_one_is_refused():
    one = experiments.load("fig9_hysteresis_10hz@y", SETS, 0.1)
    assert one.axes == ("y",)
    assert one.nodes["plant"].params.K == 0.12
    with pytest.raises(ParameterError, match="no axis 'z'"):
        experiments.load("fig9_hysteresis_10hz@z", SETS, 0.1)
    with pytest.raises(ParameterError, match="this takes one: write fig9_hysteresis_10hz@x"):
        experiments.load("fig9_hysteresis_10hz", SETS, 0.1)


@pytest.mark.parametrize(
    ("sets", "of"),
    [
        (["controller.y.preset=recommended"], "the axis y"),
        (["plant.K=0.14", "plant.y.K=0.13"], "the axis y"),
        (["plant.stage.cross_talk=[0, 0.1, 0.1, 0]"], "all axes together"),
    ],
)
def test_what_is_said_of_another_axis_than_the_one_alone_is_refused(sets, of):
    experiments.load_axes("raster_xy", sets, 0.01)
    with pytest.raises(ParameterError, match=f"is of {of}, and this is the axis x alone"):
        experiments.load("raster_xy@x", sets, 0.01)
    experiments.load("raster_xy@x", [text for text in sets if text == "plant.K=0.14"], 0.01)
