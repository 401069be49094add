"""Replays of long recordings are compiled: the same bits as in plain Python."""

import numpy as np
import pytest

from pea_core.block import changed
from pea_engine.compiled import SWITCH
from pea_experiment import experiments
from pea_experiment.experiment import SCHEMAS
from pea_record.bag import BagWriter
from pea_record.origin import ORIGIN, origin
from pea_record.read import load
from pea_record.rows import NOTHING, ahead, record
from pea_report import recorded, replay
from pea_wire import events
from pea_wire.topics import PARAMETER_EVENTS

T_NS = 50_000
N = 3000
CHANGES = {
    400: ("controller", {"P": 0.0123456789, "preview_samples": 2.5}),
    1010: ("observer", {"noise_nm": 1.1}),
    1020: ("controller", {"P": 0.004}),
}


@pytest.fixture(scope="module", params=[True, False], ids=["preview known", "preview ends"])
def bag(request, tmp_path_factory):
    """A run whose parameters change; its reference ends with it, or reaches beyond."""
    directory = tmp_path_factory.mktemp("run") / "bag"
    sets = ("controller.preview_samples=1.5", "plant.sensor.ideal=false")
    sets += ("plant.sensor.noise_nm=2.0",)
    what = experiments.load(
        "fig9_hysteresis_10hz", sets, N * T_NS * 1e-9, None, {"observer": "kalman"}
    )
    loop = what.loop()
    with BagWriter(directory, T_NS) as writer:
        writer.metadata(ORIGIN, origin(what.name, what.sections(), "batch", T_NS))
        for k in range(0, N, 10):
            if k in CHANGES:
                node, values = CHANGES[k]
                block = getattr(loop, node)
                block.retune(changed(SCHEMAS[node], block.planned, values))
                event = events.encode(k * T_NS, f"/pea/{node}", values)
                writer.write(PARAMETER_EVENTS, k * T_NS, event)
            rows = loop.run(10)
            record(writer, k, T_NS, rows, ahead(loop) if request.param and loop.k == N else NOTHING)
    return directory


def again(bag, through, monkeypatch, switch, sets=()):
    monkeypatch.setenv(SWITCH, switch)
    recording = load(bag)
    what = recorded.experiment_of(recording, bag, sets)
    decided = replay.asked(sets, {}, through)
    return replay.replay(recording, what, bag, through, decided)


@pytest.mark.parametrize("through", replay.THROUGH)
def test_compiled_replay_is_the_plain_one_to_the_bit(bag, through, monkeypatch):
    plain = again(bag, through, monkeypatch, "0")
    compiled = again(bag, through, monkeypatch, "1")

    assert compiled.samples.tobytes() == plain.samples.tobytes()
    assert (compiled.first, compiled.changes) == (plain.first, plain.changes) == (
        None, {"observer": 1, "controller": 2, "both": 3}[through]
    )  # fmt: skip
    assert N - 3 <= len(plain.samples) <= N


def test_compiled_replay_tells_what_would_have_been_said_alike(bag, monkeypatch):
    sets = ("controller.P=0.02", "controller.preview_samples=3")
    plain = again(bag, "both", monkeypatch, "0", sets)
    compiled = again(bag, "both", monkeypatch, "1", sets)

    assert plain.first is not None
    assert compiled.first == plain.first
    assert compiled.samples.tobytes() == plain.samples.tobytes()


def test_compiled_replay_is_what_runs(bag, monkeypatch):
    """Not a test of nothing: the kernels are called."""
    called = []
    kernel = replay.law_kernel
    monkeypatch.setattr(replay, "law_kernel", lambda law: called.append(law) or kernel(law))

    found = again(bag, "controller", monkeypatch, "1")

    assert called
    assert np.isfinite(found.samples["u"]).all()
