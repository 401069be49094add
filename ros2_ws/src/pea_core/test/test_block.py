from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest

from pea_core.block import Block, Signal, changed
from pea_core.params import ParameterError, build, choice, flatten, group, param
from pea_core.registry import registry
from pea_core.signals import Reference

T_s = 0.5


@dataclass(frozen=True)
class Params:
    """A lag y' = (y + gain x) / 2 in toy form."""

    gain: float = param(2.0, "", -10.0, 10.0, help="gain")
    lags: tuple[float, ...] = param((1.0, 2.0), "s", 0.0, 10.0, help="lags", fixed=True)
    seed: int = param(1, "", 0, 100, help="seed", fixed=True)
    delayed: bool = param(False, help="delay", fixed=True)


class Coefficients(NamedTuple):
    gain_T: float


class State(NamedTuple):
    total: float


def design(params: Params, T_s: float) -> Coefficients:
    if params.gain == 0.0:
        raise ParameterError("gain = 0: must not vanish")
    return Coefficients(params.gain * T_s)


def start(c: Coefficients) -> State:
    return State(0.0)


def output(c: Coefficients, s: State, x: float) -> float:
    return s.total + c.gain_T * x


def update(c: Coefficients, s: State, x: float, out: float, *realised: float) -> State:
    return State(out - sum(realised))


LAG = SimpleNamespace(Params=Params, design=design, start=start, output=output, update=update)


# Block


def test_block_starts_designed_for_its_sample_period():
    block = Block(LAG, Params(gain=3.0), T_s)
    assert (block.c, block.s) == (Coefficients(1.5), State(0.0))


def test_block_that_cannot_be_designed_is_refused():
    with pytest.raises(ParameterError, match="gain = 0: must not vanish"):
        Block(LAG, Params(gain=0.0), T_s)


def test_output_changes_no_state():
    block = Block(LAG, Params(), T_s)
    assert [block.output(7.0), block.output(7.0)] == [7.0, 7.0]
    assert block.s == State(0.0)


def test_update_commits_the_output_last_computed():
    block = Block(LAG, Params(), T_s)
    block.output(100.0)
    block.output(3.0)
    block.update()
    assert block.s == State(3.0)


def test_update_is_told_what_came_of_the_output():
    block = Block(LAG, Params(), T_s)
    block.output(3.0)
    block.update(2.5)
    assert block.s == State(0.5)


def test_update_hands_the_model_the_last_signals_in_order():
    seen: list[Any] = []
    model = SimpleNamespace(
        design=lambda params, T_s: "c",
        start=lambda c: "s",
        output=lambda c, s, *signals: "out",
        update=lambda *arguments: seen.append(arguments),
    )
    block = Block(model, None, T_s)
    block.output("W of", "another", "sample")
    block.output("W", "W_ff", "x")
    block.update("u")
    assert seen == [("c", "s", "W", "W_ff", "x", "out", "u")]


def test_update_before_any_output_is_a_mistake():
    with pytest.raises(AssertionError):
        Block(LAG, Params(), T_s).update()


def test_retune_takes_effect_on_the_next_signal():
    block = Block(LAG, Params(), T_s)
    block.output(3.0)
    block.retune(Params(gain=6.0))
    assert block.output(4.0) - block.output(3.0) == 6.0 * T_s


def test_retune_before_the_first_sample_is_as_if_built_so():
    block = Block(LAG, Params(), T_s)
    block.retune(Params(gain=6.0))
    fresh = Block(LAG, Params(gain=6.0), T_s)
    assert (block.c, block.s, block.params) == (fresh.c, fresh.s, fresh.params)


def test_retune_keeps_the_state():
    block = Block(LAG, Params(), T_s)
    block.output(3.0)
    block.update()
    block.retune(Params(gain=6.0))
    assert (block.s, block.c) == (State(3.0), Coefficients(3.0))


def test_retune_with_the_same_parameters_changes_nothing():
    block = Block(LAG, Params(), T_s)
    block.output(3.0)
    block.update()
    before = (block.c, block.s, block.params)
    block.retune(Params())
    assert (block.c, block.s, block.params) == before


def test_retune_that_fails_leaves_everything_as_it_was():
    def refuse(*_: Any) -> Any:
        raise ParameterError("gain = 9: not today")

    model = SimpleNamespace(**vars(LAG))
    block = Block(model, Params(), T_s)
    block.output(3.0)
    block.update()
    before = (block.c, block.s, block.params)
    model.design = refuse
    with pytest.raises(ParameterError, match="not today"):
        block.retune(Params(gain=9.0))
    assert (block.c, block.s, block.params) == before


# Signal


def level(c: float, k: int) -> Reference:
    return Reference(c * k, c, 0.0)


RAMP = SimpleNamespace(Params=Params, output=level, design=lambda p, T_s: design(p, T_s).gain_T)


def test_signal_is_a_function_of_the_sample_number():
    signal = Signal(RAMP, Params(), T_s)
    assert [signal.at(k).w for k in (5, 0, 5)] == [5.0, 0.0, 5.0]


