"""Kernels are kept where nobody else can write, and run where they cannot be kept at all."""

from __future__ import annotations

import concurrent.futures
import multiprocessing
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numba
import pytest

import pea_engine
from pea_core.paths import own
from pea_engine import callee
from pea_engine.kernel import Kernel, open_sources


def function(x: float) -> float:
    return 2.0 * x


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """Let numba keep what it compiles in a directory of the test's own."""
    there = tmp_path / "kept"
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(there))
    return there


def files(there: Path) -> list[Path]:
    return [path for path in there.rglob("*") if path.is_file()]


def test_a_kernel_is_kept(kept):
    assert Kernel(function)(1.5) == 3.0
    assert files(kept)


def test_nothing_is_compiled_but_by_a_kernel():
    """So what holds for one here holds in every mode, for sweeps, replay and the dashboard."""
    sources = Path(pea_engine.__file__).resolve().parents[2]
    makes = re.compile(r"\b(njit|jit|vectorize|guvectorize|cfunc|stencil)\(")
    found = [
        (path.name, line.strip())
        for path in sources.glob("*/pea_*/**/*.py")
        for line in path.read_text(encoding="utf-8").splitlines()
        if makes.search(line)
    ]
    (only,) = found
    assert only[0] == "kernel.py"


def test_where_it_cannot_be_kept_it_runs(kept):
    kept.write_text("no directory")
    assert Kernel(function)(1.5) == 3.0


def test_where_there_is_no_room_it_runs(kept, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pea_engine.kept.Path.write_bytes", full)
    assert Kernel(function)(1.5) == 3.0
    assert not files(kept)


@pytest.mark.parametrize("damage", [b"", b"damaged", b"\x80\x04\x95"])
def test_what_is_damaged_is_made_anew(kept, damage):
    assert Kernel(function)(1.5) == 3.0
    for path in files(kept):
        path.write_bytes(damage)
    assert Kernel(function)(2.5) == 5.0


def times(factor: float) -> Callable[[float], float]:
    def product(x: float) -> float:
        return factor * x

    return product


def test_one_is_never_run_for_another(kept):
    """Their types and their text are the same; what they close over is not."""
    assert Kernel(times(2.0))(1.5) == 3.0
    (first,) = files(kept)
    assert Kernel(times(3.0))(1.5) == 4.5
    second = next(path for path in files(kept) if path != first)
    second.write_bytes(first.read_bytes())
    assert Kernel(times(3.0))(1.5) == 4.5


def test_processes_that_keep_at_once_do_not_take_each_other_s(kept):
    factors = range(2, 8)
    context = multiprocessing.get_context("fork")
    with concurrent.futures.ProcessPoolExecutor(2, context) as pool:
        made = list(pool.map(_product, [str(kept)] * len(factors), factors))
    assert made == [1.5 * factor for factor in factors]
    assert len(files(kept)) == len(factors)
    for factor in factors:
        kernel = Kernel(times(float(factor)))
        assert kernel(1.5) == 1.5 * factor
        assert kernel.compiled.stats.cache_hits


def _product(kept: str, factor: int) -> float:
    numba.config.CACHE_DIR = kept
    return Kernel(times(float(factor)))(1.5)


def test_what_an_older_text_left_is_taken_away(kept, monkeypatch):
    assert Kernel(function)(1.5) == 3.0
    before = files(kept)
    monkeypatch.setattr("pea_engine.kept.numba.__version__", "0")
    assert Kernel(function)(1.5) == 3.0
    assert len(files(kept)) == 1
    assert files(kept) != before


@pytest.mark.parametrize("known", [(numba.version_info.short,), ()])
def test_what_a_kernel_calls_is_compiled_by_any_numba(kept, monkeypatch, known):
    monkeypatch.setattr(callee, "KNOWN", known)
    assert ("pipeline_class" in callee.options()) == bool(known)

    def inner(x: float) -> float:
        return 2.0 * x

    def outer(x: float) -> float:
        return inner(x) + 1.0

    open_sources(outer)

    def kernel(x: float) -> float:
        return outer(x)

    assert Kernel(kernel)(1.5) == 4.0


def test_an_error_of_what_a_kernel_calls_comes_out(kept):
    def divide(x: float) -> float:
        return 1.0 / x

    open_sources(divide)

    def kernel(x: float) -> float:
        return divide(x)

    for _ in range(2):
        with pytest.raises(ZeroDivisionError):
            Kernel(kernel)(0.0)


def test_where_others_can_write_nothing_is_kept_nor_run(kept):
    assert Kernel(function)(1.5) == 3.0
    (there,) = {path.parent for path in files(kept)}
    before = {path: path.stat().st_mtime_ns for path in files(kept)}
    there.chmod(0o777)
    kernel = Kernel(function)
    assert kernel(1.5) == 3.0
    assert not kernel.compiled.stats.cache_hits
    assert {path: path.stat().st_mtime_ns for path in files(kept)} == before


def test_a_directory_of_another_user_is_not_our_own(tmp_path):
    assert own(tmp_path)
    assert own(tmp_path / "not there yet")
    if os.geteuid() == 0:
        os.chown(tmp_path, 12345, -1)
        assert not own(tmp_path)


HELD = """
import threading, time
from llvmlite.binding import ffi
import pea_engine.callee

def work():
    with ffi.lib._lock:  # as every call of LLVM does
        begun.set()
        time.sleep(0.3)
        print("whole", flush=True)

begun = threading.Event()
threading.Thread(target=work, daemon=True).start()
begun.wait()
"""


def test_a_process_does_not_end_while_llvm_is_at_work():
    done = subprocess.run([sys.executable, "-c", HELD], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, "whole\n"), done.stderr
