"""What the commands print can be read at every width."""

import io

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from rich.box import SIMPLE_HEAD
from rich.table import Table

from pea_core.console import Console

WORD = st.text("abcdefghijklm0123456789.-_", min_size=1, max_size=30)
CELL = st.lists(WORD, min_size=1, max_size=4).map(" ".join)


def printed(width, table):
    console = Console(file=io.StringIO(), width=width, soft_wrap=True, highlight=False)
    console.print(table)
    return console.file.getvalue()


@settings(max_examples=30, deadline=None)
@example(rows=[["0", "0 0", "00000000000"]], width=20, simple=False)
@given(
    rows=st.integers(1, 4).flatmap(
        lambda n: st.lists(st.lists(CELL, min_size=n, max_size=n), min_size=1, max_size=4)
    ),
    width=st.sampled_from([20, 40, 60, 80, 120]),
    simple=st.booleans(),
)
def test_a_table_breaks_no_word_at_any_width(rows, width, simple):
    table = Table(*rows[0], **({"box": SIMPLE_HEAD} if simple else {}))
    for row in rows[1:]:
        table.add_row(*row)
    lines = printed(width, table)
    words = "".join(c if c.isascii() else " " for c in lines).split()
    cells = {word for row in rows for cell in row for word in cell.split()}
    assert set(words) == cells
    others = sorted(word for row in rows for cell in row[1:] for word in cell.split())
    first = [word for row in rows for word in row[0].split()]
    tables = (len(words) - len(others)) // len(first)  # each has the first column
    assert sorted(words) == sorted([*others, *first * tables])


@pytest.mark.parametrize("width", [40, 60, 80])
def test_a_number_is_whole_beside_a_long_name(width):
    table = Table("", "before", "found", title="fig10", title_justify="left")
    table.add_row("gain margin at the actuator", "123.456789", "0.000123457")
    table.add_row("controller.learning_frequency_hz", "1.23457e-08", "-0.000123457")
    shown = printed(width, table)
    assert "controller.learning_frequency_hz" in shown
    assert all(number in shown for number in ("123.456789", "1.23457e-08", "-0.000123457"))


def test_a_table_of_too_many_columns_is_several_that_fit():
    axes = [f"axis_{i}" for i in range(12)]
    table = Table("", *axes, title="stage", title_justify="left")
    table.add_row("largest pole", *(f"0.{i:05}" for i in range(12)))
    shown = printed(80, table)
    assert max(map(len, shown.splitlines())) <= 80
    assert shown.count("largest pole") == 2
    assert shown.count("stage") == 1
    assert all(axis in shown for axis in axes)
    assert all(f"0.{i:05}" in shown for i in range(12))


def test_a_table_that_fits_is_as_narrow_as_the_terminal():
    table = Table("", "value")
    table.add_row("a long description " * 8, "0.000123457")
    assert max(map(len, printed(60, table).splitlines())) == 60
