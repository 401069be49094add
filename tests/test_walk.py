"""A short walk through what may happen to a rig; ``make walk`` takes a long one."""

from __future__ import annotations

import importlib.util
import sys
import time
from pathlib import Path

import pytest

spec = importlib.util.spec_from_file_location("pea_walk", Path(__file__).with_name("walk.py"))
assert spec is not None
assert spec.loader is not None
walk = importlib.util.module_from_spec(spec)
sys.modules["pea_walk"] = walk
spec.loader.exec_module(walk)

WIDE = walk.Limits(-20.0, 110.0, 2000.0, 0.0)
TIGHT = walk.Limits(-20.0, 60.0, 300.0, 0.0)


class Still:
    """Control of a device that has felt nothing."""

    def log(self):
        return {"last_voltage_V": None}


def felt():
    return walk.Felt(Still(), 5e-3, WIDE)


@pytest.mark.alone
def test_a_short_walk_breaks_nothing(tmp_path):
    said = []
    course = walk.run(30, 5, tmp_path, walk.faults.RIG, said.append, length=30)
    assert course.done == 30, said
    assert len(course.counts) > 5


@pytest.mark.alone
def test_requests_do_not_wait_for_a_slow_device(tmp_path):
    """Whatever else is due between two samples, an answer takes a few exchanges at most."""
    with walk.Course(tmp_path, walk.faults.RIG, 1, print) as course:
        lab = course.open()
        lab.inject("delay=0.15")  # ten samples: the gate trips, and the plant dials again
        lab.wait(lambda: lab.gate_state == "fault", "a gate that trips")
        lab.wait(lambda: lab.trigger("reset").success, "a device that is reached", 4 * walk.HANG)
        since, asked = time.monotonic_ns(), 20
        for _ in range(asked):
            assert lab.lifecycle() == "inactive"
        exchanges = len(lab.control.since(since))
        assert 0 < exchanges <= 3 * asked


def test_the_walk_sees_a_voltage_outside_the_range():
    device = felt()
    t = device.last[0]
    device.judge(t + 10**9, 110.0)
    with pytest.raises(AssertionError, match="outside"):
        device.judge(t + 2 * 10**9, 110.5)


def test_the_walk_sees_a_change_above_the_limit():
    device = felt()
    t = device.last[0]
    device.judge(t + 5_000_000, 10.0)
    with pytest.raises(AssertionError, match="at most 10"):
        device.judge(t + 10_000_000, 21.0)


def test_a_range_that_is_tightened_is_entered_and_not_left_again():
    device = felt()
    t = device.last[0]
    device.judge(t + 10**9, 100.0)
    device.held.change(TIGHT)
    later = t + 60 * 10**9
    device.judge(later, 98.0)
    with pytest.raises(AssertionError, match="outside"):
        device.judge(later + 10**9, 98.5)


def test_the_limits_before_count_while_a_command_is_under_way():
    device = felt()
    before = device.held.at(device.last[0])
    device.held.change(TIGHT)
    now = walk.time.monotonic_ns()
    assert WIDE in before
    assert {WIDE, TIGHT} <= set(device.held.at(now))
    assert device.held.at(now + 10**10) == [TIGHT]


def test_a_slew_rate_of_nothing_that_is_refused_allows_nothing():
    assert walk.Limits(-20.0, 110.0, 0.0, 0.0).step(1.0, 5e-3) == 0.0
