"""Time series in text files: heads, units, separators, decimal commas, encodings, time of day."""

import contextlib
from decimal import Decimal

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pea_core import tables
from pea_core.params import ParameterError
from pea_core.tables import LENGTH, TIME

SOME = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.fixture
def read(tmp_path):
    count = iter(range(10**6))

    def of(text, quantity=LENGTH, encoding="utf-8"):
        path = tmp_path / f"{next(count)}.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode(encoding))
        return tables.read(path, "path = 'w.csv'", quantity)

    return of


def refusal(read, text, quantity=LENGTH):
    with pytest.raises(ParameterError) as error:
        read(text, quantity)
    assert "\n" not in str(error.value)
    return str(error.value)


STYLES = ("{name} ({unit})", "{name} [{unit}]", "{name}_{unit}", "{name} / {unit}", "{name} {unit}")
ENCODINGS = ("utf-8", "utf-8-sig", "cp1252", "utf-16")
numbers = st.decimals(Decimal(-10), Decimal(10), places=4)


@given(
    st.lists(numbers, min_size=2, max_size=6),
    st.sampled_from(list(TIME.units)),
    st.sampled_from(list(LENGTH.units)),
    st.sampled_from(STYLES),
    st.sampled_from([(",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ","), ("  ", ".")]),
    st.sampled_from(ENCODINGS),
    st.sampled_from(["\n", "\r\n"]),
    st.sampled_from(["", "# measured on a bench\n", "\n"]),
)
@SOME
def test_what_is_written_comes_back(read, values, t, y, style, dialect, encoding, end, before):
    if encoding == "cp1252":
        t, y = (unit.replace("\N{GREEK SMALL LETTER MU}", "u") for unit in (t, y))
    separator, point = dialect
    rows = [(Decimal(i) / 8, value) for i, value in enumerate(values)]
    if separator == "  ":  # a name of two words would be two columns
        style = "{name}_{unit}"
    text = separator.join([style.format(name="t", unit=t), style.format(name="pos", unit=y)])
    for row in rows:
        text += "\n" + separator.join(f"{x:f}".replace(".", point) for x in row)
    table = read((before + text).replace("\n", end), encoding=encoding)
    assert table.time.tolist() == [float(a * TIME.units[t]) for a, _ in rows]
    assert table.value.tolist() == [float(b * LENGTH.units[y]) for _, b in rows]
    assert f"time in {t} (" in table.understood
    assert f"w in {y} (" in table.understood


def test_without_a_head_the_units_are_assumed_and_said(read):
    table = read("0,0\n0.5,2\n")
    assert (table.time.tolist(), table.value.tolist()) == ([0.0, 0.5], [0.0, 2.0])
    assert table.understood == (
        "2 lines of time in s (assumed) and w in um (assumed); comma, UTF-8"
    )


@pytest.mark.parametrize("first", ["0.000000,", ",0", "0", "0,zero", "0,1,2"])
def test_a_first_row_with_a_number_is_no_head(read, first):
    assert refusal(read, f"{first}\n0,1\n1,2\n").startswith(
        "path = 'w.csv': line 1 must be two numbers, time (s) and w (um), not "
    )


@pytest.mark.parametrize(
    ("text", "time", "value"),
    [
        ("Time (ms),Position (nm)\n0,0\n1,1000\n", 1e-3, 1.0),
        ("t [s],y [m]\n0,0\n1,1e-6\n", 1.0, 1.0),
        ("Time,Position\nms,nm\n0,0\n1,1000\n", 1e-3, 1.0),
        ("# t (ms), w (nm)\n0 0\n1 1000\n", 1e-3, 1.0),
        ("# made (twice), by me\n0 0\n1 1\n", 1.0, 1.0),
        ('"Time, all (ms)","Weg (nm)"\n"0,5","0,5"\n"1,5","1000,5"\n', 1e-3, 1.0005),
        ("sep=;\nt;w\n0;0\n1;1\n", 1.0, 1.0),
        ("TIME (MS);W (NM)\n0;0\n1;1000\n", 1e-3, 1.0),
        ("milliseconds\tnanometers\n0\t0\n1\t1000\n", 1e-3, 1.0),
    ],
)
def test_heads_of_other_programs(read, text, time, value):
    table = read(text)
    assert (table.time[-1], table.value[-1]) == (time, value)


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("Time (hours),w\n0,0\n1,1\n", "line 1 has a time in none of s, ms, us"),
        ("t (s),w (V)\n0,0\n1,1\n", "line 1 has a w in none of m, mm, um"),
        ("w (nm),t (ms)\n0,0\n1,1\n", "line 1 has a time in none of s, ms, us"),
        ("position,time\n0,0\n1,1\n", "line 1 has time second: it must be the first column"),
        ("t (ms),w\ns,um\n0,0\n1,1\n", "line 2 contradicts 't (ms)' above it"),
        ("# t (hours), w (nm)\n0,0\n1,1\n", "line 1 has a time in none of s, ms, us"),
        ("1,250;1,500\n2,250;2,500\n", "line 1 has 1,250: a decimal comma or thousands?"),
        ("t,w,z\n0,1\n1,2\n", "line 1 must be two names, or two numbers, not 't,w,z'"),
        ("0,0\n1,nan\n", "line 2 is not finite"),
        ("0,0\n1,1e999\n", "line 2 is not finite"),
        ("0,0\n1_0,1\n", "line 2 must be two numbers"),
        ("time,w\n", "has no line of two numbers"),
        (b"\x00\x01\x02", "is no text of separated values"),
    ],
)
def test_what_has_two_meanings_or_none_is_refused(read, text, rule):
    assert rule in refusal(read, text)


@pytest.mark.parametrize("day", ["1732900000", "1732900000.123456789", "86399.999"])
def test_a_time_of_day_loses_nothing(read, day):
    steps = [Decimal(k) * Decimal("0.00005") for k in range(20)]
    plain = read("".join(f"{t},0\n" for t in steps))
    late = read("".join(f"{Decimal(day) + t},0\n" for t in steps))
    assert np.array_equal(plain.time, late.time)
    assert f"time counts from {day} s" in late.understood


@given(st.binary(max_size=60))
@SOME
def test_any_bytes_are_read_or_refused(read, data):
    with contextlib.suppress(ParameterError):
        table = read(data)
        assert len(table.time) == len(table.value) > 0
