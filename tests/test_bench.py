"""Every yardstick of the bench runs, with tiny sizes; no figure of time is judged."""

from __future__ import annotations

import shutil

import pytest

from pea_bench import composed, distributed, hardware, memory
from pea_bench.plan import QUICK
from pea_bench.rows import KEYS, figures

TINY = QUICK._replace(wall_rounds=1, wall_s=0.2, thread_s=0.2)


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch, free_domain: int) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_domain))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


def test_a_ring_of_pipes_goes_round():
    assert distributed.pipes(0.1) > 0.0


@pytest.mark.parametrize("ring", [distributed.naive, distributed.fast_ring])
def test_a_ring_of_nodes_goes_round(alone, ring):
    assert ring(0.2) > 0.0


def test_our_nodes_are_timed_while_they_run(alone):
    assert distributed.nodes("fast", 2000) > 0.0


def test_axes_run_at_once():
    assert distributed.axes(2, 1000, "fast") > 0.0


def test_composed_loop_empty_loop_and_executor_thread_are_compared(alone):
    ticks = []
    part = composed.measure(TINY, lambda: ticks.append(1))
    told = figures(part.rows, ["composed"])["composed"]
    assert tuple(told) == KEYS["composed"]
    assert None not in told.values()
    assert 0.0 <= told["missed_fraction"] <= 1.0
    rows = {row.name: row.value for row in part.rows}
    assert rows["composed.lost"] == 0
    assert len(ticks) == composed.steps(TINY)
    assert set(part.curves["lateness"]) == {"loop", "empty loop"}


def test_memory_is_compared_from_soon_after_the_start_to_the_end():
    watched = [(float(i), 100.0 if i < 10 else 200.0 + (i >= 90) * 10.0) for i in range(100)]
    assert memory.grown(watched) == pytest.approx(1.05)


@pytest.mark.alone
@pytest.mark.skipif(not shutil.which("cc"), reason="compiled drivers need a C compiler")
def test_the_exchange_with_a_device_in_another_process_is_timed(alone):
    empty = hardware.empty("registers_emulated", 0.1)
    assert empty.deadlines.samples == 2000
    assert 0.0 < empty.exchange_p50 <= empty.exchange_p999
    assert 0.0 <= empty.missed <= 1.0


@pytest.mark.alone
def test_a_loop_on_a_device_is_timed(alone):
    found = hardware.loop("e727_200hz_emulated", 0.2)
    assert found.deadlines.samples == 40
    assert found.lost == 0


@pytest.mark.alone
def test_commands_over_the_graph_are_counted(alone):
    sets = ("plant.safety.stale_samples=400", "T_s=0.01", "plant.safety.jump_um=10")
    assert 0.0 <= hardware.graph("e727_200hz_emulated", 0.2, sets) <= 1.0
