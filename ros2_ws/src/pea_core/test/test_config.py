"""How sources of values add up: a preset, a type and single values, from weak to strong."""

from dataclasses import dataclass
from typing import ClassVar

import pytest

from pea_core import config
from pea_core.config import Source, replaced, resolve
from pea_core.params import Choice, ParameterError, param


@dataclass(frozen=True)
class Slow:
    K: float = param(1.0, "", 0.0, 9.0, help="of the stage", common=True)
    gain: float = param(1.0, "", 0.0, 9.0, help="its own")


@dataclass(frozen=True)
class Fast:
    K: float = param(1.0, "", 0.0, 9.0, help="of the stage", common=True)
    gain: float = param(2.0, "", 0.0, 9.0, help="its own")
    boost: float = param(3.0, "", 0.0, 9.0, help="its own")


@dataclass(frozen=True)
class Keen:
    PRESET: ClassVar[str] = "keen"
    gain: float = param(2.0, "", 0.0, 9.0, help="its own")


LAWS = Choice({"slow": Slow, "fast": Fast, "keen": Keen}, "slow", "the law")

PRESETS = {
    "calm": {"type": "slow", "gain": 0.5},
    "brisk": {"type": "fast", "gain": 4.0},
    "bare": {"type": "fast"},
    "keen": {"type": "keen", "gain": 8.5},
    "mild": {"type": "keen", "gain": 0.1},
    "gain_only": {"gain": 7.0},
    "sampled": {"type": "slow", "T_s": 1e-3},
    "stage": {"type": "slow", "K": 5.0},
}


OF_FILE = config.preset_values


@pytest.fixture(autouse=True)
def presets(monkeypatch):
    monkeypatch.setattr(config, "preset_values", lambda node, name, *more: dict(PRESETS[name]))


def values(*sources):
    return resolve("controller", LAWS, sources).values


def in_force(*sources):
    found = values(*sources)
    return {name: found[name] for name in found if name not in ("T_s", "axes", "changed_by")}


def test_a_preset_of_a_stronger_source_replaces_type_and_gains_and_keeps_the_stage():
    file = {"type": "fast", "gain": 8.0, "boost": 8.0, "K": 5.0}
    assert in_force(file, {"preset": "calm"}) == {
        "preset": "calm",
        "type": "slow",
        "K": 5.0,
        "gain": 0.5,
    }


def test_a_preset_of_the_same_type_leaves_no_gain_of_the_weaker_source():
    found = in_force({"type": "fast", "gain": 8.0, "boost": 8.0}, {"preset": "bare"})
    assert (found["gain"], found["boost"]) == (2.0, 3.0)


def test_a_preset_that_is_replaced_leaves_nothing_behind():
    stage, sampled = {"preset": "stage"}, {"preset": "sampled"}
    assert in_force(stage, {"preset": "calm"})["K"] == 1.0
    assert in_force(stage, {"preset": "gain_only"}) == {
        "preset": "gain_only",
        "type": "slow",
        "K": 1.0,
        "gain": 7.0,
    }
    assert values(sampled, {"preset": "calm"})["T_s"] == values()["T_s"]
    assert in_force(stage, {"K": 5.0}, {"preset": "calm"})["K"] == 5.0
    assert values(sampled, {"T_s": 1e-3}, {"preset": "calm"})["T_s"] == 1e-3


def test_values_beside_a_preset_are_laid_over_it():
    assert in_force({"preset": "brisk", "boost": 1.0})["boost"] == 1.0
    assert in_force({"preset": "brisk"}, {"boost": 1.0})["gain"] == 4.0


def test_a_type_of_a_stronger_source_replaces_the_preset():
    found = in_force({"preset": "brisk", "K": 5.0}, {"type": "slow"})
    assert found == {"preset": "", "type": "slow", "K": 5.0, "gain": 1.0}


def test_a_type_that_is_in_force_already_changes_nothing():
    assert in_force({"preset": "brisk"}, {"type": "fast"}) == in_force({"preset": "brisk"})
    anew = in_force({"preset": "brisk"}, Source({"type": "fast"}, anew=True))
    assert anew["gain"] == 2.0


def typed(**given):
    return Source(given, "the command line", typed=True)


