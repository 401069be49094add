import math
from array import array
from dataclasses import FrozenInstanceError, dataclass, fields, make_dataclass
from fractions import Fraction
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from pea_core.params import (
    Choice,
    ParameterError,
    Spec,
    build,
    choice,
    flatten,
    group,
    layer,
    nearest,
    param,
    specs,
)


@dataclass(frozen=True)
class Linear:
    pass


@dataclass(frozen=True)
class BoucWen:
    alpha: float = param(0.35, "", 0.0, 1.0, help="slope")
    gain: float = param(1.0, "", 0.0, 10.0, help="shared name")


@dataclass(frozen=True)
class Play:
    thresholds: tuple[float, ...] = param((0.0, 1.5), "V", 0.0, 40.0, help="thresholds")
    gain: float = param(2.0, "", 0.0, 10.0, help="shared name")


KINDS = {"none": Linear, "bouc_wen": BoucWen, "play": Play}


@dataclass(frozen=True)
class Sensor:
    noise_nm: float = param(0.0, "nm", 0.0, 1e6, help="noise")
    ideal: bool = param(False, help="ideal")

    def __post_init__(self) -> None:
        if self.ideal and self.noise_nm > 0.0:
            raise ParameterError(f"noise_nm = {self.noise_nm:g}: an ideal sensor has none")


@dataclass(frozen=True)
class Plant:
    omega_n: float = param(5450.0, "rad/s", 1.0, 1e6, help="frequency")
    K: float = param(0.142, "um/V", 1e-6, 1e3, help="gain")
    seed: int = param(1, "", 0, 2**31 - 1, help="seed", fixed=True)
    port: str = param("sim", help="device")
    mode: str = param("voltage", help="drive", choices=("voltage", "charge"))
    hysteresis: Any = choice(KINDS, "none", help="H")
    sensor: Sensor = group(Sensor)


PLANT = Choice({"actuator": Plant, "still": Linear}, "actuator", "a choice that holds a choice")


def refusal(schema: Any, values: Any, where: str = "") -> str:
    with pytest.raises(ParameterError) as caught:
        build(schema, values, where)
    return str(caught.value)


# Values of one parameter


@pytest.mark.parametrize("value", [1.0, 1e6, 1, "1", "1e6", " 2.5 "])
def test_float_takes_numbers_and_their_text_up_to_both_ends(value):
    omega_n = build(Plant, {"omega_n": value}).omega_n
    assert type(omega_n) is float
    assert omega_n == float(value)


def test_small_number_as_yaml_1_1_reads_it():
    assert build(BoucWen, {"alpha": "1e-8"}).alpha == 1e-8


@pytest.mark.parametrize("value", [math.nextafter(1.0, 0.0), math.nextafter(1e6, 2e6), -5450.0, 0])
def test_number_outside_the_range_is_refused_with_value_rule_and_unit(value):
    assert refusal(Plant, {"omega_n": value}) == f"omega_n = {value}: must be 1 to 1e+06 rad/s"


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, "nan", "inf", "1e400", 10**400])
def test_number_that_is_not_finite_is_refused(value):
    message = refusal(Plant, {"omega_n": value})
    assert message.startswith("omega_n = ")
    assert message.endswith(": must be finite, 1 to 1e+06 rad/s")


@pytest.mark.parametrize("value", [None, [], {}, "", "fast", "1,5", "0x10", 1j, True, False])
@pytest.mark.parametrize("name", ["omega_n", "seed"])
def test_what_is_no_number_is_refused_and_a_bool_is_none(name, value):
    assert refusal(Plant, {name: value}).startswith(f"{name} = {value!r}: give a number, ")


@pytest.mark.parametrize("value", [7, 7.0, "7", "7.0"])
def test_whole_number_takes_any_spelling_and_is_an_int(value):
    seed = build(Plant, {"seed": value}).seed
    assert type(seed) is int
    assert seed == 7


@pytest.mark.parametrize("value", [7.5, "7.5", 1e-9])
def test_whole_number_refuses_a_fraction(value):
    assert "must be a whole number, 0 to 2147483647" in refusal(Plant, {"seed": value})


def test_range_is_written_so_that_it_does_not_contradict_the_value():
    assert refusal(Plant, {"seed": 2**31}) == "seed = 2147483648: must be 0 to 2147483647"


