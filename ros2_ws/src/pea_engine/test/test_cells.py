"""What is put into a cell comes back, and compiled code finds it there."""

import os
import subprocess
import sys
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

cells = pytest.importorskip("pea_engine.cells", reason="needs numba")
from pea_core.injection import off  # noqa: E402
from pea_core.live import Coefficients  # noqa: E402
from pea_core.signals import Estimate  # noqa: E402
from pea_engine.kernel import compile_kernel  # noqa: E402

Cell, get, put = cells.Cell, cells.get, cells.put


def value(k=3, on=True, rate=1.5, past=(1.0, 2.0)):
    return k, Coefficients((on, np.array(past)), rate, off(5e-5)), (Estimate(rate, -rate, 0.0), k)


@pytest.fixture(scope="module")
def cell():
    return Cell(value())


@settings(max_examples=50, deadline=None)
@given(
    k=st.integers(-(2**63), 2**63 - 1),
    on=st.booleans(),
    rate=st.floats(allow_nan=False),
    past=st.lists(st.floats(allow_nan=False), max_size=9),
)
def test_what_is_put_in_comes_back(cell, k, on, rate, past):
    before = value(k, on, rate, past)
    cell.value = before
    after = cell.value
    assert (after[0], after[2], after[1].share) == (k, before[2], rate)
    assert type(after[1]) is Coefficients
    assert type(after[2][0]) is Estimate
    assert after[1].c[0] is on
    assert np.array_equal(after[1].c[1], before[1].c[1])


def test_arrays_stay_where_they_are(cell):
    before = value()
    cell.value = before
    before[1].c[1][0] = 7.0
    assert cell.value[1].c[1][0] == 7.0


def test_compiled_code_keeps_its_values_from_call_to_call(cell):
    def step(address, like):
        k, inner, rest = get(address, like)
        inner.c[1][0] += inner.share
        put(address, (k + 1, inner, rest))
        return k

    before = value(k=40)
    cell.value = before
    kernel = compile_kernel(step)
    assert [kernel.again(cell.address, cell.like) for _ in range(3)] == [40, 41, 42]
    assert cell.value[0] == 43
    assert before[1].c[1][0] == 1.0 + 3 * 1.5


def test_kernels_of_a_package_that_is_gone_are_no_hindrance(tmp_path):
    (tmp_path / "lab.py").write_text(
        "from typing import NamedTuple\nclass Own(NamedTuple):\n    a: float\n"
    )
    lines = "from pea_engine.cells import Cell; print(Cell({}).value)"
    cache = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    path = f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"

    def told(text, **environment):
        command = [sys.executable, "-c", text]
        return subprocess.check_output(command, env={**cache, **environment}, text=True)

    assert told("import lab; " + lines.format("(lab.Own(1.0),)"), PYTHONPATH=path)
    assert told(lines.format("(1.0, 2)")) == "(1.0, 2)\n"


def namesake(first):
    """A NamedTuple of the name and the shape of others, with a field of its own name."""
    return NamedTuple("Coefficients", [(first, float), ("B2", float)])


def test_namesakes_of_one_shape_are_kept_apart():
    values = [namesake(name)(float(i), 0.5) for i, name in enumerate("mpq")]
    kept = [Cell((value, 1)) for value in values]
    assert [type(cell.value[0]) for cell in kept] == [type(value) for value in values]
    assert len({cell.like.kind for cell in kept}) == len(values)
