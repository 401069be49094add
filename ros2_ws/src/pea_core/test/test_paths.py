"""Files that somebody names, read whole."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from pea_core import parameter_file, tables
from pea_core.params import ParameterError
from pea_core.paths import TEXT_MAX, bytes_of


@pytest.fixture(params=["zero", "fifo", "huge", "folder"])
def odd(request, tmp_path) -> Path:
    """What can be opened, and is no file to read whole."""
    path = tmp_path / "odd"
    match request.param:
        case "zero":
            return Path("/dev/zero")
        case "fifo":
            os.mkfifo(path)
        case "huge":
            with path.open("wb") as file:
                file.truncate(1 << 30)  # sparse: it takes no room
        case "folder":
            path.mkdir()
    return path


def test_a_table_is_a_file_of_bounded_size(odd):
    with pytest.raises(ParameterError, match=r"^reference\.path = odd: .+$"):
        tables.read(odd, "reference.path = odd", tables.LENGTH)


def test_a_parameter_file_is_a_file_of_bounded_size(odd):
    with pytest.raises(ParameterError, match=f"^{odd}: .+$"):
        parameter_file.sections(odd)


def test_a_file_may_have_as_many_bytes_as_said(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(bytes(8))
    assert bytes_of(path, 8) == bytes(8)
    with pytest.raises(ParameterError, match="has 8 bytes, more than 7"):
        bytes_of(path, 7)


def test_a_file_that_grows_is_bounded():
    path = Path("/proc/self/maps")  # says that it has no byte
    assert path.stat().st_size == 0
    with pytest.raises(ParameterError, match="more than 10"):
        bytes_of(path, 10)
    assert TEXT_MAX > len(bytes_of(path)) > 10