@pytest.mark.parametrize("value", [0, 1, 1.0, "true", "yes", None, []])
def test_bool_takes_nothing_else(value):
    assert refusal(Sensor, {"ideal": value}) == f"ideal = {value!r}: give true or false"


@pytest.mark.parametrize("value", [True, False])
def test_bool_is_kept(value):
    assert build(Sensor, {"ideal": value}).ideal is value


def test_a_whole_number_is_a_name_where_text_is_asked_for():
    assert build(Plant, {"port": 7}).port == "7"


@pytest.mark.parametrize("value", [1.5, True, None, ["sim"]])
def test_text_takes_nothing_else(value):
    assert refusal(Plant, {"port": value}) == f"port = {value!r}: give text"


def test_one_of_several_texts_names_the_nearest():
    assert refusal(Plant, {"mode": "volt"}) == "mode = 'volt': did you mean voltage?"


def test_one_of_several_texts_names_them_all_where_none_is_near():
    assert refusal(Plant, {"mode": "x"}) == "mode = 'x': known: charge, voltage"


def test_one_of_several_texts_says_so_to_what_is_no_text():
    assert refusal(Plant, {"mode": 3}) == "mode = 3: give one of voltage, charge"


def test_off_is_a_word_where_it_is_one_of_several():
    spec = Spec(choices=("off", "warn"), kind=str)
    assert spec.check("guard", yaml.safe_load("off")) == "off"
    with pytest.raises(ParameterError, match="guard = True: give one of off, warn"):
        spec.check("guard", yaml.safe_load("on"))


@pytest.mark.parametrize(
    "value", [[0, 2], (0.0, 2.0), ["0", "2e0"], array("d", [0.0, 2.0]), [0, Fraction(2)]]
)
def test_list_of_numbers_becomes_a_tuple_of_floats(value):
    thresholds = build(Play, {"thresholds": value}).thresholds
    assert thresholds == (0.0, 2.0)
    assert [type(x) for x in thresholds] == [float, float]


def test_list_of_numbers_may_be_empty():
    assert build(Play, {"thresholds": []}).thresholds == ()


@pytest.mark.parametrize("value", ["0,2", "0", 2.0, None, {0: 1.0}, {1.0, 2.0}])
def test_list_of_numbers_takes_nothing_else(value):
    message = refusal(Play, {"thresholds": value})
    assert message == f"thresholds = {value!r}: give a list of numbers, each 0 to 40 V"


@pytest.mark.parametrize(
    ("item", "rule"),
    [
        (41.0, "must be 0 to 40 V"),
        (math.nan, "must be finite, 0 to 40 V"),
        (True, "give a number, 0 to 40 V"),
        ([1.0], "give a number, 0 to 40 V"),
    ],
)
def test_list_of_numbers_names_the_item_that_breaks_the_rule(item, rule):
    assert refusal(Play, {"thresholds": [0.0, item]}) == f"thresholds[1] = {item!r}: {rule}"


@pytest.mark.parametrize(
    ("spec", "rule"),
    [
        (Spec("V", -20.0, 110.0), "-20 to 110 V"),
        (Spec("V", low=0.0), "at least 0 V"),
        (Spec("V", high=110.0), "at most 110 V"),
        (Spec("V"), "a finite number V"),
        (Spec(kind=int), "a whole number"),
        (Spec(kind=bool), "true or false"),
        (Spec(kind=str), "text"),
        (Spec(kind=str, choices=("a", "b")), "one of a, b"),
    ],
)
def test_rule_in_words(spec, rule):
    assert spec.rule == rule


@pytest.mark.parametrize(("spec", "value"), [(Spec(low=0.0), -1.0), (Spec(high=0.0), 1.0)])
def test_range_with_one_end_is_kept(spec, value):
    assert spec.check("x", -value) == -value
    with pytest.raises(ParameterError, match=f"x = {value}: must be at (least|most) 0"):
        spec.check("x", value)


def test_default_outside_its_own_range_cannot_be_declared():
    with pytest.raises(ParameterError, match=r"default = 2\.0: must be 0 to 1"):
        param(2.0, "", 0.0, 1.0, help="wrong")


def test_parameters_cannot_be_overwritten():
    with pytest.raises(FrozenInstanceError):
        build(Plant, {}).K = 1.0


