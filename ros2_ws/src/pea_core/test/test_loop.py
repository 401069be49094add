import gc
import math
import weakref
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pea_core.block import Block, Signal
from pea_core.loop import CHUNK, PREVIEW_MAX, Horizon, Loop, LoopFault, blocks_of, trace
from pea_core.signals import SAMPLE, Estimate, Measurement, Reference, between

T_s = 50e-6
OMEGA = 2.0 * math.pi * 150.0


def sine(k: float) -> Reference:
    s, c = math.sin(OMEGA * k * T_s), math.cos(OMEGA * k * T_s)
    return Reference(s, OMEGA * c, -OMEGA * OMEGA * s)


class Points(list):  # a list that can be referred to weakly
    pass


def horizon(*lengths: int) -> Horizon:
    """A horizon that knows a sine, sent in chunks of these lengths."""
    known = Horizon(T_s)
    for n in lengths:
        known.extend(known.end, Points(sine(known.end + i) for i in range(n)))
    return known


# Horizon


def test_horizon_is_empty_at_first():
    assert horizon().end == 0
    assert not horizon().knows(0)


@pytest.mark.parametrize("k", [19, 0, 21, 40])
def test_gap_or_repeat_is_named_with_both_numbers(k):
    with pytest.raises(LoopFault, match=f"^reference: expected sample 20, got {k}$"):
        horizon(10, 10).extend(k, [sine(k)])


def test_refused_chunk_leaves_the_horizon_as_it_was():
    known = horizon(10)
    with pytest.raises(LoopFault):
        known.extend(11, [sine(11)])
    known.extend(10, [sine(10)])
    assert known.end == 11


@given(lengths=st.lists(st.integers(0, 5), max_size=12))
@settings(deadline=None)
def test_every_sample_is_found_however_it_was_cut(lengths):
    known = horizon(*lengths)
    assert [known.at(k)[0] for k in range(known.end)] == [sine(k) for k in range(sum(lengths))]


def test_samples_may_be_passed_over():
    known = horizon(3, 3, 3, 3)
    assert [known.at(k)[0] for k in (1, 7, 11)] == [sine(1), sine(7), sine(11)]


def test_no_preview_is_the_sample_itself():
    W, W_ff = horizon(3).at(2)
    assert W_ff is W


@pytest.mark.parametrize("preview", [1.0, 3.0, 0.5, 2.25, 4.5])
def test_preview_looks_ahead_across_chunk_borders(preview):
    known = horizon(4, 1, 2, 20)
    known.preview = preview
    whole = math.floor(preview)
    for k in range(10):
        a, b = sine(k + whole), sine(k + whole + 1)
        ahead = a if preview == whole else between(a, b, preview - whole, T_s)
        assert known.at(k) == (sine(k), ahead)


@pytest.mark.parametrize("preview", [0.5, 2.25, 4.5])
def test_preview_is_the_reference_at_that_time(preview):
    known = horizon(3, 30)
    known.preview = preview
    assert known.at(1)[1].w == pytest.approx(sine(1 + preview).w, abs=1e-9)


@pytest.mark.parametrize("preview", [0.0, 1.0, 4.5, PREVIEW_MAX - 0.5, float(PREVIEW_MAX)])
def test_what_the_horizon_knows_suffices_for_any_preview(preview):
    known = horizon(PREVIEW_MAX + 1)
    known.preview = preview
    assert known.knows(0)
    assert known.at(0)[0] == sine(0)


def test_horizon_does_not_know_a_sample_whose_preview_is_missing():
    assert not horizon(PREVIEW_MAX).knows(0)


@pytest.mark.parametrize("chunks", [(), (2, 3)])
def test_sample_not_known_yet_is_named(chunks):
    known = horizon(*chunks)
    k = known.end
    with pytest.raises(LoopFault, match=f"sample {k} is not known yet, only up to {k - 1}"):
        known.at(k)


def test_preview_not_known_yet_is_named():
    known = horizon(2, 3)
    known.preview = 2.5
    with pytest.raises(LoopFault, match="sample 5 is not known yet, only up to 4"):
        known.at(2)


def test_asking_too_early_loses_nothing():
    known = horizon(2, 3)
    with pytest.raises(LoopFault):
        known.at(5)
    assert known.at(0)[0] == sine(0)


def test_forgotten_sample_is_named_and_no_other_is_given_for_it():
    known = horizon(2, 3)
    known.at(3)
    with pytest.raises(LoopFault, match="sample 1 is forgotten, the first kept is 2"):
        known.at(1)


def test_horizon_goes_on_after_all_it_knew_is_used():
    known = horizon(2)
    known.at(1)
    known.extend(2, [sine(2)])
    assert known.at(2)[0] == sine(2)


