"""Kernels are kept where nobody else can write, and run where they cannot be kept at all."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numba
import pytest

import pea_engine
from pea_engine.compiled import Kernel, own


def function(x: float) -> float:
    return 2.0 * x


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """Let numba keep what it compiles in a directory of the test's own."""
    there = tmp_path / "kept"
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(there))
    return there


def files(there: Path) -> list[Path]:
    return [path for path in there.rglob("*.nb?") if path.is_file()]


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
    assert only[0] == "compiled.py"
    assert "cache=kept" in only[1]


def test_where_it_cannot_be_kept_it_runs(kept):
    kept.write_text("no directory")
    assert Kernel(function)(1.5) == 3.0


def test_where_there_is_no_room_it_runs(kept, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("numba.core.caching.IndexDataCacheFile.save", full)
    assert Kernel(function)(1.5) == 3.0


@pytest.mark.parametrize("damage", [b"", b"damaged", b"\x80\x04\x95"])
def test_what_is_damaged_is_made_anew(kept, damage):
    assert Kernel(function)(1.5) == 3.0
    for path in files(kept):
        path.write_bytes(damage)
    assert Kernel(function)(2.5) == 5.0


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
