"""A loop is changed while it runs: the voltage does not step, whatever is changed, in any mode."""

import itertools
import math
import time

import numpy as np
import pytest

from pea_controller import model as controllers
from pea_core.block import changed
from pea_core.live import FADE, LAW, OBSERVER, WARM, Live
from pea_core.loop import PREVIEW_MAX, blocks_of
from pea_core.params import ParameterError, build, specs
from pea_core.signals import Estimate, Measurement, Reference
from pea_engine.wall import WallLoop
from pea_experiment.experiment import SCHEMAS
from pea_lab import steps
from pea_observer import model as observers

T_S = 50e-6
TOLD = math.ceil(WARM / T_S)
FADES = math.ceil(FADE / T_S)
W = Reference(3e-6, 1e-3, 2.0)
X = Estimate(2.98e-6, 1.2e-3, 4.0)


def law(**values):
    return Live(controllers.MODELS, build(controllers.CHOICE, values), T_S, LAW)


def observer(**values):
    return Live(observers.MODELS, build(observers.CHOICE, values), T_S, OBSERVER)


def told(block, n, signals):
    found = [block.output(*signals), block.update()][:1]
    for _ in range(n - 1):
        found.append(block.output(*signals))
        block.update()
    return found


def retuned(block, choice, values):
    block.retune(changed(choice, block.planned, values))


@pytest.mark.parametrize("name", controllers.MODELS)
def test_unchanged_it_has_the_bits_of_the_model(name):
    model = controllers.MODELS[name]
    live = law(type=name)
    c = model.design(model.Params(), T_S)
    s = model.start(c)
    for k in range(50):
        x = Estimate(X.x1 + 1e-9 * k, X.x2, X.eps)
        u = model.output(c, s, W, W, x)
        assert live.output(W, W, x) == u
        live.update()
        s = model.update(c, s, W, W, x, u)


def test_new_values_count_from_the_next_sample_and_start_where_the_old_ones_were():
    live, old = law(), law()
    for block in (live, old):
        told(block, 10, (W, W, X))
    retuned(live, controllers.CHOICE, {"P": 0.002})
    assert live.output(W, W, X) == pytest.approx(old.output(W, W, X), abs=1e-9)
    live.update()
    assert live.params.P == 0.002
    near = Estimate(X.x1, X.x2 + 1e-5, X.eps)
    q = 1e-5
    more = live.output(W, W, near) - live.output(W, W, X)
    less = old.output(W, W, near) - old.output(W, W, X)
    assert more - less == pytest.approx(-(0.002 - 0.0012) * 1e6 * q, rel=1e-6)


def test_what_no_integral_takes_fades():
    live, old, new = (law(type="open_loop", K=K) for K in (0.142, 0.142, 0.1))
    for block in (live, old, new):
        told(block, 5, (W, W, X))
    retuned(live, controllers.CHOICE, {"K": 0.1})
    a, b = old.output(W, W, X), new.output(W, W, X)
    u = np.array(told(live, FADES + 2, (W, W, X)))
    expected = b + (a - b) * np.clip(1.0 - np.arange(FADES + 2) / FADES, 0.0, None)
    np.testing.assert_allclose(u, expected, rtol=0.0, atol=1e-9)
    assert u[-1] == b


def test_another_type_runs_beside_until_it_takes_over():
    live, old = law(), law()
    for block in (live, old):
        told(block, 10, (W, W, X))
    retuned(live, controllers.CHOICE, {"type": "pid"})
    assert told(live, TOLD, (W, W, X)) == told(old, TOLD, (W, W, X))
    assert live.kind is controllers.MODELS["pidsmc"]
    assert live.output(W, W, X) == pytest.approx(old.output(W, W, X), abs=1e-9)
    assert live.kind is controllers.MODELS["pid"]
    assert live.params.K_p == 1.0


def test_another_observer_takes_over_with_estimates_of_its_own():
    live, new = observer(), observer(type="luenberger")
    y = [2e-6 + 1e-9 * k for k in range(TOLD + FADES + 400)]
    found = []
    for k, value in enumerate(y):
        measured = Measurement(value, math.nan, 20.0)
        if k == 100:
            retuned(live, observers.CHOICE, {"type": "luenberger"})
        found.append((live.output(measured), new.output(measured)))
        live.update()
        new.update()
    np.testing.assert_allclose(*found[-1], rtol=1e-6, atol=1e-15)
    eps = np.array([estimate.eps for estimate, _ in found])
    first = 100 + TOLD
    assert eps[first] - eps[first - 1] == pytest.approx(eps[first - 1] - eps[first - 2], rel=1e-6)
    assert np.abs(np.diff(eps[first:])).max() < 1.1 * abs(eps[first]) / FADES
    assert eps[-1] == 0.0