def test_past_chunks_are_let_go_and_the_others_kept():
    known = Horizon(T_s)
    held = []
    for k in (0, 2, 4):
        points = Points([sine(k), sine(k + 1)])
        held.append(weakref.ref(points))
        known.extend(k, points)
    del points
    known.at(2)
    gc.collect()
    assert [chunk() is None for chunk in held] == [True, False, False]


# Loop, with blocks that record who is called when


class Recorder:
    """Blocks of a loop that write down every call."""

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []
        self.params = SimpleNamespace(preview=0.0)

    def block(self, name: str, answer: Any) -> Block:
        def output(c: Any, s: int, *signals: Any) -> Any:
            self.calls.append((name, "output", *signals))
            return answer(s)

        def update(c: Any, s: int, *signals: Any) -> int:
            self.calls.append((name, "update", *signals))
            return s + 1

        model = SimpleNamespace(
            design=lambda params, T_s: None, start=lambda c: 0, output=output, update=update
        )
        return Block(model, self.params, T_s)

    def read(self) -> Measurement:
        self.calls.append(("plant", "read"))
        return Measurement(1.0, 2.0, 3.0)

    def write(self, u: float) -> None:
        self.calls.append(("plant", "write", u))

    def loop(self) -> Loop:
        observer = self.block("observer", lambda s: Estimate(10.0 + s, 20.0, 30.0))
        controller = self.block("controller", lambda s: 40.0 + s)
        return Loop(self, observer, controller, signal(), T_s)


def signal() -> Signal:
    model = SimpleNamespace(design=lambda params, T_s: None, output=lambda c, k: sine(k))
    return Signal(model, None, T_s)


def test_every_block_computes_then_every_block_commits():
    recorder = Recorder()
    recorder.loop().run(2)
    assert [call[:2] for call in recorder.calls] == 2 * [
        ("plant", "read"),
        ("observer", "output"),
        ("controller", "output"),
        ("plant", "write"),
        ("observer", "update"),
        ("controller", "update"),
    ]


def test_every_block_gets_the_signals_of_this_sample():
    recorder = Recorder()
    loop = recorder.loop()
    loop.run(1)
    recorder.calls.clear()
    loop.run(1)
    y, x, W = Measurement(1.0, 2.0, 3.0), Estimate(11.0, 20.0, 30.0), sine(1)
    assert recorder.calls == [
        ("plant", "read"),
        ("observer", "output", y),
        ("controller", "output", W, W, x),
        ("plant", "write", 41.0),
        ("observer", "update", y, x),
        ("controller", "update", W, W, x, 41.0),
    ]


def test_rows_hold_what_every_block_said():
    rows = Recorder().loop().run(3)
    assert rows.dtype == SAMPLE
    assert rows[2].item() == (*sine(2), 1.0, 2.0, 3.0, 12.0, 20.0, 30.0, 42.0)


def test_controller_sees_the_reference_as_far_ahead_as_it_asks():
    recorder = Recorder()
    loop = recorder.loop()
    recorder.params.preview = 1.5
    loop.run(1)
    W_ff = next(call[3] for call in recorder.calls if call[:2] == ("controller", "output"))
    assert W_ff == between(sine(1), sine(2), 0.5, T_s)


def test_preview_may_change_between_two_pieces():
    recorder = Recorder()
    loop = recorder.loop()
    loop.run(1)
    recorder.params.preview = 2.0
    loop.run(1)
    seen = [call[3] for call in recorder.calls if call[:2] == ("controller", "output")]
    assert seen == [sine(0), sine(3)]


def test_reference_is_asked_for_each_sample_once_in_order():
    asked: list[int] = []
    loop = Recorder().loop()
    loop.reference = SimpleNamespace(at=lambda k: asked.append(k) or sine(k))  # type: ignore
    for n in (CHUNK, 1, CHUNK - 1, CHUNK):
        loop.run(n)
    assert asked == list(range(len(asked)))
    assert 3 * CHUNK <= len(asked) <= 5 * CHUNK


def test_reference_is_known_for_a_whole_piece_with_the_longest_preview():
    recorder = Recorder()
    recorder.params.preview = PREVIEW_MAX - 0.5
    loop = recorder.loop()
    assert [len(loop.run(n)) for n in (1, CHUNK, CHUNK - 1, CHUNK)] == [1, 1000, 999, 1000]


def test_loop_counts_its_samples():
    loop = Recorder().loop()
    loop.run(3)
    loop.run(4)
    assert loop.k == 7


def test_no_samples_are_no_rows():
    recorder = Recorder()
    assert len(recorder.loop().run(0)) == 0
    assert recorder.calls == []