# Names


def test_nothing_named_gives_the_defaults():
    assert build(Plant, {}) == Plant()


def test_group_takes_dotted_names():
    assert build(Plant, {"sensor.noise_nm": 0.7}).sensor == Sensor(noise_nm=0.7)


def test_unknown_name_names_the_nearest():
    assert refusal(Plant, {"omega": 1.0}) == "unknown parameter omega: did you mean omega_n?"


def test_unknown_name_names_the_nearest_in_a_group_as_it_must_be_typed():
    message = refusal(Plant, {"noise_nm": 1.0}, "plant.")
    assert message == ("unknown parameter plant.noise_nm: did you mean plant.sensor.noise_nm?")


def test_unknown_name_that_differs_in_case_alone_names_that_one():
    assert refusal(Plant, {"k": 1.0}) == "unknown parameter k: did you mean K?"


def test_unknown_name_lists_all_where_none_is_near():
    assert nearest("zzz", ["P", "I"]) == "known: I, P"


def test_unknown_name_of_a_block_without_parameters():
    assert refusal(Linear, {"a": 1}) == "unknown parameter a: it takes none"


@pytest.mark.parametrize("chosen", [{}, {"hysteresis.type": "play"}])
@pytest.mark.parametrize("value", ["bouc_wen", {"type": "bouc_wen"}, None])
def test_group_with_a_type_given_as_a_whole_says_to_give_the_type(value, chosen):
    message = refusal(Plant, {"hysteresis": value, **chosen}, "plant.")
    assert message == (
        "unknown parameter plant.hysteresis: it is a group; give plant.hysteresis.type"
    )


def test_group_given_as_a_whole_names_its_parameters():
    message = refusal(Plant, {"sensor": {"noise_nm": 1.0}})
    assert message == (
        "unknown parameter sensor: it is a group; give sensor.noise_nm or sensor.ideal"
    )


@pytest.mark.parametrize("chosen", [{}, {"hysteresis.type": "none"}])
def test_parameter_of_another_type_names_that_type(chosen):
    message = refusal(Plant, {**chosen, "hysteresis.alpha": 0.3}, "plant.")
    assert message == (
        "unknown parameter plant.hysteresis.alpha: "
        "it belongs to plant.hysteresis.type = bouc_wen, and the type is none"
    )


def test_parameter_of_several_other_types_names_them():
    assert "= bouc_wen or play, and the type is none" in refusal(Plant, {"hysteresis.gain": 1.0})


def test_parameter_of_another_type_at_the_top():
    message = refusal(PLANT, {"type": "still", "K": 0.1})
    assert message == ("unknown parameter K: it belongs to type = actuator, and the type is still")


def test_unknown_type_is_named_first_whatever_is_said_under_it():
    values = {"hysteresis.alpha": math.nan, "hysteresis.type": "bouc_wem", "hysteresis.x": 1}
    assert refusal(Plant, values) == "hysteresis.type = 'bouc_wem': did you mean bouc_wen?"


@pytest.mark.parametrize("value", [None, 1, True, ["play"]])
def test_type_that_is_no_text_is_refused(value):
    assert refusal(Plant, {"hysteresis.type": value}) == (
        f"hysteresis.type = {value!r}: give one of none, bouc_wen, play"
    )


@pytest.mark.parametrize("name", [True, 1, None, 2.5])
def test_name_that_yaml_did_not_read_as_text_is_an_unknown_parameter(name):
    assert refusal(Plant, {name: 1}, "plant.").startswith(f"unknown parameter plant.{name}: ")


@pytest.mark.parametrize("name", ["", ".", "sensor.", ".sensor", "sensor..ideal", "K.K", "type"])
def test_name_that_is_nearly_one_is_unknown(name):
    assert refusal(Plant, {name: 1}).startswith(f"unknown parameter {name}: ")


def test_rule_between_values_is_reported_with_the_group_before_it():
    message = refusal(Plant, {"sensor.ideal": True, "sensor.noise_nm": 0.7}, "plant.")
    assert message == "plant.sensor.noise_nm = 0.7: an ideal sensor has none"


def test_value_in_a_group_is_reported_with_the_group_before_it():
    message = refusal(Plant, {"sensor.noise_nm": -1.0}, "plant.")
    assert message == "plant.sensor.noise_nm = -1.0: must be 0 to 1e+06 nm"


