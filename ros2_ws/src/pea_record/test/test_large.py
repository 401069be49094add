"""Arrays of long recordings."""

import errno

import numpy as np
import pytest

from pea_record import large


@pytest.fixture
def small_limit(monkeypatch):
    monkeypatch.setattr(large, "LIMIT", 1000)


def mapped(array: np.ndarray) -> bool:
    while array.base is not None and isinstance(array.base, np.ndarray):
        if isinstance(array, np.memmap):
            return True
        array = array.base
    return isinstance(array, np.memmap)


@pytest.mark.parametrize("sizes", [(3, 5), (40, 1, 300, 7), (0, 200)])
def test_rows_come_back_in_order_whether_in_memory_or_in_a_file(small_limit, sizes):
    rng = np.random.default_rng(1)
    pieces = [rng.random((n, 3)) for n in sizes]
    growing = large.Growing(float, 3)
    for piece in pieces:
        growing.add(piece)
    assert len(growing) == sum(sizes)
    np.testing.assert_array_equal(growing.whole(), np.concatenate(pieces))
    growing.add(pieces[0])
    np.testing.assert_array_equal(growing.whole(), np.concatenate([*pieces, pieces[0]]))


def test_only_a_large_array_lies_in_a_file(small_limit):
    assert not mapped(large.empty(125))
    array = large.empty((42, 3))
    assert mapped(array)
    array[:] = 1.0
    assert array.sum() == 126.0


def test_a_full_disk_means_memory(small_limit, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(large.os, "posix_fallocate", full)
    assert not mapped(large.empty(1000))


def test_files_have_no_name(small_limit, monkeypatch, tmp_path):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(large.tempfile, "tempdir", None)
    array = large.empty(1000)
    array[:] = 0.0
    assert not list(tmp_path.iterdir())


def test_pieces_hold_each_row_once_and_give_back_what_lies_in_a_file(small_limit, monkeypatch):
    monkeypatch.setattr(large, "PIECE", 7)
    array = large.empty((42, 3))
    for part in large.pieces(42, array):
        array[part] = np.arange(part.start, part.stop)[:, None]
    np.testing.assert_array_equal(array[:, 0], np.arange(42.0))
    neighbours = list(large.pieces(15, before=1))
    assert [(p.start, p.stop) for p in neighbours] == [(0, 7), (6, 14), (13, 15)]
    assert large.same(array[:, 0], np.arange(42.0))
    assert not large.same(array[:, 0], np.arange(42.0) + (np.arange(42) == 41))