def test_more_than_a_chunk_at_once_is_refused_before_anything_moves():
    recorder = Recorder()
    with pytest.raises(ValueError, match="samples = 1001: at most 1000"):
        recorder.loop().run(CHUNK + 1)
    assert recorder.calls == []


def test_fault_of_the_plant_leaves_the_sample_uncommitted():
    recorder = Recorder()
    loop = recorder.loop()
    loop.run(1)
    recorder.calls.clear()

    def refuse(u: float) -> None:
        raise LoopFault("no voltage")

    recorder.write = refuse  # type: ignore[method-assign]
    assert len(loop.run(1)) == 0
    assert str(loop.fault) == "no voltage"
    assert loop.k == 1
    assert not [call for call in recorder.calls if call[1] == "update"]


# Loop, with toy dynamics


class Saturating:
    """y follows what the amplifier lets through: y' = 0.9 y + 0.1 u_applied."""

    def __init__(self, u_max: float) -> None:
        self.u_max, self.y, self.u_applied = u_max, 0.0, 0.0

    def read(self) -> Measurement:
        return Measurement(self.y, math.nan, self.u_applied)

    def write(self, u: float) -> None:
        self.u_applied = max(-self.u_max, min(self.u_max, u))
        self.y = 0.9 * self.y + 0.1 * self.u_applied


class Held(NamedTuple):
    value: float


OBSERVER = SimpleNamespace(  # a predictor driven by the applied voltage
    design=lambda params, T_s: None,
    start=lambda c: Held(0.0),
    output=lambda c, s, y: Estimate(y.y, 0.8 * s.value + 0.1 * y.u_applied, y.y - s.value),
    update=lambda c, s, y, x: Held(x.x1 + x.x2),
)
CONTROLLER = SimpleNamespace(  # integral action on the previewed reference
    design=lambda params, T_s: None,
    start=lambda c: Held(0.0),
    output=lambda c, s, W, W_ff, x: W_ff.w + s.value - 0.01 * x.x2,
    update=lambda c, s, W, W_ff, x, u: Held(s.value + 0.1 * (W.w - x.x1)),
)


def toy(u_max: float = 1e9) -> Loop:
    controller = Block(CONTROLLER, SimpleNamespace(preview=1.5), T_s)
    return Loop(Saturating(u_max), Block(OBSERVER, None, T_s), controller, signal(), T_s)


def test_applied_voltage_comes_back_with_the_next_sample():
    rows = toy(u_max=0.5).run(200)
    assert np.abs(rows["u"]).max() > 0.5
    assert rows["u_applied"][0] == 0.0
    np.testing.assert_array_equal(rows["u_applied"][1:], np.clip(rows["u"][:-1], -0.5, 0.5))


def test_loop_closes_as_its_difference_equations_say():
    rows = toy().run(300)
    y = v = s = u = 0.0
    for k in range(300):
        y = 0.9 * y + 0.1 * u
        x2 = 0.8 * s + 0.1 * u
        u = between(sine(k + 1), sine(k + 2), 0.5, T_s).w + v - 0.01 * x2
        s, v = y + x2, v + 0.1 * (sine(k).w - y)
        assert rows[k][["y", "x2_hat", "u"]].item() == pytest.approx((y, x2, u), rel=1e-12)


@pytest.mark.parametrize(
    "pieces",
    [[1] * 30 + [970, 1000, 500], [700, 900, 900], [999, 1000, 501], [1000, 1000, 500]],
)
def test_rows_do_not_depend_on_the_pieces_of_the_run(pieces):
    whole, cut = toy(), toy()
    expected = trace([whole.run(n) for n in blocks_of(2500)])
    assert trace([cut.run(n) for n in pieces]).tobytes() == expected.tobytes()


# Pieces


@given(samples=st.integers(0, 10 * CHUNK))
@settings(deadline=None)
def test_pieces_add_up_and_none_is_empty_or_too_long(samples):
    lengths = blocks_of(samples)
    assert sum(lengths) == samples
    assert all(0 < n <= CHUNK for n in lengths)


@pytest.mark.parametrize(
    ("samples", "lengths"), [(0, []), (1, [1]), (1000, [1000]), (2500, [1000, 1000, 500])]
)
def test_pieces_are_whole_chunks_and_a_rest(samples, lengths):
    assert blocks_of(samples) == lengths


def test_trace_joins_pieces_in_order():
    loop = toy()
    pieces = [loop.run(2), loop.run(3)]
    assert trace(pieces)["w"].tolist() == [sine(k).w for k in range(5)]


def test_trace_of_nothing_has_no_rows():
    assert (trace([]).dtype, len(trace([]))) == (SAMPLE, 0)