# What people may type


@given(
    name=st.text(max_size=200) | st.sampled_from(["K", "seed", "port", "mode", "hysteresis.type"]),
    value=st.text(max_size=200) | st.integers() | st.floats() | st.lists(st.text()) | st.none(),
)
@settings(deadline=None)
def test_error_is_one_short_line_whatever_is_typed(name, value):
    try:
        build(Plant, {name: value}, "plant.")
    except ParameterError as error:
        assert str(error).isprintable()  # noqa: PT017
        assert len(str(error)) < 400  # noqa: PT017


@pytest.mark.parametrize("value", ["nan\n", "1e9\r\n", "a\x1b[31mb", "\u2028", "\ud800"])
def test_control_characters_in_a_value_are_shown_escaped(value):
    message = refusal(Plant, {"omega_n": value})
    assert message.startswith(f"omega_n = {value!r}: ")
    assert message.isprintable()


def test_control_characters_in_a_name_are_shown_escaped():
    assert refusal(Plant, {"a\nb\x1b": 1}).startswith(r"unknown parameter a\nb\x1b: ")


def test_control_characters_in_the_message_of_a_model_are_shown_escaped():
    assert str(ParameterError("file = a\nb: not found")) == r"file = a\nb: not found"


@pytest.mark.parametrize(
    "value",
    ["z" * 100_000, [0.0] * 100_000, 10**5000, -(10**4000)],
    ids=["text", "list", "integer too long to write", "integer"],
)
def test_very_long_value_is_cut(value):
    assert len(refusal(Plant, {"omega_n": value})) < 150


def test_very_long_name_is_cut():
    assert len(refusal(Plant, {"z" * 100_000: 1})) < 300


# Specs


def test_specs_follow_the_chosen_type():
    names = specs(Plant, {"hysteresis.type": "play"})
    assert list(names)[5:] == [
        "hysteresis.type",
        "hysteresis.thresholds",
        "hysteresis.gain",
        "sensor.noise_nm",
        "sensor.ideal",
    ]


def test_specs_carry_what_was_declared():
    spec = specs(Plant)["seed"]
    assert spec == Spec("", 0, 2**31 - 1, (), True, "seed", int, 1)


def test_type_of_a_choice_is_fixed_and_one_of_its_names():
    spec = specs(Plant)["hysteresis.type"]
    assert (spec.fixed, spec.choices, spec.default, spec.kind) == (True, tuple(KINDS), "none", str)


def test_two_types_with_one_dataclass_are_refused():
    with pytest.raises(ValueError, match="a, b: each type needs a dataclass of its own"):
        Choice({"a": BoucWen, "b": BoucWen}, "a", "cannot be distinguished")


def test_parameters_of_a_foreign_type_have_no_type():
    with pytest.raises(TypeError, match="is no type of none, bouc_wen, play"):
        Choice(KINDS, "none", "H").type_of(Sensor())


# Layers


def test_layer_lays_the_new_over_the_base():
    assert layer(Plant, {"K": 0.1, "seed": 2}, {"K": 0.2}) == {"K": 0.2, "seed": 2}


def test_layer_leaves_its_arguments_alone():
    base, new = (
        {"hysteresis.type": "bouc_wen", "hysteresis.alpha": 0.1},
        {"hysteresis.type": "none"},
    )
    layer(Plant, base, new)
    assert (len(base), len(new)) == (2, 1)


def test_layer_drops_what_was_said_of_the_old_type():
    base = {"K": 0.1, "hysteresis.type": "bouc_wen", "hysteresis.alpha": 0.1}
    merged = layer(Plant, base, {"hysteresis.type": "play"})
    assert merged == {"K": 0.1, "hysteresis.type": "play"}


def test_layer_drops_what_was_said_of_the_default_type():
    merged = layer(PLANT, {"K": 0.1, "sensor.ideal": True}, {"type": "still"})
    assert merged == {"type": "still"}


def test_another_type_begins_at_its_defaults_also_where_a_name_is_the_same():
    base = {"hysteresis.type": "bouc_wen", "hysteresis.gain": 3.0}
    built = build(Plant, layer(Plant, base, {"hysteresis.type": "play"}))
    assert built.hysteresis.gain == Play().gain