@pytest.mark.parametrize("file", [{"type": "fast", "gain": 1.0}, {"preset": "mild"}, {}])
def test_a_type_that_is_typed_alone_comes_with_its_own_preset(file):
    assert in_force(file, typed(type="keen")) == {"preset": "keen", "type": "keen", "gain": 8.5}
    assert in_force(file, typed(type="keen", gain=1.0))["gain"] == 1.0


def test_a_type_that_is_typed_with_a_preset_or_without_its_own_comes_with_none():
    assert in_force(typed(type="keen", preset="mild"))["gain"] == 0.1
    assert in_force(typed(type="keen", preset=""))["gain"] == 2.0
    assert in_force({"preset": "calm"}, typed(type="fast"))["gain"] == 2.0
    assert in_force({"type": "keen"})["gain"] == 2.0  # a file says what it says


def test_single_values_of_the_type_that_is_typed_stay():
    found = in_force({"preset": "mild", "gain": 3.0}, typed(type="keen"))
    assert found == {"preset": "keen", "type": "keen", "gain": 3.0}
    again = in_force({"gain": 3.0}, {"type": "keen"}, {"gain": 4.0}, {"preset": "mild"})
    assert again["gain"] == 0.1
    anew = in_force({"type": "keen", "gain": 3.0}, typed(type="keen")._replace(anew=True))
    assert anew["gain"] == 8.5


def test_the_strongest_preset_counts():
    found = in_force({"preset": "brisk"}, {"preset": "calm"}, {"K": 2.0})
    assert (found["preset"], found["type"], found["K"]) == ("calm", "slow", 2.0)


def test_a_preset_and_another_type_from_one_source_are_refused():
    with pytest.raises(ParameterError) as error:
        values(Source({"preset": "brisk", "type": "slow"}, "my.yaml"))
    assert str(error.value) == (
        "controller.type = 'slow' and controller.preset = 'brisk', both from my.yaml: the preset "
        "is of type fast; give one of them"
    )


@pytest.mark.parametrize(("kind", "inner"), [("pid", "smc"), ("smc", "precise")])
def test_a_file_of_a_preset_that_names_another_type_beside_a_preset_is_refused(
    tmp_path, kind, inner
):
    file = tmp_path / "mine.yaml"
    config.write(file, {"controller": {"type": kind, "preset": inner}})
    with pytest.raises(ParameterError, match=rf"type '{kind}' and preset '{inner}', which is of"):
        OF_FILE("controller", str(file))
    config.write(file, {"controller": {"type": "smc", "preset": "smc", "m": 1234.0}})
    assert OF_FILE("controller", str(file))["m"] == 1234.0


def test_a_preset_and_its_own_type_from_one_source_agree():
    assert in_force({"preset": "brisk", "type": "fast"})["gain"] == 4.0


def test_a_preset_without_a_type_gives_gains_to_the_type_in_force():
    assert in_force({"type": "fast", "preset": "gain_only"})["gain"] == 7.0
    assert in_force({"type": "fast"}, {"preset": "gain_only"})["type"] == "fast"


def test_a_preset_beside_every_value_is_refused_where_it_would_have_no_effect():
    whole = {"type": "fast", "K": 1.0, "gain": 4.0, "boost": 3.0}
    assert in_force({**whole, "preset": "brisk"})["gain"] == 4.0
    with pytest.raises(ParameterError, match=r"gives gain = 4\.0, .* gain = 1\.0: the preset"):
        values({**whole, "gain": 1.0, "preset": "brisk"})


def test_the_sample_period_of_a_preset_is_in_force():
    assert values({"preset": "sampled"})["T_s"] == 1e-3
    assert values({"preset": "sampled", "T_s": 2e-3})["T_s"] == 2e-3


def test_what_a_source_gives_is_told():
    assert resolve("controller", LAWS, [{"preset": "brisk"}]).given == {"type", "gain"}


def test_a_source_over_a_running_node_names_all_that_its_preset_replaces():
    assert replaced("controller", LAWS, {"preset": "bare"}) == {
        "type": "fast",
        "gain": 2.0,
        "boost": 3.0,
    }
    assert replaced("controller", LAWS, {"gain": 2.5}) == {"gain": 2.5}