def test_signal_is_retuned_whole():
    signal = Signal(RAMP, Params(), T_s)
    signal.retune(Params(gain=4.0))
    assert (signal.at(5).w, signal.params) == (10.0, Params(gain=4.0))


def test_signal_that_cannot_be_retuned_stays():
    signal = Signal(RAMP, Params(), T_s)
    with pytest.raises(ParameterError, match="must not vanish"):
        signal.retune(Params(gain=0.0))
    assert (signal.at(5).w, signal.params) == (5.0, Params())


# Trying parameters before they are swapped in


@pytest.mark.parametrize(("kind", "model"), [(Block, LAG), (Signal, RAMP)])
def test_try_design_refuses_what_cannot_be_designed(kind, model):
    with pytest.raises(ParameterError, match="must not vanish"):
        kind(model, Params(), T_s).try_design(Params(gain=0.0))


@pytest.mark.parametrize(("kind", "model"), [(Block, LAG), (Signal, RAMP)])
def test_try_design_changes_nothing(kind, model):
    tried, other = kind(model, Params(), T_s), kind(model, Params(), T_s)
    tried.try_design(Params(gain=4.0))
    assert (tried.c, tried.params) == (other.c, other.params)


# Registry


def test_registry_offers_each_models_parameters():
    @dataclass(frozen=True)
    class Other:
        pass

    offered = registry("toys", {"lag": LAG, "other": SimpleNamespace(Params=Other)}, "lag", "toys")
    assert offered.kinds == {"lag": Params, "other": Other}
    assert (offered.default, offered.spec.help) == ("lag", "toys")
    assert offered.type_of(Other()) == "other"


# Changes while the loop runs


@dataclass(frozen=True)
class Nothing:
    pass


@dataclass(frozen=True)
class Plant:
    K: float = param(0.142, "um/V", 1e-6, 1e3, help="gain")
    low: float = param(0.0, "V", -100.0, 100.0, help="lowest")
    high: float = param(1.0, "V", -100.0, 100.0, help="highest")
    lag: Params = group(Params)
    hysteresis: Any = choice({"none": Nothing, "lag": Params}, "lag", help="H")

    def __post_init__(self) -> None:
        if self.low >= self.high:
            raise ParameterError(f"low = {self.low:g}: must be below high ({self.high:g} V)")


PLANT = Plant(K=0.1, lag=Params(gain=5.0))


def test_changed_changes_what_is_named_alone():
    got = changed(Plant, PLANT, {"K": 0.2, "lag.gain": 6})
    assert got == Plant(K=0.2, lag=Params(gain=6.0))


def test_changed_leaves_its_argument_alone():
    changed(Plant, PLANT, {"K": 0.2})
    assert PLANT.K == 0.1


def test_changed_takes_values_that_fit_only_together():
    got = changed(Plant, PLANT, {"low": 5.0, "high": 6.0})
    assert (got.low, got.high) == (5.0, 6.0)


def test_changed_checks_the_values_as_a_whole():
    with pytest.raises(ParameterError, match="low = 5: must be below high"):
        changed(Plant, PLANT, {"low": 5.0})


@pytest.mark.parametrize(
    ("name", "value", "old"),
    [
        ("lag.seed", 2, "1"),
        ("lag.delayed", True, "False"),
        ("lag.lags", [1.0, 3.0], "(1.0, 2.0)"),
        ("hysteresis.type", "none", "'lag'"),
    ],
)
def test_changed_refuses_what_is_fixed(name, value, old):
    with pytest.raises(ParameterError) as caught:
        changed(Plant, PLANT, {name: value})
    assert str(caught.value) == (
        f"{name} = {old} is fixed while the loop runs: stop the loop to change it"
    )


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("lag.seed", "1"),
        ("lag.seed", 1.0),
        ("lag.lags", [1, 2]),
        ("lag.lags", (1.0, 2.0)),
        ("hysteresis.type", "lag"),
        ("lag.delayed", False),
    ],
)
def test_changed_takes_a_fixed_value_that_stays_in_any_spelling(name, value):
    assert changed(Plant, PLANT, {name: value, "K": 0.3}) == replace(PLANT, K=0.3)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"k": 1.0}, "unknown parameter k: did you mean K?"),
        ({"lag.seed": True}, "lag.seed = True: give a number, 0 to 100"),
        ({"lag.seed": 101}, "lag.seed = 101: must be 0 to 100"),
        ({"hysteresis.type": "lug"}, "hysteresis.type = 'lug': did you mean lag?"),
        ({"K": float("nan")}, "K = nan: must be finite, 1e-06 to 1000 um/V"),
    ],
)
def test_changed_refuses_what_build_refuses(values, message):
    with pytest.raises(ParameterError) as caught:
        changed(Plant, PLANT, values)
    assert str(caught.value) == message


def test_changed_with_every_value_as_it_is_gives_the_same():
    assert (
        changed(Plant, PLANT, flatten(Plant, PLANT)) == PLANT == build(Plant, flatten(Plant, PLANT))
    )