def test_a_common_value_stays_when_the_type_changes():
    @dataclass(frozen=True)
    class One:
        limit: float = param(1.0, "V", 0.0, 9.0, help="of both", common=True)
        gain: float = param(1.0, "", 0.0, 9.0, help="its own")

    @dataclass(frozen=True)
    class Two:
        limit: float = param(2.0, "V", 0.0, 9.0, help="of both", common=True)
        gain: float = param(2.0, "", 0.0, 9.0, help="its own")

    schema = Choice({"one": One, "two": Two}, "one", "")
    merged = layer(schema, {"limit": 5.0, "gain": 5.0}, {"type": "two"})
    assert build(schema, merged) == Two(limit=5.0, gain=2.0)


def test_a_preset_begins_its_type_anew_and_a_layer_does_not():
    base = {"K": 0.1, "hysteresis.type": "bouc_wen", "hysteresis.alpha": 0.1}
    new = {"hysteresis.type": "bouc_wen"}
    assert layer(Plant, base, new) == base
    assert layer(Plant, base, new, anew=True) == {"K": 0.1, **new}


def test_layer_drops_what_the_new_type_declares_otherwise():
    @dataclass(frozen=True)
    class Narrow:
        gain: float = param(1.0, "", 0.0, 1.0, help="shared name, other range")

    schema = Choice({"bouc_wen": BoucWen, "narrow": Narrow}, "bouc_wen", "")
    assert layer(schema, {"gain": 5.0}, {"type": "narrow"}) == {"type": "narrow"}


def test_layer_keeps_the_values_of_a_type_that_stays():
    base = {"hysteresis.type": "bouc_wen", "hysteresis.alpha": 0.1}
    new = {"hysteresis.type": "bouc_wen", "K": 0.2}
    assert layer(Plant, base, new) == {**base, **new}


def test_layer_keeps_new_values_that_do_not_fit_for_build_to_refuse():
    base = {"hysteresis.type": "bouc_wen"}
    merged = layer(Plant, base, {"hysteresis.type": "none", "hysteresis.alpha": 0.1})
    assert "it belongs to hysteresis.type = bouc_wen" in refusal(Plant, merged)


def test_layer_does_not_hide_a_misspelt_name_when_the_type_changes():
    merged = layer(PLANT, {"omega": 1.0}, {"type": "still"})
    assert refusal(PLANT, merged).startswith("unknown parameter omega")


@pytest.mark.parametrize("name", [1, True])
def test_layer_keeps_a_name_that_is_no_text_for_build_to_refuse(name):
    merged = layer(Plant, {name: 1}, {"hysteresis.type": "play"})
    assert refusal(Plant, merged).startswith(f"unknown parameter {name}")


def test_layer_refuses_an_unknown_type_by_its_full_name():
    with pytest.raises(ParameterError, match=r"^plant\.hysteresis\.type = 'pley': did you mean pl"):
        layer(Plant, {}, {"hysteresis.type": "pley"}, "plant.")


# Made-up schemas

SOME = settings(deadline=None, max_examples=25)

NAMES = st.sampled_from(["a", "b", "K", "m", "omega_n", "x_1", "gain"])


@st.composite
def leaves(draw: st.DrawFn) -> Any:
    """A declared parameter of some kind."""
    kind = draw(st.sampled_from(["bool", "int", "float", "free", "str", "one_of", "tuple"]))
    fixed = draw(st.booleans())
    if kind == "bool":
        return param(draw(st.booleans()), help="", fixed=fixed)
    if kind == "str":
        return param(draw(st.text(max_size=5)), help="", fixed=fixed)
    if kind == "one_of":
        return param("up", help="", choices=("up", "down", "off"), fixed=fixed)
    if kind == "free":
        return param(0.0, help="", fixed=fixed)
    if kind == "int":
        low, high = sorted(draw(st.tuples(st.integers(-1000, 1000), st.integers(-1000, 1000))))
        return param(low, "", low, high, help="", fixed=fixed)
    ends = st.floats(-1e9, 1e9)
    low, high = sorted(draw(st.tuples(ends, ends)))
    return param(
        (low,) * draw(st.integers(0, 2)) if kind == "tuple" else high,
        "V",
        low,
        high,
        help="",
        fixed=fixed,
    )