def test_a_type_that_is_changed_back_before_it_takes_over_never_acts():
    live, old = law(), law()
    for block in (live, old):
        told(block, 10, (W, W, X))
    retuned(live, controllers.CHOICE, {"type": "pid"})
    told(live, 100, (W, W, X))
    told(old, 100, (W, W, X))
    retuned(live, controllers.CHOICE, {"type": "pidsmc"})
    after = told(live, TOLD + 10, (W, W, X))
    assert after == pytest.approx(told(old, TOLD + 10, (W, W, X)), abs=1e-6)
    assert live.kind is controllers.MODELS["pidsmc"]


def test_values_that_cannot_be_designed_change_nothing():
    live = law(type="predictive")
    told(live, 3, (W, W, X))
    with pytest.raises(ParameterError, match="omega_o"):
        retuned(live, controllers.CHOICE, {"omega_o": 70000.0})
    assert live.coming is None


def test_before_the_first_sample_it_is_as_if_built_so():
    live = law()
    retuned(live, controllers.CHOICE, {"type": "pid", "K_p": 2.0})
    fresh = law(type="pid", K_p=2.0)
    assert live.params == fresh.params
    assert str((live.c, live.s)) == str((fresh.c, fresh.s))  # arrays answer == with arrays


# In the loop

CHANGES = {
    100: ("controller", {"P": 0.0008, "preview_samples": 2.0}),
    300: ("controller", {"type": "pid", "K_p": 8.5, "K_i": 28000.0, "K_d": 9.5e-4, "T_f": 5e-5}),
    2000: ("observer", {"omega_o": 15000.0}),
}


def run(loop, pieces):
    rows = []
    for k, end in itertools.pairwise(pieces):
        if k in CHANGES:
            node, values = CHANGES[k]
            block = getattr(loop, node)
            block.retune(changed(SCHEMAS[node], block.planned, values))
        while loop.k < end:
            rows.append(loop.run(min(1000, end - loop.k)))
    return np.concatenate(rows)


def test_changes_have_the_same_bits_compiled_and_plain():
    pytest.importorskip("numba")
    experiment = steps.tracking("recommended", "extended_state")
    pieces = [0, 100, 300, 2000, 3000]
    plain, compiled = (run(experiment.loop(each), pieces) for each in (False, True))
    assert np.isfinite(plain["u"]).all()
    assert compiled.tobytes() == plain.tobytes()


@pytest.mark.alone
def test_in_wall_time_another_type_has_the_bits_of_the_other_loop():
    pytest.importorskip("numba")
    experiment = steps.tracking("recommended", "extended_state")
    made = experiment.loop()
    blocks = made.plant, made.observer, made.controller, made.reference
    loop = WallLoop(*blocks, 200_000, 10**7)
    pieces, changes = [], []
    loop.start()
    try:
        for node, values in CHANGES.values():
            block = loop.blocks[node]
            loop.change(node, changed(SCHEMAS[node], block.planned, values))
            before = len(changes)
            while loop.alive and (len(changes) == before or block.coming is not None):
                time.sleep(0.01)
                pieces.append(loop.take().rows)
                changes += loop.changes()
                loop.feed()
    finally:
        loop.stop()
    assert loop.fault is None
    pieces.append(loop.take().rows)
    assert [change.name for change in changes] == [node for node, _ in CHANGES.values()]
    other, rows = experiment.loop(), []
    for change, end in itertools.zip_longest([None, *changes], [c.k for c in changes]):
        if change is not None:
            getattr(other, change.name).retune(change.new)
        stop = sum(map(len, pieces)) if end is None else end
        rows += [other.run(n) for n in blocks_of(stop - other.k)]
    assert np.concatenate(pieces).tobytes() == np.concatenate(rows).tobytes()


def test_in_wall_time_another_reference_begins_where_no_preview_has_looked():
    experiment = steps.tracking("recommended", "extended_state")
    made, before = experiment.loop(), experiment.loop().reference
    blocks = made.plant, made.observer, made.controller, made.reference
    loop = WallLoop(*blocks, 1_000_000, 10**6, compiled=False)
    other = changed(SCHEMAS["reference"], made.reference.planned, {"phase_deg": 60.0})
    pieces, changes = [], []
    loop.start()
    try:
        while loop.waiting < 50:
            time.sleep(0.01)
        loop.change("reference", other)
        while not changes or sum(map(len, pieces)) < changes[0].k + 2 * PREVIEW_MAX:
            time.sleep(0.01)
            pieces.append(loop.take().rows)
            changes += loop.changes()
            loop.feed()
    finally:
        loop.stop()
    w = np.concatenate(pieces)["w"]
    kept = w == [before.at(k).w for k in range(len(w))]
    begins = changes[0].k + PREVIEW_MAX
    assert kept[:begins].all()
    assert not kept[begins:].any()


@pytest.mark.parametrize(("node", "kind"), list(steps.kinds()))
def test_no_change_of_one_parameter_steps_the_voltage(node, kind):
    for found in steps.measure(node, kind):
        assert found.step <= steps.bound(found), found


def test_every_live_parameter_has_its_changes():
    for node, kind in steps.kinds():
        known = specs(SCHEMAS[node], {"type": kind})
        live = {name for name, spec in known.items() if not spec.fixed}
        assert live - steps.WITHOUT_EFFECT == set(steps.changes(node, kind))
