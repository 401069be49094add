"""YAML that a recording holds of itself is read within bounds."""

from __future__ import annotations

import pytest

from pea_record.origin import MAPPING_MAX, mapping


def test_a_mapping_is_read():
    assert mapping("/pea/plant:\n  ros__parameters: {K: 0.1, seed: 1}\n") == {
        "/pea/plant": {"ros__parameters": {"K": 0.1, "seed": 1}}
    }


@pytest.mark.timeout(20)
@pytest.mark.parametrize(
    "text",
    [
        "a0: &a0 x\n" + "".join(f"a{i}: &a{i} [{f'*a{i - 1}, ' * 9}]\n" for i in range(1, 30)),
        "[" * 100_000,
        "{a: " * 1000,
        "a: 1\n" * MAPPING_MAX,
        "&a {x: *a}",
        "just words",
        "\x00",
    ],
    ids=["aliases", "lists", "mappings", "long", "of itself", "words", "no text"],
)
def test_what_costs_too_much_or_is_none_is_empty(text):
    assert mapping(text) == {}


@pytest.mark.parametrize("tag", ["timestamp", "bool", "int", "float", "set", "omap"])
def test_a_tag_whose_text_is_not_of_its_kind_maps_nothing(tag):
    assert mapping(f"K: !!{tag} '%'") == {}