@st.composite
def dataclasses_of(draw: st.DrawFn, depth: int) -> type:
    """A parameter dataclass, with groups and choices inside down to `depth`."""
    declared = []
    for name in draw(st.lists(NAMES, unique=True, max_size=3)):
        what = draw(st.sampled_from(["leaf", "group", "choice"] if depth else ["leaf"]))
        if what == "leaf":
            field = draw(leaves())
        elif what == "group":
            field = group(draw(dataclasses_of(depth - 1)))
        else:
            kinds = draw(kinds_of(depth - 1))
            field = choice(kinds, draw(st.sampled_from(list(kinds))), help="")
        declared.append((name, Any, field))
    return make_dataclass("Made", declared, frozen=True)


def kinds_of(depth: int) -> Any:
    """Dataclass of each type of a choice."""
    types = st.sampled_from(["none", "bouc_wen", "play", "pid"])
    return st.dictionaries(types, dataclasses_of(depth), min_size=1, max_size=2)


@st.composite
def schemas(draw: st.DrawFn) -> Any:
    """A dataclass, or a choice of them."""
    if draw(st.booleans()):
        return draw(dataclasses_of(2))
    kinds = draw(kinds_of(2))
    return Choice(kinds, draw(st.sampled_from(list(kinds))), "")


def values_of(spec: Spec) -> Any:
    """Values that keep the rule."""
    if spec.choices:
        return st.sampled_from(spec.choices)
    if spec.kind is int:
        return st.integers(int(spec.low or 0), int(spec.high or 0))
    floats = st.floats(spec.low, spec.high, allow_nan=False, allow_infinity=False)
    return {
        bool: st.booleans(),
        str: st.text(max_size=5),
        float: floats,
        tuple: st.lists(floats, max_size=3).map(tuple),
    }[spec.kind]


def instance(draw: st.DrawFn, schema: Any) -> Any:
    """Parameters made by calling the dataclasses themselves."""
    kind = schema
    if isinstance(schema, Choice):
        kind = schema.kinds[draw(st.sampled_from(list(schema.kinds)))]
    return kind(
        **{
            field.name: instance(draw, field.metadata["group"])
            if "group" in field.metadata
            else draw(values_of(field.metadata["spec"]))
            for field in fields(kind)
        }
    )


@st.composite
def schema_and_params(draw: st.DrawFn, count: int) -> Any:
    schema = draw(schemas())
    return schema, *(instance(draw, schema) for _ in range(count))


@given(schema_and_params(1))
@SOME
def test_build_makes_again_what_flatten_took_apart(case):
    schema, x = case
    again = build(schema, flatten(schema, x))
    assert again == x
    assert repr(again) == repr(x)  # types too: 1 is not 1.0


@given(schema_and_params(1))
@SOME
def test_flatten_names_what_specs_name(case):
    schema, x = case
    flat = flatten(schema, x)
    assert list(flat) == list(specs(schema, flat))


@given(schema_and_params(1))
@SOME
def test_numbers_survive_as_text(case):
    schema, x = case
    flat = flatten(schema, x)
    text = {name: repr(v) if type(v) in (int, float) else v for name, v in flat.items()}
    assert build(schema, text) == x


@given(schema_and_params(2))
@SOME
def test_whole_layer_wins_over_any_base(case):
    schema, x, y = case
    assert build(schema, layer(schema, flatten(schema, x), flatten(schema, y))) == y


@given(schema_and_params(2))
@SOME
def test_types_alone_can_be_changed_over_any_base(case):
    schema, x, y = case
    types = {n: v for n, v in flatten(schema, y).items() if n == "type" or n.endswith(".type")}
    built = flatten(schema, build(schema, layer(schema, flatten(schema, x), types)))
    assert {name: built[name] for name in types} == types


@given(schema_and_params(1))
@SOME
def test_defaults_in_the_specs_are_those_that_build_takes(case):
    schema, x = case
    types = {n: v for n, v in flatten(schema, x).items() if n == "type" or n.endswith(".type")}
    flat = flatten(schema, build(schema, types))
    defaults = {name: spec.default for name, spec in specs(schema, types).items()}
    assert flat == {**defaults, **types}


def test_nearest_names_what_starts_with_the_word():
    assert nearest("fig9", ["fig8_initial", "fig9_hysteresis", "sine"]) == (
        "did you mean fig9_hysteresis?"
    )
